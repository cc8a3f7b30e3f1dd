"""Simulated passengers: hidden taste in, takeover and feedback on a realised drive out.

A taste is a number on an axis of driving styles: -1 the middle of the conservative ranges, 0 of the
moderate, +1 of the aggressive ones. On a trip a passenger wants

    wanted = wish of the words (-1, 0, +1) + hidden taste for this kind of scenario + weather

and judges what the car did, never the matrix: each aspect of the drive (rise time, acceleration,
jerk, lateral motion, gap) is compared with that of a drive at the wanted taste, in units of taste.
The weighted root mean square of these deviations, against the passenger's tolerance, gives the
probability of a takeover; their weighted mean says whether the drive was too aggressive.

This is a simulation: it shows how a policy fares under the stated `Priors`, nothing about people.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ridetune.codec import MatrixCodec
from ridetune.matrix import NUM_PARAMETERS, STYLES, ControllerMatrix, Style, ki_limit
from ridetune.sample import FEEDBACK_KINDS, Condition, FeedbackKind
from ridetune.sim.metrics import DriveMetrics

# What a passenger can tell of a drive, in this order wherever aspects are numbered.
ASPECTS = ("t90", "peak |a_x|", "mean |J_x|", "peak felt |a_y|", "peak felt |J_y|", "smallest gap")
WISHES: dict[Style, float] = dict(zip(STYLES, (-1.0, 0.0, 1.0), strict=True))
# A deviation beyond this many units of taste is simply wrong, however far it goes.
FARTHEST_DEVIATION = 3.0

Aspects = NDArray[np.float64]  # [aspect]


@dataclass(frozen=True)
class Priors:
    """Everything that is assumed about passengers; only the tolerance is calibrated.

    taste_spread: standard deviation of taste, half the way between two styles: people ask for the
        same style and mean different things. No study gives it, so results are shown for a range.
    kind_share: share of that variance which differs between kinds of scenario in one passenger; a
        person who likes brisk starts mostly, but not always, likes brisk bends.
    farthest_taste: wanted tastes end here, where the styles' ranges do.
    adverse_shift: in rain, fog, snow or night people want it calmer, by about as much as the
        labels of the dataset move (0.25 to 0.4 of a style's range, which is 0.7 units wide).
    aspect_weights: discomfort follows acceleration more than jerk (study with 23 participants),
        hence half the weight for jerk; the rest weighs alike for want of evidence.
    weight_spread: log-normal spread of a passenger's own weights: tastes differ in what matters.
    patience_spread: log-normal spread of the personal tolerance: some people bear more.
    softness: width of the logistic step in units of taste; narrow, because a person who is content
        hardly ever takes over (at the calibrated tolerance about one trip in a thousand).
    content_share: within this share of the tolerance the feedback is "just right".
    wrong_feedback: share of feedback sentences that name a wrong kind.
    noticeable: differences taken to be unfelt, chosen and not measured [s, m/s^2, m/s^3, m/s^2,
        m/s^3, m]; an aspect whose change per unit of taste is smaller plays no part in a scenario.
    """

    taste_spread: float = 0.5
    kind_share: float = 0.25
    farthest_taste: float = 1.5
    adverse_shift: float = -0.25
    aspect_weights: tuple[float, ...] = (1.0, 1.0, 0.5, 1.0, 0.5, 1.0)
    weight_spread: float = 0.4
    patience_spread: float = 0.25
    softness: float = 0.15
    content_share: float = 0.5
    wrong_feedback: float = 0.1
    noticeable: tuple[float, ...] = (0.2, 0.05, 0.02, 0.05, 0.1, 0.2)


@dataclass(frozen=True)
class Passenger:
    """A hidden taste by kind of scenario, weights by aspect, and a factor on the tolerance."""

    taste: Mapping[str, float]
    weights: tuple[float, ...]
    patience: float

    def wants(self, style: Style, kind: str, condition: Condition, priors: Priors) -> float:
        """The wanted taste of a trip on which the words ask for a style."""
        weather = 0.0 if condition == "sunny" else priors.adverse_shift
        wanted = WISHES[style] + self.taste[kind] + weather
        return min(max(wanted, -priors.farthest_taste), priors.farthest_taste)


@dataclass(frozen=True)
class Impression:
    """A drive against what was wanted, in units of taste: positive `lean` is too aggressive."""

    distance: float
    lean: float


def draw_passenger(kinds: Sequence[str], priors: Priors, rng: np.random.Generator) -> Passenger:
    """A passenger with a taste for each kind of scenario; spreads only scale the same draws."""
    own, by_kind = rng.standard_normal(), rng.standard_normal(len(kinds))
    mixed = math.sqrt(1.0 - priors.kind_share) * own + math.sqrt(priors.kind_share) * by_kind
    factors = np.exp(priors.weight_spread * rng.standard_normal(len(ASPECTS)))
    return Passenger(
        taste=dict(zip(kinds, (priors.taste_spread * mixed).tolist(), strict=True)),
        weights=tuple((np.array(priors.aspect_weights) * factors).tolist()),
        patience=math.exp(priors.patience_spread * rng.standard_normal()),
    )


def matrix_of_taste(taste: float, codec: MatrixCodec) -> ControllerMatrix:
    """The matrix at a taste: between the middles of the styles' ranges, on the codec's scale.

    Beyond -1 and +1 the axis goes straight on and ends at the envelope; K_i <= K_p^2 / 8 holds.
    """
    near: tuple[Style, Style] = (STYLES[0], STYLES[1]) if taste < 0 else (STYLES[1], STYLES[2])
    part = taste + 1.0 if taste < 0 else taste
    values = []
    for i in range(NUM_PARAMETERS):
        start, end = (_middle(style, i, codec) for style in near)
        values.append(codec.value(min(max(start + part * (end - start), 0.0), 1.0), i))
    values[1] = min(values[1], ki_limit(values[0]))
    return ControllerMatrix.of(values)


def aspects_of(drive: DriveMetrics) -> Aspects:
    """The aspects of a drive in the order of ASPECTS; NaN where one does not apply.

    A speed that is never reached counts as reached at the end of the drive.
    """
    t90 = math.nan if drive.t90_s is None else min(drive.t90_s, drive.duration_s)
    gap = drive.min_gap_m if math.isfinite(drive.min_gap_m) else math.nan
    felt = drive.felt
    return np.array(
        [t90, drive.peak_ax, drive.mean_jx, felt.peak_acceleration, felt.peak_jerk, gap]
    )


@dataclass(frozen=True)
class Expectation:
    """How drives at each taste look in one setting, found by driving them.

    aspects: [taste, aspect]; scale: [aspect], change per unit of taste with its sign, 0 for an
    aspect that tells no tastes apart here.
    """

    tastes: NDArray[np.float64]
    aspects: NDArray[np.float64]
    scale: Aspects

    def judge(self, drive: DriveMetrics, wanted: float, weights: Sequence[float]) -> Impression:
        """A drive against the wanted taste; one that broke off or collided is infinitely wrong."""
        if drive.failed:
            return Impression(math.inf, math.inf)
        used = self.scale != 0.0
        usual = np.array([np.interp(wanted, self.tastes, a) for a in self.aspects[:, used].T])
        deviation = (aspects_of(drive)[used] - usual) / self.scale[used]
        # An aspect that the drive does not show, such as a gap to nobody, deviates in no direction.
        deviation = np.clip(np.nan_to_num(deviation), -FARTHEST_DEVIATION, FARTHEST_DEVIATION)
        share = np.array(weights)[used] / np.sum(np.array(weights)[used])
        return Impression(float(np.sqrt(share @ deviation**2)), float(share @ deviation))


def expect(
    measure_taste: Callable[[float, int], DriveMetrics], priors: Priors, seeds: Sequence[int]
) -> Expectation:
    """Drive a grid of tastes, each under the same seeds, and learn what tastes look like.

    measure_taste: taste, seed -> metrics of the drive. An aspect counts where one unit of taste
    changes it by more than is noticeable, and by more than the seeds do. Raises ValueError if a
    drive fails, or if no aspect counts.
    """
    far = priors.farthest_taste
    tastes = np.unique(np.r_[np.arange(-far, far, 0.5), -1.0, 0.0, 1.0, far])
    drives = [[measure_taste(float(taste), seed) for seed in seeds] for taste in tastes]
    for taste, row in zip(tastes, drives, strict=True):
        if any(drive.failed for drive in row):
            raise ValueError(
                f"a drive at taste {taste:+.2f} broke off or collided; tame the setting"
            )
    seen = np.array([[aspects_of(drive) for drive in row] for row in drives])  # [taste, seed, .]
    mean, spread = seen.mean(axis=1), seen.std(axis=1).mean(axis=0)
    at = {taste: int(np.argmin(np.abs(tastes - taste))) for taste in (-1, 1)}
    scale = (mean[at[1]] - mean[at[-1]]) / 2.0
    # A NaN anywhere compares as false: the aspect does not apply here.
    counts = (np.abs(scale) >= np.maximum(priors.noticeable, spread)) & ~np.isnan(mean).any(axis=0)
    if not counts.any():
        raise ValueError("no aspect of this setting changes noticeably between driving styles")
    return Expectation(tastes, mean, np.where(counts, scale, 0.0))


def takeover_probability(
    impression: Impression, passenger: Passenger, tolerance: float, priors: Priors
) -> float:
    """Logistic in how far the impression exceeds the passenger's tolerance [units of taste]."""
    excess = impression.distance - tolerance * passenger.patience
    return 0.5 * (1.0 + math.tanh(0.5 * excess / priors.softness))


def feedback_kind(
    impression: Impression,
    passenger: Passenger,
    tolerance: float,
    priors: Priors,
    rng: np.random.Generator,
) -> FeedbackKind:
    """The kind of sentence that the passenger says after the drive; sometimes a wrong one."""
    bearable = priors.content_share * tolerance * passenger.patience
    right: FeedbackKind = "too_aggressive" if impression.lean > 0 else "too_conservative"
    if abs(impression.lean) <= bearable:
        right = "just_right"
    wrong = [kind for kind in FEEDBACK_KINDS if kind != right]
    slip, choice = rng.random(), int(rng.integers(len(wrong)))
    return wrong[choice] if slip < priors.wrong_feedback else right


def _middle(style: Style, parameter: int, codec: MatrixCodec) -> float:
    limits = codec.ranges.styles[style][parameter]
    return (codec.share(limits.lower, parameter) + codec.share(limits.upper, parameter)) / 2.0
