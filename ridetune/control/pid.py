"""Longitudinal PID (on-board VLM paper, Eq. 4): speed error -> acceleration command.

    a = K_p e + K_i sum(e dt) + K_d de/dt,      e = reference speed - measured speed

The derivative acts on the measured speed (low-pass filtered): a step of the reference gives no
kick. The integral is kept as an acceleration and stands still while the command is limited and
the error pushes further (conditional integration). The command is clamped to the vehicle's
acceleration and braking and moves no faster than its jerk limit, which also bounds what a swap of
gains can do.
"""

from typing import NamedTuple

import numpy as np

from ridetune.control.kernel import Numbers, kernel
from ridetune.control.vehicle import Limits

# The cells of a PID memory: filtered speed [m/s], integral term and last command [m/s^2].
FILTERED, INTEGRAL, COMMAND = range(3)
DERIVATIVE_FILTER_S = 0.2


class CommandLimits(NamedTuple):
    """What the acceleration command may be [m/s^2, m/s^3], and how often it is sent."""

    lowest: float
    highest: float
    jerk: float
    period_s: float

    @staticmethod
    def of(limits: Limits, period_s: float) -> "CommandLimits":
        """The limits of a vehicle at a control period [s]."""
        return CommandLimits(
            -limits.braking_mps2, limits.acceleration_mps2, limits.jerk_mps3, period_s
        )


@kernel
def pid_step(
    memory: Numbers,
    kp: float,
    ki: float,
    kd: float,
    reference_mps: float,
    speed_mps: float,
    ceiling_mps2: float,
    limits: CommandLimits,
) -> float:
    """One control step: the acceleration command [m/s^2]; updates `memory` in place.

    ceiling_mps2: a momentary upper limit, e.g. of the braking that the gap ahead demands; it is
    approached at the jerk limit.
    """
    slope = (speed_mps - memory[FILTERED]) / DERIVATIVE_FILTER_S
    memory[FILTERED] += limits.period_s * slope
    error = reference_mps - speed_mps
    asked = kp * error + memory[INTEGRAL] - kd * slope
    step = limits.jerk * limits.period_s
    lowest = max(limits.lowest, memory[COMMAND] - step)
    highest = min(limits.highest, ceiling_mps2, memory[COMMAND] + step)
    command: float = max(min(asked, highest), lowest)
    if asked == command or (asked > command) == (error < 0.0):
        memory[INTEGRAL] += ki * error * limits.period_s
    memory[COMMAND] = command
    return command


@kernel
def swap_integral(memory: Numbers, ki_before: float, ki_after: float) -> None:
    """Carry the integral term over a swap of gains: it scales down with K_i and never up."""
    if ki_after < ki_before:
        memory[INTEGRAL] *= ki_after / ki_before


class SpeedController:
    """The PID of one car at a fixed control period [s]; gains may be swapped while it drives."""

    def __init__(self, gains: tuple[float, float, float], limits: Limits, period_s: float) -> None:
        self._limits = CommandLimits.of(limits, period_s)
        self._gains = gains
        self._memory: Numbers | None = None

    def swap(self, gains: tuple[float, float, float]) -> None:
        """Take other (K_p, K_i, K_d) from the next step on."""
        if self._memory is not None:
            swap_integral(self._memory, self._gains[1], gains[1])
        self._gains = gains

    def step(
        self, reference_mps: float, speed_mps: float, ceiling_mps2: float = float("inf")
    ) -> float:
        """The acceleration command [m/s^2]; NaN in gives the last command again."""
        if self._memory is None:
            self._memory = np.array([speed_mps, 0.0, 0.0])
        before = self._memory.copy()
        command = pid_step(
            self._memory, *self._gains, reference_mps, speed_mps, ceiling_mps2, self._limits
        )
        if not np.isfinite(self._memory).all():
            self._memory[:] = before
            return float(before[COMMAND])
        return float(command)
