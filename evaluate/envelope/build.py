"""The verified envelope: which matrices may run in which condition, computed and written down.

eigenvalues of both loops at the corners of the styles -> common Lyapunov matrix for switching ->
per condition: matrices driven through the gate's trials, the largest box without a violation,
its corners passed by the gate's check, verified on independent matrices, cars and noise
-> configs/verified.yaml, report, plot

    python -m evaluate.envelope --config configs/envelope.yaml
"""

import json
import logging
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ridetune.control.vehicle import Vehicle
from ridetune.envelope import Box, Envelope, Evidence, Limits, hash_of
from ridetune.matrix import PARAMETERS, STYLES, Ranges
from ridetune.sample import CONDITIONS, Condition
from ridetune.sim.check import OPEN_ROAD, RolloutCheck
from ridetune.sim.scenarios import LANE_CHANGE, LEFT_TURN, SCENARIOS, Scenario

from .monte_carlo import MonteCarlo, Search, Shares, project
from .peeling import peel
from .plot import plot_envelope
from .switching import badly_damped, speed_corners, steering_corners, study_loops

_log = logging.getLogger(__name__)
ALL_SCENARIOS: tuple[Scenario, ...] = (*SCENARIOS.values(), OPEN_ROAD)
MANOEUVRES = (LEFT_TURN, LANE_CHANGE, OPEN_ROAD)
_ROUNDS = 80
_CREEP = 0.06  # share of the way to the default


@dataclass(frozen=True)
class ProofConfig:
    """Sizes of the proof of the gate; see `evaluate/envelope/proof.py`."""

    proposals: int
    first: int
    step_drives: int
    box: bool
    report: Path


@dataclass(frozen=True)
class EnvelopeConfig:
    """Where things are, and sizes; see `configs/envelope.yaml`."""

    vehicle: Path
    ranges: Path
    out: Path
    plot: Path
    report: Path
    seed: int
    damping: float
    search_matrices: int
    verify_runs: int
    style_runs: int
    proof: ProofConfig


def find_box(
    carlo: MonteCarlo, condition: Condition, config: EnvelopeConfig, outer: Box
) -> tuple[Box, Evidence, Search]:
    """Peel, verify, and peel again with what the verification found; ValueError if that fails.

    The box stays within `outer`. Each verification draws anew, so that its runs are independent of
    those that shaped the box.
    """
    rng = np.random.default_rng([config.seed, CONDITIONS.index(condition)])
    default = carlo.shares([carlo.ranges.default])[0]
    found = carlo.search(rng, condition, config.search_matrices)
    check = RolloutCheck(carlo.vehicle, carlo.limits)
    for _ in range(_ROUNDS):
        box = _round_inwards(carlo, peel(found, default, carlo.ends(outer)), outer)
        # The gate moves proposals to the edges of the box, so its own check must pass there.
        edges = [*steering_corners(box), *speed_corners(box)]
        failed = [m for m in edges if check(m, condition) is not None]
        failed += badly_damped(box, carlo.vehicle, condition, config.damping)
        if failed:
            _log.info("condition=%s bad_corners=%d box=%s", condition, len(failed), box)
            # What lies a little further inside goes with it, or the cuts would creep along.
            shares = carlo.shares(failed)
            found = _with_violations(found, shares + _CREEP * (default - shares))
            continue
        drives = (
            (carlo.draw(rng, box), scenario)
            for scenario in ALL_SCENARIOS
            for _ in range(config.verify_runs)
        )
        evidence, failed = carlo.count(drives, rng, condition)
        _log.info("condition=%s runs=%d violations=%d", condition, evidence.runs, len(failed))
        if not failed:
            return box, evidence, found
        found = _with_violations(found, carlo.shares(failed))
    raise ValueError(f"no box without violations was found for {condition}; raise search_matrices")


def _with_violations(found: Search, shares: Shares) -> Search:
    more = np.ones(len(shares), bool)
    return Search(
        np.concatenate([found.shares, shares]),
        np.append(found.turn, more),
        np.append(found.road, ~more),
    )


def _round_inwards(carlo: MonteCarlo, shares: tuple[Shares, Shares], outer: Box) -> Box:
    """A box in values of three digits; what was not cut keeps the ends of the outer one."""
    box = []
    for i, (least, most) in enumerate(outer):
        low, high = (carlo.codec.value(float(end[i]), i) for end in shares)
        low = least if low <= least * (1.0 + 1e-9) else _three_digits(low, np.ceil)
        high = most if high >= most * (1.0 - 1e-9) else _three_digits(high, np.floor)
        box.append((low, high))
    return tuple(box)


def _three_digits(value: float, rounded: Callable[[float], float]) -> float:
    step = 10.0 ** (math.floor(math.log10(value)) - 2)
    return float(f"{rounded(value / step) * step:.3g}")


def study_styles(
    carlo: MonteCarlo, boxes: dict[Condition, Box], config: EnvelopeConfig
) -> dict[str, dict[str, Any]]:
    """Per style and condition: violations over the style's whole box, as asked and projected."""
    rng = np.random.default_rng([config.seed, len(CONDITIONS)])
    table: dict[str, dict[str, Any]] = {}
    for style in STYLES:
        own = carlo.style_box(style)
        for condition in CONDITIONS:
            drawn = [
                (carlo.draw(rng, own), s) for s in MANOEUVRES for _ in range(config.style_runs)
            ]
            moved = [(project(matrix, boxes[condition]), s) for matrix, s in drawn]
            before, _ = carlo.count(drawn, rng, condition)
            after, _ = carlo.count(moved, rng, condition)
            same = sum(a == b for (a, _), (b, _) in zip(drawn, moved, strict=True))
            table.setdefault(style, {})[condition] = {
                "as_asked": asdict(before),
                "projected": asdict(after),
                "inside": same / len(drawn),
            }
    return table


def build(config: EnvelopeConfig) -> None:
    """Compute, verify and write the envelope; prints one JSON line last."""
    vehicle, ranges = Vehicle.load(config.vehicle), Ranges.load(config.ranges)
    carlo = MonteCarlo(vehicle, ranges, Limits())
    # A condition only tightens: clear daylight first, the others within what holds there.
    found = {CONDITIONS[0]: find_box(carlo, CONDITIONS[0], config, carlo.whole)}
    for condition in CONDITIONS[1:]:
        found[condition] = find_box(carlo, condition, config, found[CONDITIONS[0]][0])
    write(config, carlo, found)


def write(
    config: EnvelopeConfig,
    carlo: MonteCarlo,
    found: dict[Condition, tuple[Box, Evidence, Search]],
) -> None:
    """Study the loops and the styles on the boxes that were found; write file, report and plot."""
    boxes = {condition: box for condition, (box, _, _) in found.items()}
    evidence = {condition: counted for condition, (_, counted, _) in found.items()}
    envelope = Envelope(
        vehicle=carlo.vehicle.name,
        vehicle_sha256=hash_of(asdict(carlo.vehicle)),
        ranges_sha256=hash_of(carlo.ranges.as_dict()),
        seed=config.seed,
        limits=carlo.limits,
        boxes={c: dict(zip(PARAMETERS, box, strict=True)) for c, box in boxes.items()},
        evidence=evidence,
    )
    report = {
        "loops": study_loops(carlo.vehicle, carlo.ranges, boxes),
        "styles": study_styles(carlo, boxes, config),
        "searched": {c: _shares_broken(search) for c, (_, _, search) in found.items()},
        "boxes": envelope.boxes,
        "evidence": {c: asdict(e) for c, e in evidence.items()},
    }
    header = "Written by `python -m evaluate.envelope`; change nothing here."
    envelope.save(config.out, header=header)
    config.report.parent.mkdir(parents=True, exist_ok=True)
    config.report.write_text(json.dumps(report, indent=2) + "\n")
    points = {c: (search.shares, search.turn) for c, (_, _, search) in found.items()}
    config.plot.write_text(plot_envelope(carlo.codec, envelope, points))
    print(json.dumps(report["evidence"]))


def _shares_broken(search: Search) -> dict[str, float]:
    return {
        "matrices": len(search.shares),
        "turn": round(float(search.turn.mean()), 4),
        "road": round(float(search.road.mean()), 4),
    }
