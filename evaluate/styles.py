"""Whether a drive shows its style: order of the styles, and the style read from the drive alone.

A linear discriminant (Fisher 1936: Gaussian classes with one covariance) is fitted per manoeuvre
and condition on drives with matrices drawn from the styles' ranges, with seeds of their own and
never on a model's drives. The ranges of neighbouring styles overlap, so no reader is right every
time: range-drawn drives that it was not fitted on show how far it can get.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ridetune.codec import MatrixCodec
from ridetune.matrix import STYLES, ControllerMatrix, Style, ki_limit
from ridetune.sample import CONDITIONS, Condition
from ridetune.sim.metrics import DriveMetrics

from .driving_score import MANOEUVRES, Manoeuvre
from .trials import Car, Drive, Trial, drive_proposals

# What shows the style of a manoeuvre, with the sign of its growth from conservative to aggressive.
SHOWN: dict[Manoeuvre, dict[str, int]] = {
    "acceleration": {"t90_s": -1, "peak_ax": 1, "mean_jx": 1},
    "lane_change": {"felt_peak_ay": 1, "felt_peak_jy": 1, "felt_mean_jy": 1},
    "left_turn": {"felt_peak_ay": 1, "felt_peak_jy": 1, "felt_mean_jy": 1},
}
# The ridge keeps a feature that hardly varies from ruling.
_RIDGE = 1e-3
_Values = NDArray[np.float64]
# medians: in the order of STYLES.
Order = dict[str, object]


def features_of(drive: DriveMetrics) -> dict[str, float]:
    """What an observer may measure of a drive; a value that does not apply is NaN."""
    t90 = np.nan if drive.t90_s is None else min(drive.t90_s, drive.duration_s)
    return {
        "t90_s": t90,
        "peak_ax": drive.peak_ax,
        "mean_jx": drive.mean_jx,
        "min_gap_m": drive.min_gap_m if np.isfinite(drive.min_gap_m) else np.nan,
        "felt_peak_ay": drive.felt.peak_acceleration,
        "felt_peak_jy": drive.felt.peak_jerk,
        "felt_mean_jy": drive.felt.mean_jerk,
        "lateral_error_peak_m": drive.lateral_error_peak_m,
    }


@dataclass(frozen=True)
class StyleReader:
    """The discriminant of one manoeuvre and condition; used: which features."""

    used: NDArray[np.bool_]
    centre: _Values  # [style, feature], whitened
    whiten: _Values  # [feature, feature]

    @staticmethod
    def fit(drives: Mapping[Style, Sequence[DriveMetrics]]) -> "StyleReader":
        """From drives of each style; drives that failed are left out."""
        rows = {s: _rows([d for d in drives[s] if not d.failed]) for s in STYLES}
        everything = np.concatenate(list(rows.values()))
        used = np.isfinite(everything).all(axis=0) & (everything.std(axis=0) > 1e-9)
        spread = np.concatenate([rows[s][:, used] - rows[s][:, used].mean(axis=0) for s in STYLES])
        size = np.sqrt(spread.var(axis=0)) + 1e-12
        covariance = np.cov((spread / size).T, ddof=len(STYLES)) + _RIDGE * np.eye(int(used.sum()))
        whiten = np.linalg.inv(np.linalg.cholesky(covariance)).T / size[:, None]
        centre = np.array([rows[s][:, used].mean(axis=0) @ whiten for s in STYLES])
        return StyleReader(used, centre, whiten)

    def read(self, drive: DriveMetrics) -> Style | None:
        """The nearest style; None for a drive that failed."""
        if drive.failed:
            return None
        seen = np.nan_to_num(_rows([drive])[0][self.used]) @ self.whiten
        return STYLES[int(np.argmin(((self.centre - seen) ** 2).sum(axis=1)))]


def draw_from_range(style: Style, codec: MatrixCodec, rng: np.random.Generator) -> ControllerMatrix:
    """A matrix from the full-score ranges of a style, uniform on the codec's scale, K_i coupled."""
    values = []
    for i, limits in enumerate(codec.ranges.styles[style]):
        low, high = codec.share(limits.lower, i), codec.share(limits.upper, i)
        values.append(codec.value(float(rng.uniform(low, high)), i))
    values[1] = min(values[1], ki_limit(values[0]))
    return ControllerMatrix.of(values)


def drive_ranges(
    trials: Sequence[Trial], count: int, car: Car, codec: MatrixCodec, rng: np.random.Generator
) -> list[Drive]:
    """`count` drives per manoeuvre, condition and style with matrices from the style's range."""
    scenarios = {trial.manoeuvre: trial.scenario for trial in trials}
    return [
        drive_proposals(
            [draw_from_range(style, codec, rng)],
            Trial(name, scenarios[name], style, "I", "", 0, int(rng.integers(2**31, 2**32))),
            condition,
            car,
        )
        for name in scenarios
        for condition in CONDITIONS
        for style in STYLES
        for _ in range(count)
    ]


def fit_readers(drives: Sequence[Drive]) -> dict[tuple[Manoeuvre, Condition], StyleReader]:
    """A reader for each manoeuvre and condition that was driven."""
    by_place: dict[tuple[Manoeuvre, Condition], dict[Style, list[DriveMetrics]]] = {}
    for drive in drives:
        styles = by_place.setdefault(
            (drive.trial.manoeuvre, drive.condition), {style: [] for style in STYLES}
        )
        styles[drive.trial.style].append(drive.metrics)
    return {place: StyleReader.fit(styles) for place, styles in by_place.items()}


def order_styles(drives: Sequence[Drive]) -> dict[str, dict[str, dict[str, Order]]]:
    """By manoeuvre, feature and condition: the medians of the styles, and whether they rise."""
    return {
        name: {
            feature: {
                condition: _order(
                    [d for d in drives if (d.trial.manoeuvre, d.condition) == (name, condition)],
                    feature,
                    sign,
                )
                for condition in CONDITIONS
            }
            for feature, sign in SHOWN[name].items()
        }
        for name in MANOEUVRES
    }


def _order(drives: Sequence[Drive], feature: str, sign: int) -> Order:
    medians = [
        float(np.median([features_of(d.metrics)[feature] for d in drives if d.trial.style == s]))
        for s in STYLES
    ]
    return {
        "medians": [round(m, 4) for m in medians],
        "ordered": bool(np.all(sign * np.diff(medians) > 0)),
    }


def _rows(drives: Sequence[DriveMetrics]) -> _Values:
    """Features [drive, feature]."""
    return np.array([list(features_of(drive).values()) for drive in drives])
