"""Drives of a policy and of its controls on the same trials: same words, streets, noise, weather.

In: a plan of trials, a source of matrices for each arm. Out: a `Drive` per trial and condition,
with what was proposed and what came of it. The arms:

    served     the bundle reads the frame and the words, a few times a drive
    text       the same bundle writes the matrix as text, the paper's way
    constant   the vehicle's default matrix, whatever is said
    random     six uniform bins, drawn for each drive
    shuffled   what the bundle proposed in the same manoeuvre and weather on other words
    oracle     the middle of the right style's range, in bad weather calmer by `adverse_shift`

Every proposal passes the gate, and every drive begins with the default.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from ridetune.codec import MatrixCodec
from ridetune.control.vehicle import Vehicle
from ridetune.gate import SafetyGate
from ridetune.matrix import STYLES, ControllerMatrix, Style
from ridetune.policy import Policy
from ridetune.sample import CONDITIONS, LEVELS, Condition, Level, Sample
from ridetune.sim.drive import Answer, MatrixSource, Moment, drive_policy
from ridetune.sim.metrics import DriveMetrics, measure
from ridetune.sim.passengers import WISHES, Priors, matrix_of_taste
from ridetune.sim.rollout import Rollout
from ridetune.sim.scenarios import MANOEUVRES, Scenario
from ridetune.sim.view import photograph

from .decisions import random_matrices
from .driving_score import Manoeuvre
from .writing import MatrixWriter

Arm = Literal["served", "text", "constant", "random", "shuffled", "oracle"]
ARMS: tuple[Arm, ...] = get_args(Arm)


@dataclass(frozen=True)
class Asking:
    """How the policy is asked.

    every_s: between two questions. looks: how many of them it reads a frame for; behind these its
    last proposal is repeated, as a passenger speaks once a trip. latency_s: from a question to its
    answer, a stated constant, so that a busy machine does not change a drive; text_latency_s: the
    same where the matrix is written as text.
    """

    every_s: float
    looks: int
    latency_s: float
    text_latency_s: float


@dataclass(frozen=True)
class Trial:
    """One manoeuvre with one sentence; driven in every condition."""

    manoeuvre: Manoeuvre
    scenario: Scenario = field(repr=False)
    style: Style
    level: Level
    instruction: str
    street: int
    seed: int


@dataclass(frozen=True)
class Drive:
    """A trial in one condition: the proposals as they came, and the drive."""

    trial: Trial
    condition: Condition
    proposals: tuple[ControllerMatrix, ...]
    rollout: Rollout = field(repr=False)
    metrics: DriveMetrics = field(repr=False)


@dataclass(frozen=True)
class Car:
    """What every drive shares."""

    vehicle: Vehicle
    gate: SafetyGate
    default: ControllerMatrix
    asking: Asking

    def drive(
        self, source: MatrixSource, trial: Trial, condition: Condition
    ) -> tuple[Rollout, DriveMetrics]:
        """One drive of a trial with a source of matrices."""
        driven = drive_policy(
            source,
            trial.scenario,
            condition,
            vehicle=self.vehicle,
            gate=self.gate,
            default=self.default,
            ask_every_s=self.asking.every_s,
            seed=trial.seed,
        ).rollout
        return driven, measure(driven.trajectory)


def plan_trials(
    sentences: Mapping[tuple[Style, Level], Sequence[str]], count: int, rng: np.random.Generator
) -> list[Trial]:
    """`count` trials per manoeuvre and style, with the directness levels in turn."""
    names = get_args(Manoeuvre)
    trials = []
    for name, scenario in zip(names, MANOEUVRES, strict=True):
        assert scenario.name == name
        for number in range(count):
            level = LEVELS[number % len(LEVELS)]
            # The three styles meet the same street and the same noise.
            street, seed = (int(rng.integers(2**31)) for _ in range(2))
            for style in STYLES:
                said = sentences[style, level]
                words = said[int(rng.integers(len(said)))]
                trials.append(Trial(name, scenario, style, level, words, street, seed))
    return trials


def sentences_of(samples: Sequence[Sample]) -> dict[tuple[Style, Level], list[str]]:
    """The instructions of samples by style and level; one that stands for two styles is left out.

    Raises ValueError where a style and level has none.
    """
    styles: dict[str, set[Style]] = {}
    for sample in samples:
        styles.setdefault(sample.instruction, set()).add(sample.style)
    found = {
        (style, level): sorted(
            {
                s.instruction
                for s in samples
                if (s.style, s.level) == (style, level) and len(styles[s.instruction]) == 1
            }
        )
        for style in STYLES
        for level in LEVELS
    }
    missing = [key for key, said in found.items() if not said]
    if missing:
        raise ValueError(f"no test sentence for {missing}; build the dataset with more test scenes")
    return found


def drive_served(policy: Policy, trial: Trial, condition: Condition, car: Car) -> Drive:
    """One drive with the bundle in the loop, the six bins decided in one pass."""

    def propose(frame: bytes, kept: ControllerMatrix) -> ControllerMatrix:
        return policy.decide(frame, trial.instruction, last_safe=kept).proposal

    return _drive_asked(propose, car.asking.latency_s, trial, condition, car)


def drive_written(writer: MatrixWriter, trial: Trial, condition: Condition, car: Car) -> Drive:
    """One drive with the matrix as text; where the text holds none the car keeps its own."""

    def propose(frame: bytes, kept: ControllerMatrix) -> ControllerMatrix:
        return writer.write(frame, trial.instruction)[0] or kept

    return _drive_asked(propose, car.asking.text_latency_s, trial, condition, car)


def _drive_asked(
    propose: Callable[[bytes, ControllerMatrix], ControllerMatrix],
    latency_s: float,
    trial: Trial,
    condition: Condition,
    car: Car,
) -> Drive:
    """One drive of a model that sees what the camera would see."""
    proposals: list[ControllerMatrix] = []

    def source(moment: Moment) -> Answer:
        if len(proposals) < car.asking.looks:
            frame = photograph(moment, trial.scenario, condition, trial.street)
            proposals.append(propose(frame, moment.matrix))
        return Answer(proposals[-1], latency_s)

    rollout, metrics = car.drive(source, trial, condition)
    return Drive(trial, condition, tuple(proposals), rollout, metrics)


def drive_proposals(
    proposals: Sequence[ControllerMatrix], trial: Trial, condition: Condition, car: Car
) -> Drive:
    """One drive with proposals known beforehand: one a question, the last one repeated."""
    answers = iter(proposals[:-1])

    def source(_: Moment) -> Answer:
        return Answer(next(answers, proposals[-1]), car.asking.latency_s)

    rollout, metrics = car.drive(source, trial, condition)
    return Drive(trial, condition, tuple(proposals), rollout, metrics)


def drive_arms(
    asked: Mapping[Arm, Callable[[Trial, Condition], Drive]],
    trials: Sequence[Trial],
    car: Car,
    codec: MatrixCodec,
    rng: np.random.Generator,
) -> dict[Arm, list[Drive]]:
    """Every arm on every trial in every condition, in the same order.

    asked: how the arms drive in which a model is asked; "served" must be among them.
    """
    priors = Priors()
    everywhere = [(trial, condition) for trial in trials for condition in CONDITIONS]
    arms = {arm: [drive(*place) for place in everywhere] for arm, drive in asked.items()}
    served = arms["served"]
    other = _other_words(trials, rng)
    place = {(id(d.trial), d.condition): d for d in served}
    drawn = random_matrices(len(everywhere), codec, rng)
    proposals: dict[Arm, list[Sequence[ControllerMatrix]]] = {
        "constant": [[car.default]] * len(everywhere),
        "random": [[matrix] for matrix in drawn],
        "shuffled": [place[id(other[id(t)]), c].proposals for t, c in everywhere],
        "oracle": [
            [matrix_of_taste(WISHES[t.style] + (c != "sunny") * priors.adverse_shift, codec)]
            for t, c in everywhere
        ],
    }
    for arm, given in proposals.items():
        arms[arm] = [
            drive_proposals(p, trial, condition, car)
            for p, (trial, condition) in zip(given, everywhere, strict=True)
        ]
    return arms


def _other_words(trials: Sequence[Trial], rng: np.random.Generator) -> dict[int, Trial]:
    """For each trial some other one of its manoeuvre, each used once."""
    other = {}
    for name in get_args(Manoeuvre):
        there = [trial for trial in trials if trial.manoeuvre == name]
        order = rng.permutation(len(there))
        for to, source in zip(order, np.roll(order, 1), strict=True):
            other[id(there[to])] = there[source]
    return other
