"""Closed-loop runs: matrix, scenario, condition, car and seed in, trajectory and outcome out.

    vehicle = Vehicle.load(Path("configs/vehicle.yaml"))
    run = rollout(ranges.default, SCENARIOS["left_turn"], "rain", vehicle=vehicle, seed=3)

A seed gives the measurement noise of a run, whatever the matrix, so that two matrices can be
compared on the same noise. Simulation, with all that `plant.py` and `scenarios.py` leave out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ridetune.control.kernel import Numbers
from ridetune.control.tracker import PERIOD_S
from ridetune.control.vehicle import Vehicle
from ridetune.matrix import ControllerMatrix
from ridetune.sample import Condition
from ridetune.sim.conditions import EFFECTS
from ridetune.sim.loop import (
    COLLIDED,
    DRIVING,
    LEFT_LANE,
    NUM_NOISES,
    STANDING_MPS,
    UNSTABLE,
    Ego,
    begin,
    drive,
    new_gains,
)
from ridetune.sim.plant import NOMINAL, Plant, Spread
from ridetune.sim.road import lay_out, num_steps
from ridetune.sim.scenarios import Scenario
from ridetune.sim.trajectory import SIGNALS, Trajectory

# stopped: the whole drive, and the car stands at its end. The last three end a run early.
Status = Literal["finished", "stopped", "collided", "left_lane", "unstable"]
_ENDS: dict[int, Status] = {
    COLLIDED: "collided",
    LEFT_LANE: "left_lane",
    UNSTABLE: "unstable",
}


@dataclass(frozen=True)
class Rollout:
    """One run; behind an early end the trajectory's rows are NaN."""

    trajectory: Trajectory
    status: Status

    @property
    def safe(self) -> bool:
        """Whether the car kept its lane, hit nothing and stayed in control."""
        return self.status in ("finished", "stopped")


@dataclass(frozen=True)
class Batch:
    """Many runs of one scenario: signals [run, step, signal], NaN behind an early end."""

    period_s: float
    signals: NDArray[np.float64]
    statuses: tuple[Status, ...]

    def __len__(self) -> int:
        return len(self.statuses)

    def __getitem__(self, run: int) -> Rollout:
        return Rollout(Trajectory(self.period_s, self.signals[run]), self.statuses[run])


def rollout(
    matrix: ControllerMatrix,
    scenario: Scenario,
    condition: Condition = "sunny",
    *,
    vehicle: Vehicle,
    spread: Spread = NOMINAL,
    seed: int = 0,
) -> Rollout:
    """One closed-loop run; the same arguments give the same run, bit by bit."""
    return rollout_batch(
        [matrix], scenario, condition, vehicle=vehicle, spreads=[spread], seeds=[seed]
    )[0]


def rollout_batch(
    matrices: Sequence[ControllerMatrix],
    scenario: Scenario,
    condition: Condition = "sunny",
    *,
    vehicle: Vehicle,
    spreads: Sequence[Spread] = (NOMINAL,),
    seeds: Sequence[int] = (0,),
) -> Batch:
    """Runs one after the other, each in the compiled loop: run i takes matrix i, car i and seed i.

    A single matrix, spread or seed serves all runs; runs that share a matrix are quickest side
    by side. 62 kB of signals per run of 18 s: split what does not fit. ValueError where the
    counts do not fit each other.
    """
    count = max(len(matrices), len(spreads), len(seeds))
    for name, given in (("matrices", matrices), ("spreads", spreads), ("seeds", seeds)):
        if len(given) not in (1, count):
            raise ValueError(f"{count} runs need 1 or {count} {name}, got {len(given)}")
    friction = EFFECTS[condition].friction
    road, ego = lay_out(scenario, condition, vehicle, PERIOD_S), Ego.of(vehicle, PERIOD_S)
    steps = num_steps(scenario, PERIOD_S)
    signals = np.full((count, steps, len(SIGNALS)), np.nan)
    outcomes = []
    known: ControllerMatrix | None = None
    gains = new_gains()
    for run in range(count):
        matrix = matrices[run % len(matrices)]
        if matrix != known:
            known, values, gains = matrix, np.array(matrix.values, float), new_gains()
        plant = Plant.of(vehicle, spreads[run % len(spreads)], friction, PERIOD_S)
        noise = draw_noise(seeds[run % len(seeds)], steps)
        memory = begin(road, steps, *gains)
        outcomes.append(
            drive(0, steps, values, False, ego, plant, road, noise, memory, signals[run])
        )
    statuses = tuple(
        status_of(outcome, row) for outcome, row in zip(outcomes, signals, strict=True)
    )
    return Batch(PERIOD_S, signals, statuses)


def draw_noise(seed: int, steps: int) -> Numbers:
    """Standard normal noise [step, NUM_NOISES] of a seed."""
    return np.random.default_rng(seed).standard_normal((steps, NUM_NOISES))


def status_of(outcome: int, signals: NDArray[np.float64]) -> Status:
    """What the loop's outcome and a run's signals [step, signal] amount to."""
    if outcome == DRIVING:
        standing = signals[-1, SIGNALS.index("speed_mps")] < STANDING_MPS
        return "stopped" if standing else "finished"
    return _ENDS[outcome]
