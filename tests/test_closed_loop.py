"""The policy in the loop beside its controls: what it sees, what it is scored for, what is read."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evaluate.closed_loop import against_paper, judge, trajectories
from evaluate.driving_score import METRICS, DrivingScoreConfig
from evaluate.loop_scores import align_conditions, score_arm, summarise
from evaluate.passenger_trips import IdealPolicy, Place, ServedPolicy, settings_of, settle
from evaluate.styles import StyleReader, drive_ranges, fit_readers, order_styles
from evaluate.trials import (
    Asking,
    Car,
    Drive,
    Trial,
    drive_arms,
    drive_proposals,
    drive_served,
    drive_written,
    plan_trials,
    sentences_of,
)
from evaluate.trips import Sentences, Setting
from evaluate.writing import MatrixWriter
from ridetune.codec import MatrixCodec
from ridetune.config import load_config
from ridetune.engines import ActionPass, Prefix
from ridetune.gate import SafetyGate
from ridetune.matrix import STYLES, ControllerMatrix, Style
from ridetune.policy import Policy
from ridetune.sample import (
    CONDITIONS,
    FEEDBACK_KINDS,
    LEVELS,
    Condition,
    Level,
    Memory,
    Observation,
    Sample,
)
from ridetune.sim.check import load_gate
from ridetune.sim.passengers import WISHES, Priors, matrix_of_taste
from ridetune.sim.scenarios import ACCELERATION, LANE_CHANGE
from tests.fake_policy import CONTRACT, TOKENIZER, FakeEngine
from tests.shipped_car import DEFAULT, RANGES, VEHICLE, middle

CODEC = MatrixCodec(RANGES)
GATE = SafetyGate(RANGES, CODEC)
CAR = Car(VEHICLE, GATE, DEFAULT, Asking(every_s=2.0, looks=2, latency_s=0.05, text_latency_s=0.2))
WORDS = {(style, level): [f"{style} {level}"] for style in STYLES for level in LEVELS}


class Listening(FakeEngine):
    """Proposes the middle of the moderate style and keeps what it was shown."""

    def __init__(self) -> None:
        super().__init__(middle("moderate"), "scene: clear day.")
        self.seen: list[NDArray[np.float32]] = []

    def prefill(self, patches: NDArray[np.float32]) -> Prefix:
        self.seen.append(patches)
        return super().prefill(patches)

    def decide(self, prefix: Prefix, suffix: Sequence[int]) -> ActionPass:
        return super().decide(prefix, suffix)


class Scribe(MatrixWriter):
    """Writes what it is told to, one text a question."""

    def __init__(self, written: list[ControllerMatrix | None]) -> None:
        self.written = written

    def write(
        self, frame: bytes, instruction: str, memories: Sequence[Memory] = ()
    ) -> tuple[ControllerMatrix | None, int]:
        return self.written.pop(0), 30


def policy(engine: FakeEngine) -> Policy:
    return Policy(engine, CONTRACT, TOKENIZER)


def serve_taste(trial: Trial, condition: Condition) -> Drive:
    """A bundle that understands every word and sees the weather."""
    taste = WISHES[trial.style] - 0.25 * (condition != "sunny")
    return drive_proposals([matrix_of_taste(taste, CODEC)], trial, condition, CAR)


@cache
def arms() -> dict[Any, list[Drive]]:
    rng = np.random.default_rng(0)
    trials = plan_trials(WORDS, 1, rng)
    return drive_arms({"served": serve_taste, "text": serve_taste}, trials, CAR, CODEC, rng)


@pytest.fixture(scope="module")
def config(root: Any) -> DrivingScoreConfig:
    return load_config(DrivingScoreConfig, root / "configs/driving_score.yaml")


def test_the_policy_sees_the_drive_as_it_goes_and_is_asked_as_often_as_said() -> None:
    engine = Listening()
    trial = Trial("acceleration", ACCELERATION, "moderate", "I", "hurry", 2, 7)
    drive = drive_served(policy(engine), trial, "fog", CAR)
    assert len(engine.seen) == len(drive.proposals) == 2
    assert not np.array_equal(engine.seen[0], engine.seen[1])
    assert drive.rollout.status == "finished"  # its repeated answer keeps the car alive
    again = drive_proposals(drive.proposals, trial, "fog", CAR)
    np.testing.assert_array_equal(
        again.rollout.trajectory.signals, drive.rollout.trajectory.signals
    )


def test_a_matrix_written_as_text_drives_and_without_one_the_car_keeps_its_own() -> None:
    asked = middle("aggressive")
    trial = Trial("acceleration", ACCELERATION, "aggressive", "I", "hurry", 2, 7)
    drive = drive_written(Scribe([asked, None]), trial, "sunny", CAR)
    assert drive.proposals == (asked, GATE.judge(asked, DEFAULT, "sunny").matrix)


def test_all_arms_drive_the_same_trials() -> None:
    places = {arm: [(id(d.trial), d.condition) for d in drives] for arm, drives in arms().items()}
    assert len(places) == 6 and len(set(map(tuple, places.values()))) == 1
    assert len(places["served"]) == 3 * 3 * len(CONDITIONS)
    assert {d.proposals for d in arms()["constant"]} == {(DEFAULT,)}


def test_shuffled_proposals_come_from_other_words_of_the_same_place() -> None:
    served = {(id(d.trial), d.condition): d.proposals for d in arms()["served"]}
    for drive in arms()["shuffled"]:
        assert drive.proposals != served[id(drive.trial), drive.condition]
        here = [
            d.proposals
            for d in arms()["served"]
            if (d.trial.manoeuvre, d.condition) == (drive.trial.manoeuvre, drive.condition)
        ]
        assert drive.proposals in here


def test_the_constant_default_is_eighty_in_motion_and_aligns_with_no_weather(
    config: DrivingScoreConfig,
) -> None:
    constant = arms()["constant"]
    scored = score_arm(constant, constant, 0.0, CODEC, config)
    parts = dict(zip(METRICS, np.mean([s.parts for s in scored], axis=0), strict=True))
    for name in METRICS[1:7]:
        assert parts[name] == pytest.approx(80.0, abs=0.5)
    assert parts["scenario_alignment"] == 0.0
    aligned: Any = align_conditions(constant, CODEC)
    assert {row["share"] for row in aligned.values()} == {0.0}


def test_a_policy_that_reads_words_and_weather_beats_the_default(
    config: DrivingScoreConfig,
) -> None:
    scored = {
        arm: score_arm(drives, arms()["constant"], 0.0, CODEC, config)
        for arm, drives in arms().items()
    }
    found: Any = summarise(scored)
    for name in ("acceleration", "lane_change", "left_turn"):
        assert found[name]["served"]["over_constant"] > 0.0
        assert found[name]["constant"]["over_constant"] == 0.0
        served = found[name]["served"]
        # A weight of 0.15: all of it to what sees the weather, nothing to the default.
        assert served["over_constant"] - served[
            "over_constant_without_scenario_alignment"
        ] == pytest.approx(15.0, abs=0.02)
        assert served["parts"]["scenario_alignment"] == 100.0
        assert found[name]["served"]["parts"]["command_alignment"] > 90.0


def test_a_failed_drive_scores_nothing(config: DrivingScoreConfig) -> None:
    constant = arms()["constant"]
    broken = [
        replace(d, metrics=replace(d.metrics, broke_off_s=1.0)) if i == 0 else d
        for i, d in enumerate(constant)
    ]
    scored = score_arm(broken, constant, 0.0, CODEC, config)
    assert scored[0].score == 0.0 and min(s.score for s in scored[1:]) > 0.0


def test_styles_come_out_in_order_where_the_car_speeds_up_or_changes_lanes() -> None:
    found: Any = order_styles(arms()["oracle"])
    for name, feature in (("acceleration", "t90_s"), ("lane_change", "felt_peak_ay")):
        assert all(row["ordered"] for row in found[name][feature].values())
    backwards: Any = order_styles(
        [replace(d, trial=replace(d.trial, style=_other(d.trial.style))) for d in arms()["oracle"]]
    )
    assert not any(row["ordered"] for row in backwards["acceleration"]["t90_s"].values())


def _other(style: Style) -> Style:
    return STYLES[2 - STYLES.index(style)]


def test_the_reader_knows_styles_that_it_has_never_seen() -> None:
    rng = np.random.default_rng(1)
    trial = Trial("lane_change", LANE_CHANGE, "moderate", "I", "", 0, 3)
    ranges = drive_ranges([trial], 6, CAR, CODEC, rng)
    readers = fit_readers([d for d in ranges if d.condition == "sunny"])
    assert set(readers) == {("lane_change", "sunny")}
    reader = readers["lane_change", "sunny"]
    for style in STYLES:
        drive = drive_proposals([middle(style)], trial, "sunny", CAR)
        assert reader.read(drive.metrics) == style
        assert reader.read(replace(drive.metrics, broke_off_s=2.0)) is None
    by_style = {s: [d.metrics for d in ranges if d.trial.style == s] for s in STYLES}
    swapped = StyleReader.fit({s: by_style[_other(s)] for s in STYLES})
    calm = drive_proposals([middle("conservative")], trial, "sunny", CAR)
    assert swapped.read(calm.metrics) == "aggressive"


def test_the_default_is_held_against_the_papers_baseline() -> None:
    found = against_paper(arms()["constant"])
    assert found["sv_x"]["paper"] == 28.8 and found["mean_ax"]["paper"] == 0.78
    assert abs(found["sv_x"]["off"]) < 0.15 and abs(found["mean_ax"]["off"]) < 0.15


def test_trajectories_are_one_of_each_manoeuvre_and_style() -> None:
    found = trajectories(arms()["served"])
    assert len({(t["manoeuvre"], t["style"]) for t in found}) == len(found) == 9
    assert {len(t["signals"]["x_m"]) for t in found} == {150}


def test_targets_are_reached_or_not_by_their_numbers() -> None:
    def result(over: float, fewer: float) -> dict[str, Any]:
        rows = {"sunny": {"ordered": over > 0}}
        return {
            "scores": {
                m: {
                    "served": {
                        "over_constant": over,
                        "over_constant_without_scenario_alignment": over,
                    }
                }
                for m in ("acceleration", "lane_change", "left_turn")
            },
            "styles_in_order": {
                "served": {m: {"t90_s": rows} for m in ("acceleration", "lane_change", "left_turn")}
            },
            "style_read": {"served": {"asked_for": 0.8 if over > 0 else 0.79}},
            "scenario_alignment": {
                "served": {
                    c: {"share": 0.9 if over > 0 else 0.89} for c in CONDITIONS if c != "sunny"
                }
            },
            "baseline": {"sv_x": {"off": -0.1}, "mean_ax": {"off": 0.1 + (over <= 0)}},
            "takeovers": {"fewer_with_memory": dict.fromkeys(LEVELS, fewer)},
        }

    assert all(t["reached"] for t in judge(result(1.0, 0.7)).values())
    assert not any(t["reached"] for t in judge(result(0.0, 0.69)).values())


def said(words: str, style: Style, level: Level) -> Sample:
    return Sample(
        observation=Observation(b""),
        instruction=words,
        memories=(),
        matrix=DEFAULT,
        scene="",
        explanation="",
        style=style,
        level=level,
        intent="",
        condition="sunny",
        split="test",
        scene_id="",
        phrase_id="",
    )


def test_a_sentence_that_stands_for_two_styles_is_left_out() -> None:
    samples = [said(f"{style} {level}", style, level) for style in STYLES for level in LEVELS]
    both = [said("go", style, "I") for style in STYLES[:2]]
    assert sentences_of([*samples, *both]) == WORDS
    with pytest.raises(ValueError, match="conservative"):
        sentences_of(samples[1:])


def test_the_gate_lets_a_far_matrix_through_step_by_step() -> None:
    far = ControllerMatrix(1.2, 0.0, 0.0, 1.5, 20.0, 6.0)
    assert GATE.judge(far, DEFAULT).matrix != far
    assert settle(GATE, far, DEFAULT, "sunny").values == pytest.approx(far.values)
    wild = ControllerMatrix(9.0, 0, 0, 0.1, 1.0, 0.3)
    assert settle(GATE, wild, DEFAULT, "sunny") == DEFAULT


def test_a_settled_matrix_lies_in_the_box_of_its_road() -> None:
    gate = load_gate(CONTRACT, VEHICLE, Path("configs/verified.yaml"))
    brisk = ControllerMatrix(0.6, 0.0, 0.0, 0.05, 5.0, 1.0)
    settled = {c: settle(gate, brisk, DEFAULT, c).wl for c in ("sunny", "snow")}
    assert settled["sunny"] < settled["snow"], settled


def test_the_ideal_policy_follows_words_weather_and_complaints() -> None:
    feedback = {kind: [kind] for kind in FEEDBACK_KINDS}
    ideal = IdealPolicy(Sentences(WORDS, feedback), CODEC, Priors())
    clear, wet = (Place(ACCELERATION, c) for c in ("sunny", "rain"))
    usual = ideal.decide("moderate I", (), clear)
    assert usual == matrix_of_taste(0.0, CODEC)
    assert ideal.decide("moderate I", (), wet) == matrix_of_taste(-0.25, CODEC)
    for kind, taste in (("too_aggressive", -0.5), ("just_right", 0.0), ("too_conservative", 0.5)):
        memory = Memory("moderate I", "a sunny straight road", usual, kind)
        learnt = ideal.decide("moderate II", (memory,), clear)
        assert learnt.kp == pytest.approx(matrix_of_taste(taste, CODEC).kp, rel=0.02)


def test_the_served_policy_answers_once_and_recalls_words_that_it_takes_alike() -> None:
    engine = Listening()
    served = ServedPolicy(policy(engine), GATE, VEHICLE, streets=1)
    place = Place(ACCELERATION, "rain")
    first = served.decide("hurry", (), place)
    assert served.decide("hurry", (), place) == first
    assert len(engine.suffixes) == len(engine.seen) == 1
    settings: list[Setting[Place]] = settings_of(["rain"], CAR)
    memories = [Memory("slow", s.scene, DEFAULT, f"drive {i}") for i, s in enumerate(settings)]
    past = list(zip(settings, memories, strict=True)) * 2
    recalled = served.recall_alike(1)("hurry", settings[0], past)
    assert recalled == (memories[0],)
    assert "rainy" in settings[0].scene and settings[0].kind == "acceleration"
