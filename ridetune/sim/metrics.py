"""What one simulated drive is worth in numbers: a Trajectory in, its DriveMetrics out.

The seven driving metrics of the paper's Table 1 (time to collision, variances of speed, mean
absolute accelerations and jerks), and those that tell driving styles apart (rise time, peaks,
overshoot, tracking error, gap). Lateral motion comes in two definitions, because the paper's
printed |a_y| fits the first while a passenger feels the second:

    body    a_y = d(v_y)/dt, the derivative of the body's lateral speed; 0 in a kinematic model
    felt    a_y = v * yaw rate

Derivatives are plain differences of neighbouring samples, unfiltered: a jerk column follows the
period and the noise of its trajectory, so it is compared only between drives of one simulation.
"""

import math
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from ridetune.sim.trajectory import SIGNALS, Trajectory

# The second difference of a speed, and one more row to take a mean over.
MIN_ROWS = 4
# A change of the reference speed below this is no speed step [m/s].
MIN_STEP_MPS = 1.0
RISE_SHARE = 0.9
# The steady error is averaged over the end of the drive [s].
STEADY_S = 2.0

# What must be finite while the car drives; gap and lead speed say "free road" by inf and NaN.
_REQUIRED = [i for i, name in enumerate(SIGNALS) if name not in ("gap_m", "lead_speed_mps")]

Signal = NDArray[np.float64]  # [time step]


@dataclass(frozen=True)
class LateralMotion:
    """Lateral acceleration [m/s^2] and jerk [m/s^3]: mean and largest absolute value."""

    mean_acceleration: float
    mean_jerk: float
    peak_acceleration: float
    peak_jerk: float


@dataclass(frozen=True)
class DriveMetrics:
    """The numbers of one drive; infinite means never, None not applicable.

    broke_off_s: when a signal stopped being finite, None for a whole drive. The other numbers
        then describe the part before it, and are NaN where that part is too short.
    ttc_s: smallest gap / closing speed over the moments at which the gap closes (paper, 4.2).
    min_gap_m: bumper to bumper; 0 or less is a collision.
    sv_x, sv_y: variance of longitudinal and lateral body speed [m^2/s^2].
    mean_ax, mean_jx, peak_ax, peak_jx: of the absolute values [m/s^2, m/s^3].
    t90_s: from the start until 90 % of the way to the last reference speed.
    overshoot_mps: farthest beyond the last reference speed, in the direction of the step.
    lateral_error_peak_m, lateral_error_steady_m: of the absolute value; mean of the last 2 s.
    """

    duration_s: float
    broke_off_s: float | None
    ttc_s: float
    min_gap_m: float
    sv_x: float
    sv_y: float
    mean_ax: float
    mean_jx: float
    peak_ax: float
    peak_jx: float
    body: LateralMotion
    felt: LateralMotion
    t90_s: float | None
    overshoot_mps: float | None
    lateral_error_peak_m: float
    lateral_error_steady_m: float

    @property
    def collided(self) -> bool:
        """Whether the bumpers met."""
        return self.min_gap_m <= 0.0

    @property
    def failed(self) -> bool:
        """Whether the drive broke off or hit something: its other numbers praise nothing."""
        return self.broke_off_s is not None or self.collided

    def as_dict(self) -> dict[str, object]:
        """The JSON form: what is infinite or NaN becomes null."""
        return {name: _plain(value) for name, value in asdict(self).items()}


def measure(drive: Trajectory) -> DriveMetrics:
    """The metrics of a drive; nothing is raised.

    A drive that broke off says when; one of fewer than MIN_ROWS rows counts as broken off.
    """
    rows = _finite_rows(drive)
    broke_off_s = rows * drive.period_s if rows < len(drive.signals) else None
    duration_s = max(rows - 1, 0) * drive.period_s
    if rows < MIN_ROWS:
        return _too_short(duration_s, rows * drive.period_s)
    part = Trajectory(drive.period_s, drive.signals[:rows])
    speed, acceleration = part["speed_mps"], part["acceleration_mps2"]
    jerk = np.abs(np.diff(acceleration)) / part.period_s
    body_acceleration = np.diff(part["lateral_speed_mps"]) / part.period_s
    t90_s, overshoot_mps = _speed_step(part)
    error = np.abs(part["lateral_error_m"])
    return DriveMetrics(
        duration_s=duration_s,
        broke_off_s=broke_off_s,
        ttc_s=time_to_collision(part),
        min_gap_m=float(np.min(part["gap_m"])),
        sv_x=float(np.var(speed)),
        sv_y=float(np.var(part["lateral_speed_mps"])),
        mean_ax=float(np.mean(np.abs(acceleration))),
        mean_jx=float(np.mean(jerk)),
        peak_ax=float(np.max(np.abs(acceleration))),
        peak_jx=float(np.max(jerk)),
        body=_lateral(body_acceleration, part.period_s),
        felt=_lateral(part.felt_lateral_mps2, part.period_s),
        t90_s=t90_s,
        overshoot_mps=overshoot_mps,
        lateral_error_peak_m=float(np.max(error)),
        lateral_error_steady_m=float(np.mean(error[-max(1, round(STEADY_S / part.period_s)) :])),
    )


def time_to_collision(drive: Trajectory) -> float:
    """The smallest gap / closing speed [s] while the gap closes: inf if never, 0 on contact.

    Closing speed: the speed minus that of what is ahead, where the road is not free.
    """
    gap, closing = drive["gap_m"], drive["speed_mps"] - drive["lead_speed_mps"]
    if np.any(gap <= 0.0):
        return 0.0
    near = np.isfinite(gap) & (closing > 0.0)  # a NaN lead speed closes nothing
    return float(np.min(gap[near] / closing[near])) if near.any() else math.inf


def _finite_rows(drive: Trajectory) -> int:
    """How many rows stand before the first that is not finite."""
    fine = np.isfinite(drive.signals[:, _REQUIRED]).all(axis=1)
    # A finite gap needs a lead speed, and a gap that is not a number is none.
    gap = drive["gap_m"]
    fine &= ~np.isnan(gap) & (np.isinf(gap) | np.isfinite(drive["lead_speed_mps"]))
    return len(fine) if fine.all() else int(np.argmin(fine))


def _speed_step(drive: Trajectory) -> tuple[float | None, float | None]:
    """t90 [s] and overshoot [m/s] of the way from the first speed to the last reference speed."""
    speed, target = drive["speed_mps"], float(drive["reference_speed_mps"][-1])
    step = target - float(speed[0])
    if abs(step) < MIN_STEP_MPS:
        return None, None
    done = (speed - speed[0]) / step  # [time step], 1 at the target
    overshoot = max(0.0, float(np.max(done)) - 1.0) * abs(step)
    if np.max(done) < RISE_SHARE:
        return math.inf, overshoot
    after = int(np.argmax(done >= RISE_SHARE))
    before, reached = float(done[after - 1]), float(done[after])
    share = (RISE_SHARE - before) / (reached - before)
    return (after - 1 + share) * drive.period_s, overshoot


def _lateral(acceleration: Signal, period_s: float) -> LateralMotion:
    size, jerk = np.abs(acceleration), np.abs(np.diff(acceleration)) / period_s
    return LateralMotion(
        mean_acceleration=float(np.mean(size)),
        mean_jerk=float(np.mean(jerk)),
        peak_acceleration=float(np.max(size)),
        peak_jerk=float(np.max(jerk)),
    )


def _too_short(duration_s: float, broke_off_s: float) -> DriveMetrics:
    nan = math.nan
    return DriveMetrics(
        duration_s=duration_s,
        broke_off_s=broke_off_s,
        ttc_s=nan,
        min_gap_m=nan,
        sv_x=nan,
        sv_y=nan,
        mean_ax=nan,
        mean_jx=nan,
        peak_ax=nan,
        peak_jx=nan,
        body=LateralMotion(nan, nan, nan, nan),
        felt=LateralMotion(nan, nan, nan, nan),
        t90_s=None,
        overshoot_mps=None,
        lateral_error_peak_m=nan,
        lateral_error_steady_m=nan,
    )


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {name: _plain(inner) for name, inner in value.items()}
    return value if not isinstance(value, float) or math.isfinite(value) else None
