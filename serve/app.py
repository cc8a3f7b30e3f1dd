"""The HTTP side: questions in, decisions out, the last safe matrix whenever there is none.

    POST /v1/decide    multipart: frame, instruction, [memories], [session]
    GET  /healthz      the process is alive
    GET  /readyz       200 once the model has answered a frame, else 503

Each session keeps the matrix that its car runs; the gate limits the step from there. Requests
wait their turn for at most half of the deadline, so that the model always has the other half.
"""

import asyncio
import logging
import time
import uuid
from collections import OrderedDict
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException

from ridetune.matrix import ControllerMatrix
from ridetune.prompt import InstructionError, clean_instruction

from .inference import Job
from .wire import (
    DecisionOut,
    ErrorOut,
    FallbackOut,
    Health,
    Question,
    Readiness,
    RequestError,
    VerdictOut,
    finite,
    read_question,
    rows,
)
from .worker import InferenceWorker, InputRejectedError, Reply, WorkerUnavailableError

_log = logging.getLogger(__name__)

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]


@dataclass(frozen=True)
class ServeConfig:
    """How to serve. deadline_s: until the matrix; explanation_s: from there to the explanation.

    port 0 takes a free one. queue: requests at once, the next one is sent away. vehicle, envelope:
    what the gate verifies proposals with.
    """

    bundle: Path
    host: str
    port: Annotated[int, Field(ge=0, le=65535)]
    threads: Count
    deadline_s: Positive
    explanation_s: Positive
    max_sessions: Count
    queue: Count
    vehicle: Path = Path("configs/vehicle.yaml")
    envelope: Path = Path("configs/verified.yaml")


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


class NoDecisionError(Exception):
    """The model gave no answer; the car stays on the session's last safe matrix."""

    def __init__(self, sentence: str, session: str) -> None:
        super().__init__(sentence)
        self.session = session


class Desk:
    """Takes questions one at a time to the worker; lives on the event loop."""

    def __init__(self, worker: InferenceWorker, config: ServeConfig) -> None:
        self.worker = worker
        self.default = worker.contract.ranges.default
        self.sessions = Sessions(self.default, config.max_sessions)
        self._codec = worker.contract.codec
        self._config = config
        self._open = 0
        self._turn = asyncio.Lock()

    @contextmanager
    def place(self) -> Iterator[None]:
        """A place in the queue; RequestError 429 if there is none."""
        if self._open >= self._config.queue:
            raise RequestError(
                429, f"{self._open} requests are waiting already, that is the limit; try again"
            )
        self._open += 1
        try:
            yield
        finally:
            self._open -= 1

    async def decide(self, question: Question) -> DecisionOut:
        """Answer a question; NoDecisionError when the model gives no answer in time."""
        arrived_s = time.monotonic()
        self._check(question)
        session = question.session or uuid.uuid4().hex
        try:
            async with asyncio.timeout(self._config.deadline_s / 2):
                await self._turn.acquire()
        except TimeoutError as error:
            raise NoDecisionError("the server is busy with other requests", session) from error
        try:
            reply = await self._ask(question, session, arrived_s)
        finally:
            self._turn.release()
        return self._answer(reply, session)

    async def _ask(self, question: Question, session: str, arrived_s: float) -> Reply:
        job = Job(
            question.frame,
            question.instruction,
            question.memories,
            self.sessions.last_safe(session),
            question.condition,
            arrived_s,
        )
        until_s = arrived_s + self._config.deadline_s
        try:
            reply = await asyncio.to_thread(self.worker.decide, job, until_s=until_s)
        except WorkerUnavailableError as error:
            raise NoDecisionError(str(error), session) from error
        self.sessions.keep(session, reply.decided.verdict.matrix)
        return reply

    def _check(self, question: Question) -> None:
        """What can be told without the model: words, and memories within the envelope."""
        clean_instruction(question.instruction)
        for number, memory in enumerate(question.memories):
            try:
                self._codec.encode(memory.matrix)
            except ValueError as error:
                raise RequestError(422, f"memories.{number}.matrix: {error}") from error

    def _answer(self, reply: Reply, session: str) -> DecisionOut:
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
            confidence=finite(list(decided.confidence)),
            scene=said.scene if said else None,
            explanation=said.explanation if said else None,
            timings_ms={stage: round(ms, 3) for stage, ms in timings.items()},
            frame_age_ms=round(decided.frame_age_ms, 3),
            session=session,
            bundle=self.worker.bundle_id,
        )


def create_app(worker: InferenceWorker, config: ServeConfig) -> FastAPI:
    """The application on a started worker; it stops the worker when it shuts down."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        yield
        worker.stop()

    # No /docs page: it would load scripts from outside the car.
    app = FastAPI(title="ridetune", lifespan=lifespan, docs_url=None, redoc_url=None)
    desk = Desk(worker, config)

    @app.post("/v1/decide", responses={503: {"model": FallbackOut}, 422: {"model": ErrorOut}})
    async def decide(request: Request) -> DecisionOut:
        with desk.place():
            return await desk.decide(await read_question(request))

    @app.get("/healthz")
    async def healthz() -> Health:
        return Health()

    @app.get("/readyz", responses={503: {"model": Readiness}})
    async def readyz() -> JSONResponse:
        ready = worker.ready
        reason = None if ready else worker.reason
        body = Readiness(ready=ready, reason=reason, bundle=worker.bundle_id)
        return _json(200 if ready else 503, body)

    _answer_errors(app, desk)
    return app


def _answer_errors(app: FastAPI, desk: Desk) -> None:
    """Every error is one sentence under the key `error`."""

    @app.exception_handler(RequestError)
    async def refuse(_: Request, error: RequestError) -> JSONResponse:
        return _json(error.status, ErrorOut(error=str(error)))

    @app.exception_handler(InputRejectedError)
    @app.exception_handler(InstructionError)
    async def reject(_: Request, error: ValueError) -> JSONResponse:
        return _json(422, ErrorOut(error=str(error)))

    @app.exception_handler(NoDecisionError)
    async def fall_back(_: Request, error: NoDecisionError) -> JSONResponse:
        _log.warning("event=no_decision reason=%r", str(error))
        body = FallbackOut(
            error=f"no decision: {error}; the last safe matrix stays",
            matrix=rows(desk.sessions.last_safe(error.session)),
            default=rows(desk.default),
            session=error.session,
        )
        return _json(503, body)

    @app.exception_handler(HTTPException)
    async def other(_: Request, error: HTTPException) -> JSONResponse:
        return _json(error.status_code, ErrorOut(error=str(error.detail)))

    @app.exception_handler(Exception)
    async def fail(_: Request, __: Exception) -> JSONResponse:
        return _json(500, ErrorOut(error="an internal fault; the server's log says more"))


def _json(status: int, body: BaseModel) -> JSONResponse:
    return JSONResponse(body.model_dump(), status)
