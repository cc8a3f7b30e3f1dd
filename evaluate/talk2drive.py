"""Talk2Drive's driving score, recovered from its published table (survey, Table VIII).

    score = 0.30 S_ttc + 0.20 S_sv + 0.25 S_|a| + 0.25 S_|J|                    (Eq. 18)
    S_ttc = 100 from 1.5 s on, else 0                                          (Eq. 19)
    S_x   = 100 - gamma * x / x_baseline, gamma = 20                           (Eq. 20)

The survey leaves out gamma and the weights; these reproduce the table, see the tests.
"""

from dataclasses import dataclass

TTC_WEIGHT, SV_WEIGHT, ACCELERATION_WEIGHT, JERK_WEIGHT = 0.30, 0.20, 0.25, 0.25
GAMMA = 20.0
TTC_THRESHOLD_S = 1.5


@dataclass(frozen=True)
class Talk2DriveRow:
    """One row: TTC [s] (infinite where the table has none), SV [m^2/s^2], |a|, |J| (SI)."""

    ttc_s: float
    speed_variance: float
    acceleration: float
    jerk: float


def driving_score(row: Talk2DriveRow, baseline: Talk2DriveRow) -> float:
    """Eq. 18 against the baseline of the same driving behaviour."""
    return (
        TTC_WEIGHT * (100.0 if row.ttc_s >= TTC_THRESHOLD_S else 0.0)
        + SV_WEIGHT * _relative(row.speed_variance, baseline.speed_variance)
        + ACCELERATION_WEIGHT * _relative(row.acceleration, baseline.acceleration)
        + JERK_WEIGHT * _relative(row.jerk, baseline.jerk)
    )


def _relative(value: float, baseline: float) -> float:
    return 100.0 - GAMMA * value / baseline
