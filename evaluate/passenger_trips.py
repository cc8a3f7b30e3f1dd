"""The takeover study with the served bundle: what passengers do whose car reads and remembers.

In: a policy, held-out sentences and held-out feedback. Out: counts by arm and directness level for
the served bundle, and for an ideal policy that understands every word and every complaint, on the
same trips. The words are heard before the trip, so the car drives all of it with one matrix: the
one that the gate lets through once its slew limit has been walked.
"""

import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ridetune.alignment import style_of
from ridetune.camera.scene import describe
from ridetune.codec import MatrixCodec
from ridetune.control.vehicle import Vehicle
from ridetune.gate import SafetyGate
from ridetune.matrix import ControllerMatrix, Style
from ridetune.policy import Policy, PreparedFrame
from ridetune.sample import CONDITIONS, LEVELS, Condition, FeedbackKind, Level, Memory
from ridetune.scene import scene_answers
from ridetune.sim.drive import Moment
from ridetune.sim.passengers import WISHES, Priors, matrix_of_taste
from ridetune.sim.road import lay_out
from ridetune.sim.rollout import rollout
from ridetune.sim.scenarios import MANOEUVRES, Scenario
from ridetune.sim.trajectory import Trajectory
from ridetune.sim.view import photograph, scene_of

from .significance import fisher_exact
from .takeover import Arm, Past, Recall, Study, study
from .trials import Car
from .trips import Sentences, Setting, StudyConfig, World, prepare

# How far the ideal policy moves against a complaint [units of taste].
COMPLAINT_STEP: dict[FeedbackKind, float] = {
    "too_aggressive": -0.5,
    "too_conservative": 0.5,
    "just_right": 0.0,
}
_IDEAL_ARMS: tuple[Arm, ...] = ("without_memory", "with_memory")
# Steps of the slew limit that lead anywhere.
_SLEW_STEPS = 4


@dataclass(frozen=True)
class PassengerConfig:
    """The study. streets: how many pictures of each setting; spreads: of taste, for sensitivity.

    recall: newest takes the newest drives of the same manoeuvre, alike only those among them
    whose words the policy takes for the same style.
    """

    study: StudyConfig
    conditions: tuple[Condition, ...]
    streets: int
    recall: Literal["newest", "alike"]
    spreads: tuple[float, ...]


@dataclass(frozen=True)
class Place:
    """A scenario in one condition."""

    scenario: Scenario
    condition: Condition

    def start(self, default: ControllerMatrix, car: Vehicle) -> Moment:
        """The moment before the drive."""
        road = lay_out(self.scenario, self.condition, car, 0.03)
        actors = tuple((float(track[0, 0]), float(track[0, 1])) for track in road.positions)
        return Moment(0.0, 0.0, 0.0, 0.0, self.scenario.initial_mps, actors, default)


class ServedPolicy:
    """The bundle as the study asks it; the same question is answered once."""

    def __init__(self, policy: Policy, gate: SafetyGate, vehicle: Vehicle, streets: int) -> None:
        self._policy = policy
        self._gate = gate
        self._vehicle = vehicle
        self._streets = streets
        self._frames: dict[tuple[Place, int], PreparedFrame] = {}
        self._known: dict[tuple[str, tuple[Memory, ...], Place], ControllerMatrix] = {}

    def decide(
        self, instruction: str, memories: tuple[Memory, ...], place: Place
    ) -> ControllerMatrix:
        """The matrix that the car ends up driving with after these words."""
        question = (instruction, memories, place)
        if question not in self._known:
            default = self._policy.contract.ranges.default
            frame = self._frame(place, zlib.crc32(instruction.encode()) % self._streets)
            decision = self._policy.decide(frame, instruction, memories, last_safe=default)
            self._known[question] = settle(self._gate, decision.proposal, default, place.condition)
        return self._known[question]

    def recall_alike(self, count: int) -> Recall[Place]:
        """Drives of the manoeuvre whose words the policy takes for the same style."""
        ranges = self._policy.contract.ranges

        def recall(
            instruction: str, setting: Setting[Place], past: Past[Place]
        ) -> tuple[Memory, ...]:
            def heard(words: str) -> Style:
                return style_of(self.decide(words, (), setting.scenario), ranges)

            alike = [
                memory
                for place, memory in reversed(past)
                if place.kind == setting.kind and heard(memory.instruction) == heard(instruction)
            ]
            return tuple(alike[:count])

        return recall

    def _frame(self, place: Place, street: int) -> PreparedFrame:
        if (place, street) not in self._frames:
            moment = place.start(self._policy.contract.ranges.default, self._vehicle)
            frame = photograph(moment, place.scenario, place.condition, street)
            self._frames[place, street] = self._policy.prepare(frame)
        return self._frames[place, street]


class IdealPolicy:
    """Understands every sentence, sees the weather, and moves half a style against a complaint."""

    def __init__(self, sentences: Sentences, codec: MatrixCodec, priors: Priors) -> None:
        self._styles = {
            said: style for (style, _), every in sentences.instructions.items() for said in every
        }
        self._kinds = {said: kind for kind, every in sentences.feedback.items() for said in every}
        self._codec = codec
        self._shift = priors.adverse_shift
        self._tastes = np.linspace(-1.5, 1.5, 61)
        self._gains = [matrix_of_taste(float(taste), codec).kp for taste in self._tastes]

    def decide(
        self, instruction: str, memories: tuple[Memory, ...], place: Place
    ) -> ControllerMatrix:
        """The taste of the words in this weather, and what the newest memory teaches."""
        learnt = 0.0
        for memory in memories[:1]:
            stood = float(np.interp(memory.matrix.kp, self._gains, self._tastes))
            weather = CONDITIONS[scene_answers(memory.scene)[0]]
            usual = WISHES[self._styles[memory.instruction]] + self._weather(weather)
            learnt = stood - usual + COMPLAINT_STEP[self._kinds[memory.feedback]]
        taste = WISHES[self._styles[instruction]] + self._weather(place.condition) + learnt
        return matrix_of_taste(taste, self._codec)

    def _weather(self, condition: Condition) -> float:
        return 0.0 if condition == "sunny" else self._shift


def settle(
    gate: SafetyGate,
    proposal: ControllerMatrix,
    default: ControllerMatrix,
    condition: Condition,
) -> ControllerMatrix:
    """Where the car is once the gate has let the same proposal through again and again.

    The gate is told the condition, as in a drive.
    """
    matrix = default
    for _ in range(_SLEW_STEPS):
        matrix = gate.judge(proposal, matrix, condition).matrix
    return matrix


def ride_with_passengers(
    config: PassengerConfig,
    data: Path,
    policy: Policy,
    car: Car,
    instructions: Mapping[tuple[Style, Level], Sequence[str]],
) -> dict[str, Any]:
    """Both studies, memory's own effect, and the sensitivity to the spread of taste."""
    feedback = json.loads((data / "feedback-test.json").read_text())
    sentences = Sentences(instructions, feedback)
    codec, priors = policy.contract.codec, Priors()

    def drive(matrix: ControllerMatrix, place: Place, seed: int) -> Trajectory:
        return rollout(
            matrix, place.scenario, place.condition, vehicle=car.vehicle, seed=seed
        ).trajectory

    world = prepare(
        settings_of(config.conditions, car), drive, sentences, codec, priors, config.study
    )
    served = ServedPolicy(policy, car.gate, car.vehicle, config.streets)
    recall = served.recall_alike(config.study.memories) if config.recall == "alike" else None
    ours = study(world, served.decide, recall=recall)
    ideal = IdealPolicy(sentences, codec, priors)
    return {
        "served": ours.as_dict(),
        "ideal": study(world, ideal.decide, arms=_IDEAL_ARMS).as_dict(),
        "fewer_with_memory": fewer_takeovers(ours),
        "memory": memory_effect(ours),
        "sensitivity": {
            str(spread): memory_effect(
                study(with_spread(world, spread), served.decide, arms=_IDEAL_ARMS, recall=recall)
            )
            for spread in config.spreads
        },
        "recall": config.recall,
        "conditions": config.conditions,
    }


def settings_of(conditions: Sequence[Condition], car: Car) -> list[Setting[Place]]:
    """Every manoeuvre in every condition; the scene as a true description has it."""
    places = [Place(scenario, condition) for scenario in MANOEUVRES for condition in conditions]
    return [
        Setting(
            place.scenario.name,
            place.condition,
            describe(
                scene_of(place.start(car.default, car.vehicle), place.scenario, place.condition)
            ),
            place,
        )
        for place in places
    ]


def with_spread(world: World[Place], spread: float) -> World[Place]:
    """The same draws and tolerance with another spread of taste."""
    return replace(world, priors=replace(world.priors, taste_spread=spread))


def fewer_takeovers(found: Study) -> dict[str, float]:
    """By level and over all: how far takeovers with memory lie below the baseline's, as a share.

    A level at which the baseline has none counts as 0.
    """
    shares: dict[str, float] = {}
    levels: tuple[Level | None, ...] = (None, *LEVELS)
    for level in levels:
        base, ours = found.count("baseline", level), found.count("with_memory", level)
        shares[level or "all"] = round(1.0 - ours.takeovers / max(base.takeovers, 1), 4)
    return shares


def memory_effect(found: Study) -> dict[str, Any]:
    """Takeovers of the baseline, without and with memory, and Fisher's p of the last two."""
    base, without, remembered = (
        found.count(arm) for arm in ("baseline", "without_memory", "with_memory")
    )
    p = fisher_exact(remembered.takeovers, remembered.trips, without.takeovers, without.trips)
    return {
        "baseline": base.as_dict(),
        "without_memory": without.as_dict(),
        "with_memory": remembered.as_dict(),
        "p_of_memory": round(p, 6),
    }
