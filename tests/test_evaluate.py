"""The scores tell an oracle from a constant, and the whole report runs on a small bundle."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from evaluate.alignment import agreement, clear_adverse_pairs, memory_shift, past_drive, score
from evaluate.decisions import propose, random_matrices, shuffle_frames, shuffle_instructions
from evaluate.report import EvaluateConfig, evaluate, gate_outcomes, score_text
from evaluate.writing import MatrixWriter
from ridetune.bundle import Bundle, load_bundle
from ridetune.codec import MatrixCodec
from ridetune.contract import Contract, load_tokenizer
from ridetune.control.vehicle import Vehicle
from ridetune.engines import Engine
from ridetune.matrix import STYLES, ControllerMatrix, Ranges, Style
from ridetune.ort_engine import OrtEngine
from ridetune.policy import Policy
from ridetune.sample import ADVERSE, Observation, Sample, read_samples
from ridetune.scene import SCENE_QUESTIONS
from ridetune.sim.check import load_gate
from ridetune.stage import run_stage
from tests.small_base import RANGES, small_base, small_data
from tests.tiny_bundle import awq_bundle, awq_model, plain_model


@pytest.fixture(scope="module")
def samples() -> list[Sample]:
    return read_samples(small_data() / "test.parquet")


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return load_bundle(awq_bundle())


@pytest.fixture(scope="module")
def policy(bundle: Bundle) -> Policy:
    return Policy(OrtEngine(bundle), bundle.contract, load_tokenizer(bundle.folder))


def middle(style: Style, ranges: Ranges) -> ControllerMatrix:
    return ControllerMatrix.of([(r.lower + r.upper) / 2 for r in ranges.styles[style]])


def test_oracle_scores_full_marks(samples: list[Sample], codec: MatrixCodec) -> None:
    scores = score([sample.matrix for sample in samples], samples, codec)
    assert scores["command_alignment"] > 99
    assert scores["style_accuracy"] == 1.0
    assert set(scores["style_accuracy_by_level"].values()) == {1.0}
    assert scores["scenario_alignment"] == 1.0
    assert scores["scenario_alignment_by_condition"] == dict.fromkeys(ADVERSE, 1.0)
    assert (scores["decisions"], scores["pairs"]) == (30, 24)


def test_constant_that_ignores_the_scene_scores_no_scenario(
    samples: list[Sample], codec: MatrixCodec
) -> None:
    scores = score([codec.ranges.default] * len(samples), samples, codec)
    assert scores["scenario_alignment"] == 0.0
    assert scores["style_accuracy"] == pytest.approx(1 / 3, abs=1e-3)
    assert scores["command_alignment"] < 95


def test_opposite_style_is_never_right(samples: list[Sample], codec: MatrixCodec) -> None:
    other = {"conservative": "aggressive", "moderate": "conservative", "aggressive": "moderate"}
    wrong = [middle(cast(Style, other[s.style]), codec.ranges) for s in samples]
    scores = score(wrong, samples, codec)
    assert scores["style_accuracy"] == 0.0
    assert scores["command_alignment"] < 60


def test_scenario_counts_only_the_frames_that_grow_more_conservative(
    samples: list[Sample], codec: MatrixCodec
) -> None:
    calm, brisk = (middle(style, codec.ranges) for style in ("conservative", "aggressive"))
    found = [calm if s.condition in ("fog", "snow") else brisk for s in samples]
    scores = score(found, samples, codec)
    shares = {"rain": 0.0, "fog": 1.0, "snow": 1.0, "night": 0.0}
    assert scores["scenario_alignment_by_condition"] == shares
    assert scores["scenario_alignment"] == 0.5


def test_levels_that_do_not_occur_have_no_score(samples: list[Sample], codec: MatrixCodec) -> None:
    level = samples[0].level
    scenes = {s.scene_id for s in samples}
    chosen = [replace(s, level=level) for s in samples if s.scene_id in scenes]
    scores = score([s.matrix for s in chosen], chosen, codec)
    assert scores["style_accuracy_by_level"] == {level: 1.0}
    json.dumps(scores, allow_nan=False)


def test_pairs_join_the_same_scene_and_words(samples: list[Sample], codec: MatrixCodec) -> None:
    numbered = [codec.decode([number] * 6) for number in range(len(samples))]
    number_of = {matrix.values: sample for matrix, sample in zip(numbered, samples, strict=True)}
    pairs = clear_adverse_pairs(numbered, samples)
    assert set(pairs) == set(ADVERSE)
    for condition, found in pairs.items():
        for clear, adverse in found:
            sunny, other = number_of[clear.values], number_of[adverse.values]
            assert (sunny.condition, other.condition) == ("sunny", condition)
            assert sunny.scene_id == other.scene_id
            assert sunny.instruction == other.instruction


def test_agreement_holds_within_two_bins_of_the_same_style(codec: MatrixCodec) -> None:
    bins = [[100] * 6, [60] * 6, [200] * 6]
    ours = [codec.decode(b) for b in bins]
    assert agreement(ours, ours, codec) == {
        "equal": 1.0,
        "same_style": 1.0,
        "bins_p50": 0.0,
        "bins_p99": 0.0,
        "decisions": 3,
    }
    near = [codec.decode([b[0] + 1.9, *b[1:]]) for b in bins]
    far = [codec.decode([b[0] + 2.1, *b[1:]]) for b in bins]
    assert agreement(ours, near, codec)["equal"] == agreement(ours, near, codec)["same_style"]
    assert agreement(ours, near, codec)["bins_p50"] == pytest.approx(1.9, abs=1e-3)
    assert agreement(ours, far, codec)["equal"] == 0.0
    assert agreement(ours[:1] * 2, [ours[0], far[0]], codec)["equal"] == 0.5


def test_styles_that_differ_do_not_agree(codec: MatrixCodec) -> None:
    matrices = [middle(style, codec.ranges) for style in STYLES]
    found = agreement(matrices, matrices[1:] + matrices[:1], codec)
    assert found["same_style"] == found["equal"] == 0.0


def test_memory_shift_is_positive_towards_caution(codec: MatrixCodec) -> None:
    calm, brisk = (middle(style, codec.ranges) for style in ("conservative", "aggressive"))
    up, down = memory_shift([brisk], [calm], codec), memory_shift([calm], [brisk], codec)
    assert up["mean_shift"] > 0.1
    assert up["share_more_conservative"] == 1.0
    assert down == {**up, "mean_shift": -up["mean_shift"], "share_more_conservative": 0.0}
    still = memory_shift([brisk, brisk], [brisk, calm], codec)
    assert still["share_more_conservative"] == 0.5
    assert still["mean_shift"] == pytest.approx(up["mean_shift"] / 2, abs=1e-4)


def test_past_drive_is_the_sample_with_feedback(samples: list[Sample]) -> None:
    (memory,) = past_drive(samples[0], "too fast")
    assert memory.matrix == samples[0].matrix
    assert (memory.instruction, memory.feedback) == (samples[0].instruction, "too fast")


def test_shuffled_frames_are_the_same_frames_elsewhere(samples: list[Sample]) -> None:
    mixed = shuffle_frames(samples, np.random.default_rng(0))
    assert Counter(s.observation.frame for s in mixed) == Counter(
        s.observation.frame for s in samples
    )
    assert [replace(m, observation=s.observation) for m, s in zip(mixed, samples, strict=True)] == (
        samples
    )
    moved = sum(m.observation != s.observation for m, s in zip(mixed, samples, strict=True))
    assert moved > len(samples) / 2


def test_shuffled_sentences_stay_together_over_the_conditions(samples: list[Sample]) -> None:
    mixed = shuffle_instructions(samples, np.random.default_rng(1))
    assert Counter(s.instruction for s in mixed) == Counter(s.instruction for s in samples)
    assert [replace(m, instruction=s.instruction) for m, s in zip(mixed, samples, strict=True)] == (
        samples
    )
    assert any(m.instruction != s.instruction for m, s in zip(mixed, samples, strict=True))
    assert sum(len(p) for p in clear_adverse_pairs([s.matrix for s in mixed], mixed).values()) == 24


def test_random_matrices_spread_over_the_envelope(codec: MatrixCodec) -> None:
    found = random_matrices(200, codec, np.random.default_rng(0))
    shares = np.array([[codec.share(v, i) for i, v in enumerate(m.values)] for m in found])
    assert shares.min() >= 0
    assert shares.max() <= 1
    assert np.abs(shares.mean(0) - 0.5).max() < 0.1
    assert shares.std(0).min() > 0.2


def test_each_frame_is_read_once_and_each_sample_decided(
    policy: Policy, samples: list[Sample], monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[bytes] = []
    real = policy.prepare

    def prepare(frame: bytes, *, captured_s: float | None = None) -> Any:
        read.append(frame)
        return real(frame, captured_s=captured_s)

    monkeypatch.setattr(policy, "prepare", prepare)
    found = propose(policy, samples[:9], "test")
    assert len(found) == 9
    assert len(read) == len({s.observation.frame for s in samples[:9]}) == 3
    default = policy.contract.ranges.default
    alone = policy.decide(
        samples[4].observation.frame, samples[4].instruction, last_safe=default
    ).proposal
    assert found[4] == alone
    past = [past_drive(s, "far too fast") for s in samples[:2]]
    assert propose(policy, samples[:2], "test", past) != found[:2]


class Scribe:
    """An engine whose text is given."""

    def __init__(self, texts: Sequence[list[int]]) -> None:
        self.texts = list(texts)

    def prefill(self, patches: object) -> None:
        return None

    def write_matrix(self, prefix: object, suffix: object, limit: int) -> list[int]:
        return self.texts.pop(0)


def test_matrix_written_as_text_is_read_back_and_scored(
    bundle: Bundle, samples: list[Sample]
) -> None:
    bundle = Bundle(small_base(), bundle.facts, Contract.load(small_base()))
    prompts, codec = bundle.prompts(), bundle.contract.codec
    subset, served = samples[:4], [codec.ranges.default] * len(samples)
    frame = Observation(subset[0].observation.frame)
    subset = [replace(s, observation=frame, instruction="hurry up") for s in subset]
    told = [prompts.text(codec.text(s.matrix)) for s in subset]
    told[3] = told[3][:20]  # breaks off
    engine = cast(Engine, Scribe(told))
    writer = MatrixWriter(engine, bundle.contract, load_tokenizer(bundle.folder))
    found = score_text(writer, subset, served[:4], subset, codec.ranges)
    assert found["well_formed"] == 0.75
    assert found["command_alignment_text"] == pytest.approx(75, abs=0.5)
    assert found["command_alignment_bins"] < 99
    assert found["decisions"] == 4


def test_gate_outcomes_tell_what_the_gate_does(policy: Policy, samples: list[Sample]) -> None:
    contract = policy.contract
    vehicle = Vehicle.load(RANGES.with_name("vehicle.yaml"))
    gate = load_gate(contract, vehicle, RANGES.with_name("verified.yaml"))
    default = contract.ranges.default
    calm = replace(default, wl=contract.ranges.lowest[3])
    outside = replace(default, kp=2 * contract.ranges.highest[0])
    counts = gate_outcomes([default, calm, outside, outside], samples[:4], gate)
    assert counts == {"accepted": 1, "limited": 1, "refused": 2}


def test_report_holds_every_score(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = [
        f"bundle={awq_bundle()}",
        f"data={small_data()}",
        f"merged={plain_model()}",
        f"quantized={awq_model()}",
        f"out={tmp_path / 'report/evaluation.json'}",
        "threads=1",
        "torch_samples=15",
        "text_samples=2",
        "scene_samples=2",
        "memory_samples=3",
    ]
    yaml = str(RANGES.with_name("evaluate.yaml"))
    monkeypatch.setattr("sys.argv", ["evaluate", "--config", yaml, *settings])
    assert run_stage(EvaluateConfig, yaml, evaluate, None) == 0
    text = (tmp_path / "report/evaluation.json").read_text()
    result = json.loads(text, parse_constant=pytest.fail)  # NaN is no JSON
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == result

    controls = {"constant", "random", "shuffled_frames", "shuffled_instructions", "oracle"}
    assert set(result["controls"]) == controls
    scores = set(result["served"])
    assert {"command_alignment", "style_accuracy", "scenario_alignment", "decisions"} <= scores
    assert all(set(result["controls"][name]) == scores for name in controls)
    assert result["controls"]["oracle"]["scenario_alignment"] == 1.0
    assert result["controls"]["constant"]["scenario_alignment"] == 0.0
    assert result["served"]["decisions"] == 30
    compared = result["torch"]
    assert compared["merged"]["decisions"] == compared["quantized"]["decisions"] == 15
    assert compared["served_against_quantized"]["decisions"] == 15
    # The served integers are those of the quantized checkpoint, exactly.
    assert compared["served_against_quantized"]["equal"] == 1.0
    assert compared["served_against_merged"]["bins_p50"] > 0.1
    assert result["text"]["decisions"] == 2
    assert set(result["scene"]) == set(SCENE_QUESTIONS)
    assert {"too_aggressive", "too_conservative"} <= set(result["memory"])
    assert result["memory"]["too_aggressive"]["decisions"] == 3
    assert sum(result["gate"].values()) == 30
    assert result["peak_rss_mb"] > 0


def test_scores_by_voice_are_those_of_its_own_phrases(
    samples: list[Sample], codec: MatrixCodec
) -> None:
    named = [replace(s, phrase_id="moderate_voices/II/1") for s in samples[:3]]
    named.append(replace(samples[3], phrase_id="conservative_mirrors/I/2"))
    wrong = middle("aggressive" if named[3].style != "aggressive" else "moderate", codec.ranges)
    scores = score([*(s.matrix for s in named[:3]), wrong], named, codec)
    assert scores["style_accuracy_by_voice"] == {"mirrors": 0.0, "voices": 1.0}
    assert scores["command_alignment_by_voice"]["voices"] > 99
