"""What a simulated drive leaves behind: one row per time step, one column per signal."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# The order of the columns of `Trajectory.signals`; SI units, x forward, y left, counter-clockwise.
SIGNALS = (
    "x_m",
    "y_m",
    "heading_rad",
    "speed_mps",
    "acceleration_mps2",  # longitudinal, of the body
    "steer_rad",  # front wheels
    "yaw_rate_radps",
    "lateral_speed_mps",  # of the body: what an IMU would integrate; 0 for a kinematic model
    "reference_speed_mps",
    "lateral_error_m",  # left of the reference path is positive
    "heading_error_rad",
    "gap_m",  # bumper to bumper to what is ahead; infinite where the road is free
    "lead_speed_mps",  # NaN where the road is free
)


@dataclass(frozen=True)
class Trajectory:
    """Signals [time step, signal] at a fixed period [s]."""

    period_s: float
    signals: NDArray[np.float64]

    def __post_init__(self) -> None:
        assert self.signals.ndim == 2 and self.signals.shape[1] == len(SIGNALS)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """One signal [time step] by its name in SIGNALS."""
        return self.signals[:, SIGNALS.index(name)]

    @property
    def time_s(self) -> NDArray[np.float64]:
        """The time of each step [s], from 0."""
        return np.arange(len(self.signals), dtype=np.float64) * self.period_s

    @property
    def felt_lateral_mps2(self) -> NDArray[np.float64]:
        """The lateral acceleration that a passenger feels: speed x yaw rate."""
        return self["speed_mps"] * self["yaw_rate_radps"]
