"""The tracker of the car: waypoints, speeds and a matrix in, (delta_f, a) out, 30-50 Hz.

    place on the path -> errors -> rolled forward over the commands under way -> steering (MPC)
    speed of the path -> capped by the gap ahead -> acceleration (PID)

A matrix may be swapped between any two steps: the commands still move no faster than the jerk
and steering-rate limits. Nothing raises out of `Tracker.step`; a measurement that is no number
repeats the last command and says so.
"""

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from ridetune.control.headway import Headway, braking_ceiling, hold_ceiling, safe_speed
from ridetune.control.mpc import (
    MIN_MODEL_MPS,
    BicycleModel,
    clamp_steering,
    roll_forward,
    slip_gain,
)
from ridetune.control.path import SPEED, Path, locate, wrap
from ridetune.control.pid import SpeedController
from ridetune.control.steering import LateralController, Status
from ridetune.control.vehicle import Vehicle
from ridetune.matrix import ControllerMatrix

PERIOD_S = 0.03


@dataclass(frozen=True)
class Measurement:
    """Pose of the rear axle's middle [m, rad], speed [m/s] and front-wheel angle [rad]."""

    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    steer_rad: float


@dataclass(frozen=True)
class Ahead:
    """What is ahead in the lane: gap to its bumper [m], its speed and acceleration."""

    gap_m: float = math.inf
    speed_mps: float = 0.0
    acceleration_mps2: float = 0.0


@dataclass(frozen=True)
class Command:
    """What the car is told, and what the controllers saw."""

    steer_rad: float
    acceleration_mps2: float
    reference_mps: float
    lateral_error_m: float
    heading_error_rad: float
    status: Status


FREE_ROAD = Ahead()


class Tracker:
    """Follows one path with one car; the matrix may change while it drives."""

    def __init__(
        self,
        vehicle: Vehicle,
        path: Path,
        matrix: ControllerMatrix,
        *,
        period_s: float = PERIOD_S,
        headway: Headway | None = None,
    ) -> None:
        """ValueError for a matrix that is not finite."""
        if not _is_finite(matrix):
            raise ValueError(f"a tracker needs a finite matrix to start with, got {matrix}")
        self._path = path.table
        self._model = BicycleModel.of(vehicle)
        self._limits = vehicle.limits
        self._period_s = period_s
        self._headway = Headway() if headway is None else headway
        self._lateral = LateralController(vehicle, period_s)
        self._speed = SpeedController(_gains(matrix), vehicle.limits, period_s)
        self._weights = np.array(matrix.values[3:])
        delay = max(round(vehicle.actuators.steer_delay_s / period_s), 0)
        self._under_way = deque([0.0] * delay, maxlen=delay)
        self._index = 0
        self._last = Command(0.0, 0.0, 0.0, 0.0, 0.0, "unconstrained")

    def swap(self, matrix: ControllerMatrix) -> bool:
        """Drive with another matrix from the next step on; False keeps the present one (NaN)."""
        if not _is_finite(matrix):
            return False
        self._speed.swap(_gains(matrix))
        self._weights = np.array(matrix.values[3:])
        return True

    def step(self, measured: Measurement, ahead: Ahead = FREE_ROAD) -> Command:
        """The commands for this moment."""
        numbers = (measured.x_m, measured.y_m, measured.heading_rad, measured.speed_mps)
        if not all(math.isfinite(n) for n in (*numbers, measured.steer_rad)):
            return self._repeat()
        self._index, at_m, lateral, heading = locate(
            self._path, self._index, measured.x_m, measured.y_m
        )
        error = wrap(measured.heading_rad - heading)
        steer, status = self._steer(measured, at_m, lateral, error)
        reference, acceleration = self._accelerate(measured.speed_mps, ahead)
        self._last = Command(steer, acceleration, reference, lateral, error, status)
        return self._last

    def _steer(
        self, measured: Measurement, at_m: float, lateral: float, error: float
    ) -> tuple[float, Status]:
        speed = max(measured.speed_mps, MIN_MODEL_MPS)
        course = error - slip_gain(self._model, speed) * measured.steer_rad
        state = np.array([lateral, course, measured.steer_rad])
        if self._under_way.maxlen:
            at_m = roll_forward(
                self._model,
                speed,
                self._period_s,
                np.array(self._under_way),
                self._path,
                at_m,
                state,
            )
        last = self._last.steer_rad
        solved = self._lateral.step(self._weights, state, speed, self._path, at_m, last)
        # The solver keeps the limits to its tolerance; the car gets them exactly.
        steer = clamp_steering(
            solved.angle_rad,
            last,
            self._limits.steer_rad,
            self._limits.steer_rate_radps,
            self._period_s,
        )
        self._under_way.append(steer)
        return steer, solved.status

    def _accelerate(self, speed_mps: float, ahead: Ahead) -> tuple[float, float]:
        target = float(self._path[self._index, SPEED])
        reference = min(target, safe_speed(ahead.gap_m, ahead.speed_mps, self._headway))
        ceiling = braking_ceiling(
            ahead.gap_m, speed_mps, ahead.speed_mps, ahead.acceleration_mps2, self._headway
        )
        ceiling = hold_ceiling(reference, speed_mps, ceiling)
        return reference, self._speed.step(reference, speed_mps, ceiling)

    def _repeat(self) -> Command:
        self._under_way.append(self._last.steer_rad)
        self._last = replace(self._last, status="invalid")
        return self._last


def _gains(matrix: ControllerMatrix) -> tuple[float, float, float]:
    return matrix.kp, matrix.ki, matrix.kd


def _is_finite(matrix: ControllerMatrix) -> bool:
    return all(math.isfinite(value) for value in matrix.values)
