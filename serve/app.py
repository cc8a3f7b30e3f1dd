"""The HTTP side: questions in, decisions out, the last safe matrix whenever there is none.

    POST /v1/decide    multipart: frame, instruction, [passenger | memories], [session], [condition]
    GET  /healthz      the process is alive
    GET  /readyz       200 while decisions are possible, else 503 with the reason

The routes of feedback and passengers are in passengers.py. Every decision, fallback and refusal is
in the audit log before its answer goes out, every start and stop too; what is older than the
retention goes at the start and each hour.
"""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from http import HTTPStatus
from pathlib import Path
from typing import Annotated

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException

from ridetune.memory import RETENTION_DAYS, PassengerMemory
from ridetune.prompt import InstructionError

from .audit.events import FallbackEvent, RefusalEvent, StartEvent, StopEvent
from .audit.log import AuditLog
from .desk import Desk, NoDecisionError
from .journal import Journal
from .passengers import passenger_routes
from .question import read_question
from .recollection import Recollection
from .wire import DecisionOut, ErrorOut, FallbackOut, Health, Readiness, RequestError, rows
from .worker import InferenceWorker, InputRejectedError

_log = logging.getLogger(__name__)
_HOUR_S = 3600.0

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]


@dataclass(frozen=True)
class ServeConfig:
    """How to serve. deadline_s: until the matrix; explanation_s: from there to the explanation.

    port 0 takes a free one. queue: requests at once, the next one is sent away. vehicle, envelope:
    what the gate verifies proposals with. memory, audit: the folders of the passengers' memory and
    of the audit log, None for none; audit_words: whether the log keeps the passengers' words.
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
    memory: Path | None = None
    retention_days: Annotated[float, Field(gt=0, le=36_500)] = RETENTION_DAYS
    audit: Path | None = None
    audit_words: bool = False


def create_app(
    worker: InferenceWorker,
    config: ServeConfig,
    *,
    memory: PassengerMemory | None = None,
    log: AuditLog | None = None,
) -> FastAPI:
    """The application on a started worker; it stops the worker when it shuts down.

    memory, log: of the folders that the config names; whoever opened them closes them.
    """
    journal = Journal(log)
    recollection = Recollection(memory, worker.contract.codec, worker.bundle_id)
    desk = Desk(
        worker,
        recollection,
        journal,
        deadline_s=config.deadline_s,
        max_sessions=config.max_sessions,
        queue=config.queue,
    )

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await journal.note(StartEvent(bundle=worker.bundle_id))
        retiring = asyncio.create_task(
            _retire(recollection, journal, timedelta(days=config.retention_days))
        )
        yield
        retiring.cancel()
        with suppress(asyncio.CancelledError):
            await retiring
        worker.stop()
        await journal.note(StopEvent(reason="the server was told to stop"))

    # No /docs page: it would load scripts from outside the car.
    app = FastAPI(title="ridetune", lifespan=lifespan, docs_url=None, redoc_url=None)
    app.include_router(passenger_routes(recollection))

    @app.post("/v1/decide", responses={503: {"model": FallbackOut}, 422: {"model": ErrorOut}})
    async def decide(request: Request) -> DecisionOut:
        with desk.place():
            return await desk.decide(await read_question(request))

    @app.get("/healthz")
    async def healthz() -> Health:
        return Health()

    @app.get("/readyz", responses={503: {"model": Readiness}})
    async def readyz() -> JSONResponse:
        reason = journal.fault if worker.ready else worker.reason
        body = Readiness(ready=reason is None, reason=reason, bundle=worker.bundle_id)
        return _json(200 if body.ready else 503, body)

    _answer_errors(app, desk, journal)
    return app


async def _retire(recollection: Recollection, journal: Journal, retention: timedelta) -> None:
    """Remove what is too old, now and every hour."""
    while True:
        await recollection.retire()
        await journal.prune(datetime.now(UTC) - retention)
        await asyncio.sleep(_HOUR_S)


def _answer_errors(app: FastAPI, desk: Desk, journal: Journal) -> None:
    """Every error is one sentence under the key `error`, and in the audit log."""

    async def send_away(
        request: Request, status: int, sentence: str, *, quotes: bool = False
    ) -> JSONResponse:
        # Not the path itself: it may name a passenger, or be anything at all.
        route = getattr(request.scope.get("route"), "path", "none of this server")
        reason = HTTPStatus(status).phrase if quotes else sentence
        await journal.note(RefusalEvent(session=None, route=route, status=status, reason=reason))
        return _json(status, ErrorOut(error=sentence))

    @app.exception_handler(RequestError)
    async def refuse(request: Request, error: RequestError) -> JSONResponse:
        return await send_away(request, error.status, str(error), quotes=error.quotes)

    @app.exception_handler(InputRejectedError)
    @app.exception_handler(InstructionError)
    async def reject(request: Request, error: ValueError) -> JSONResponse:
        return await send_away(request, 422, str(error))

    @app.exception_handler(NoDecisionError)
    async def fall_back(_: Request, error: NoDecisionError) -> JSONResponse:
        _log.warning("event=no_decision reason=%r", str(error))
        matrix = desk.sessions.last_safe(error.session)
        event = FallbackEvent(
            **vars(error.asked),
            bundle=desk.worker.bundle_id,
            reason=str(error),
            matrix=matrix.values,
            expired=False,
        )
        await journal.note(event)
        body = FallbackOut(
            error=f"no decision: {error}; the last safe matrix stays",
            matrix=rows(matrix),
            default=rows(desk.default),
            session=error.session,
        )
        return _json(503, body)

    @app.exception_handler(HTTPException)
    async def other(request: Request, error: HTTPException) -> JSONResponse:
        return await send_away(request, error.status_code, str(error.detail))

    @app.exception_handler(Exception)
    async def fail(request: Request, _: Exception) -> JSONResponse:
        return await send_away(request, 500, "an internal fault; the server's log says more")


def _json(status: int, body: BaseModel) -> JSONResponse:
    return JSONResponse(body.model_dump(), status)
