"""The takeover study on a toy car: oracle, policy and controls come out in their proper order."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from evaluate.significance import clopper_pearson, fisher_exact
from evaluate.takeover import ARMS, Count, Study, sensitivity, study
from evaluate.trips import Sentences, Setting, StudyConfig, World, plan_trips, prepare
from ridetune.codec import MatrixCodec
from ridetune.matrix import STYLES, ControllerMatrix, Ranges, Style, ki_limit
from ridetune.sample import FEEDBACK_KINDS, LEVELS, Memory
from ridetune.sim.metrics import measure
from ridetune.sim.passengers import (
    WISHES,
    Impression,
    Passenger,
    Priors,
    draw_passenger,
    expect,
    feedback_kind,
    matrix_of_taste,
    takeover_probability,
)
from ridetune.sim.trajectory import SIGNALS, Trajectory

PERIOD_S = 0.1
SENTENCES = Sentences(
    instructions={(style, level): [f"{style} {level}"] for style in STYLES for level in LEVELS},
    feedback={kind: [kind] for kind in FEEDBACK_KINDS},
)
SETTINGS = [
    Setting("acceleration", "sunny", "a straight road", "straight"),
    Setting("left_turn", "rain", "a wet junction", "bend"),
]
CONFIG = StudyConfig(passengers=40, calibration_passengers=40, reference_seeds=3)
FEW = replace(CONFIG, passengers=5)  # for what needs no statistics


def drive(matrix: ControllerMatrix, scenario: str, seed: int) -> Trajectory:
    """A toy car: K_p sets how fast it reaches 14 m/s, W_s how sharply it swings into a bend."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 18.0, PERIOD_S)
    signals = np.zeros((len(time), len(SIGNALS)))
    column = {name: signals[:, i] for i, name in enumerate(SIGNALS)}
    pull = matrix.kp * (1.0 + 0.02 * rng.standard_normal())
    column["gap_m"][:], column["lead_speed_mps"][:] = math.inf, math.nan
    if scenario == "straight":
        column["speed_mps"][:] = 14.0 * -np.expm1(-pull * time)
        column["acceleration_mps2"][:] = 14.0 * pull * np.exp(-pull * time)
        column["reference_speed_mps"][:] = 14.0
    else:
        sharpness = (1.0 + 0.02 * rng.standard_normal()) / (0.5 + matrix.ws)
        column["speed_mps"][:] = column["reference_speed_mps"][:] = 8.0
        column["yaw_rate_radps"][:] = 0.3 * (1 + sharpness * np.exp(-((time - 5) ** 2)))
    return Trajectory(PERIOD_S, signals)


@pytest.fixture(scope="module")
def world(codec: MatrixCodec) -> World[str]:
    return prepare(SETTINGS, drive, SENTENCES, codec, Priors(), CONFIG)


def remembering(codec: MatrixCodec) -> Callable[[str, tuple[Memory, ...], str], ControllerMatrix]:
    """A policy that understands every word and moves half a style against each complaint."""
    shift = {"too_aggressive": -0.5, "too_conservative": +0.5, "just_right": 0.0}
    tastes = np.linspace(-1.5, 1.5, 61)
    gains = [matrix_of_taste(float(taste), codec).kp for taste in tastes]

    def decide(instruction: str, memories: tuple[Memory, ...], scenario: str) -> ControllerMatrix:
        weather = -0.25 if scenario == "bend" else 0.0
        learnt = 0.0
        for memory in memories[:1]:  # the newest: where it stood, and what was said of that
            stood = float(np.interp(memory.matrix.kp, gains, tastes))
            learnt = stood - WISHES[_style(memory.instruction)] - weather + shift[memory.feedback]
        return matrix_of_taste(WISHES[_style(instruction)] + weather + learnt, codec)

    return decide


def _style(instruction: str) -> Style:
    return next(style for style in STYLES if instruction.startswith(style))


@pytest.fixture(scope="module")
def outcome(world: World[str], codec: MatrixCodec) -> Study:
    return study(world, remembering(codec))


def rate(outcome: Study, arm: str) -> float:
    count = outcome.count(next(a for a in ARMS if a == arm))
    return count.takeovers / count.trips


def test_arms_come_out_in_their_proper_order(outcome: Study) -> None:
    assert rate(outcome, "oracle") < 0.02
    assert rate(outcome, "oracle") <= rate(outcome, "with_memory")
    assert rate(outcome, "with_memory") < rate(outcome, "without_memory")
    assert rate(outcome, "without_memory") < rate(outcome, "baseline")
    assert rate(outcome, "shuffled") > rate(outcome, "baseline")
    assert rate(outcome, "random") > rate(outcome, "baseline")
    assert outcome.p_value("oracle") < 1e-6
    assert outcome.p_value("baseline") == pytest.approx(1.0)


def test_all_arms_count_the_same_trips_at_every_level(outcome: Study) -> None:
    assert list(outcome.counts) == list(ARMS)
    for arm in ARMS:
        assert {level: c.trips for level, c in outcome.counts[arm].items()} == dict.fromkeys(
            LEVELS, CONFIG.passengers * len(SETTINGS)
        )


def test_a_policy_that_is_deaf_gains_nothing_over_the_baseline(world: World[str]) -> None:
    default = world.codec.ranges.default
    deaf = study(replace(world, config=FEW), lambda *_: default)
    for arm in ("without_memory", "with_memory", "shuffled"):
        assert deaf.counts[arm] == deaf.counts["baseline"]
        assert deaf.p_value(arm) == pytest.approx(1.0)


def test_calibrated_tolerance_gives_other_passengers_the_baseline_rate(outcome: Study) -> None:
    low, high = clopper_pearson(
        outcome.count("baseline").takeovers, outcome.count("baseline").trips, confidence=0.999
    )
    assert low < CONFIG.baseline_rate < high


def test_memory_helps_more_where_tastes_spread(world: World[str], codec: MatrixCodec) -> None:
    found = sensitivity(replace(world, config=replace(CONFIG, passengers=20)), remembering(codec))
    assert list(found) == [0.2, 0.5, 0.8]
    gain = [rate(s, "without_memory") - rate(s, "with_memory") for s in found.values()]
    assert gain[2] > gain[0]
    assert gain[2] > 0.1
    without = [rate(s, "without_memory") for s in found.values()]
    assert without[0] < without[1] < without[2]
    assert {s.tolerance for s in found.values()} == {world.tolerance}
    assert [s.priors.taste_spread for s in found.values()] == [0.2, 0.5, 0.8]
    assert "shuffled" not in found[0.2].counts


def test_study_repeats_exactly_and_changes_with_its_seed(
    world: World[str], codec: MatrixCodec
) -> None:
    few, other = (replace(world, config=replace(FEW, seed=seed)) for seed in (0, 1))
    once, again, elsewhere = (study(w, remembering(codec)) for w in (few, few, other))
    assert once.counts == again.counts
    assert once.counts != elsewhere.counts


def test_policy_is_shown_the_newest_memories_of_the_kind_first(world: World[str]) -> None:
    shown: list[tuple[str, tuple[Memory, ...]]] = []
    default = world.codec.ranges.default

    def decide(_: str, memories: tuple[Memory, ...], scenario: str) -> ControllerMatrix:
        shown.append((scenario, memories))
        return replace(default, wh=len(shown) / 1000)

    study(replace(world, config=FEW), decide, arms=("with_memory",))
    first = [seen for seen in shown[: CONFIG.rehearsals * 2 + 6] if seen[0] == "bend"]
    assert [len(memories) for _, memories in first] == [0, 1, 2, 3, 3, 3]
    for _, memories in first:
        assert {m.scene for m in memories} <= {"a wet junction"}
        order = [m.matrix.wh for m in memories]
        assert order == sorted(order, reverse=True)
        assert {m.feedback for m in memories} <= set(FEEDBACK_KINDS)


def test_callers_recall_decides_what_is_remembered(world: World[str]) -> None:
    lengths = []

    def decide(_: str, memories: tuple[Memory, ...], __: str) -> ControllerMatrix:
        lengths.append(len(memories))
        return world.codec.ranges.default

    study(replace(world, config=FEW), decide, arms=("with_memory",), recall=lambda *_: ())
    assert set(lengths) == {0}


def test_report_of_a_study_is_json_with_its_assumptions(outcome: Study) -> None:
    report = json.loads(json.dumps(outcome.as_dict(), allow_nan=False))
    assert set(report["arms"]) == set(ARMS)
    assert set(report["arms"]["oracle"]) == {"all", *LEVELS}
    assert report["priors"]["taste_spread"] == 0.5
    assert "simulated" in report["about"]


def test_rate_that_no_tolerance_reaches_is_refused(codec: MatrixCodec) -> None:
    config = replace(CONFIG, baseline_rate=1.0, calibration_passengers=3)
    with pytest.raises(ValueError, match="no tolerance"):
        prepare(SETTINGS, drive, SENTENCES, codec, Priors(), config)


def test_passengers_without_words_are_refused(codec: MatrixCodec) -> None:
    mute = replace(SENTENCES, feedback={**SENTENCES.feedback, "just_right": []})
    with pytest.raises(ValueError, match="just_right"):
        prepare(SETTINGS, drive, mute, codec, Priors(), CONFIG)
    some = {k: v for k, v in SENTENCES.instructions.items() if k != ("moderate", "III")}
    with pytest.raises(ValueError, match="moderate"):
        prepare(SETTINGS, drive, replace(SENTENCES, instructions=some), codec, Priors(), CONFIG)


def test_setting_without_styles_is_refused(codec: MatrixCodec) -> None:
    def same(_: ControllerMatrix, scenario: str, seed: int) -> Trajectory:
        return drive(codec.ranges.default, scenario, 0)

    with pytest.raises(ValueError, match="no aspect"):
        prepare(SETTINGS, same, SENTENCES, codec, Priors(), CONFIG)


def test_drive_that_breaks_off_is_always_taken_over(world: World[str]) -> None:
    def break_off(matrix: ControllerMatrix, scenario: str, seed: int) -> Trajectory:
        whole = drive(matrix, scenario, seed).signals.copy()
        whole[60:] = math.nan
        return Trajectory(PERIOD_S, whole)

    few = replace(world, drive=break_off, config=FEW)
    broken = study(few, lambda *_: world.codec.ranges.default)
    assert all(rate(broken, arm) == 1.0 for arm in ARMS)
    trip = plan_trips(world)[0]
    impression = world.ride(trip, world.codec.ranges.default)
    assert math.isfinite(impression.distance)
    with pytest.raises(ValueError, match="broke off"):
        prepare(SETTINGS, break_off, SENTENCES, world.codec, Priors(), CONFIG)


def test_taste_axis_meets_the_middles_of_the_styles_and_keeps_the_rules(
    codec: MatrixCodec, ranges: Ranges
) -> None:
    for style, taste in WISHES.items():
        for i, limits in enumerate(ranges.styles[style]):
            value = matrix_of_taste(taste, codec).values[i]
            middle = (codec.share(limits.lower, i) + codec.share(limits.upper, i)) / 2
            if i != 1:
                assert codec.share(value, i) == pytest.approx(middle)
    for taste in np.linspace(-3, 3, 25):
        matrix = matrix_of_taste(float(taste), codec)
        assert matrix.ki <= ki_limit(matrix.kp)
        codec.encode(matrix)


def test_wanted_taste_adds_words_taste_and_weather() -> None:
    passenger = Passenger({"turn": 0.3}, (1.0,) * 6, 1.0)
    wants = partial(passenger.wants, kind="turn", priors=Priors())
    assert wants("moderate", condition="sunny") == pytest.approx(0.3)
    assert wants("moderate", condition="snow") == pytest.approx(0.05)
    assert wants("conservative", condition="sunny") == pytest.approx(-0.7)
    far = Passenger({"turn": 2.0}, (1.0,) * 6, 1.0)
    assert far.wants("aggressive", "turn", "sunny", Priors()) == 1.5


def test_spread_scales_the_same_tastes() -> None:
    def taste(spread: float) -> float:
        priors = Priors(taste_spread=spread)
        return draw_passenger(["turn"], priors, np.random.default_rng(3)).taste["turn"]

    assert taste(0.8) == pytest.approx(4 * taste(0.2))
    rng = np.random.default_rng(0)
    both = [draw_passenger(["a", "b"], Priors(), rng).taste for _ in range(4000)]
    a, b = np.array([t["a"] for t in both]), np.array([t["b"] for t in both])
    assert np.std(a) == pytest.approx(0.5, abs=0.03)
    assert np.corrcoef(a, b)[0, 1] == pytest.approx(0.75, abs=0.03)


def test_judgement_is_in_units_of_taste_and_knows_the_direction(codec: MatrixCodec) -> None:
    expectation = expect(
        lambda taste, seed: measure(drive(matrix_of_taste(taste, codec), "straight", seed)),
        Priors(),
        [1, 2, 3],
    )
    weights = (1.0,) * 6
    brisk = measure(drive(matrix_of_taste(1.0, codec), "straight", 9))
    calm = measure(drive(matrix_of_taste(-1.0, codec), "straight", 9))
    assert expectation.judge(brisk, 1.0, weights).distance < 0.15
    assert expectation.judge(brisk, 0.0, weights).lean > 0.3
    assert expectation.judge(calm, 0.0, weights).lean < -0.3
    assert expectation.judge(brisk, -1.0, weights).distance > 1.0
    # Nothing moves sideways on a straight road, and nothing is ahead.
    assert np.array_equal(expectation.scale[3:], [0.0, 0.0, 0.0])


def test_takeover_is_logistic_in_what_exceeds_the_personal_tolerance() -> None:
    calm, patient = (Passenger({}, (1.0,) * 6, patience) for patience in (1.0, 1.5))
    probability = partial(takeover_probability, tolerance=1.0, priors=Priors(softness=0.2))
    assert probability(Impression(1.0, 0.0), calm) == pytest.approx(0.5)
    assert probability(Impression(1.2, 0.0), calm) == pytest.approx(1 / (1 + math.exp(-1)))
    assert probability(Impression(1.2, 0.0), patient) < 0.2
    assert probability(Impression(math.inf, math.inf), patient) == 1.0


def test_feedback_names_the_violated_direction_but_for_one_in_ten() -> None:
    passenger = Passenger({}, (1.0,) * 6, 1.0)
    rng = np.random.default_rng(5)
    for lean, right in ((0.9, "too_aggressive"), (-0.9, "too_conservative"), (0.1, "just_right")):
        said = [
            feedback_kind(Impression(abs(lean), lean), passenger, 1.0, Priors(), rng)
            for _ in range(3000)
        ]
        assert said.count(right) / 3000 == pytest.approx(0.9, abs=0.02)  # type: ignore[arg-type]
        assert set(said) == set(FEEDBACK_KINDS)


@pytest.mark.parametrize(
    ("baseline", "ours", "expected"),
    [
        # The paper's takeovers at directness levels I, II, III and over all.
        ((7, 36), (2, 36), 0.15),
        ((4, 33), (2, 33), 0.67),
        ((13, 36), (3, 36), 0.009),
        ((24, 105), (7, 105), 0.002),
    ],
)
def test_fisher_agrees_with_the_papers_counts(
    baseline: tuple[int, int], ours: tuple[int, int], expected: float
) -> None:
    p = fisher_exact(*baseline, *ours)
    digits = 3 if expected < 0.01 else 2
    assert round(p, digits) == expected
    assert fisher_exact(*ours, *baseline) == pytest.approx(p)


def test_fisher_by_hand_on_the_lady_tasting_tea() -> None:
    assert fisher_exact(4, 4, 0, 4) == pytest.approx(2 / 70)
    assert fisher_exact(3, 4, 1, 4) == pytest.approx((16 + 16 + 1 + 1) / 70)
    assert fisher_exact(2, 4, 2, 4) == pytest.approx(1.0)
    assert fisher_exact(0, 5, 0, 7) == pytest.approx(1.0)


def test_clopper_pearson_by_hand_at_its_ends() -> None:
    assert clopper_pearson(0, 10) == pytest.approx((0.0, 1 - 0.025**0.1))
    assert clopper_pearson(10, 10) == pytest.approx((0.025**0.1, 1.0))
    # No failure in 2000 runs: the one-sided 95 % bound is that of a two-sided 90 % interval.
    assert clopper_pearson(0, 2000, 0.9)[1] == pytest.approx(0.0015, abs=2e-5)
    low, high = clopper_pearson(13, 36)
    assert (1 - high, 1 - low) == pytest.approx(clopper_pearson(23, 36))


def test_statistics_agree_with_scipy() -> None:
    stats = pytest.importorskip("scipy.stats")
    for events, trials, other, others in ((7, 36, 2, 36), (0, 9, 5, 8), (50, 400, 81, 390)):
        table = [[events, trials - events], [other, others - other]]
        expected = stats.fisher_exact(table)[1]
        assert fisher_exact(events, trials, other, others) == pytest.approx(expected, rel=1e-9)
    for events, trials in ((1, 20), (7, 36), (24, 105), (3, 1000)):
        exact = stats.binomtest(events, trials).proportion_ci(method="exact")
        assert clopper_pearson(events, trials) == pytest.approx((exact.low, exact.high), abs=1e-9)


def test_impossible_counts_are_refused() -> None:
    with pytest.raises(ValueError, match="impossible"):
        clopper_pearson(3, 2)
    with pytest.raises(ValueError, match="impossible"):
        clopper_pearson(0, 0)
    with pytest.raises(ValueError, match="impossible"):
        fisher_exact(3, 2, 0, 4)


def test_count_reports_rate_and_interval() -> None:
    report = Count(7, 36).as_dict()
    assert report["rate"] == 0.1944
    assert report["interval"] == [0.0819, 0.3602]
