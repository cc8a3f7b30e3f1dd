"""The closed loop: physics, scenarios, and what the fast loop leaves out."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ridetune.control.kernel import Numbers
from ridetune.control.mpc import NUM_GAINS, BicycleModel, preview_gains
from ridetune.control.path import Path as DrivePath
from ridetune.control.tracker import PERIOD_S, Measurement, Tracker
from ridetune.control.vehicle import Sensors, Vehicle
from ridetune.matrix import STYLES, ControllerMatrix, Style
from ridetune.sample import CONDITIONS, Condition
from ridetune.sim.loop import BIN_MPS, LANE_MARGIN_M
from ridetune.sim.metrics import measure
from ridetune.sim.plant import (
    HEADING,
    NOMINAL,
    NUM_CELLS,
    SPEED,
    STEER,
    Plant,
    Spread,
    X,
    Y,
    draw_spread,
    move,
)
from ridetune.sim.road import AT_SPEED, lay_out
from ridetune.sim.rollout import rollout, rollout_batch
from ridetune.sim.scenarios import (
    ACCELERATION as ACCELERATING,
)
from ridetune.sim.scenarios import (
    KMH,
    LANE_CHANGE,
    LEFT_TURN,
    MANOEUVRES,
    PEDESTRIAN,
    SCENARIOS,
    TRAFFIC_LIGHT,
    Actor,
    Scenario,
    Straight,
)
from tests.shipped_car import DEFAULT, RANGES, VEHICLE, middle, run

QUIET = replace(VEHICLE, sensors=Sensors(0.0, 0.0, 0.0, 0.0))
FREE_STEP = replace(ACCELERATING, actors=(), drive_off_s=0.0)


# --- the same run again ---


def test_the_same_seed_gives_the_same_run_and_another_one_does_not() -> None:
    first, again = run(DEFAULT, LANE_CHANGE, seed=4), run(DEFAULT, LANE_CHANGE, seed=4)
    np.testing.assert_array_equal(first.trajectory.signals, again.trajectory.signals)
    other = run(DEFAULT, LANE_CHANGE, seed=5)
    assert not np.array_equal(first.trajectory.signals, other.trajectory.signals)


def test_a_batch_equals_its_runs_one_by_one() -> None:
    matrices = [DEFAULT, DEFAULT, middle("aggressive"), DEFAULT]
    spreads = [NOMINAL, Spread(mass=1.2), Spread(tyres=0.7), Spread(steer_delay_s=0.15)]
    batch = rollout_batch(
        matrices, LEFT_TURN, "rain", vehicle=VEHICLE, spreads=spreads, seeds=[1, 2, 3, 4]
    )
    for i, (matrix, spread) in enumerate(zip(matrices, spreads, strict=True)):
        alone = rollout(matrix, LEFT_TURN, "rain", vehicle=VEHICLE, spread=spread, seed=i + 1)
        np.testing.assert_array_equal(batch[i].trajectory.signals, alone.trajectory.signals)


def test_counts_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="4 runs need 1 or 4 matrices, got 3"):
        rollout_batch([DEFAULT] * 3, LEFT_TURN, vehicle=VEHICLE, seeds=[1, 2, 3, 4])


# --- what the six numbers do ---


def test_a_higher_kp_reaches_the_speed_sooner() -> None:
    times = []
    for kp in (0.1, 0.2, 0.3, 0.5, 1.0):
        matrix = replace(DEFAULT, kp=kp, ki=kp * kp / 8.0)
        times.append(measure(run(matrix, FREE_STEP).trajectory).t90_s or math.inf)
    assert times == sorted(times, reverse=True)
    assert times[0] > 2.5 * times[-1]


@pytest.mark.parametrize("kp", [0.2, 0.35, 0.5])
def test_the_overshoot_grows_with_ki_and_stays_small_within_its_coupling(kp: float) -> None:
    limit = kp * kp / 8.0
    overshoots = [
        measure(run(replace(DEFAULT, kp=kp, ki=ki, kd=0.0), FREE_STEP).trajectory).overshoot_mps
        or 0.0
        for ki in (0.0, limit, 4.0 * limit)
    ]
    step = FREE_STEP.target_mps
    assert overshoots[0] < 0.005 * step
    # A PI loop without limits would overshoot by 8.2 % of the step at the limit.
    assert overshoots[1] < 0.082 * step
    assert overshoots[2] > 2.0 * overshoots[1]


def test_a_higher_steering_weight_lowers_the_lateral_acceleration() -> None:
    peaks = [
        measure(run(replace(DEFAULT, ws=ws), LANE_CHANGE).trajectory).felt.peak_acceleration
        for ws in (0.02, 0.1, 0.35, 1.0, 3.0, 10.0)
    ]
    assert peaks == sorted(peaks, reverse=True)
    assert peaks[0] > 1.5 * peaks[-1]


def test_the_styles_are_ordered_in_time_lateral_acceleration_and_jerk() -> None:
    speeding = [measure(run(middle(s), ACCELERATING).trajectory) for s in STYLES]
    turning = [measure(run(middle(s), LANE_CHANGE).trajectory) for s in STYLES]
    times = [m.t90_s or math.inf for m in speeding]
    assert times == sorted(times, reverse=True) and times[0] > 1.2 * times[-1]
    for values in (
        [m.mean_jx for m in speeding],
        [m.peak_ax for m in speeding],
        [m.felt.peak_acceleration for m in turning],
        [m.felt.mean_jerk for m in turning],
    ):
        assert values == sorted(values) and values[-1] > 1.2 * values[0]


def test_the_default_accelerates_like_the_baseline_of_the_paper() -> None:
    """Table 1, acceleration, baseline: SV_x 28.8 m2/s2, |a_x| 0.78 m/s2; within 15 %."""
    runs = [measure(run(DEFAULT, ACCELERATING, c).trajectory) for c in CONDITIONS]
    assert np.mean([m.sv_x for m in runs]) == pytest.approx(28.8, rel=0.15)
    assert np.mean([m.mean_ax for m in runs]) == pytest.approx(0.78, rel=0.15)


# --- scenarios and conditions ---


@pytest.mark.parametrize("condition", CONDITIONS)
@pytest.mark.parametrize("name", sorted(SCENARIOS))
def test_the_default_drives_every_scenario_in_every_condition(
    name: str, condition: Condition
) -> None:
    driven = run(DEFAULT, SCENARIOS[name], condition)
    assert driven.safe
    assert np.isfinite(driven.trajectory["speed_mps"]).all()
    stands = name == "static_obstacle"
    assert driven.status == ("stopped" if stands else "finished")


@pytest.mark.parametrize("style", STYLES)
def test_every_style_drives_every_scenario_in_every_condition(style: Style) -> None:
    for scenario in SCENARIOS.values():
        for condition in CONDITIONS:
            assert run(middle(style), scenario, condition).safe, (scenario.name, condition)


@pytest.mark.parametrize("kp", [0.08, 1.2])
def test_neither_slow_nor_quick_gains_come_too_close_to_what_is_ahead(kp: float) -> None:
    for name in ("acceleration", "car_following", "work_zone", "static_obstacle", "pedestrian"):
        driven = run(replace(DEFAULT, kp=kp, ki=0.0), SCENARIOS[name])
        assert driven.safe and driven.trajectory["gap_m"].min() > 2.5, name
        assert driven.trajectory["acceleration_mps2"].min() > -3.0, name


@pytest.mark.parametrize("style", STYLES)
def test_every_style_drives_a_spread_of_cars_through_the_manoeuvres(style: Style) -> None:
    rng = np.random.default_rng(7)
    spreads = [draw_spread(rng) for _ in range(12)]
    for scenario in MANOEUVRES:
        batch = rollout_batch(
            [middle(style)], scenario, vehicle=VEHICLE, spreads=spreads, seeds=range(12)
        )
        assert set(batch.statuses) == {"finished"}, scenario.name


def test_the_left_turn_has_the_radius_of_the_paper() -> None:
    table = DrivePath.of(LEFT_TURN.waypoints(), 1.0).table
    curvature = table[:, 3]
    assert 1.0 / np.median(curvature[curvature > 0.03]) == pytest.approx(23.89, rel=0.005)
    assert table[-1, 2] == pytest.approx(math.pi / 2, abs=1e-3)


def test_the_lead_drives_off_as_in_the_paper() -> None:
    road = lay_out(ACCELERATING, "sunny", VEHICLE, PERIOD_S)
    speed = road.positions[0, :, AT_SPEED]
    assert speed[0] == 0.0
    assert speed[100] == pytest.approx(1.26 * 3.0)
    assert speed[-1] == pytest.approx(45.0 * KMH, rel=0.005)
    assert run(DEFAULT, ACCELERATING).trajectory["gap_m"][0] == pytest.approx(30.0)


def test_the_overtaking_car_leaves_the_lane_of_the_lead_about_30_m_behind_it() -> None:
    for style in STYLES:
        gap = run(middle(style), LANE_CHANGE).trajectory["gap_m"]
        assert 20.0 < gap[np.isfinite(gap)].min() < 40.0


def test_the_light_turns_green_only_once_the_car_stands_before_the_line() -> None:
    driven = run(DEFAULT, TRAFFIC_LIGHT).trajectory
    speed, nose = driven["speed_mps"], driven["x_m"] + VEHICLE.body.nose_m
    stop = int(np.argmax(speed < 0.1))
    assert stop > 0 and speed[-1] > 0.8 * TRAFFIC_LIGHT.target_mps
    line = VEHICLE.body.nose_m + 350.0
    assert line - 5.0 < nose[stop] < line
    assert speed[:stop].min() >= 0.1


def test_the_pedestrian_has_crossed_before_the_car_drives_on() -> None:
    driven = run(DEFAULT, PEDESTRIAN).trajectory
    speed = driven["speed_mps"]
    stop = int(np.argmax(speed < 0.1))
    standing = int(np.sum(speed < 0.1)) * PERIOD_S
    assert stop > 0 and standing > 4.0
    assert speed[-1] > 0.8 * PEDESTRIAN.target_mps


def test_fog_hides_what_stands_ahead_and_the_car_brakes_later() -> None:
    def first_braking(condition: Condition) -> float:
        driven = run(DEFAULT, TRAFFIC_LIGHT, condition).trajectory
        slower = driven["reference_speed_mps"] < 0.99 * TRAFFIC_LIGHT.target_mps
        return float(driven["x_m"][int(np.argmax(slower))])

    far = replace(TRAFFIC_LIGHT, initial_mps=20.0, target_mps=20.0)
    clear = run(DEFAULT, far, "sunny").trajectory["reference_speed_mps"]
    foggy = run(DEFAULT, far, "fog").trajectory["reference_speed_mps"]
    assert np.argmax(foggy < 19.0) > np.argmax(clear < 19.0)
    assert first_braking("sunny") > 0.0


def test_snow_takes_the_grip_that_a_fast_turn_needs() -> None:
    fast = replace(LEFT_TURN, initial_mps=11.0, target_mps=11.0)
    assert run(DEFAULT, fast, "sunny").status == "finished"
    assert run(DEFAULT, fast, "snow").status == "left_lane"


def test_running_into_something_is_a_collision_and_ends_the_run() -> None:
    wall = Scenario("wall", "", (Straight(300.0),), 20.0, 20.0, actors=(Actor("barrier", 15.0),))
    driven = run(DEFAULT, wall)
    assert driven.status == "collided" and not driven.safe
    gap = driven.trajectory["gap_m"]
    assert np.nanmin(gap) <= 0.0
    end = int(np.argmax(np.isnan(driven.trajectory["speed_mps"])))
    assert end > 0 and np.isnan(driven.trajectory.signals[end:]).all()
    assert measure(driven.trajectory).failed


def test_crossing_a_closed_stop_line_is_a_collision() -> None:
    line = Actor("stop_line", 10.0, length_m=0.3, trigger="stopped", leaves_s=0.0)
    driven = run(DEFAULT, Scenario("line", "", (Straight(300.0),), 20.0, 20.0, actors=(line,)))
    assert driven.status == "collided"


def test_leaving_the_lane_ends_the_run() -> None:
    weak = replace(DEFAULT, wl=0.0, wh=0.0, ws=1e6)
    driven = run(weak, LEFT_TURN)
    assert driven.status == "left_lane"
    assert np.nanmax(np.abs(driven.trajectory["lateral_error_m"])) > LANE_MARGIN_M


@pytest.mark.parametrize("cell", range(6))
def test_a_matrix_with_nan_ends_the_run_as_unstable(cell: int) -> None:
    values = list(DEFAULT.values)
    values[cell] = math.nan
    driven = run(ControllerMatrix.of(values), LEFT_TURN)
    assert driven.status == "unstable"


def test_wild_matrices_end_in_a_status_and_never_raise() -> None:
    rng = np.random.default_rng(3)
    scale = 10.0 ** rng.uniform(-9, 12, (40, 6)) * rng.choice([-1.0, 0.0, 1.0], (40, 6))
    scale[:4] = [[np.inf] * 6, [-np.inf] * 6, [0.0] * 6, [1e308] * 6]
    batch = rollout_batch([ControllerMatrix.of(row) for row in scale], LEFT_TURN, vehicle=VEHICLE)
    assert "unstable" in batch.statuses and "left_lane" in batch.statuses


# --- what the fast loop leaves out ---


def drive_exactly(
    vehicle: Vehicle, matrix: ControllerMatrix, scenario: Scenario
) -> tuple[Numbers, set[str]]:
    """The Tracker (Riccati or DAQP, exact speed) on the same plant: poses [step, 3], statuses."""
    tracker = Tracker(vehicle, DrivePath.of(scenario.waypoints(), scenario.target_mps), matrix)
    plant = Plant.of(vehicle, NOMINAL, 0.9, PERIOD_S)
    steps = round(scenario.duration_s / PERIOD_S)
    statuses: set[str] = set()
    state, poses = np.zeros(NUM_CELLS), np.empty((steps, 3))
    state[SPEED] = scenario.initial_mps
    steers, pulls = np.zeros(steps), np.zeros(steps)
    for k in range(steps):
        x, y, heading = (float(state[i]) for i in (X, Y, HEADING))
        poses[k] = x, y, heading
        command = tracker.step(Measurement(x, y, heading, float(state[SPEED]), float(state[STEER])))
        statuses.add(command.status)
        steers[k], pulls[k] = command.steer_rad, command.acceleration_mps2
        move(plant, state, steers, pulls, k, PERIOD_S)
    return poses, statuses


@pytest.mark.parametrize("scenario", [LANE_CHANGE, LEFT_TURN], ids=lambda s: s.name)
@pytest.mark.parametrize("style", STYLES)
def test_the_fast_loop_drives_within_millimetres_of_the_exact_controller(
    style: Style, scenario: Scenario
) -> None:
    matrix, alone = middle(style), replace(scenario, actors=())
    exact, statuses = drive_exactly(QUIET, matrix, alone)
    fast = rollout(matrix, alone, vehicle=QUIET).trajectory
    apart = np.hypot(fast["x_m"] - exact[:, 0], fast["y_m"] - exact[:, 1])
    assert statuses == {"unconstrained"}
    assert apart.max() < 0.005


def test_where_the_rate_limit_is_active_clamping_comes_near_the_quadratic_program() -> None:
    hard = replace(middle("aggressive"), wl=1.5, ws=0.07)
    fast_turn = replace(LEFT_TURN, initial_mps=10.0, target_mps=10.0)
    slow_wheel = replace(QUIET, limits=replace(QUIET.limits, steer_rate_radps=0.2))
    exact, statuses = drive_exactly(slow_wheel, hard, fast_turn)
    fast = rollout(hard, fast_turn, vehicle=slow_wheel)
    assert "constrained" in statuses and fast.status == "finished"
    driven = fast.trajectory
    apart = np.hypot(driven["x_m"] - exact[:, 0], driven["y_m"] - exact[:, 1])
    # Not the same solver: the difference shows, and stays within a lane's slack.
    assert 0.01 < apart.max() < 0.2


def test_gains_between_two_speeds_are_nearly_the_exact_ones() -> None:
    """Halfway between bins, where the linear blend is worst, over the corners of the envelope."""
    model, worst = BicycleModel.of(VEHICLE), 0.0
    low, high, exact = np.empty(NUM_GAINS), np.empty(NUM_GAINS), np.empty(NUM_GAINS)
    for wl in (RANGES.lowest[3], RANGES.highest[3]):
        for ws in (RANGES.lowest[5], RANGES.highest[5]):
            for speed in (2.0, 5.0, 14.0):
                weights = np.array([wl, 1.0, ws])
                preview_gains(model, weights, speed, low)
                preview_gains(model, weights, speed + BIN_MPS, high)
                preview_gains(model, weights, speed + 0.5 * BIN_MPS, exact)
                off = np.abs(0.5 * (low + high) - exact)[:3] / np.abs(exact[:3])
                worst = max(worst, float(off.max()))
    assert worst < 0.03
