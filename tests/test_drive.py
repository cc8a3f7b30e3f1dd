"""A policy in the loop: the gate, swaps, and every way in which a policy fails."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from ridetune.codec import MatrixCodec
from ridetune.control.tracker import PERIOD_S
from ridetune.gate import SafetyGate
from ridetune.matrix import ControllerMatrix
from ridetune.sim.drive import Answer, MatrixSource, Moment, PolicyDrive, drive_policy
from ridetune.sim.scenarios import (
    LANE_CHANGE,
    MANOEUVRES,
    STATIC_OBSTACLE,
    Scenario,
)
from tests.shipped_car import DEFAULT, RANGES, VEHICLE, middle, run

GATE = SafetyGate(RANGES, MatrixCodec(RANGES))


def with_policy(source: MatrixSource, scenario: Scenario = LANE_CHANGE) -> PolicyDrive:
    return drive_policy(source, scenario, vehicle=VEHICLE, gate=GATE, default=DEFAULT)


def test_a_policy_that_says_the_default_drives_like_the_default() -> None:
    driven = with_policy(lambda _: Answer(DEFAULT))
    expected = run(DEFAULT, LANE_CHANGE).trajectory.signals
    np.testing.assert_array_equal(driven.rollout.trajectory.signals, expected)
    assert driven.questions == len(driven.changes) == 19
    assert driven.stopping_s == 0.0


def test_proposals_pass_the_gate_and_swap_without_a_jump() -> None:
    styles = [middle("aggressive"), middle("conservative")]
    driven = with_policy(lambda moment: Answer(styles[round(moment.time_s) % 2]))
    assert "limited" in {change.outcome for change in driven.changes}
    assert len({change.matrix for change in driven.changes}) > 1
    signals = driven.rollout.trajectory
    assert driven.rollout.status == "finished"
    jerk = np.diff(signals["acceleration_mps2"]) / PERIOD_S
    assert np.abs(jerk).max() <= VEHICLE.limits.jerk_mps3 + 1e-9
    rate = np.diff(signals["steer_rad"]) / PERIOD_S
    assert np.abs(rate).max() <= VEHICLE.limits.steer_rate_radps + 1e-9


def raising(moment: Moment) -> Answer:
    raise RuntimeError("the model is gone")


FAILURES: dict[str, Callable[[Moment], Answer | None]] = {
    "never": lambda _: None,
    "raises": raising,
    "nan": lambda _: Answer([[math.nan] * 3, [math.nan] * 3]),
    "no matrix": lambda _: Answer("drive carefully"),
    "outside": lambda _: Answer(ControllerMatrix(50.0, 0.0, 0.0, 0.1, 1.0, 0.3)),
    "too late": lambda _: Answer(DEFAULT, latency_s=3.5),
    "latency nan": lambda _: Answer(DEFAULT, latency_s=math.nan),
}


@pytest.mark.parametrize("scenario", MANOEUVRES, ids=lambda s: s.name)
@pytest.mark.parametrize("failure", sorted(FAILURES))
def test_a_failing_policy_leaves_the_last_matrix_and_the_car_stops_in_its_lane(
    failure: str, scenario: Scenario
) -> None:
    driven = with_policy(FAILURES[failure], scenario)
    assert driven.rollout.status == "stopped"
    assert {change.matrix for change in driven.changes} <= {DEFAULT}
    assert {change.outcome for change in driven.changes} <= {"refused"}
    signals = driven.rollout.trajectory
    assert np.abs(signals["lateral_error_m"]).max() < 0.5
    assert signals["acceleration_mps2"].min() > -3.0
    patient = signals["speed_mps"][signals.time_s < 3.0]
    assert patient[-1] > 0.8 * scenario.initial_mps


def test_a_policy_that_is_late_but_not_too_late_is_heard_late() -> None:
    driven = with_policy(lambda _: Answer(middle("moderate"), latency_s=2.0))
    assert driven.rollout.status == "finished" and driven.stopping_s == 0.0
    assert driven.changes[0].time_s == pytest.approx(2.01, abs=PERIOD_S)
    # One question at a time: the next one waits for the answer.
    assert driven.questions <= 7


def test_a_policy_that_comes_back_lets_the_car_drive_on() -> None:
    driven = with_policy(lambda moment: Answer(DEFAULT) if moment.time_s > 8.0 else None)
    speed = driven.rollout.trajectory["speed_mps"]
    assert driven.stopping_s == pytest.approx(5.0, abs=1.1)
    assert speed.min() < 0.6 * LANE_CHANGE.initial_mps
    assert speed[-1] > 0.8 * LANE_CHANGE.target_mps


def test_the_source_sees_the_road_as_it_is() -> None:
    seen: list[Moment] = []

    def source(moment: Moment) -> Answer:
        seen.append(moment)
        return Answer(DEFAULT)

    driven = with_policy(source, STATIC_OBSTACLE)
    assert [round(moment.time_s) for moment in seen] == list(range(19))
    assert seen[0].speed_mps == STATIC_OBSTACLE.initial_mps
    assert len(seen[0].actors) == len(STATIC_OBSTACLE.actors)
    assert seen[0].actors[0] == pytest.approx((VEHICLE.body.nose_m + 30.3, -0.4))
    k = round(seen[5].time_s / PERIOD_S)
    assert seen[5].x_m == driven.rollout.trajectory["x_m"][k]
