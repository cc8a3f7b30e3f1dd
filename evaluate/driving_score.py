"""The driving score of a manoeuvre (the on-board VLM paper, Eq. 6): S = sum of w_k * S_k.

Ten metrics k, each scored S_k in [0, 100]:

    time to collision             100 from the threshold on, 0 below
    SV, |a|, |J| (x and y)        100 - gamma * value / baseline: 80 for what equals the baseline
    latency                       100 at once, 0 from the limit on, linear between
    command, scenario alignment   as they are

The first two forms are Talk2Drive's (survey, Eq. 19 and 20), which the paper follows; the form of
the latency and all weights are ours, with reasons, in configs/driving_score.yaml. How far they come
from the paper's printed scores is shown, not fitted:

    python -m evaluate.driving_score

What the score says, and what it does not:

    Motion is "lower is better" throughout (the arrows of Table 1) and is compared with the default;
    the only time that counts is the model's. So an aggressive drive, asked for and well driven,
    scores less in motion than a conservative one, and only command alignment pays it back. This
    is the paper's definition; no weight is moved against it.
    The constant default has 80 in every motion metric, being compared with itself, and full marks
    for latency. Its scenario alignment is 0 here, because a tie is no success; the paper prints 60
    for its baseline and does not say how a constant gets there. That is worth 9 points.
    The time to collision is a threshold. In the lane change every style passes it (2.0 to 2.05 s:
    30 m at 50 km/h, before the lead has gained speed), so there it tells no styles apart.
    In the lane change and the left turn the simulated car holds its speed: SV_x and |a_x| lie below
    their floors (paper: 3.91 and 0.37), and |J_x| is measurement noise times K_p.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from ridetune.config import load_config
from ridetune.sim.metrics import DriveMetrics

Manoeuvre = Literal["acceleration", "lane_change", "left_turn"]
MANOEUVRES: tuple[Manoeuvre, ...] = get_args(Manoeuvre)
SHIPPED = Path("configs/driving_score.yaml")


@dataclass(frozen=True)
class TenMetrics:
    """The ten metrics of one drive, or of one row of Table 1, in SI units.

    ttc_s: infinite where nothing is ahead. latency_s: 0 for a policy that decides nothing.
    command_alignment, scenario_alignment: in [0, 100].
    """

    ttc_s: float
    sv_x: float
    sv_y: float
    mean_ax: float
    mean_jx: float
    mean_ay: float
    mean_jy: float
    latency_s: float
    command_alignment: float
    scenario_alignment: float


METRICS = tuple(field.name for field in fields(TenMetrics))
# The paper's own Table 1, printed on a real car: the ten metrics in the order and units of
# TenMetrics, then the printed driving score. A dash stands for nothing ahead, or nothing to wait
# for.
# fmt: off
TABLE_1: dict[Manoeuvre, dict[str, tuple[float, ...]]] = {
    "acceleration": {
        "baseline": (2.44, 28.8, .0036, .78, 3.27, .046, .44, 0., 92.0, 60.0, 75.6),
        "GPT-4o": (2.52, 30.0, .0039, .83, 3.40, .052, .52, 5.82, 92.9, 71.3, 76.4),
        "on-board VLM": (2.46, 30.8, .0039, .81, 3.07, .053, .81, 1.98, 96.3, 60.9, 76.5),
    },
    "lane_change": {
        "baseline": (2.44, 3.91, .0165, .37, 3.14, .088, 1.01, 0., 88.5, 60.0, 74.5),
        "GPT-4o": (2.71, 3.88, .0223, .53, 4.38, .113, 1.39, 4.84, 90.4, 88.6, 78.4),
        "on-board VLM": (2.15, 4.07, .0215, .41, 3.35, .098, 1.02, 1.83, 92.2, 71.9, 77.5),
    },
    "left_turn": {
        "baseline": (math.inf, 1.12, .0752, .22, 1.81, .129, 1.36, 0., 88.0, 60.0, 70.4),
        "GPT-4o": (math.inf, .93, .115, .29, 2.75, .211, 2.40, 5.23, 91.3, 85.0, 71.4),
        "on-board VLM": (math.inf, .94, .0674, .19, 1.67, .133, 1.32, 1.64, 90.2, 67.8, 74.4),
    },
}
# fmt: on


@dataclass(frozen=True)
class Weights:
    """Shares of the score; the motion shares are split between the axes by manoeuvre."""

    time_to_collision: float
    speed_variance: float
    acceleration: float
    jerk: float
    latency: float
    command_alignment: float
    scenario_alignment: float


@dataclass(frozen=True)
class LongitudinalShare:
    """How much of the motion weights is longitudinal, by manoeuvre."""

    acceleration: float
    lane_change: float
    left_turn: float


@dataclass(frozen=True)
class Floors:
    """Values that nobody notices [m^2/s^2, m/s^2, m/s^3]; smaller ones count as these."""

    speed_variance: float
    acceleration: float
    jerk: float


@dataclass(frozen=True)
class DrivingScoreConfig:
    """configs/driving_score.yaml; ValueError where weights or shares make no score in [0, 100]."""

    gamma: float
    ttc_threshold_s: float
    latency_limit_s: float
    lateral: Literal["body", "felt"]
    weights: Weights
    longitudinal_share: LongitudinalShare
    floors: Floors

    def __post_init__(self) -> None:
        shares = astuple(self.weights)
        if min(shares) < 0 or abs(sum(shares) - 1.0) > 1e-6:
            raise ValueError(f"weights must be positive and sum to 1, they sum to {sum(shares):g}")
        if not all(0 <= share <= 1 for share in astuple(self.longitudinal_share)):
            raise ValueError("every longitudinal_share must lie in [0, 1]")
        if not all(value > 0 for value in (self.latency_limit_s, *astuple(self.floors))):
            raise ValueError("latency_limit_s and all floors must be above 0")

    def weights_of(self, manoeuvre: Manoeuvre) -> tuple[float, ...]:
        """The ten weights w_k in the order of METRICS; they sum to 1."""
        w, x = self.weights, float(getattr(self.longitudinal_share, manoeuvre))
        y = 1.0 - x
        motion = (w.speed_variance * x, w.speed_variance * y, w.acceleration * x, w.jerk * x)
        lateral = (w.acceleration * y, w.jerk * y)
        rest = (w.latency, w.command_alignment, w.scenario_alignment)
        return (w.time_to_collision, *motion, *lateral, *rest)


def ten_metrics(
    drive: DriveMetrics,
    config: DrivingScoreConfig,
    *,
    latency_s: float,
    command_alignment: float,
    scenario_alignment: float,
) -> TenMetrics:
    """The ten metrics of one drive; the alignments in [0, 100], lateral motion as configured."""
    lateral = drive.body if config.lateral == "body" else drive.felt
    return TenMetrics(
        ttc_s=drive.ttc_s,
        sv_x=drive.sv_x,
        sv_y=drive.sv_y,
        mean_ax=drive.mean_ax,
        mean_jx=drive.mean_jx,
        mean_ay=lateral.mean_acceleration,
        mean_jy=lateral.mean_jerk,
        latency_s=latency_s,
        command_alignment=command_alignment,
        scenario_alignment=scenario_alignment,
    )


def mean_metrics(rows: Sequence[TenMetrics]) -> TenMetrics:
    """The mean of each metric, for the baseline; ValueError without rows or with a NaN in one."""
    if not rows or np.isnan([astuple(row) for row in rows]).any():
        raise ValueError(
            f"the baseline's mean needs whole drives, got {len(rows)} rows; leave out the drives "
            "that broke off"
        )
    return TenMetrics(*np.mean([astuple(row) for row in rows], axis=0).tolist())


def sub_scores(
    row: TenMetrics, baseline: TenMetrics, config: DrivingScoreConfig
) -> tuple[float, ...]:
    """The ten S_k in [0, 100], in the order of METRICS; what is not a number scores 0."""
    f = config.floors
    floors = (f.speed_variance, f.speed_variance, f.acceleration, f.jerk, f.acceleration, f.jerk)
    motion = [
        100.0 - config.gamma * max(value, floor) / max(usual, floor)
        for value, usual, floor in zip(
            astuple(row)[1:7], astuple(baseline)[1:7], floors, strict=True
        )
    ]
    scores = (
        100.0 if row.ttc_s >= config.ttc_threshold_s else 0.0,
        *motion,
        100.0 * (1.0 - row.latency_s / config.latency_limit_s),
        row.command_alignment,
        row.scenario_alignment,
    )
    return tuple(min(max(s, 0.0), 100.0) if math.isfinite(s) else 0.0 for s in scores)


def driving_score(
    row: TenMetrics, baseline: TenMetrics, manoeuvre: Manoeuvre, config: DrivingScoreConfig
) -> float:
    """Eq. 6 in [0, 100]."""
    weighted = zip(config.weights_of(manoeuvre), sub_scores(row, baseline, config), strict=True)
    return sum(weight * score for weight, score in weighted)


def mean_driving_score(
    drives: Sequence[tuple[DriveMetrics, TenMetrics]],
    baseline: TenMetrics,
    manoeuvre: Manoeuvre,
    config: DrivingScoreConfig,
) -> float:
    """The mean score of many drives; one that broke off or collided scores 0."""
    if not drives:
        raise ValueError(f"no drive of the manoeuvre {manoeuvre} to score")
    scores = [
        0.0 if drive.failed else driving_score(row, baseline, manoeuvre, config)
        for drive, row in drives
    ]
    return sum(scores) / len(scores)


def printed_against_ours(
    config: DrivingScoreConfig,
) -> dict[tuple[Manoeuvre, str], tuple[float, float]]:
    """Per row of Table 1 the printed score and the one that our weights give the same metrics.

    Information on how far stated weights lie from unpublished ones; nothing is fitted to it.
    """
    found = {}
    for manoeuvre, rows in TABLE_1.items():
        baseline = TenMetrics(*rows["baseline"][:-1])
        for model, row in rows.items():
            ours = driving_score(TenMetrics(*row[:-1]), baseline, manoeuvre, config)
            found[manoeuvre, model] = (row[-1], ours)
    return found


def main() -> int:
    """Print the paper's scores beside those of our weights."""
    print(f"{'':28}{'printed':>9}{'our weights':>13}{'difference':>12}")
    for (manoeuvre, model), (printed, ours) in printed_against_ours(
        load_config(DrivingScoreConfig, SHIPPED)
    ).items():
        name = f"{manoeuvre.replace('_', ' ')}, {model}"
        print(f"{name:28}{printed:>9.1f}{ours:>13.1f}{ours - printed:>+12.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
