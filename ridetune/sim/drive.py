"""A drive with a policy in the loop: a source is asked for matrices and may fail in every way.

Every `ask_every_s` the source sees the moment and answers with a proposal and how long it took,
or not at all. A proposal passes the safety gate; until then, and whenever it is refused, late or
missing, the car keeps its last safe matrix. If no proposal has passed for `patience_s`, the car
slows down and stops in its lane; it drives on when one passes again. Nothing that a source
returns or raises ends the drive.
"""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ridetune.control.kernel import Numbers
from ridetune.control.tracker import PERIOD_S
from ridetune.control.vehicle import Vehicle
from ridetune.gate import Outcome, SafetyGate
from ridetune.matrix import ControllerMatrix
from ridetune.sample import Condition
from ridetune.sim.conditions import EFFECTS
from ridetune.sim.loop import DRIVING, Ego, Memory, begin, drive, new_gains, swap
from ridetune.sim.plant import HEADING, NOMINAL, SPEED, Plant, Spread, X, Y
from ridetune.sim.road import AT_X, AT_Y, PRESENT, Road, clock_step, lay_out, num_steps
from ridetune.sim.rollout import Rollout, draw_noise, status_of
from ridetune.sim.scenarios import Scenario
from ridetune.sim.trajectory import SIGNALS, Trajectory

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Moment:
    """What there is to see when the source is asked; poses as in Trajectory.

    actors: for each actor of the scenario its middle (x, y) [m], None where it is gone.
    """

    time_s: float
    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    actors: tuple[tuple[float, float] | None, ...]
    matrix: ControllerMatrix


@dataclass(frozen=True)
class Answer:
    """A proposal, of any form, and how long after the question it arrives [s]."""

    proposal: object
    latency_s: float = 0.0


# None: this question is never answered.
MatrixSource = Callable[[Moment], Answer | None]


@dataclass(frozen=True)
class Change:
    """When an answer arrived, what the gate said and what the car drives with since."""

    time_s: float
    outcome: Outcome
    matrix: ControllerMatrix


@dataclass(frozen=True)
class PolicyDrive:
    """A run and its answers; stopping_s: how long the car was slowing down for want of them."""

    rollout: Rollout
    changes: tuple[Change, ...]
    questions: int
    stopping_s: float


def drive_policy(
    source: MatrixSource,
    scenario: Scenario,
    condition: Condition = "sunny",
    *,
    vehicle: Vehicle,
    gate: SafetyGate,
    default: ControllerMatrix,
    ask_every_s: float = 1.0,
    patience_s: float = 3.0,
    spread: Spread = NOMINAL,
    seed: int = 0,
) -> PolicyDrive:
    """Drive a scenario with the matrices of a source, starting from the default.

    One question is open at a time; an answer that takes longer than `patience_s` is dropped, for
    the scene that it was about is gone. The gate is told the condition, as by a car's own sensors.
    The same answers give the same drive, bit by bit.
    """
    car = _Car(scenario, condition, vehicle, default, spread, seed)
    every, patience = _steps(ask_every_s), _steps(patience_s)
    pending: Answer | None = None
    due, heard, questions, stopping = 0, 0, 0, 0
    changes = []
    while car.outcome == DRIVING and car.step < car.num_steps:
        now = car.step
        if pending is None and now % every == 0:
            questions += 1
            pending = _ask(source, car.moment(), patience_s)
            due = now + (math.ceil(pending.latency_s / PERIOD_S) if pending else 0)
        if pending is not None and due <= now:
            verdict = gate.judge(pending.proposal, car.matrix, condition)
            changes.append(Change(now * PERIOD_S, verdict.outcome, verdict.matrix))
            if verdict.outcome != "refused":
                heard = now
                car.swap(verdict.matrix)
            pending = None
        stop = now - heard >= patience
        until = [car.num_steps, (now // every + 1) * every]
        until += [heard + patience] * (not stop) + [due] * (pending is not None)
        car.drive(min(until), stopping=stop)
        stopping += (car.step - now) * stop
    return PolicyDrive(car.rollout(), tuple(changes), questions, stopping * PERIOD_S)


class _Car:
    """A run in the compiled loop, driven in stretches."""

    def __init__(
        self,
        scenario: Scenario,
        condition: Condition,
        vehicle: Vehicle,
        matrix: ControllerMatrix,
        spread: Spread,
        seed: int,
    ) -> None:
        self.num_steps = num_steps(scenario, PERIOD_S)
        self.step = 0
        self.outcome = DRIVING
        self.matrix = matrix
        self._ego = Ego.of(vehicle, PERIOD_S)
        self._road: Road = lay_out(scenario, condition, vehicle, PERIOD_S)
        self._plant = Plant.of(vehicle, spread, EFFECTS[condition].friction, PERIOD_S)
        self._noise = draw_noise(seed, self.num_steps)
        self._signals: Numbers = np.full((self.num_steps, len(SIGNALS)), np.nan)
        self._memory: Memory = begin(self._road, self.num_steps, *new_gains())

    def swap(self, matrix: ControllerMatrix) -> None:
        if matrix != self.matrix:
            swap(self._memory, self.matrix.ki, matrix.ki)
            self.matrix = matrix

    def drive(self, until: int, *, stopping: bool) -> None:
        self.outcome = drive(
            self.step,
            until,
            np.array(self.matrix.values),
            stopping,
            self._ego,
            self._plant,
            self._road,
            self._noise,
            self._memory,
            self._signals,
        )
        self.step = until

    def moment(self) -> Moment:
        state, road, clocks = self._memory.state, self._road, self._memory.clocks
        rows = [road.positions[a, clock_step(road, clock)] for a, clock in enumerate(clocks)]
        actors = tuple((float(r[AT_X]), float(r[AT_Y])) if r[PRESENT] else None for r in rows)
        x, y, heading, speed = (float(state[i]) for i in (X, Y, HEADING, SPEED))
        return Moment(self.step * PERIOD_S, x, y, heading, speed, actors, self.matrix)

    def rollout(self) -> Rollout:
        status = status_of(self.outcome, self._signals)
        return Rollout(Trajectory(PERIOD_S, self._signals), status)


def _ask(source: MatrixSource, moment: Moment, patience_s: float) -> Answer | None:
    """The answer of a source that may be foreign code, or None if none comes in time."""
    try:
        answer = source(moment)
    # A policy may fail in any way; for the car that is one more answer that never came.
    except Exception as error:  # noqa: BLE001
        log.warning("policy=failed time_s=%.2f error=%r", moment.time_s, error)
        return None
    # Written so that a latency of NaN counts as never.
    return answer if answer is not None and 0.0 <= answer.latency_s <= patience_s else None


def _steps(seconds: float) -> int:
    return max(round(seconds / PERIOD_S), 1)
