"""What the drives of every arm are worth: driving score (Eq. 6), scenario alignment, style read.

The relative sub-scores compare a drive with the constant default in the same manoeuvre and
condition. Command alignment is the mean over a drive's proposals; scenario alignment is one number
per arm and manoeuvre, as in the paper's Table 1: the share of adverse proposals that are more
conservative than the proposal of the same trial, at the same question, in clear daylight.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from ridetune.alignment import command_alignment, scenario_alignment, style_of
from ridetune.codec import MatrixCodec
from ridetune.matrix import STYLES
from ridetune.sample import ADVERSE, CONDITIONS, Condition

from .alignment import Pair
from .driving_score import (
    MANOEUVRES,
    METRICS,
    DrivingScoreConfig,
    Manoeuvre,
    TenMetrics,
    driving_score,
    mean_metrics,
    sub_scores,
    ten_metrics,
)
from .significance import clopper_pearson
from .styles import StyleReader
from .trials import Arm, Drive

Readers = Mapping[tuple[Manoeuvre, Condition], StyleReader]
# The sub-scores that say how the car drove, not what was decided.
_DRIVEN = len(METRICS) - 2


@dataclass(frozen=True)
class Scored:
    """A drive with its ten metrics, their sub-scores (0 where it failed) and its score.

    unseen: the score less what scenario alignment gives. driven: the score, in [0, 100], of the
    metrics other than the two alignments.
    """

    drive: Drive
    row: TenMetrics
    parts: tuple[float, ...]
    score: float
    unseen: float
    driven: float


def score_arm(
    drives: Sequence[Drive],
    constant: Sequence[Drive],
    latency_s: float,
    codec: MatrixCodec,
    config: DrivingScoreConfig,
) -> list[Scored]:
    """Every drive of an arm against the constant default; latency_s: 0 for what decides nothing."""
    aligned = {
        name: 100.0 * _share(pairs, codec)
        for name in MANOEUVRES
        if (pairs := condition_pairs([d for d in drives if d.trial.manoeuvre == name]))
    }
    baselines = {
        (name, condition): mean_metrics(rows)
        for name in MANOEUVRES
        for condition in CONDITIONS
        if (rows := _baseline_rows(constant, name, condition, config))
    }
    return [
        _score(
            drive,
            ten_metrics(
                drive.metrics,
                config,
                latency_s=latency_s,
                command_alignment=_command(drive, codec),
                scenario_alignment=aligned[drive.trial.manoeuvre],
            ),
            baselines[drive.trial.manoeuvre, drive.condition],
            config,
        )
        for drive in drives
    ]


def condition_pairs(drives: Sequence[Drive], only: Condition | None = None) -> list[Pair]:
    """(clear, adverse) proposals of the same trial at the same question."""
    clear = {id(d.trial): d.proposals for d in drives if d.condition == "sunny"}
    return [
        pair
        for drive in drives
        if drive.condition != "sunny" and only in (None, drive.condition)
        for pair in zip(clear[id(drive.trial)], drive.proposals, strict=False)
    ]


def summarise(scored: Mapping[Arm, Sequence[Scored]]) -> dict[str, object]:
    """By manoeuvre and arm: the mean score, its parts, and the paired difference to constant."""
    found: dict[str, object] = {}
    for name in MANOEUVRES:
        constant = [s for s in scored["constant"] if s.drive.trial.manoeuvre == name]
        found[name] = {
            arm: _summary([s for s in rows if s.drive.trial.manoeuvre == name], constant)
            for arm, rows in scored.items()
        }
    return found


def cells(scored: Sequence[Scored]) -> dict[str, dict[str, dict[str, float]]]:
    """The mean score by manoeuvre, condition and style."""
    return {
        name: {
            condition: {
                style: _mean(
                    [
                        s.score
                        for s in scored
                        if (s.drive.trial.manoeuvre, s.drive.condition) == (name, condition)
                        and s.drive.trial.style == style
                    ]
                )
                for style in STYLES
            }
            for condition in CONDITIONS
        }
        for name in MANOEUVRES
    }


def align_conditions(drives: Sequence[Drive], codec: MatrixCodec) -> dict[str, object]:
    """Scenario alignment per adverse condition with the number of pairs."""
    found: dict[str, object] = {}
    for condition in ADVERSE:
        pairs = condition_pairs(drives, condition)
        found[condition] = {"share": round(_share(pairs, codec), 4), "pairs": len(pairs)}
    return found


def read_styles(drives: Sequence[Drive], readers: Readers, codec: MatrixCodec) -> dict[str, object]:
    """How often the style that the words ask for, and that of the last matrix, is read back."""
    asked, proposed = Counter[str](), Counter[str]()
    trips = Counter[str]()
    for drive in drives:
        name = drive.trial.manoeuvre
        read = readers[name, drive.condition].read(drive.metrics)
        trips[name] += 1
        asked[name] += read == drive.trial.style
        proposed[name] += read == style_of(drive.proposals[-1], codec.ranges)
    total = trips.total()
    return {
        "asked_for": round(asked.total() / total, 4),
        "interval": [round(x, 4) for x in clopper_pearson(asked.total(), total)],
        "of_the_matrix": round(proposed.total() / total, 4),
        "asked_for_by_manoeuvre": {n: round(asked[n] / trips[n], 4) for n in trips},
        "drives": total,
    }


def _score(
    drive: Drive, row: TenMetrics, baseline: TenMetrics, config: DrivingScoreConfig
) -> Scored:
    name = drive.trial.manoeuvre
    if drive.metrics.failed:
        return Scored(drive, row, (0.0,) * len(METRICS), 0.0, 0.0, 0.0)
    parts, weights = sub_scores(row, baseline, config), config.weights_of(name)
    driven = sum(w * s for w, s in zip(weights[:_DRIVEN], parts[:_DRIVEN], strict=True))
    score = driving_score(row, baseline, name, config)
    unseen = score - weights[-1] * parts[-1]
    return Scored(drive, row, parts, score, unseen, driven / sum(weights[:_DRIVEN]))


def _summary(rows: Sequence[Scored], constant: Sequence[Scored]) -> dict[str, object]:
    difference = [a.score - b.score for a, b in zip(rows, constant, strict=True)]
    spread = float(np.std(difference, ddof=1)) / math.sqrt(len(rows)) if len(rows) > 1 else 0.0
    return {
        "score": _mean([s.score for s in rows]),
        "over_constant": _mean(difference),
        "standard_error": round(spread, 2),
        "over_constant_without_scenario_alignment": _mean(
            [a.unseen - b.unseen for a, b in zip(rows, constant, strict=True)]
        ),
        "without_alignment": _mean([s.driven for s in rows]),
        "without_alignment_by_style": {
            style: _mean([s.driven for s in rows if s.drive.trial.style == style])
            for style in STYLES
        },
        "parts": dict(
            zip(
                METRICS,
                (round(float(x), 1) for x in np.mean([s.parts for s in rows], axis=0)),
                strict=True,
            )
        ),
        "metrics": _mean_row([s for s in rows if not s.drive.metrics.failed]),
        "failed": sum(s.drive.metrics.failed for s in rows),
        "drives": len(rows),
    }


def _mean_row(rows: Sequence[Scored]) -> dict[str, float | None] | None:
    """Mean metrics in SI units, and the lateral acceleration that is felt; null: nothing ahead."""
    if not rows:
        return None
    felt = float(np.mean([s.drive.metrics.felt.mean_acceleration for s in rows]))
    means = {**asdict(mean_metrics([s.row for s in rows])), "felt_ay": felt}
    return {name: x if math.isfinite(x) else None for name, x in means.items()}


def _baseline_rows(
    constant: Sequence[Drive], name: Manoeuvre, condition: Condition, config: DrivingScoreConfig
) -> list[TenMetrics]:
    return [
        ten_metrics(d.metrics, config, latency_s=0.0, command_alignment=0.0, scenario_alignment=0.0)
        for d in constant
        if d.trial.manoeuvre == name and d.condition == condition and not d.metrics.failed
    ]


def _command(drive: Drive, codec: MatrixCodec) -> float:
    scores = [command_alignment(m, drive.trial.style, codec.ranges) for m in drive.proposals]
    return float(np.mean(scores))


def _share(pairs: Sequence[Pair], codec: MatrixCodec) -> float:
    return scenario_alignment(pairs, codec) if pairs else 0.0


def _mean(values: Sequence[float]) -> float:
    return round(float(np.mean(values)), 2)
