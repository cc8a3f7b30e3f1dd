"""The gate with envelope and rollout check: what the simulation refuses, what it lets through."""

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from ridetune.codec import MatrixCodec
from ridetune.envelope import Envelope, Limits
from ridetune.gate import Check, SafetyGate
from ridetune.matrix import STYLES, ControllerMatrix, Style
from ridetune.sample import CONDITIONS, Condition
from ridetune.sim.check import OPEN_ROAD, SHORT_TURN, RolloutCheck, Trial, load_gate, violation
from ridetune.sim.plant import NOMINAL, Spread
from ridetune.sim.rollout import rollout
from tests.fake_policy import CONTRACT
from tests.shipped_car import DEFAULT, RANGES, VEHICLE, middle

CODEC = MatrixCodec(RANGES)
ENVELOPE = Envelope.load(Path("configs/verified.yaml"), vehicle=VEHICLE, ranges=RANGES)
CHECK = RolloutCheck(VEHICLE, ENVELOPE.limits)
GATE = SafetyGate(RANGES, CODEC, envelope=ENVELOPE, check=CHECK)
# The calmest steering of the ranges: too calm for a turn on snow.
SLOW = replace(DEFAULT, wl=RANGES.lowest[3], wh=0.0, ws=RANGES.highest[5])


def gate_with(check: Check) -> SafetyGate:
    """A gate whose check passes the default when it is made."""
    ready = False

    def late(matrix: ControllerMatrix, condition: Condition | None) -> str | None:
        return check(matrix, condition) if ready else None

    gate = SafetyGate(RANGES, CODEC, check=late)
    ready = True
    return gate


def test_a_violation_that_the_rollout_sees_is_refused_with_scenario_and_limit() -> None:
    run = rollout(SLOW, SHORT_TURN, "snow", vehicle=VEHICLE, spread=Spread(1.2, 0.7, 0.15))
    assert run.status == "left_lane"
    verdict = SafetyGate(RANGES, CODEC, check=CHECK).judge(SLOW, SLOW, "snow")
    assert (verdict.outcome, verdict.matrix) == ("refused", SLOW)
    assert "left turn, snow" in verdict.reasons[-1]
    assert "leaves its lane; the last safe matrix stays" in verdict.reasons[-1]


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("condition", [*CONDITIONS, None])
def test_the_middle_of_each_style_passes_in_every_condition_once_it_is_in_the_box(
    style: Style, condition: Condition | None
) -> None:
    asked = middle(style)
    last = asked
    verdict = GATE.judge(asked, last, condition)
    assert verdict.outcome != "refused", verdict.reasons
    assert ENVELOPE.contains(verdict.matrix, condition)
    if ENVELOPE.contains(asked, condition):
        assert verdict.matrix == asked


def test_the_default_is_accepted_in_every_condition() -> None:
    for condition in (*CONDITIONS, None):
        assert GATE.judge(DEFAULT, DEFAULT, condition).outcome == "accepted"


def test_a_condition_only_tightens_and_the_unknown_one_is_the_tightest() -> None:
    for condition in CONDITIONS:
        boxes = zip(
            zip(RANGES.lowest, RANGES.highest, strict=True),
            ENVELOPE.box("sunny"),
            ENVELOPE.box(condition),
            ENVELOPE.box(None),
            strict=True,
        )
        for nested in boxes:
            lows, highs = zip(*nested, strict=True)
            assert list(lows) == sorted(lows) and list(highs) == sorted(highs, reverse=True)


def test_when_snow_begins_a_refusal_keeps_the_last_matrix_moved_into_the_box() -> None:
    verdict = GATE.judge([math.nan] * 6, SLOW, "snow")
    assert verdict.outcome == "refused"
    assert ENVELOPE.contains(verdict.matrix, "snow")
    assert "the last matrix" in verdict.reasons[0] and "for snow" in verdict.reasons[0]


def test_a_matrix_beyond_the_box_is_moved_to_its_edge_even_against_the_slew() -> None:
    verdict = GATE.judge(SLOW, SLOW, "snow")
    assert verdict.outcome == "limited"
    assert ENVELOPE.contains(verdict.matrix, "snow")
    assert any("no further is verified for snow" in reason for reason in verdict.reasons)


def test_an_unknown_word_for_the_condition_counts_as_not_known() -> None:
    hail: Condition = "hail"  # type: ignore[assignment]
    assert GATE.judge(SLOW, SLOW, hail) == GATE.judge(SLOW, SLOW, None)


def test_a_check_that_raises_keeps_the_last_safe_matrix() -> None:
    def raises(matrix: ControllerMatrix, condition: Condition | None) -> str | None:
        raise FloatingPointError("no convergence")

    last = replace(DEFAULT, kp=0.4)
    verdict = gate_with(raises).judge(DEFAULT, last)
    assert (verdict.outcome, verdict.matrix) == ("refused", last)
    assert "no answer (FloatingPointError)" in verdict.reasons[-1]


def test_nan_in_a_checked_drive_is_a_violation_and_keeps_the_last_safe_matrix() -> None:
    def drives_nan(matrix: ControllerMatrix, condition: Condition | None) -> str | None:
        run = rollout(replace(matrix, ws=math.nan), SHORT_TURN, vehicle=VEHICLE)
        return violation(run, SHORT_TURN, "sunny", Limits())

    last = replace(DEFAULT, kp=0.4)
    verdict = gate_with(drives_nan).judge(DEFAULT, last)
    assert (verdict.outcome, verdict.matrix) == ("refused", last)
    assert "gets out of control" in verdict.reasons[-1]


def test_a_trajectory_with_nan_breaks_a_limit_whatever_its_status() -> None:
    run = rollout(DEFAULT, SHORT_TURN, vehicle=VEHICLE)
    for signal in ("lateral_error_m", "speed_mps", "yaw_rate_radps", "acceleration_mps2"):
        trajectory = replace(run.trajectory, signals=run.trajectory.signals.copy())
        trajectory[signal][-3] = math.nan
        assert violation(replace(run, trajectory=trajectory), SHORT_TURN, "sunny", Limits())


def test_an_integral_gain_above_its_rule_overshoots_and_is_seen() -> None:
    trial = Trial(OPEN_ROAD, NOMINAL)
    check = RolloutCheck(VEHICLE, Limits(), [trial])
    assert check(replace(DEFAULT, kp=0.35, ki=0.35**2 / 8.0), "sunny") is None
    assert "faster than asked" in (check(replace(DEFAULT, kp=0.35, ki=0.1), "sunny") or "")


def test_an_unstable_speed_loop_is_refused_because_it_does_not_settle() -> None:
    check = RolloutCheck(VEHICLE, Limits(), [Trial(OPEN_ROAD, Spread(mass=0.8))])
    found = check(replace(DEFAULT, kp=8.0, ki=0.0, kd=0.0), "sunny")
    assert found is not None and ("settle" in found or "faster" in found)


def test_an_unstable_steering_loop_is_refused_with_its_reason() -> None:
    wild = replace(DEFAULT, wl=20.0, wh=0.0, ws=0.01)
    assert "leaves its lane" in (CHECK(wild, "sunny") or "")


def test_the_check_stops_at_the_first_violation() -> None:
    trials = [Trial(SHORT_TURN, Spread(1.25, 0.65, 0.15)), Trial(OPEN_ROAD, NOMINAL)]
    both = RolloutCheck(VEHICLE, Limits(), trials)(replace(SLOW, ki=0.1), "snow")
    assert both is not None and "left turn" in both


def test_a_gate_is_not_made_with_a_default_that_the_check_refuses() -> None:
    with pytest.raises(ValueError, match="default matrix of lexus-rx450h is not safe: never"):
        SafetyGate(RANGES, CODEC, check=lambda *_: "never")


def test_the_served_gate_drives_what_it_judges() -> None:
    gate = load_gate(CONTRACT, VEHICLE, Path("configs/verified.yaml"))
    verdict = gate.judge(SLOW, SLOW)
    assert ENVELOPE.contains(verdict.matrix, None)


def test_gate_and_envelope_load_without_the_simulation() -> None:
    code = (
        "import sys; sys.modules['numba'] = None\n"
        "import ridetune.envelope, ridetune.gate, ridetune.policy"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
