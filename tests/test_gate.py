"""The gate: whatever is proposed, only a safe matrix comes out."""

import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ridetune.codec import MatrixCodec
from ridetune.gate import SafetyGate, Verdict
from ridetune.matrix import NUM_PARAMETERS, PARAMETERS, ControllerMatrix, Ranges, ki_limit

RANGES = Ranges.load(Path("configs/ranges.yaml"))
CODEC = MatrixCodec(RANGES)
GATE = SafetyGate(RANGES, CODEC)
DEFAULT = RANGES.default

within = st.tuples(
    *(st.floats(low, high) for low, high in zip(RANGES.lowest, RANGES.highest, strict=True))
)
numbers = st.lists(st.floats(-1, 25), min_size=NUM_PARAMETERS, max_size=NUM_PARAMETERS)
anything = st.recursive(
    st.none()
    | st.booleans()
    | st.floats()
    | st.integers()
    | st.text()
    | st.binary()
    | st.fractions()
    | st.decimals()
    | st.complex_numbers(),
    lambda inner: st.lists(inner, max_size=7) | st.dictionaries(st.text(), inner, max_size=2),
    max_leaves=12,
)


def is_safe(matrix: ControllerMatrix) -> bool:
    inside = all(
        low <= v <= high
        for low, v, high in zip(RANGES.lowest, matrix.values, RANGES.highest, strict=True)
    )
    return inside and matrix.ki <= ki_limit(matrix.kp)


def safe(values: tuple[float, ...]) -> ControllerMatrix:
    matrix = ControllerMatrix.of(values)
    return replace(matrix, ki=min(matrix.ki, ki_limit(matrix.kp)))


def changed(**values: Any) -> ControllerMatrix:
    return replace(DEFAULT, **values)


@given(proposal=anything, last_safe=anything)
@settings(max_examples=150, deadline=None)
def test_gate_answers_any_object_with_a_safe_matrix(proposal: object, last_safe: object) -> None:
    verdict = GATE.judge(proposal, last_safe)
    assert is_safe(verdict.matrix)
    assert (verdict.outcome == "accepted") or verdict.reasons


@given(proposal=within | numbers, last=within)
@settings(max_examples=200, deadline=None)
def test_gate_output_meets_bounds_coupling_and_slew(proposal: Any, last: Any) -> None:
    kept = safe(last)
    verdict = GATE.judge(proposal, kept)
    assert is_safe(verdict.matrix)
    for i, name in enumerate(PARAMETERS):
        moved = CODEC.share(verdict.matrix.values[i], i) - CODEC.share(kept.values[i], i)
        assert moved <= RANGES.slew + 1e-6
        assert moved >= -RANGES.slew - 1e-6 or name == "K_i"  # coupling may lower K_i further


@given(proposal=within, last=within)
@settings(max_examples=60, deadline=None)
def test_gate_reaches_a_standing_proposal_after_a_few_decisions(proposal: Any, last: Any) -> None:
    goal, matrix = safe(proposal), safe(last)
    for _ in range(8):
        matrix = GATE.judge(goal, matrix).matrix
    assert matrix.values == pytest.approx(goal.values, abs=1e-6)


@given(st.tuples(within, within))
@settings(max_examples=200, deadline=None)
def test_gate_accepts_what_it_passed_before(pair: Any) -> None:
    passed = GATE.judge(ControllerMatrix.of(pair[0]), safe(pair[1])).matrix
    assert GATE.judge(passed, passed) == Verdict("accepted", passed, ())


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 10**400, True, "0.35", None, 1j])
def test_gate_keeps_last_matrix_when_a_value_is_no_finite_number(bad: Any) -> None:
    last = changed(kp=0.5)
    verdict = GATE.judge([0.35, 0.005, bad, 0.16, 1.0, 0.35], last)
    assert (verdict.outcome, verdict.matrix) == ("refused", last)
    assert len(verdict.reasons) == 1


@pytest.mark.parametrize("count", [0, 1, 2, 5, 7])
def test_gate_refuses_another_count_of_values(count: int) -> None:
    assert GATE.judge([0.3] * count, DEFAULT).outcome == "refused"


@pytest.mark.parametrize(
    "form",
    [
        list(DEFAULT.values),
        DEFAULT.rows,
        np.array(DEFAULT.rows),
        [Fraction(v) for v in DEFAULT.values],
    ],
)
def test_gate_reads_six_numbers_and_two_rows_of_three(form: object) -> None:
    assert GATE.judge(form, DEFAULT) == Verdict("accepted", DEFAULT, ())


def test_gate_reads_numpy_floats_but_not_numpy_truth_values() -> None:
    assert GATE.judge(np.array(DEFAULT.values, np.float32), DEFAULT).outcome == "accepted"
    assert GATE.judge(np.ones(6, bool), DEFAULT).outcome == "refused"


def test_gate_survives_objects_that_raise_when_they_are_read() -> None:
    class Hostile(list[float]):
        def __iter__(self) -> Any:
            raise RuntimeError("hostile")

    verdict = GATE.judge(Hostile([1.0] * 6), DEFAULT)
    assert verdict.outcome == "refused"
    assert verdict.matrix == DEFAULT


def test_gate_refuses_a_value_outside_the_envelope_and_names_the_limit() -> None:
    verdict = GATE.judge(changed(kp=3.0), DEFAULT)
    assert (verdict.outcome, verdict.matrix) == ("refused", DEFAULT)
    assert verdict.reasons == ("K_p = 3 lies outside 0.08 to 1.2; the last safe matrix stays",)


def test_gate_lowers_ki_to_what_kp_carries() -> None:
    verdict = GATE.judge(changed(ki=0.02), DEFAULT)
    assert verdict.outcome == "limited"
    assert verdict.matrix == changed(ki=ki_limit(0.35))
    assert "K_i is lowered from 0.02 to 0.01531" in verdict.reasons[0]


def test_gate_shortens_a_large_step_to_the_slew_limit() -> None:
    last = changed(ws=0.07)
    verdict = GATE.judge(changed(ws=6.0), last)
    assert verdict.outcome == "limited"
    assert CODEC.share(verdict.matrix.ws, 5) == pytest.approx(RANGES.slew)
    assert "W_s moves from 0.07 to" in verdict.reasons[0]
    assert "instead of 6: at most 50% of its range" in verdict.reasons[0]


def test_gate_couples_again_after_the_slew_held_kp_back() -> None:
    last = changed(kp=0.08, ki=0.0005)
    verdict = GATE.judge(changed(kp=1.2, ki=0.1), last)
    assert verdict.outcome == "limited"
    assert verdict.matrix.kp < 0.5
    assert verdict.matrix.ki <= ki_limit(verdict.matrix.kp)


def test_ki_falls_as_far_as_the_coupling_asks_in_one_step() -> None:
    last = changed(kp=1.2, ki=0.1)
    tight = SafetyGate(replace(RANGES, slew=0.9), CODEC)
    verdict = tight.judge(changed(kp=0.15, ki=0.1), last)
    assert verdict.matrix.ki == ki_limit(verdict.matrix.kp)


def test_gate_puts_the_default_in_place_of_an_unsafe_last_matrix() -> None:
    verdict = GATE.judge([math.nan] * 6, changed(kp=0.1, ki=0.1))
    assert (verdict.outcome, verdict.matrix) == ("refused", DEFAULT)
    assert "default" in verdict.reasons[0]


def test_gate_is_not_made_with_an_unsafe_default() -> None:
    with pytest.raises(ValueError, match=r"default matrix of lexus-rx450h is not safe.*K_p"):
        SafetyGate(replace(RANGES, default=changed(kp=5.0)), CODEC)
