"""LaMPilot-Bench's driving score, recovered from its published table (survey, Table IV).

    score = success * (0.5 TTC + 0.3 SV + 0.2 TE) - 5 * collisions [%]

with sub-scores in [0, 100] (survey, Eq. 3, 6 and 7). The survey says that the sub-scores are
weighted and leaves out the weights and the penalty; these reproduce the table, see the tests.
"""

from dataclasses import dataclass

TTC_WEIGHT, SV_WEIGHT, TE_WEIGHT = 0.5, 0.3, 0.2
COLLISION_PENALTY = 5.0
TTC_SAFE_S = 2.0
# Left open by the survey; its table prints sub-scores alone and cannot confirm these two.
SIGMA_SAFE_MPS = 10.0
TIME_LIMIT_S = 60.0


@dataclass(frozen=True)
class LampilotRow:
    """One method: collisions and completed tasks [%], the three sub-scores in [0, 100]."""

    collisions: float
    completed: float
    ttc: float
    sv: float
    te: float


def ttc_score(ttc_s: float) -> float:
    """Eq. 3: 100 beyond the margin, 100 - 1 / TTC within it, 0 on contact."""
    if ttc_s > TTC_SAFE_S:
        return 100.0
    return max(0.0, 100.0 - 1.0 / ttc_s) if ttc_s > 0 else 0.0


def sv_score(speed_deviation_mps: float) -> float:
    """Eq. 6: falls linearly with the standard deviation of the speed."""
    return max(0.0, 100.0 * (1.0 - speed_deviation_mps / SIGMA_SAFE_MPS))


def te_score(duration_s: float) -> float:
    """Eq. 7: falls linearly with the time that the task takes."""
    return max(0.0, 100.0 * (1.0 - duration_s / TIME_LIMIT_S))


def driving_score(row: LampilotRow) -> float:
    """The final score; negative where collisions outweigh what was completed."""
    mean = TTC_WEIGHT * row.ttc + SV_WEIGHT * row.sv + TE_WEIGHT * row.te
    return row.completed / 100.0 * mean - COLLISION_PENALTY * row.collisions
