"""The runs of one cell of the sweep: a scenario, a condition and a style in, outcomes out.

A run is fixed by the sweep's seed, its cell and its number: matrix, car and measurement noise are
drawn from a generator of its own. Neither the size of a task nor the worker that drives it can
change it, and any run can be driven again alone.
"""

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ridetune.codec import MatrixCodec
from ridetune.control.vehicle import Vehicle
from ridetune.matrix import STYLES, ControllerMatrix, Ranges, Style, ki_limit
from ridetune.sample import CONDITIONS, Condition
from ridetune.sim.metrics import DriveMetrics, measure
from ridetune.sim.plant import Spread, draw_spread
from ridetune.sim.rollout import Status, rollout_batch
from ridetune.sim.scenarios import SCENARIOS

# What is kept of a run, in this order; NaN where it does not apply.
METRICS = (
    "ttc_s",
    "min_gap_m",
    "t90_s",
    "overshoot_mps",
    "peak_ax_mps2",
    "mean_jx_mps3",
    "peak_felt_ay_mps2",
    "peak_felt_jy_mps3",
    "peak_lateral_error_m",
)


@dataclass(frozen=True)
class Cell:
    """One combination of scenario, condition and style."""

    scenario: str
    condition: Condition
    style: Style


@dataclass(frozen=True)
class Task:
    """Runs first..first+count-1 of a cell: what one worker drives at a time."""

    cell: Cell
    first: int
    count: int
    seed: int
    ranges: Ranges
    vehicle: Vehicle


@dataclass(frozen=True)
class Outcome:
    """How the runs of a task went; metrics [run, metric], cpu_s: processor time that they took."""

    cell: Cell
    first: int
    statuses: tuple[Status, ...]
    metrics: NDArray[np.float64]
    cpu_s: float


def draw_run(
    cell: Cell, number: int, seed: int, codec: MatrixCodec
) -> tuple[ControllerMatrix, Spread, int]:
    """The matrix, the car and the seed of the noise of one run.

    The matrix is uniform between the style's minimum and maximum on the codec's scale, K_i at most
    K_p^2/8 as the gate would have it; the car is one of the verified population.
    """
    place = (
        list(SCENARIOS).index(cell.scenario),
        CONDITIONS.index(cell.condition),
        STYLES.index(cell.style),
    )
    rng = np.random.default_rng([seed, *place, number])
    values = []
    for i, limits in enumerate(codec.ranges.styles[cell.style]):
        low, high = codec.share(limits.minimum, i), codec.share(limits.maximum, i)
        values.append(codec.value(low + (high - low) * float(rng.random()), i))
    values[1] = min(values[1], ki_limit(values[0]))
    return ControllerMatrix.of(values), draw_spread(rng), int(rng.integers(2**31))


def drive_task(task: Task) -> Outcome:
    """Drive a task's runs; the trajectories are measured and dropped."""
    started = time.process_time()
    codec = MatrixCodec(task.ranges)
    numbers = range(task.first, task.first + task.count)
    drawn = [draw_run(task.cell, number, task.seed, codec) for number in numbers]
    batch = rollout_batch(
        [matrix for matrix, _, _ in drawn],
        SCENARIOS[task.cell.scenario],
        task.cell.condition,
        vehicle=task.vehicle,
        spreads=[spread for _, spread, _ in drawn],
        seeds=[noise for _, _, noise in drawn],
    )
    rows = [_numbers(measure(batch[run].trajectory)) for run in range(len(batch))]
    cpu_s = time.process_time() - started
    return Outcome(task.cell, task.first, batch.statuses, np.array(rows), cpu_s)


def _numbers(drive: DriveMetrics) -> list[float]:
    """A drive's metrics in the order of METRICS."""
    values: tuple[float | None, ...] = (
        drive.ttc_s,
        drive.min_gap_m,
        drive.t90_s,
        drive.overshoot_mps,
        drive.peak_ax,
        drive.mean_jx,
        drive.felt.peak_acceleration,
        drive.felt.peak_jerk,
        drive.lateral_error_peak_m,
    )
    return [math.nan if value is None else value for value in values]
