"""The takeover study: simulated passengers ride with a policy, with controls, and step in or not.

Every arm drives the same trips: same passengers, words, scenarios, seeds and chance.

    baseline        the vehicle's default matrix, whatever is said
    without_memory  the policy hears the words
    with_memory     the policy also recalls earlier drives of this passenger and their feedback
    shuffled        the policy's matrices of other trips in the same setting: it heard other words
    random          six uniform bins, K_i coupled as the gate would
    oracle          the matrix of the taste that the passenger wants and nobody is told

Only the passengers' tolerance is calibrated, on the baseline's rate with passengers that are not in
the study. Counts come with Clopper-Pearson intervals and Fisher's exact p against the baseline.
Both take trips as independent: trips of one passenger are not, so the intervals are too narrow; and
that the arms share their trips is left unused. It is a simulation and says nothing about people:
compare arms under the stated priors, and look at `sensitivity` before believing a size.

    world = prepare(settings, drive, sentences, codec, Priors(), StudyConfig())
    study(world, decide).as_dict()
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal, TypeVar, get_args

import numpy as np

from ridetune.matrix import ControllerMatrix, ki_limit
from ridetune.sample import LEVELS, Level, Memory
from ridetune.sim.passengers import (
    Impression,
    Priors,
    feedback_kind,
    matrix_of_taste,
    takeover_probability,
)

from .decisions import random_matrices
from .significance import clopper_pearson, fisher_exact
from .trips import Setting, StudyConfig, Trip, World, plan_trips

Arm = Literal["baseline", "without_memory", "with_memory", "shuffled", "random", "oracle"]
ARMS: tuple[Arm, ...] = get_args(Arm)
SENSITIVITY_ARMS: tuple[Arm, ...] = ("baseline", "without_memory", "with_memory", "oracle")
SPREADS = (0.2, 0.5, 0.8)

Scenario = TypeVar("Scenario")
# instruction, memories, scenario (what the camera would see) -> matrix
Decide = Callable[[str, tuple[Memory, ...], Scenario], ControllerMatrix]
Past = Sequence[tuple[Setting[Scenario], Memory]]  # a passenger's earlier drives, oldest first
Recall = Callable[[str, Setting[Scenario], Past[Scenario]], tuple[Memory, ...]]


@dataclass(frozen=True)
class Count:
    """Takeovers in a number of trips."""

    takeovers: int
    trips: int

    def as_dict(self) -> dict[str, object]:
        """Counts, rate and its 95 % interval."""
        interval = clopper_pearson(self.takeovers, self.trips)
        rate = self.takeovers / self.trips
        return {**asdict(self), "rate": round(rate, 4), "interval": [round(x, 4) for x in interval]}


@dataclass(frozen=True)
class Study:
    """The outcome by arm and directness level, with what it rests on."""

    counts: dict[Arm, dict[Level, Count]]
    tolerance: float
    priors: Priors
    config: StudyConfig

    def count(self, arm: Arm, level: Level | None = None) -> Count:
        """The count of an arm at one level, or over all."""
        chosen = [c for at, c in self.counts[arm].items() if level in (None, at)]
        return Count(sum(c.takeovers for c in chosen), sum(c.trips for c in chosen))

    def p_value(self, arm: Arm, level: Level | None = None) -> float:
        """Fisher's exact p of an arm against the baseline."""
        ours, base = self.count(arm, level), self.count("baseline", level)
        return fisher_exact(ours.takeovers, ours.trips, base.takeovers, base.trips)

    def as_dict(self) -> dict[str, object]:
        """The JSON form, with every assumption."""
        levels: tuple[Level | None, ...] = (None, *LEVELS)
        arms = {
            arm: {
                level or "all": {
                    **self.count(arm, level).as_dict(),
                    "p_against_baseline": round(self.p_value(arm, level), 6),
                }
                for level in levels
            }
            for arm in self.counts
        }
        return {
            "about": "simulated passengers under stated priors; no claim about people",
            "arms": arms,
            "tolerance": round(self.tolerance, 4),
            "priors": asdict(self.priors),
            "config": asdict(self.config),
        }


def study(
    world: World[Scenario],
    decide: Decide[Scenario],
    *,
    arms: Sequence[Arm] = ARMS,
    recall: Recall[Scenario] | None = None,
) -> Study:
    """Drive every trip under every arm and count takeovers; the baseline is always among them.

    recall: which of a passenger's earlier drives a decision is shown; by default the newest of the
    same kind of scenario, newest first, at most `config.memories`.
    """
    trips = [trip for trip in plan_trips(world) if trip.counted]
    heard = _hear(world, trips, decide) if {"without_memory", "shuffled"} & set(arms) else []
    counts: dict[Arm, dict[Level, Count]] = {}
    for arm in ARMS:
        if arm not in ("baseline", *arms):
            continue
        if arm == "with_memory":
            stepped_in = _ride_with_memory(world, decide, recall or _newest(world.config.memories))
        else:
            matrices = _matrices(arm, world, trips, heard)
            stepped_in = [
                _takes_over(world, trip, world.ride(trip, matrix))
                for trip, matrix in zip(trips, matrices, strict=True)
            ]
        counts[arm] = _by_level(trips, stepped_in)
    return Study(counts, world.tolerance, world.priors, world.config)


def sensitivity(
    world: World[Scenario],
    decide: Decide[Scenario],
    *,
    spreads: Sequence[float] = SPREADS,
    recall: Recall[Scenario] | None = None,
) -> dict[float, Study]:
    """The study again for other spreads of taste, with the same draws and the same tolerance."""
    return {
        spread: study(
            replace(world, priors=replace(world.priors, taste_spread=spread)),
            decide,
            arms=SENSITIVITY_ARMS,
            recall=recall,
        )
        for spread in spreads
    }


def _hear(
    world: World[Scenario], trips: Sequence[Trip], decide: Decide[Scenario]
) -> list[ControllerMatrix]:
    return [decide(trip.instruction, (), world.settings[trip.setting].scenario) for trip in trips]


def _matrices(
    arm: Arm, world: World[Scenario], trips: Sequence[Trip], heard: list[ControllerMatrix]
) -> list[ControllerMatrix]:
    """What an arm that remembers nothing drives on each trip."""
    rng = np.random.default_rng([world.config.seed, len(trips), ARMS.index(arm)])
    if arm == "baseline":
        return [world.codec.ranges.default] * len(trips)
    if arm == "oracle":
        return [matrix_of_taste(trip.wanted, world.codec) for trip in trips]
    if arm == "random":
        drawn = random_matrices(len(trips), world.codec, rng)
        return [replace(m, ki=min(m.ki, ki_limit(m.kp))) for m in drawn]
    return _swap(heard, trips, rng) if arm == "shuffled" else heard


def _swap(
    matrices: list[ControllerMatrix], trips: Sequence[Trip], rng: np.random.Generator
) -> list[ControllerMatrix]:
    """Each trip gets the matrix of some other trip in its setting."""
    swapped = list(matrices)
    for setting in {trip.setting for trip in trips}:
        there = rng.permutation([i for i, trip in enumerate(trips) if trip.setting == setting])
        for to, source in zip(there, np.roll(there, 1), strict=True):
            swapped[to] = matrices[source]
    return swapped


def _ride_with_memory(
    world: World[Scenario], decide: Decide[Scenario], recall: Recall[Scenario]
) -> list[bool]:
    """Whether the passenger steps in on each counted trip; every drive leaves a memory."""
    stepped_in = []
    past: dict[int, list[tuple[Setting[Scenario], Memory]]] = {}
    for trip in plan_trips(world):
        setting, own = world.settings[trip.setting], past.setdefault(trip.number_of_passenger, [])
        memories = recall(trip.instruction, setting, own)
        matrix = decide(trip.instruction, memories, setting.scenario)
        impression = world.ride(trip, matrix)
        if trip.counted:
            stepped_in.append(_takes_over(world, trip, impression))
        feedback = _say_feedback(world, trip, impression)
        own.append((setting, Memory(trip.instruction, setting.scene, matrix, feedback)))
    return stepped_in


def _newest(count: int) -> Recall[Scenario]:
    def recall(_: str, setting: Setting[Scenario], past: Past[Scenario]) -> tuple[Memory, ...]:
        alike = [memory for place, memory in reversed(past) if place.kind == setting.kind]
        return tuple(alike[:count])

    return recall


def _takes_over(world: World[Scenario], trip: Trip, impression: Impression) -> bool:
    chance = float(np.random.default_rng(trip.chance).random())
    return chance < takeover_probability(impression, trip.passenger, world.tolerance, world.priors)


def _say_feedback(world: World[Scenario], trip: Trip, impression: Impression) -> str:
    rng = np.random.default_rng([trip.chance, 1])
    kind = feedback_kind(impression, trip.passenger, world.tolerance, world.priors, rng)
    said = world.sentences.feedback[kind]
    return said[int(rng.integers(len(said)))]


def _by_level(trips: Sequence[Trip], stepped_in: Sequence[bool]) -> dict[Level, Count]:
    return {
        level: Count(
            sum(t for t, trip in zip(stepped_in, trips, strict=True) if trip.level == level),
            sum(trip.level == level for trip in trips),
        )
        for level in LEVELS
    }
