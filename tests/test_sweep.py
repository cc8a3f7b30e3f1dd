"""The sweep: the same runs whatever drives them, and counts that hold what they say."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluate.significance import clopper_pearson
from evaluate.sweep import SAFE, SweepConfig, plan_tasks, summarise, sweep
from evaluate.sweep_runs import METRICS, Cell, Outcome, draw_run, drive_task
from ridetune.codec import MatrixCodec
from ridetune.config import load_config
from ridetune.matrix import STYLES, Ranges, ki_limit
from ridetune.sim.metrics import measure
from ridetune.sim.rollout import rollout
from ridetune.sim.scenarios import SCENARIOS
from ridetune.stage import run_stage
from ridetune.workers import Backend, run_tasks
from tests.shipped_car import VEHICLE

SMALL = [
    "scenarios=[lane_change, static_obstacle]",
    "conditions=[sunny, snow]",
    "styles=[conservative, aggressive]",
    "runs_per_cell=3",
    "runs_per_task=2",
    "compared_runs=1",
]
LEFT_TURN_ON_SNOW = Cell("left_turn", "snow", "conservative")


def config(root: Path, *overrides: str) -> SweepConfig:
    return load_config(SweepConfig, root / "configs/sweep.yaml", [*SMALL, *overrides])


def same(ours: Outcome, theirs: Outcome) -> bool:
    """Equal bit for bit; a NaN equals the same NaN."""
    return (
        (ours.cell, ours.first, ours.statuses) == (theirs.cell, theirs.first, theirs.statuses)
    ) and ours.metrics.tobytes() == theirs.metrics.tobytes()


def outcomes(config: SweepConfig, backend: Backend) -> list[Outcome]:
    tasks = plan_tasks(config, config.runs_per_cell)
    return list(run_tasks(drive_task, tasks, backend=backend, workers=2))


def test_every_run_is_planned_once_and_cells_stay_together(root: Path) -> None:
    tasks = list(plan_tasks(config(root), 3))
    numbers = [(t.cell, t.first + i) for t in tasks for i in range(t.count)]
    assert len(numbers) == len(set(numbers)) == 2 * 2 * 2 * 3
    assert [t.count for t in tasks] == [2, 1] * 8
    cells = [t.cell for t in tasks]
    assert cells == sorted(cells, key=cells.index)


@pytest.mark.parametrize("backend", ["serial", "joblib"])
def test_an_error_among_the_tasks_reaches_whoever_asks(backend: Backend) -> None:
    def tasks() -> Iterator[int]:
        yield from range(-20, 0)
        raise ValueError("the source broke off")

    with pytest.raises(ValueError, match="the source broke off"):
        list(run_tasks(abs, tasks(), backend=backend, workers=2))


@pytest.mark.parametrize("style", STYLES)
def test_drawn_matrices_fill_their_style_and_keep_the_coupling(
    ranges: Ranges, codec: MatrixCodec, style: Any
) -> None:
    drawn = [draw_run(Cell("left_turn", "rain", style), n, 5, codec) for n in range(200)]
    for i, limits in enumerate(ranges.styles[style]):
        values = [matrix.values[i] for matrix, _, _ in drawn]
        assert limits.minimum - 1e-12 <= min(values)
        assert max(values) <= limits.maximum + 1e-12
        if i != 1:  # K_i is cut by the coupling
            shares = [codec.share(v, i) for v in values]
            low, high = codec.share(limits.minimum, i), codec.share(limits.maximum, i)
            assert abs(np.mean(shares) - (low + high) / 2) < 0.1 * (high - low)
    assert all(m.ki <= ki_limit(m.kp) for m, _, _ in drawn)
    assert len({seed for _, _, seed in drawn}) == len({spread for _, spread, _ in drawn}) == 200


def test_a_run_depends_on_its_cell_number_and_seed_alone(codec: MatrixCodec) -> None:
    first = draw_run(LEFT_TURN_ON_SNOW, 7, 5, codec)
    assert first == draw_run(LEFT_TURN_ON_SNOW, 7, 5, codec)
    others = [
        draw_run(LEFT_TURN_ON_SNOW, 8, 5, codec),
        draw_run(LEFT_TURN_ON_SNOW, 7, 6, codec),
        draw_run(Cell("left_turn", "rain", "conservative"), 7, 5, codec),
        draw_run(Cell("lane_change", "snow", "conservative"), 7, 5, codec),
    ]
    assert len({(matrix.values, seed) for matrix, _, seed in [first, *others]}) == 5


def test_an_outcome_is_that_of_the_same_run_driven_alone(root: Path, codec: MatrixCodec) -> None:
    task = next(plan_tasks(config(root), 3))
    outcome = drive_task(task)
    matrix, spread, noise = draw_run(task.cell, 1, task.seed, codec)
    alone = rollout(
        matrix,
        SCENARIOS[task.cell.scenario],
        task.cell.condition,
        vehicle=VEHICLE,
        spread=spread,
        seed=noise,
    )
    metrics = measure(alone.trajectory)
    assert outcome.statuses[1] == alone.status
    row = dict(zip(METRICS, outcome.metrics[1].tolist(), strict=True))
    assert row["peak_felt_ay_mps2"] == metrics.felt.peak_acceleration
    assert row["min_gap_m"] == metrics.min_gap_m
    assert np.isnan(row["t90_s"]) == (metrics.t90_s is None)


def test_the_size_of_a_task_changes_no_run(root: Path) -> None:
    small, large = (outcomes(config(root, f"runs_per_task={n}"), "serial") for n in (1, 3))
    assert [s for o in small for s in o.statuses] == [s for o in large for s in o.statuses]
    rows = [np.concatenate([o.metrics for o in every]).tobytes() for every in (small, large)]
    assert rows[0] == rows[1]


def test_two_joblib_workers_give_the_serial_results_bit_for_bit(root: Path) -> None:
    serial, joblib = outcomes(config(root), "serial"), outcomes(config(root), "joblib")
    assert len(serial) == 16
    assert all(same(a, b) for a, b in zip(serial, joblib, strict=True))


@pytest.mark.slow
def test_two_local_ray_workers_give_the_serial_results_bit_for_bit(root: Path) -> None:
    pytest.importorskip("ray")
    serial, ray = outcomes(config(root), "serial"), outcomes(config(root), "ray")
    assert len(serial) == 16
    assert all(same(a, b) for a, b in zip(serial, ray, strict=True))


def test_ray_that_is_not_installed_is_said_with_its_remedy(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match="scale"):
        outcomes(config(root), "ray")


def test_tasks_are_taken_as_the_results_are_asked_for() -> None:
    taken = []

    def tasks() -> Any:
        for number in range(50):
            taken.append(number)
            yield number

    results = run_tasks(abs, tasks(), backend="serial", workers=1)
    assert next(results) == 0
    assert len(taken) == 1


def test_no_workers_and_unknown_scenarios_are_refused(root: Path) -> None:
    with pytest.raises(ValueError, match="workers"):
        run_tasks(abs, [1], backend="serial", workers=0)
    with pytest.raises(ValueError, match="no scenarios"):
        config(root, "scenarios=[moonwalk]")
    with pytest.raises(ValueError, match="runs_per_task"):
        config(root, "runs_per_task=0")


def test_unsafe_runs_are_counted_with_their_interval_and_leave_the_quantiles() -> None:
    metrics = np.full((4, len(METRICS)), np.nan)
    metrics[:, METRICS.index("min_gap_m")] = [1.0, 2.0, 3.0, 99.0]
    metrics[0, METRICS.index("ttc_s")] = np.inf
    parts = [
        Outcome(LEFT_TURN_ON_SNOW, 0, ("finished", "stopped"), metrics[:2], 0.1),
        Outcome(LEFT_TURN_ON_SNOW, 2, ("finished", "left_lane"), metrics[2:], 0.1),
    ]
    cell = summarise(LEFT_TURN_ON_SNOW, parts)
    assert (cell["runs"], cell["unsafe"], cell["unsafe_runs"]) == (4, 1, [3])
    assert cell["interval"] == pytest.approx(clopper_pearson(1, 4), abs=1e-6)
    assert cell["statuses"] == {"finished": 2, "left_lane": 1, "stopped": 1}
    assert cell["quantiles_of_safe"]["min_gap_m"] == {"p5": 1.1, "p50": 2.0, "p95": 2.9, "runs": 3}
    assert cell["quantiles_of_safe"]["ttc_s"] is None
    json.dumps(cell, allow_nan=False)


def test_the_command_writes_every_cell_and_that_the_backends_agree(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "deep/sweep.json"
    yaml = str(root / "configs/sweep.yaml")
    monkeypatch.setattr("sys.argv", ["sweep", "--config", yaml, *SMALL, f"out={out}"])
    assert run_stage(SweepConfig, yaml, sweep, None) == 0
    result = json.loads(out.read_text(), parse_constant=pytest.fail)
    assert len(result["cells"]) == 8
    assert sum(cell["runs"] for cell in result["cells"]) == result["rate"]["runs"] == 24
    assert all(sum(cell["statuses"].values()) == 3 for cell in result["cells"])
    unsafe = sum(
        count
        for cell in result["cells"]
        for status, count in cell["statuses"].items()
        if status not in SAFE
    )
    assert sum(pool["unsafe"] for pool in result["unsafe_by_style"].values()) == unsafe
    assert [row["backend"] for row in result["compared"]] == ["serial", "joblib"]
    assert all(row["same_results"] and row["runs"] == 8 for row in result["compared"])
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert last["runs"] == 24
