"""Metrics of drives whose values follow from a formula, and of drives that broke off."""

import json
import math
from collections.abc import Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from ridetune.sim.metrics import measure, time_to_collision
from ridetune.sim.trajectory import SIGNALS, Trajectory

PERIOD_S = 0.02
TIME = np.arange(0.0, 10.0 + PERIOD_S / 2, PERIOD_S)


def trajectory(signals: Mapping[str, NDArray[np.float64] | float]) -> Trajectory:
    """A drive on a free road with the given signals, the others 0."""
    free: dict[str, NDArray[np.float64] | float] = {"gap_m": math.inf, "lead_speed_mps": math.nan}
    columns = free | dict(signals)
    rows = [np.broadcast_to(columns.get(name, 0.0), TIME.shape) for name in SIGNALS]
    return Trajectory(PERIOD_S, np.stack(rows, axis=1).astype(np.float64))


def first_order(target: float, tau_s: float) -> Trajectory:
    return trajectory(
        {
            "speed_mps": target * -np.expm1(-TIME / tau_s),
            "acceleration_mps2": target / tau_s * np.exp(-TIME / tau_s),
            "reference_speed_mps": target,
        }
    )


def test_first_order_start_has_its_textbook_rise_time_acceleration_and_jerk() -> None:
    drive = measure(first_order(14.0, 2.0))
    assert drive.t90_s == pytest.approx(2.0 * math.log(10.0), abs=1e-3)
    assert drive.overshoot_mps == 0.0
    assert drive.peak_ax == pytest.approx(7.0)
    assert drive.mean_ax == pytest.approx(14.0 * -math.expm1(-5.0) / 10.0, rel=0.02)
    assert drive.peak_jx == pytest.approx(3.5, rel=0.01)
    assert drive.mean_jx == pytest.approx(7.0 * -math.expm1(-5.0) / 10.0, rel=0.01)
    assert drive.duration_s == pytest.approx(10.0)
    assert drive.broke_off_s is None and not drive.failed


def test_variance_of_a_linear_speed_is_that_of_a_uniform_variable() -> None:
    drive = measure(trajectory({"speed_mps": 2.0 * TIME, "lateral_speed_mps": 0.3 * TIME}))
    assert drive.sv_x == pytest.approx(20.0**2 / 12.0, rel=0.01)
    assert drive.sv_y == pytest.approx(3.0**2 / 12.0, rel=0.01)


def test_time_to_collision_is_the_smallest_over_the_closing_moments() -> None:
    gap = 30.0 - 4.0 * TIME
    closing = trajectory({"speed_mps": 14.0, "lead_speed_mps": 10.0, "gap_m": np.maximum(gap, 6.0)})
    # The lead keeps 10 m/s to the end, so the smallest gap decides: 6 m / 4 m/s.
    assert time_to_collision(closing) == pytest.approx(1.5)
    fled = trajectory({"speed_mps": 10.0, "lead_speed_mps": 14.0, "gap_m": 30.0 + 4.0 * TIME})
    assert time_to_collision(fled) == math.inf
    steady = trajectory({"speed_mps": 10.0, "lead_speed_mps": 10.0, "gap_m": 5.0})
    assert time_to_collision(steady) == math.inf
    assert measure(steady).min_gap_m == 5.0


def test_lead_that_leaves_the_lane_counts_only_while_it_is_there() -> None:
    there = TIME < 5.0
    drive = trajectory(
        {
            "speed_mps": 14.0,
            "gap_m": np.where(there, 40.0 - 2.0 * TIME, math.inf),
            "lead_speed_mps": np.where(there, 12.0, math.nan),
        }
    )
    found = measure(drive)
    assert found.broke_off_s is None
    assert found.min_gap_m == pytest.approx(40.0 - 2.0 * 4.98)
    assert found.ttc_s == pytest.approx(found.min_gap_m / 2.0)


def test_contact_is_a_collision_even_when_the_lead_is_faster() -> None:
    gap = np.where(TIME > 8.0, -0.1, 3.0)
    found = measure(trajectory({"speed_mps": 9.0, "lead_speed_mps": 10.0, "gap_m": gap}))
    assert found.ttc_s == 0.0
    assert found.collided and found.failed and found.broke_off_s is None


def test_free_road_has_no_time_to_collision_and_no_gap() -> None:
    found = measure(first_order(14.0, 2.0))
    assert (found.ttc_s, found.min_gap_m) == (math.inf, math.inf)
    assert not found.collided


def test_steady_bend_is_felt_but_changes_no_lateral_speed() -> None:
    speed, radius = 30 / 3.6, 23.89
    found = measure(
        trajectory(
            {"speed_mps": speed, "yaw_rate_radps": speed / radius, "lateral_speed_mps": -0.2}
        )
    )
    assert found.felt.mean_acceleration == pytest.approx(2.907, abs=1e-3)  # v^2 / R
    assert found.felt.peak_jerk == pytest.approx(0.0, abs=1e-9)
    assert found.body.peak_acceleration == pytest.approx(0.0, abs=1e-9)


def test_lateral_swing_has_the_derivatives_of_a_sine_in_both_definitions() -> None:
    omega = 2.0
    found = measure(
        trajectory(
            {
                "speed_mps": 10.0,
                "lateral_speed_mps": 0.5 * np.sin(omega * TIME),
                "yaw_rate_radps": 0.1 * np.sin(omega * TIME),
            }
        )
    )
    assert found.body.peak_acceleration == pytest.approx(0.5 * omega, rel=0.01)
    assert found.body.peak_jerk == pytest.approx(0.5 * omega**2, rel=0.01)
    assert found.felt.peak_acceleration == pytest.approx(1.0, rel=0.01)
    assert found.felt.peak_jerk == pytest.approx(omega, rel=0.01)
    assert found.felt.mean_acceleration == pytest.approx(2.0 / math.pi, rel=0.05)


@pytest.mark.parametrize(("first", "last"), [(0.0, 14.0), (14.0, 4.0)])
def test_overshoot_is_counted_in_the_direction_of_the_step(first: float, last: float) -> None:
    decay = np.exp(-TIME) * np.cos(3.0 * TIME)
    found = measure(
        trajectory(
            {"speed_mps": last + (first - last) * decay, "reference_speed_mps": last},
        )
    )
    # The first extremum of e^-t cos 3t lies at tan 3t = -1/3, t = 0.9399.
    expected = abs(last - first) * -math.exp(-0.9399) * math.cos(3 * 0.9399)
    assert found.overshoot_mps == pytest.approx(expected, rel=1e-3)


def test_speed_that_never_comes_near_is_never_reached() -> None:
    found = measure(trajectory({"speed_mps": 0.1 * TIME, "reference_speed_mps": 14.0}))
    assert found.t90_s == math.inf
    assert found.overshoot_mps == 0.0


def test_constant_reference_is_no_speed_step() -> None:
    found = measure(trajectory({"speed_mps": 13.9, "reference_speed_mps": 14.0}))
    assert found.t90_s is None and found.overshoot_mps is None


def test_steady_error_is_that_of_the_last_two_seconds() -> None:
    error = np.where(TIME > 7.9, -0.1, 3.5)
    found = measure(trajectory({"speed_mps": 14.0, "lateral_error_m": error}))
    assert found.lateral_error_steady_m == pytest.approx(0.1)
    assert found.lateral_error_peak_m == 3.5


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("signal", ["speed_mps", "steer_rad"])
def test_drive_that_breaks_off_says_when_and_keeps_the_part_before(
    signal: str, value: float
) -> None:
    whole = first_order(14.0, 2.0)
    signals = whole.signals.copy()
    signals[250:, SIGNALS.index(signal)] = value
    found = measure(Trajectory(PERIOD_S, signals))
    assert found.broke_off_s == pytest.approx(5.0)
    assert found.failed and not found.collided
    assert math.isfinite(found.mean_jx) and math.isfinite(found.felt.peak_jerk)
    part = measure(Trajectory(PERIOD_S, whole.signals[:250]))
    assert (found.sv_x, found.t90_s, found.peak_jx) == (part.sv_x, part.t90_s, part.peak_jx)


def test_gap_that_is_not_a_number_breaks_the_drive_off() -> None:
    signals = trajectory({"speed_mps": 9.0, "lead_speed_mps": 9.0, "gap_m": 20.0}).signals
    signals[100, SIGNALS.index("gap_m")] = math.nan
    assert measure(Trajectory(PERIOD_S, signals)).broke_off_s == pytest.approx(2.0)
    signals[100, SIGNALS.index("gap_m")] = 20.0
    signals[50, SIGNALS.index("lead_speed_mps")] = math.nan
    assert measure(Trajectory(PERIOD_S, signals)).broke_off_s == pytest.approx(1.0)


@pytest.mark.parametrize("rows", [0, 1, 3])
def test_drive_of_hardly_any_rows_is_broken_off_and_praises_nothing(rows: int) -> None:
    found = measure(Trajectory(PERIOD_S, first_order(14.0, 2.0).signals[:rows]))
    assert found.broke_off_s == pytest.approx(rows * PERIOD_S)
    assert found.failed
    assert math.isnan(found.sv_x) and math.isnan(found.felt.peak_jerk)


def test_json_form_has_null_where_a_number_is_infinite_or_missing() -> None:
    for drive in (first_order(14.0, 2.0), Trajectory(PERIOD_S, np.full((9, 13), math.nan))):
        plain = json.loads(json.dumps(measure(drive).as_dict(), allow_nan=False))
        assert plain["ttc_s"] is None
        assert set(plain["felt"]) == set(plain["body"])
