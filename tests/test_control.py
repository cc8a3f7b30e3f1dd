"""The controllers: what is solved, what is limited, and what happens when inputs are no numbers."""

import math
import subprocess
import sys
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ridetune.control.headway import Headway, braking_ceiling, hold_ceiling, safe_speed
from ridetune.control.kernel import Numbers, sources_hash
from ridetune.control.mpc import (
    NUM_GAINS,
    NUM_STEPS,
    STEP_S,
    BicycleModel,
    discretise,
    matrices,
    preview_command,
    preview_gains,
    roll_forward,
    slip_gain,
    yaw_gain,
)
from ridetune.control.path import CURVATURE, HEADING, locate
from ridetune.control.path import Path as DrivePath
from ridetune.control.pid import SpeedController
from ridetune.control.steering import (
    LateralController,
    LateralProblem,
    solve_qp,
    solve_riccati,
)
from ridetune.control.tracker import PERIOD_S, Ahead, Measurement, Tracker
from ridetune.control.vehicle import Limits, Vehicle
from ridetune.matrix import ControllerMatrix

VEHICLE_YAML = Path("configs/vehicle.yaml")
VEHICLE = Vehicle.load(VEHICLE_YAML)
MODEL = BicycleModel.of(VEHICLE)
DEFAULT = ControllerMatrix(0.35, 0.005, 0.08, 0.16, 1.0, 0.35)
AGGRESSIVE = ControllerMatrix(1.0, 0.03, 0.0, 0.8, 5.0, 0.08)
NO_LIMITS = Limits(3.0, 5.0, 5.0, 10.0, 1000.0)

weights = st.tuples(st.floats(0.02, 1.5), st.floats(0.0, 20.0), st.floats(0.07, 6.0))
states = st.tuples(st.floats(-1.5, 1.5), st.floats(-0.2, 0.2), st.floats(-0.3, 0.3))
speeds = st.floats(0.0, 20.0)


def winding_path() -> DrivePath:
    x = np.linspace(0.0, 300.0, 1500)
    return DrivePath.of(np.stack([x, 3.0 * np.sin(x / 15.0)], axis=1), 10.0)


WINDING = winding_path()


def unlimited(problem: LateralProblem) -> LateralProblem:
    far = np.full(NUM_STEPS, 100.0)
    return replace(problem, lowest=-far, highest=far, slowest=-far, fastest=far)


def problem_of(
    weights: tuple[float, ...], state: tuple[float, ...], speed: float, last: float = 0.0
) -> LateralProblem:
    controller = LateralController(VEHICLE, PERIOD_S)
    return controller.problem(np.array(weights), np.array(state), speed, WINDING.table, 30.0, last)


def cost(problem: LateralProblem, commands: Numbers) -> float:
    A, B, _ = matrices(problem.step)
    x, total = problem.state, 0.0
    for u, push, angle in zip(commands, problem.pushes, problem.feed_forward, strict=True):
        x = A @ x + B * u + push
        total += problem.q_lateral * x[0] ** 2 + problem.q_course * x[1] ** 2
        total += problem.r * (u - angle) ** 2
    return total


@settings(deadline=None, max_examples=60)
@given(weights, states, speeds)
def test_riccati_equals_the_quadratic_program_where_no_limit_is_active(
    weights: tuple[float, ...], state: tuple[float, ...], speed: float
) -> None:
    problem = unlimited(problem_of(weights, state, speed))
    solved = solve_qp(problem)
    assert solved is not None
    np.testing.assert_allclose(solve_riccati(problem), solved, rtol=0.0, atol=1e-8)


@settings(deadline=None, max_examples=60)
@given(weights, states, st.floats(2.0, 20.0))
def test_preview_gains_give_the_first_command_of_the_whole_plan(
    weights: tuple[float, ...], state: tuple[float, ...], speed: float
) -> None:
    gains = np.empty(NUM_GAINS)
    preview_gains(MODEL, np.array(weights), speed, gains)
    first = preview_command(MODEL, gains, gains, 0.0, speed, np.array(state), WINDING.table, 30.0)
    plan = solve_riccati(problem_of(weights, state, speed))
    assert first == pytest.approx(plan[0], abs=1e-10)


@settings(deadline=None, max_examples=60)
@given(weights, states, speeds, st.floats(-0.5, 0.5))
def test_the_controller_keeps_its_limits_and_beats_a_clamped_plan(
    weights: tuple[float, ...], state: tuple[float, ...], speed: float, last: float
) -> None:
    problem = problem_of(weights, state, speed, last)
    solved = solve_qp(problem)
    assert solved is not None
    changes = np.diff(solved, prepend=last)
    assert np.abs(solved).max() <= VEHICLE.limits.steer_rad + 1e-7
    assert abs(changes[0]) <= VEHICLE.limits.steer_rate_radps * PERIOD_S + 1e-7
    assert np.abs(changes[1:]).max() <= VEHICLE.limits.steer_rate_radps * STEP_S + 1e-7
    clamped, before = np.empty(NUM_STEPS), last
    for j, u in enumerate(solve_riccati(problem)):
        step = VEHICLE.limits.steer_rate_radps * (STEP_S if j else PERIOD_S)
        before = clamped[j] = np.clip(np.clip(u, before - step, before + step), -0.5, 0.5)
    assert cost(problem, solved) <= cost(problem, clamped) + 1e-7


def test_the_controller_says_which_of_the_two_solved_the_problem() -> None:
    controller = LateralController(VEHICLE, PERIOD_S)
    straight = DrivePath.of([[0.0, 0.0], [300.0, 0.0]], 10.0).table
    gentle = controller.step(np.array([0.16, 1.0, 0.35]), np.zeros(3), 10.0, straight, 30.0, 0.0)
    assert gentle.status == "unconstrained"
    far_off = np.array([1.5, 0.1, 0.0])
    hard = controller.step(np.array([1.5, 0.0, 0.07]), far_off, 10.0, straight, 30.0, 0.0)
    assert hard.status == "constrained"
    assert hard.angle_rad == pytest.approx(-VEHICLE.limits.steer_rate_radps * PERIOD_S)


def test_an_infeasible_problem_repeats_the_last_command() -> None:
    controller = LateralController(VEHICLE, PERIOD_S)
    # From beyond the largest angle no allowed change leads back within it.
    steering = controller.step(
        np.array([0.16, 1.0, 0.35]), np.zeros(3), 10.0, WINDING.table, 30.0, 1.2
    )
    assert steering.status == "infeasible"
    assert steering.angle_rad == 1.2


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("cell", range(6))
def test_numbers_that_are_none_repeat_the_last_command(bad: float, cell: int) -> None:
    numbers = np.array([0.16, 1.0, 0.35, 0.1, 0.0, 0.0])
    numbers[cell] = bad
    controller = LateralController(VEHICLE, PERIOD_S)
    steering = controller.step(numbers[:3], numbers[3:], 10.0, WINDING.table, 30.0, 0.02)
    assert steering.status in ("invalid", "infeasible")
    assert steering.angle_rad == 0.02


def test_negative_weights_do_not_raise() -> None:
    controller = LateralController(VEHICLE, PERIOD_S)
    steering = controller.step(
        np.array([-1.0, -5.0, -0.1]), np.array([0.3, 0.1, 0.0]), 10.0, WINDING.table, 30.0, 0.02
    )
    assert math.isfinite(steering.angle_rad)


@pytest.mark.parametrize("speed", [2.0, 8.33, 13.9])
def test_the_discrete_model_equals_the_differential_equation(speed: float) -> None:
    A, B, D = matrices(discretise(MODEL, speed, STEP_S))
    x, u, bend = np.array([0.3, -0.05, 0.04]), 0.1, 0.02
    gain, slip = yaw_gain(MODEL, speed), slip_gain(MODEL, speed)
    lateral, heading, angle = x[0], x[1] + slip * x[2], x[2]
    parts = 20_000
    h = STEP_S / parts
    for _ in range(parts):
        mid = angle + 0.5 * h * (u - angle) / MODEL.lag_s
        turned = heading + 0.5 * h * (gain * mid - speed * bend)
        lateral += h * speed * (turned - slip * mid)
        heading += h * (gain * mid - speed * bend)
        angle += h * (u - mid) / MODEL.lag_s
    np.testing.assert_allclose(
        A @ x + B * u + D * bend, [lateral, heading - slip * angle, angle], atol=1e-8
    )


def test_rolling_forward_equals_the_model_under_the_commands_under_way() -> None:
    arc = np.linspace(0.0, 2.0, 400)
    circle = DrivePath.of(np.stack([40 * np.sin(arc), 40 * (1 - np.cos(arc))], axis=1), 10.0)
    A, B, D = matrices(discretise(MODEL, 10.0, PERIOD_S))
    x = np.array([0.2, 0.01, 0.03])
    state = x.copy()
    under_way = np.array([0.05, 0.06, 0.04])
    at_m = roll_forward(MODEL, 10.0, PERIOD_S, under_way, circle.table, 20.0, state)
    for u in under_way:
        x = A @ x + B * u + D / 40.0
    np.testing.assert_allclose(state, x, atol=1e-5)
    assert at_m == pytest.approx(20.9)


def test_a_circle_has_its_curvature_and_errors_have_their_signs() -> None:
    arc = np.linspace(0.0, math.pi / 2, 300)
    left = DrivePath.of(np.stack([30 * np.sin(arc), 30 * (1 - np.cos(arc))], axis=1), 8.0).table
    middle = len(left) // 2
    np.testing.assert_allclose(left[10:-10, CURVATURE], 1.0 / 30.0, rtol=0.01)
    # Nearer to the centre of a left turn is left of the path.
    angle = left[middle, HEADING]
    x, y = 28.0 * math.sin(angle), 30.0 - 28.0 * math.cos(angle)
    _, at_m, lateral, heading = locate(left, 0, x, y)
    assert lateral == pytest.approx(2.0, abs=0.02)
    assert heading == pytest.approx(angle, abs=0.01)
    assert at_m == pytest.approx(middle * 0.5, abs=0.1)


@pytest.mark.parametrize(
    ("waypoints", "speeds", "said"),
    [
        ([[0.0, 0.0]], 1.0, "n >= 2"),
        ([[0.0, 0.0], [0.0, 0.0]], 1.0, "repeats"),
        ([[0.0, 0.0], [math.nan, 0.0]], 1.0, "finite"),
        ([[0.0, 0.0], [1.0, 0.0]], math.inf, "finite"),
    ],
)
def test_a_path_refuses_waypoints_that_are_none(
    waypoints: list[list[float]], speeds: float, said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        DrivePath.of(waypoints, speeds)


def step_response(gains: tuple[float, float, float], seconds: float, limits: Limits) -> Numbers:
    """Speeds of an ideal car (acceleration = command) after a step from 0 to 10 m/s."""
    controller, speed, speeds = SpeedController(gains, limits, PERIOD_S), 0.0, []
    for _ in range(round(seconds / PERIOD_S)):
        speeds.append(speed)
        speed += PERIOD_S * controller.step(10.0, speed)
    return np.array(speeds)


def test_the_pid_is_equation_4_where_nothing_is_limited() -> None:
    wide = Limits(1e3, 1e3, 1e6, 1.0, 1.0)
    controller = SpeedController((0.4, 0.02, 0.0), wide, PERIOD_S)
    errors = [10.0 - v for v in (0.0, 0.3, 0.9, 1.2)]
    commands = [controller.step(10.0, 10.0 - e) for e in errors]
    expected = [0.4 * e + 0.02 * sum(errors[:i]) * PERIOD_S for i, e in enumerate(errors)]
    np.testing.assert_allclose(commands, expected, atol=1e-12)


def test_the_derivative_brakes_a_growing_speed_and_gives_no_kick_at_a_step() -> None:
    wide = Limits(1e3, 1e3, 1e6, 1.0, 1.0)
    controller = SpeedController((0.4, 0.0, 0.5), wide, PERIOD_S)
    assert controller.step(0.0, 5.0) == pytest.approx(-2.0)
    assert controller.step(10.0, 5.0) == pytest.approx(2.0)
    speed = 5.0
    for _ in range(60):
        speed += 1.0 * PERIOD_S
        command = controller.step(10.0, speed)
    # After 1.8 s at 1 m/s^2 the filtered derivative has settled at 1.
    assert command == pytest.approx(0.4 * (10.0 - speed) - 0.5, abs=0.01)


def test_commands_keep_the_acceleration_braking_and_jerk_limits() -> None:
    controller = SpeedController((1.2, 0.1, 0.3), VEHICLE.limits, PERIOD_S)
    rng = np.random.default_rng(1)
    commands = [0.0, *(controller.step(*rng.uniform(0.0, 30.0, 2)) for _ in range(2000))]
    assert max(commands) <= 3.0 and min(commands) >= -5.0
    assert max(commands) > 2.0 and min(commands) < -2.0
    assert np.abs(np.diff(commands)).max() <= 5.0 * PERIOD_S + 1e-12


def test_the_integral_does_not_wind_up_while_the_command_is_limited() -> None:
    slow = Limits(0.5, 0.5, 5.0, 1.0, 1.0)
    speeds = step_response((0.8, 0.08, 0.0), 60.0, slow)
    # Twenty seconds at the limit would store 16 m/s^2; the ideal loop overshoots by 8 %.
    assert speeds.max() < 10.9


@pytest.mark.parametrize("kp", [0.2, 0.5, 1.0])
def test_ki_up_to_an_eighth_of_kp_squared_bounds_the_overshoot(kp: float) -> None:
    wide = Limits(1e3, 1e3, 1e6, 1.0, 1.0)
    coupled = step_response((kp, kp * kp / 8.0, 0.0), 120.0, wide)
    beyond = step_response((kp, kp * kp, 0.0), 120.0, wide)
    # The zero of a PI loop leaves 8.2 % of the step at the limit of the coupling (by hand).
    assert coupled.max() - 10.0 == pytest.approx(0.82, abs=0.06)
    assert beyond.max() - 10.0 > 2.0


def test_a_speed_that_is_no_number_repeats_the_last_command() -> None:
    controller = SpeedController((0.4, 0.02, 0.1), VEHICLE.limits, PERIOD_S)
    for _ in range(20):
        last = controller.step(10.0, 5.0)
    assert controller.step(10.0, math.nan) == last
    assert controller.step(math.nan, 5.0) == last
    assert math.isfinite(controller.step(10.0, 5.0))


def test_equal_speeds_settle_at_the_standstill_gap_plus_the_reaction_way() -> None:
    rule = Headway()
    for speed in (3.0, 8.0, 14.0):
        gap = rule.standstill_m + rule.reaction_s * speed
        assert safe_speed(gap, speed, rule) == pytest.approx(speed)
        assert safe_speed(gap - 1.0, speed, rule) < speed
    assert safe_speed(rule.standstill_m, 0.0, rule) == 0.0
    assert math.isinf(safe_speed(math.inf, 0.0, rule))
    assert math.isinf(braking_ceiling(math.inf, 10.0, 0.0, 0.0, rule))


def test_a_car_too_close_behind_another_opens_the_gap_whatever_its_gains() -> None:
    rule = Headway()
    close, fair = 6.0, rule.standstill_m + rule.reaction_s * 10.0 + 1.0
    assert braking_ceiling(close, 10.0, 10.0, 0.0, rule) < -0.5
    assert math.isinf(braking_ceiling(fair, 10.0, 10.0, 0.0, rule))
    # Braking ahead is answered before the gap has closed.
    assert braking_ceiling(fair, 10.1, 10.0, -2.0, rule) < -1.5


@settings(deadline=None)
@given(st.floats(4.0, 20.0), st.floats(0.02, 1.0))
def test_the_ceiling_alone_stops_the_car_before_what_stands_ahead(speed: float, kp: float) -> None:
    """With a PID that hardly brakes, the ceiling does the rest, at no more than it planned."""
    rule = Headway()
    controller = SpeedController((kp, 0.0, 0.0), VEHICLE.limits, PERIOD_S)
    gap, hardest, acceleration = rule.standstill_m + 3.0 + speed**2 / 2.0, 0.0, 0.0
    for _ in range(round(60.0 / PERIOD_S)):
        reference = min(speed, safe_speed(gap, 0.0, rule))
        ceiling = braking_ceiling(gap, speed, 0.0, 0.0, rule)
        ceiling = hold_ceiling(reference, speed, ceiling)
        command = controller.step(reference, speed, ceiling)
        acceleration += (command - acceleration) * (1.0 - math.exp(-PERIOD_S / 0.2))
        speed = max(speed + PERIOD_S * acceleration, 0.0)
        gap -= PERIOD_S * speed
        hardest = min(hardest, acceleration)
    assert speed < 0.1
    assert 0.5 < gap < rule.standstill_m + 3.0
    assert hardest > -4.5


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda v: {"body": replace(v.body, mass_kg=-1.0)}, "mass_kg"),
        (lambda v: {"body": replace(v.body, cg_behind_front_m=3.0)}, "below wheelbase"),
        (lambda v: {"limits": replace(v.limits, jerk_mps3=math.nan)}, "jerk_mps3"),
        (lambda v: {"actuators": replace(v.actuators, steer_delay_s=-0.1)}, "steer_delay_s"),
        (lambda v: {"actuators": replace(v.actuators, steer_lag_s=0.0)}, "lag"),
    ],
)
def test_a_vehicle_that_cannot_be_is_refused(
    change: Callable[[Vehicle], dict[str, object]], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        replace(VEHICLE, **change(VEHICLE))  # type: ignore[arg-type]


def test_an_unknown_key_of_a_vehicle_is_named(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text(VEHICLE_YAML.read_text().replace("mass_kg", "mass"))
    with pytest.raises(ValueError, match="mass_kg"):
        Vehicle.load(path)


class NominalCar:
    """The controller's own model, its delay included, without noise: for the tracker alone."""

    def __init__(self, speed: float) -> None:
        self.x, self.y, self.speed, self.steer = 0.0, 0.0, speed, 0.0
        self.heading = float(WINDING.table[0, HEADING])
        delay = round(VEHICLE.actuators.steer_delay_s / PERIOD_S)
        self.sent = deque([0.0] * (delay + 1), maxlen=delay + 1)

    def measure(self) -> Measurement:
        return Measurement(self.x, self.y, self.heading, self.speed, self.steer)

    def move(self, steer: float, acceleration: float) -> None:
        self.sent.append(steer)
        self.steer += (self.sent[0] - self.steer) * (1.0 - math.exp(-PERIOD_S / MODEL.lag_s))
        course = self.heading - slip_gain(MODEL, self.speed) * self.steer
        self.x += PERIOD_S * self.speed * math.cos(course)
        self.y += PERIOD_S * self.speed * math.sin(course)
        self.heading += PERIOD_S * yaw_gain(MODEL, self.speed) * self.steer
        self.speed = max(self.speed + PERIOD_S * acceleration, 0.0)


def test_the_tracker_follows_waypoints_and_their_speeds() -> None:
    tracker, car, errors = Tracker(VEHICLE, WINDING, DEFAULT), NominalCar(6.0), []
    for _ in range(600):
        command = tracker.step(car.measure())
        car.move(command.steer_rad, command.acceleration_mps2)
        errors.append(command.lateral_error_m)
    assert car.speed == pytest.approx(10.0, abs=0.5)
    assert max(abs(e) for e in errors) < 0.35


def test_swapping_matrices_never_jumps_beyond_the_rate_limits() -> None:
    tracker, car = Tracker(VEHICLE, WINDING, DEFAULT), NominalCar(3.0)
    steers, accelerations = [], []
    for k in range(400):
        if k % 20 == 0:
            assert tracker.swap(AGGRESSIVE if k % 40 else DEFAULT)
        command = tracker.step(car.measure())
        car.move(command.steer_rad, command.acceleration_mps2)
        steers.append(command.steer_rad)
        accelerations.append(command.acceleration_mps2)
    rate = VEHICLE.limits.steer_rate_radps * PERIOD_S
    assert np.abs(np.diff(steers)).max() <= rate + 1e-12
    assert np.abs(np.diff(accelerations)).max() <= VEHICLE.limits.jerk_mps3 * PERIOD_S + 1e-12


def test_a_swap_carries_the_integral_down_with_ki_and_never_up() -> None:
    wide = Limits(1e3, 1e3, 1e6, 1.0, 1.0)
    controller = SpeedController((0.0, 0.1, 0.0), wide, PERIOD_S)
    for _ in range(101):
        before = controller.step(10.0, 9.0)
    controller.swap((0.0, 0.05, 0.0))
    assert controller.step(10.0, 10.0) == pytest.approx(0.5 * (before + 0.1 * PERIOD_S))
    controller.swap((0.0, 0.1, 0.0))
    assert controller.step(10.0, 10.0) == pytest.approx(0.5 * (before + 0.1 * PERIOD_S))


def test_a_tracker_keeps_its_matrix_when_the_next_is_not_finite() -> None:
    tracker = Tracker(VEHICLE, WINDING, DEFAULT)
    assert not tracker.swap(replace(DEFAULT, wl=math.nan))
    command = tracker.step(NominalCar(8.0).measure())
    assert command.status != "invalid" and math.isfinite(command.steer_rad)
    with pytest.raises(ValueError, match="finite"):
        Tracker(VEHICLE, WINDING, replace(DEFAULT, kp=math.inf))


def test_a_measurement_that_is_no_number_repeats_the_last_command() -> None:
    tracker, car = Tracker(VEHICLE, WINDING, DEFAULT), NominalCar(8.0)
    for _ in range(30):
        last = tracker.step(car.measure())
        car.move(last.steer_rad, last.acceleration_mps2)
    for field in ("x_m", "y_m", "heading_rad", "speed_mps", "steer_rad"):
        command = tracker.step(replace(car.measure(), **{field: math.nan}))
        assert command.status == "invalid"
        assert command.steer_rad == last.steer_rad
        assert command.acceleration_mps2 == last.acceleration_mps2
    assert tracker.step(car.measure()).status != "invalid"


def test_the_tracker_slows_down_for_what_is_ahead() -> None:
    tracker, car = Tracker(VEHICLE, WINDING, DEFAULT), NominalCar(10.0)
    for _ in range(30):
        command = tracker.step(car.measure(), Ahead(gap_m=12.0, speed_mps=0.0))
    assert command.reference_mps < 8.0
    assert command.acceleration_mps2 < -1.5


def test_a_changed_source_changes_the_folder_of_compiled_code(tmp_path: Path) -> None:
    for folder in ("control", "sim"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.py").write_text("x = 1\n")
    before = sources_hash(tmp_path)
    assert sources_hash(tmp_path) == before
    (tmp_path / "control" / "a.py").write_text("x = 2\n")
    assert sources_hash(tmp_path) != before


def test_the_library_and_its_gate_load_without_numba_and_daqp() -> None:
    code = (
        "import sys\n"
        "sys.modules['numba'] = sys.modules['daqp'] = None\n"
        "import ridetune, ridetune.gate, ridetune.matrix, ridetune.control.vehicle\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
