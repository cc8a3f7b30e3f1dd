"""The rollout check: a few hard drives with a proposed matrix, before a car may run it.

    check = RolloutCheck(vehicle, envelope.limits)
    check(matrix, "snow") -> None, or which drive breaks which limit

The cars stand outside the corners of the verified population, so that what they drive
safely the population does with some margin. The drives are those that break limits first: a left
turn (steering too calm or too nervous) and an empty road (speed). The first violation ends it.
Simulation, and the same code as the envelope's Monte Carlo.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from ridetune.contract import Contract
from ridetune.control.headway import GRAVITY_MPS2
from ridetune.control.vehicle import Vehicle
from ridetune.envelope import Envelope, Limits
from ridetune.gate import SafetyGate
from ridetune.matrix import ControllerMatrix
from ridetune.sample import CONDITIONS, Condition
from ridetune.sim.conditions import EFFECTS
from ridetune.sim.plant import Spread
from ridetune.sim.rollout import Rollout, rollout
from ridetune.sim.scenarios import ACCELERATION, LEFT_TURN, Scenario

# From rest to 50 km/h on an empty road: no lead car hides what the gains do.
OPEN_ROAD = replace(ACCELERATION, name="open_road", actors=(), drive_off_s=0.0)
# The turn and the straight behind it, until every car has settled from its exit.
SHORT_TURN = replace(LEFT_TURN, duration_s=15.0)
# Hunting is looked for at the end of a drive [s].
_END_S = 2.0
_ANSWERS_KEPT = 4096


@dataclass(frozen=True)
class Trial:
    """One car in one scenario; `seed` gives the measurement noise."""

    scenario: Scenario
    spread: Spread
    seed: int = 0


def violation(run: Rollout, scenario: Scenario, condition: Condition, limits: Limits) -> str | None:
    """Which limit a run breaks, in words, or None if it keeps them all; NaN breaks one."""
    if run.status == "collided":
        return "hits what is ahead"
    if run.status == "left_lane":
        return "leaves its lane"
    if not run.safe:
        return "gets out of control"
    drive = run.trajectory
    aside = float(np.abs(drive["lateral_error_m"]).max())
    if not aside <= limits.lane_m:
        return f"strays {aside:.2f} m from its path"
    over = float(drive["speed_mps"].max()) - scenario.target_mps
    if not over <= limits.overspeed_share * scenario.target_mps:
        return f"drives {over:.2f} m/s faster than asked"
    felt = drive.felt_lateral_mps2
    grip = EFFECTS[condition].friction * GRAVITY_MPS2
    if not np.abs(felt).max() <= limits.grip_share * grip:
        return "turns faster than its tyres can carry it"
    end = slice(-round(_END_S / drive.period_s), None)
    for acceleration, what in ((drive["acceleration_mps2"], "speed"), (felt, "steering")):
        if not np.ptp(acceleration[end]) <= limits.hunting_mps2:
            return f"does not settle ({what})"
    return None


# The corners that decide: heavy on worn tyres, and light on good ones, least and most delay.
# The verified population ends at mass +-20 %, tyres 0.7 to 1.1, steering delay 0 to 0.15 s.
_HEAVY = Spread(1.25, 0.65, 0.0, 0.15)
_HEAVY_LATE = Spread(1.25, 0.65, 0.15, 0.15)
_LIGHT = Spread(0.75, 1.1, 0.15, 0.15)

# What the check drives, soonest to fail first.
HARD_TRIALS = (
    Trial(SHORT_TURN, _HEAVY),
    Trial(SHORT_TURN, _HEAVY_LATE, seed=1),
    Trial(OPEN_ROAD, _HEAVY_LATE),
    Trial(OPEN_ROAD, _LIGHT, seed=1),
    Trial(SHORT_TURN, _LIGHT, seed=2),
)


class RolloutCheck:
    """Drives a matrix through the hard trials; a callable for `SafetyGate(check=...)`."""

    def __init__(
        self,
        vehicle: Vehicle,
        limits: Limits,
        trials: Sequence[Trial] = HARD_TRIALS,
    ) -> None:
        self._vehicle = vehicle
        self._limits = limits
        self._trials = tuple(trials)
        ordered = sorted(CONDITIONS, key=lambda c: EFFECTS[c].friction)
        self._slippery, self._firm = ordered[0], ordered[-1]
        self._known = lru_cache(maxsize=_ANSWERS_KEPT)(self._drive)

    def __call__(self, matrix: ControllerMatrix, condition: Condition | None) -> str | None:
        """Why the matrix must not be run, or None if all trials keep the limits.

        Not known: all trials where grip is least, the turns also where it is most. The same
        question has the same answer, which is kept.
        """
        return self._known(matrix, condition)

    def _drive(self, matrix: ControllerMatrix, condition: Condition | None) -> str | None:
        drives = [(trial, condition or self._slippery) for trial in self._trials]
        if condition is None:
            drives += [(t, self._firm) for t in self._trials if t.scenario is SHORT_TURN]
        for trial, road in drives:
            found = drive_trial(matrix, trial, road, self._vehicle, self._limits)
            if found is not None:
                return f"in simulation ({_say(trial, road)}) the car {found}"
        return None


def load_gate(contract: Contract, vehicle: Vehicle, envelope: Path) -> SafetyGate:
    """The gate of a car: ranges of the contract, verified envelope, rollout check.

    ValueError if the envelope was computed for another vehicle or other ranges.
    """
    verified = Envelope.load(envelope, vehicle=vehicle, ranges=contract.ranges)
    check = RolloutCheck(vehicle, verified.limits)
    return SafetyGate(contract.ranges, contract.codec, envelope=verified, check=check)


def drive_trial(
    matrix: ControllerMatrix, trial: Trial, condition: Condition, vehicle: Vehicle, limits: Limits
) -> str | None:
    """One drive of a trial: which limit it breaks, or None."""
    run = rollout(
        matrix, trial.scenario, condition, vehicle=vehicle, spread=trial.spread, seed=trial.seed
    )
    return violation(run, trial.scenario, condition, limits)


def _say(trial: Trial, condition: Condition) -> str:
    name = trial.scenario.name.replace("_", " ")
    return f"{name}, {condition}, mass x {trial.spread.mass:g}, tyres x {trial.spread.tyres:g}"
