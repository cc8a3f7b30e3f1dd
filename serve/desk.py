"""Takes questions to the model one at a time: recall, decide, record, answer.

Each session keeps the matrix that its car runs; the gate limits the step from there. Requests
wait their turn for at most half of the deadline, so that the model always has the other half. A
matrix counts, and is given out, once its decision is recorded.
"""

import asyncio
import hashlib
import logging
import time
import uuid
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime

from ridetune.matrix import ControllerMatrix
from ridetune.prompt import MAX_INSTRUCTION_CHARACTERS, clean_instruction
from ridetune.sample import Memory

from .audit.events import Asked, DecisionEvent
from .inference import Decided, Job
from .journal import Journal, UnrecordedError
from .recollection import Held, Recalled, Recollection
from .wire import DecisionOut, Question, RequestError, VerdictOut, finite, rows
from .worker import InferenceWorker, Reply, WorkerUnavailableError

_log = logging.getLogger(__name__)


class Sessions:
    """The last safe matrix of each session; the one unused for longest is dropped for a new one."""

    def __init__(self, default: ControllerMatrix, limit: int) -> None:
        self._default = default
        self._limit = limit
        self._matrices: OrderedDict[str, ControllerMatrix] = OrderedDict()

    def last_safe(self, session: str) -> ControllerMatrix:
        """What the session's car runs; the default at its start."""
        return self._matrices.get(session, self._default)

    def keep(self, session: str, matrix: ControllerMatrix) -> None:
        """Remember what the gate let through."""
        self._matrices[session] = matrix
        self._matrices.move_to_end(session)
        if len(self._matrices) > self._limit:
            self._matrices.popitem(last=False)


@dataclass(frozen=True)
class _Turn:
    """A question on its way; arrived_s is monotonic [s], asked is what the audit log may know."""

    question: Question
    session: str
    recalled: Recalled
    asked: Asked
    arrived_s: float


class NoDecisionError(Exception):
    """There is no new matrix; the car stays on the session's last safe one."""

    def __init__(self, sentence: str, session: str, asked: Asked) -> None:
        super().__init__(sentence)
        self.session = session
        self.asked = asked


class Desk:
    """Takes questions one at a time to the worker; lives on the event loop."""

    def __init__(
        self,
        worker: InferenceWorker,
        recollection: Recollection,
        journal: Journal,
        *,
        deadline_s: float,
        max_sessions: int,
        queue: int,
    ) -> None:
        self.worker = worker
        self.default = worker.contract.ranges.default
        self.sessions = Sessions(self.default, max_sessions)
        self._recollection = recollection
        self._journal = journal
        self._codec = worker.contract.codec
        self._deadline_s = deadline_s
        self._queue = queue
        self._open = 0
        self._turn = asyncio.Lock()

    @contextmanager
    def place(self) -> Iterator[None]:
        """A place in the queue; RequestError 429 if there is none."""
        if self._open >= self._queue:
            raise RequestError(
                429, f"{self._open} requests are waiting already, that is the limit; try again"
            )
        self._open += 1
        try:
            yield
        finally:
            self._open -= 1

    async def decide(self, question: Question) -> DecisionOut:
        """Answer a question; NoDecisionError where no decision is made and recorded in time."""
        arrived_s, requested = time.monotonic(), datetime.now(UTC)
        self._check(question)
        session = question.session or uuid.uuid4().hex
        recalled = await self._recollection.recall(
            question.passenger, within_s=self._deadline_s / 4
        )
        asked = Asked(
            requested=requested,
            session=None if recalled.private else session,
            frame_sha256=await asyncio.to_thread(_sha256, question.frame),
            instruction=None if recalled.private else question.instruction,
            condition=question.condition,
        )
        turn = _Turn(question, session, recalled, asked, arrived_s)
        try:
            async with asyncio.timeout(arrived_s + self._deadline_s / 2 - time.monotonic()):
                await self._turn.acquire()
        except TimeoutError as error:
            sentence = "the server is busy with other requests"
            raise NoDecisionError(sentence, session, asked) from error
        try:
            reply = await self._ask(turn)
        except (WorkerUnavailableError, UnrecordedError) as error:
            raise NoDecisionError(str(error), session, asked) from error
        finally:
            self._turn.release()
        return self._answer(reply, turn)

    async def _ask(self, turn: _Turn) -> Reply:
        question = turn.question
        last_safe = self.sessions.last_safe(turn.session)
        job = Job(
            question.frame,
            question.instruction,
            question.memories or tuple(entry.memory for entry in turn.recalled.entries),
            last_safe,
            question.condition,
            turn.arrived_s,
        )
        until_s = turn.arrived_s + self._deadline_s
        reply = await asyncio.to_thread(self.worker.decide, job, until_s=until_s)
        await self._journal.write(
            _event(turn.asked, reply.decided, last_safe, self.worker.bundle_id)
        )
        self.sessions.keep(turn.session, reply.decided.verdict.matrix)
        return reply

    def _check(self, question: Question) -> None:
        """What can be told without the model: words, and memories within the envelope."""
        clean_instruction(question.instruction)
        for number, memory in enumerate(question.memories):
            try:
                self._codec.encode(memory.matrix)
            except ValueError as error:
                raise RequestError(422, f"memories.{number}.matrix: {error}") from error

    def _answer(self, reply: Reply, turn: _Turn) -> DecisionOut:
        decided, said = reply.decided, reply.explanation
        timings = {**decided.timings_ms, **({"explain": said.ms} if said else {})}
        _log.info(
            "event=decide outcome=%s total_ms=%.1f frame_age_ms=%.1f",
            decided.verdict.outcome,
            timings["total"],
            decided.frame_age_ms,
        )
        return DecisionOut(
            matrix=rows(decided.verdict.matrix),
            default=rows(self.default),
            proposal=rows(decided.proposal),
            verdict=VerdictOut(
                outcome=decided.verdict.outcome, reasons=list(decided.verdict.reasons)
            ),
            confidence=finite(decided.confidence),
            scene=said.scene if said else None,
            explanation=said.explanation if said else None,
            timings_ms={stage: round(ms, 3) for stage, ms in timings.items()},
            frame_age_ms=round(decided.frame_age_ms, 3),
            session=turn.session,
            bundle=self.worker.bundle_id,
            decision=self._hold(reply, turn),
            recalled=[entry.number for entry in turn.recalled.entries],
        )

    def _hold(self, reply: Reply, turn: _Turn) -> str:
        """Keep the drive for its feedback, under a name that cannot be guessed."""
        decision, said, question = uuid.uuid4().hex, reply.explanation, turn.question
        scene = said.scene[:MAX_INSTRUCTION_CHARACTERS] if said else ""
        drive = Memory(question.instruction, scene, reply.decided.verdict.matrix, feedback="")
        kept = None if turn.recalled.private else drive
        self._recollection.hold(
            decision, Held(question.passenger, kept, question.condition, turn.session)
        )
        return decision


def _event(
    asked: Asked, decided: Decided, last_safe: ControllerMatrix, bundle: str
) -> DecisionEvent:
    return DecisionEvent(
        **vars(asked),
        bundle=bundle,
        last_safe=last_safe.values,
        proposal=tuple(finite(decided.proposal.values)),
        confidence=tuple(finite(decided.confidence)),
        outcome=decided.verdict.outcome,
        reasons=decided.verdict.reasons,
        matrix=decided.verdict.matrix.values,
        applied=True,
        timings_ms=decided.timings_ms,
        frame_age_ms=decided.frame_age_ms,
    )


def _sha256(frame: bytes) -> str:
    return hashlib.sha256(frame).hexdigest()
