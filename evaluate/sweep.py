"""Many closed-loop runs over scenarios, conditions and styles, on one core or on many machines.

ranges + vehicle -> runs (evaluate/sweep_runs.py) on workers (ridetune/workers.py) -> sweep.json:
per cell the counts of safe and unsafe runs with Clopper-Pearson intervals and quantiles of the
metrics, and the rate of each backend on the same runs. The last line is one JSON object.

    python -m evaluate.sweep --config configs/sweep.yaml
    python -m evaluate.sweep runs_per_cell=834        # 100,080 runs
"""

import hashlib
import json
import math
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby, product
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter
from tqdm import tqdm

from ridetune.control.vehicle import Vehicle
from ridetune.matrix import Ranges, Style
from ridetune.sample import Condition
from ridetune.sim.scenarios import SCENARIOS
from ridetune.stage import run_stage
from ridetune.workers import Backend, run_tasks

from .significance import clopper_pearson
from .sweep_runs import METRICS, Cell, Outcome, Task, drive_task

SAFE = ("finished", "stopped")
QUANTILES = (0.05, 0.5, 0.95)
# Unsafe runs of a cell that are written out, to be driven again.
_EXAMPLES = 3


@dataclass(frozen=True)
class SweepConfig:
    """What to drive, and where; cells are all combinations of scenario, condition and style.

    runs_per_task: the most that one worker drives at a time; 62 kB each for a run of 18 s.
    compare: backends that drive the first `compared_runs` of each cell, timed one after the other.
    address: of a Ray cluster, null for this machine.
    """

    ranges: Path
    vehicle: Path
    out: Path
    seed: int
    scenarios: tuple[str, ...]
    conditions: tuple[Condition, ...]
    styles: tuple[Style, ...]
    runs_per_cell: int
    runs_per_task: int
    backend: Backend
    workers: int
    address: str | None
    compare: tuple[Backend, ...]
    compared_runs: int

    def __post_init__(self) -> None:
        unknown = sorted(set(self.scenarios) - set(SCENARIOS))
        if unknown:
            raise ValueError(f"no scenarios {unknown}; there are {', '.join(SCENARIOS)}")
        for name in ("runs_per_cell", "runs_per_task", "compared_runs"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")


def sweep(config: SweepConfig) -> None:
    """Compare the backends, drive every cell, write the result and print it."""
    drive_task(next(plan_tasks(config, 1)))  # load the compiled loop before anything is timed
    compared = compare_backends(config)
    print(f"{'scenario':16} {'condition':10} {'style':13} {'unsafe':>7} {'of':>6}  95 % interval")
    cells = []
    timing = Timing(config.backend)
    for cell, outcomes in groupby(
        drive(config, config.backend, config.runs_per_cell, timing), key=lambda o: o.cell
    ):
        cells.append(summarise(cell, list(outcomes)))
        print(_line(cells[-1]), flush=True)
    result = {
        "about": "simulation: matrices drawn from the whole ranges of a style, not a model's",
        "rate": timing.as_dict(),
        "compared": compared,
        "unsafe_by_style": {s: _pool(cells, style=s) for s in config.styles},
        "unsafe_by_condition": {c: _pool(cells, condition=c) for c in config.conditions},
        "cells": cells,
        "config": TypeAdapter(SweepConfig).dump_python(config, mode="json"),
        "cores": os.cpu_count(),
    }
    config.out.parent.mkdir(parents=True, exist_ok=True)
    config.out.write_text(json.dumps(result, indent=2, allow_nan=False) + "\n")
    print(json.dumps({**result["rate"], "compared": compared, "out": str(config.out)}))


class Timing:
    """What a backend's runs took so far, and a hash of all that they gave."""

    def __init__(self, backend: Backend) -> None:
        self.backend = backend
        self.runs = 0
        self.cpu_s = 0.0
        self.simulated_s = 0.0
        self._started = time.monotonic()
        self._digest = hashlib.sha256()
        self.first_result_s = math.nan
        self.wall_s = 0.0

    def add(self, outcome: Outcome) -> None:
        """Count one outcome; the order of the outcomes is part of the hash."""
        self.wall_s = time.monotonic() - self._started
        if self.runs == 0:
            self.first_result_s = self.wall_s
        self.runs += len(outcome.statuses)
        self.cpu_s += outcome.cpu_s
        self.simulated_s += SCENARIOS[outcome.cell.scenario].duration_s * len(outcome.statuses)
        self._digest.update(repr((asdict(outcome.cell), outcome.statuses)).encode())
        self._digest.update(outcome.metrics.tobytes())

    def as_dict(self) -> dict[str, Any]:
        """Rates; wall time counts the start of the workers, CPU time only what drives."""
        return {
            "backend": self.backend,
            "runs": self.runs,
            "wall_s": round(self.wall_s, 2),
            "first_result_s": round(self.first_result_s, 2),
            "cpu_s": round(self.cpu_s, 2),
            "runs_per_s": round(self.runs / self.wall_s, 1),
            "runs_per_cpu_s": round(self.runs / self.cpu_s, 1),
            "simulated_s_per_cpu_s": round(self.simulated_s / self.cpu_s),
            "sha256": self._digest.hexdigest(),
        }


def plan_tasks(config: SweepConfig, runs_per_cell: int) -> Iterator[Task]:
    """The tasks of all cells, cell by cell."""
    ranges, vehicle = Ranges.load(config.ranges), Vehicle.load(config.vehicle)
    for scenario, condition, style in product(config.scenarios, config.conditions, config.styles):
        cell = Cell(scenario, condition, style)
        for first in range(0, runs_per_cell, config.runs_per_task):
            count = min(config.runs_per_task, runs_per_cell - first)
            yield Task(cell, first, count, config.seed, ranges, vehicle)


def drive(
    config: SweepConfig, backend: Backend, runs_per_cell: int, timing: Timing
) -> Iterator[Outcome]:
    """The outcomes of all tasks in their order, counted in `timing`."""
    cells = len(config.scenarios) * len(config.conditions) * len(config.styles)
    outcomes = run_tasks(
        drive_task,
        plan_tasks(config, runs_per_cell),
        backend=backend,
        workers=config.workers,
        address=config.address,
    )
    with tqdm(total=cells * runs_per_cell, desc=backend, unit="run", mininterval=2.0) as bar:
        for outcome in outcomes:
            timing.add(outcome)
            bar.update(len(outcome.statuses))
            yield outcome


def compare_backends(config: SweepConfig) -> list[dict[str, Any]]:
    """Each backend on the same runs: rates, speed-up against the first, same results or not."""
    rows: list[dict[str, Any]] = []
    for backend in config.compare:
        timing = Timing(backend)
        for _ in drive(config, backend, config.compared_runs, timing):
            pass
        row = timing.as_dict()
        first = rows[0] if rows else row
        row["speed_up"] = round(first["wall_s"] / row["wall_s"], 2)
        row["same_results"] = row["sha256"] == first["sha256"]
        rows.append(row)
    return rows


def summarise(cell: Cell, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Counts with their interval, quantiles over the safe runs, and some unsafe runs."""
    statuses = [status for outcome in outcomes for status in outcome.statuses]
    metrics = np.concatenate([outcome.metrics for outcome in outcomes])  # [run, metric]
    safe = np.array([status in SAFE for status in statuses])
    unsafe = int(np.sum(~safe))
    return {
        **asdict(cell),
        "runs": len(statuses),
        "unsafe": unsafe,
        "interval": [round(x, 6) for x in clopper_pearson(unsafe, len(statuses))],
        "statuses": dict(sorted(Counter(statuses).items())),
        "quantiles_of_safe": {name: _quantiles(metrics[safe, i]) for i, name in enumerate(METRICS)},
        "unsafe_runs": np.flatnonzero(~safe)[:_EXAMPLES].tolist(),
    }


def _quantiles(values: Any) -> dict[str, Any] | None:
    """Quantiles of what is finite, with its count; None where nothing is."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return None
    names = [f"p{100 * q:.0f}" for q in QUANTILES]
    found = [round(float(x), 4) for x in np.quantile(finite, QUANTILES)]
    return {**dict(zip(names, found, strict=True)), "runs": len(finite)}


def _pool(cells: Sequence[dict[str, Any]], **where: str) -> dict[str, Any]:
    chosen = [c for c in cells if all(c[key] == value for key, value in where.items())]
    unsafe, runs = sum(c["unsafe"] for c in chosen), sum(c["runs"] for c in chosen)
    interval = [round(x, 6) for x in clopper_pearson(unsafe, runs)]
    return {"runs": runs, "unsafe": unsafe, "interval": interval}


def _line(cell: dict[str, Any]) -> str:
    low, high = cell["interval"]
    name = f"{cell['scenario']:16} {cell['condition']:10} {cell['style']:13}"
    return f"{name} {cell['unsafe']:>7} {cell['runs']:>6}  {low:.4f} .. {high:.4f}"


if __name__ == "__main__":
    sys.exit(run_stage(SweepConfig, "configs/sweep.yaml", sweep, __doc__))
