"""What the car would do with a matrix: two closed-loop runs, as series for small charts.

In: a matrix and the road's condition. Out: speed and acceleration when driving off behind a lead
car, lateral offset and felt lateral acceleration in a change of lane. Simulation, of the nominal
car and without measurement noise, so that all that differs is the matrix. A run takes about a
millisecond once it is compiled.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ridetune.control.vehicle import Sensors, Vehicle
from ridetune.matrix import ControllerMatrix
from ridetune.sample import Condition
from ridetune.sim.rollout import Rollout, Status, rollout
from ridetune.sim.scenarios import ACCELERATION, LANE_CHANGE, Scenario

# What is drawn of 0.03 s steps: a point every 0.12 s.
_EVERY = 4
# The change of lane is over by then [s].
_LATERAL = replace(LANE_CHANGE, duration_s=12.0)
_KMH_PER_MPS = 3.6
_NOISELESS = Sensors(0.0, 0.0, 0.0, 0.0)
_FAULTS: dict[Status, str] = {
    "collided": "hits what is ahead",
    "left_lane": "leaves its lane",
    "unstable": "gets out of control",
}


@dataclass(frozen=True)
class Chart:
    """One line over time. least: the y axis spans no less. values: None behind an early end."""

    name: str
    unit: str
    least: float
    values: tuple[float | None, ...]


@dataclass(frozen=True)
class Drive:
    """One run; fault: how it ended early, in words, or None."""

    name: str
    about: str
    fault: str | None
    time_s: tuple[float, ...]
    charts: tuple[Chart, ...]


class Previewer:
    """Drives one vehicle; the first run compiles."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = replace(vehicle, sensors=_NOISELESS)

    def drives(self, matrix: ControllerMatrix, condition: Condition) -> tuple[Drive, ...]:
        """One longitudinal and one lateral run on the road's condition."""
        along = rollout(matrix, ACCELERATION, condition, vehicle=self._vehicle)
        aside = rollout(matrix, _LATERAL, condition, vehicle=self._vehicle)
        drive = along.trajectory
        return (
            _drive(
                ACCELERATION,
                "Driving off behind a car",
                along,
                ("Speed", "km/h", 20.0, _KMH_PER_MPS * drive["speed_mps"]),
                ("Acceleration", "m/s²", 1.0, drive["acceleration_mps2"]),
            ),
            _drive(
                _LATERAL,
                "Changing lane at 50 km/h",
                aside,
                ("Left of its path", "m", 0.4, aside.trajectory["lateral_error_m"]),
                ("Felt sideways", "m/s²", 1.0, aside.trajectory.felt_lateral_mps2),
            ),
        )


def _drive(
    scenario: Scenario,
    name: str,
    run: Rollout,
    *charts: tuple[str, str, float, NDArray[np.float64]],
) -> Drive:
    times = run.trajectory.time_s[::_EVERY]
    return Drive(
        name,
        scenario.about.replace("m/s2", "m/s²"),
        _FAULTS.get(run.status),
        tuple(round(t, 2) for t in times.tolist()),
        tuple(Chart(title, unit, least, _series(y)) for title, unit, least, y in charts),
    )


def _series(values: NDArray[np.float64]) -> tuple[float | None, ...]:
    return tuple(round(v, 4) if math.isfinite(v) else None for v in values[::_EVERY].tolist())
