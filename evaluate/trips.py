"""The trips that every arm of the takeover study drives alike: who, where, what is said and wanted.

In: settings, a drive function and sentences from the caller, priors and sizes. Out: a World, whose
passengers' tolerance is calibrated on the baseline's takeover rate, and its trips.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from ridetune.codec import MatrixCodec
from ridetune.matrix import STYLES, ControllerMatrix, Style
from ridetune.sample import FEEDBACK_KINDS, LEVELS, Condition, FeedbackKind, Level
from ridetune.sim.metrics import DriveMetrics, measure
from ridetune.sim.passengers import (
    Expectation,
    Impression,
    Passenger,
    Priors,
    draw_passenger,
    expect,
    matrix_of_taste,
    takeover_probability,
)
from ridetune.sim.trajectory import Trajectory

from .significance import solve

Scenario = TypeVar("Scenario")
# matrix, scenario, seed -> the closed-loop drive
Drive = Callable[[ControllerMatrix, Scenario, int], Trajectory]

# Independent streams of chance; a study never meets the passengers that calibrate it.
_STUDY, _CALIBRATION, _REFERENCE = range(3)
# The tolerance is searched up to here [units of taste]; a whole style off is 1.
_MOST_TOLERANT = 10.0


@dataclass(frozen=True)
class Setting(Generic[Scenario]):
    """A scenario as the study sees it; passengers have one taste per kind.

    scene: the description that a memory of a drive in it carries.
    """

    kind: str
    condition: Condition
    scene: str
    scenario: Scenario


@dataclass(frozen=True)
class StudyConfig:
    """Sizes and seeds.

    trips: counted, per passenger, setting and level. rehearsals: uncounted drives with feedback per
    passenger and setting before these, so that there is something to remember. memories: the most
    that one decision recalls. baseline_rate: the paper's 24 takeovers in 105 baseline trips.
    """

    seed: int = 0
    passengers: int = 60
    trips: int = 1
    rehearsals: int = 3
    memories: int = 3
    calibration_passengers: int = 120
    baseline_rate: float = 24 / 105
    reference_seeds: int = 5


@dataclass(frozen=True)
class Sentences:
    """What passengers say; held-out wordings where the policy learnt from others."""

    instructions: Mapping[tuple[Style, Level], Sequence[str]]
    feedback: Mapping[FeedbackKind, Sequence[str]]


@dataclass(frozen=True)
class Trip:
    """One trip; `seed` is for the drive, `chance` for the passenger's takeover and feedback."""

    passenger: Passenger
    number_of_passenger: int
    setting: int
    style: Style
    level: Level
    instruction: str
    wanted: float
    seed: int
    chance: int
    counted: bool


@dataclass(frozen=True)
class World(Generic[Scenario]):
    """All that the arms share; `prepare` makes it."""

    settings: Sequence[Setting[Scenario]]
    drive: Drive[Scenario]
    sentences: Sentences
    codec: MatrixCodec
    priors: Priors
    config: StudyConfig
    expectations: tuple[Expectation, ...]
    tolerance: float

    def ride(self, trip: Trip, matrix: ControllerMatrix) -> Impression:
        """Drive a trip with a matrix and let its passenger judge it."""
        drive = self.drive(matrix, self.settings[trip.setting].scenario, trip.seed)
        expectation = self.expectations[trip.setting]
        return expectation.judge(measure(drive), trip.wanted, trip.passenger.weights)


def prepare(
    settings: Sequence[Setting[Scenario]],
    drive: Drive[Scenario],
    sentences: Sentences,
    codec: MatrixCodec,
    priors: Priors,
    config: StudyConfig,
) -> World[Scenario]:
    """Learn what tastes look like in each setting, and calibrate the tolerance.

    Raises ValueError where a setting shows no styles, no tolerance gives the baseline's rate, or
    nothing can be said for a style and level or a kind of feedback.
    """
    _check_sentences(sentences)
    rng = np.random.default_rng([config.seed, _REFERENCE])
    seeds = rng.integers(2**31, size=config.reference_seeds).tolist()
    expectations = []
    for setting in settings:

        def drive_taste(
            taste: float, seed: int, setting: Setting[Scenario] = setting
        ) -> DriveMetrics:
            return measure(drive(matrix_of_taste(taste, codec), setting.scenario, seed))

        expectations.append(expect(drive_taste, priors, seeds))
    world = World(settings, drive, sentences, codec, priors, config, tuple(expectations), math.nan)
    return replace(world, tolerance=_calibrate(world))


def plan_trips(world: World[Scenario], *, calibration: bool = False) -> list[Trip]:
    """All trips, passenger by passenger: first the rehearsals, then the counted in random order."""
    config, stream = world.config, _CALIBRATION if calibration else _STUDY
    rng = np.random.default_rng([config.seed, stream])
    kinds = sorted({setting.kind for setting in world.settings})
    trips = []
    every = range(len(world.settings))
    for number in range(config.calibration_passengers if calibration else config.passengers):
        passenger = draw_passenger(kinds, world.priors, rng)
        rehearsed = [
            (setting, LEVELS[int(rng.integers(len(LEVELS)))], False)
            for setting in every
            for _ in range(0 if calibration else config.rehearsals)
        ]
        counted = [(setting, level, True) for setting in every for level in LEVELS] * config.trips
        for places in (rehearsed, counted):
            order = rng.permutation(len(places))
            trips += [_plan_trip(world, passenger, number, places[i], rng) for i in order]
    return trips


def _plan_trip(
    world: World[Scenario],
    passenger: Passenger,
    number: int,
    place: tuple[int, Level, bool],
    rng: np.random.Generator,
) -> Trip:
    at, level, counted = place
    setting = world.settings[at]
    style = STYLES[int(rng.integers(len(STYLES)))]
    said = world.sentences.instructions[style, level]
    return Trip(
        passenger=passenger,
        number_of_passenger=number,
        setting=at,
        style=style,
        level=level,
        instruction=said[int(rng.integers(len(said)))],
        wanted=passenger.wants(style, setting.kind, setting.condition, world.priors),
        seed=int(rng.integers(2**31)),
        chance=int(rng.integers(2**31)),
        counted=counted,
    )


def _calibrate(world: World[Scenario]) -> float:
    """The tolerance at which the baseline's expected takeover rate is the configured one."""
    default = world.codec.ranges.default
    rides = [
        (world.ride(trip, default), trip.passenger) for trip in plan_trips(world, calibration=True)
    ]
    target = world.config.baseline_rate

    def rate(tolerance: float) -> float:
        return float(
            np.mean([takeover_probability(i, p, tolerance, world.priors) for i, p in rides])
        )

    lowest, highest = rate(_MOST_TOLERANT), rate(0.0)
    if not lowest <= target <= highest:
        raise ValueError(
            f"no tolerance makes the baseline's takeover rate {target:.3f}; it lies between "
            f"{lowest:.3f} and {highest:.3f} in these settings"
        )
    return solve(lambda tolerance: -rate(tolerance), -target, high=_MOST_TOLERANT)


def _check_sentences(sentences: Sentences) -> None:
    wanted: list[tuple[object, Sequence[str] | None]] = [
        ((style, level), sentences.instructions.get((style, level)))
        for style in STYLES
        for level in LEVELS
    ]
    wanted += [(kind, sentences.feedback.get(kind)) for kind in FEEDBACK_KINDS]
    missing = [name for name, said in wanted if not said]
    if missing:
        raise ValueError(f"no sentence for {missing}; each style, level and feedback needs one")
