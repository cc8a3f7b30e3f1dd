"""The HTTP side of the review; every error is one sentence under the key `error`.

GET  /                        the page
GET  /api/sliders             the vehicle's six sliders
GET  /api/next                ?annotator=ann[&skipped=true]: the next pair
GET  /api/frame/<id>          its frame
POST /api/preview             a matrix -> what the car would do
POST /api/reviews, /api/undo  an answer, or taking back the last; the reply is the next pair
GET  /api/agreement           kappa and ICC of first and second opinions
"""

import logging
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Annotated

from fastapi import FastAPI, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.middleware.trustedhost import TrustedHostMiddleware

from ridetune.stage import explain_os_error

from .desk import Desk, RefusalError
from .wire import (
    AgreementOut,
    Annotator,
    ErrorOut,
    NextOut,
    PreviewIn,
    PreviewOut,
    ReviewIn,
    SlidersOut,
    UndoIn,
)

LOOPBACK = "127.0.0.1"
_PAGE = Path(__file__).parent / "page"
_FILES = {path.name: path for path in sorted(_PAGE.iterdir()) if path.is_file()}
# Nothing from elsewhere, and no script within the page.
_POLICY = "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'"

log = logging.getLogger(__name__)


def create_app(desk: Desk) -> FastAPI:
    """The application on an open desk."""
    app = FastAPI(title="ridetune review", docs_url=None, redoc_url=None, openapi_url=None)
    # A page of another site that has its name resolve to this machine is no page of ours.
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=[LOOPBACK, "localhost"])
    _serve_page(app)
    _answer_errors(app)

    @app.get("/api/sliders")
    def sliders() -> SlidersOut:
        return desk.sliders

    @app.get("/api/next")
    def next_pair(annotator: Annotated[Annotator, Query()], skipped: bool = False) -> NextOut:
        return desk.next_for(annotator, skipped=skipped)

    @app.get("/api/frame/{proposal_id}")
    def frame(proposal_id: str) -> Response:
        content = desk.frame(proposal_id)
        kind = "image/png" if content.startswith(b"\x89PNG") else "image/jpeg"
        return Response(content, media_type=kind, headers={"Cache-Control": "max-age=3600"})

    @app.post("/api/preview")
    def preview(asked: PreviewIn) -> PreviewOut:
        return desk.preview(asked)

    @app.post("/api/reviews")
    def review(said: ReviewIn) -> NextOut:
        return desk.review(said)

    @app.post("/api/undo")
    def undo(asked: UndoIn) -> NextOut:
        return desk.undo(asked)

    @app.get("/api/agreement")
    def agreement() -> AgreementOut:
        return desk.agreement()

    return app


def _serve_page(app: FastAPI) -> None:
    @app.middleware("http")
    async def guard(request: Request, go_on: Callable[[Request], Awaitable[Response]]) -> Response:
        response = await go_on(request)
        response.headers["Content-Security-Policy"] = _POLICY
        response.headers["X-Content-Type-Options"] = "nosniff"
        return response

    @app.get("/")
    def page() -> FileResponse:
        return FileResponse(_FILES["index.html"], headers={"Cache-Control": "no-cache"})

    @app.get("/page/{name}")
    def part(name: str) -> FileResponse:
        if name not in _FILES:
            raise HTTPException(404, f"the page has no part {name!r}")
        return FileResponse(_FILES[name], headers={"Cache-Control": "no-cache"})


def _answer_errors(app: FastAPI) -> None:
    @app.exception_handler(RefusalError)
    async def refuse(_: Request, error: RefusalError) -> JSONResponse:
        return _error(error.status, str(error))

    @app.exception_handler(RequestValidationError)
    async def invalid(_: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"][1:])
        said = first["msg"].removeprefix("Value error, ")
        return _error(422, f"{where}: {said}" if where else said)

    @app.exception_handler(OSError)
    async def unwritten(_: Request, error: OSError) -> JSONResponse:
        log.error("event=not_kept reason=%s", error)
        return _error(507, f"your answer was not kept: {explain_os_error(error)}")

    @app.exception_handler(HTTPException)
    async def other(_: Request, error: HTTPException) -> JSONResponse:
        return _error(error.status_code, str(error.detail))

    @app.exception_handler(ValueError)
    async def broken(_: Request, error: ValueError) -> JSONResponse:
        log.error("event=broken reason=%s", error)
        return _error(500, str(error))


def _error(status: int, sentence: str) -> JSONResponse:
    return JSONResponse(ErrorOut(error=sentence).model_dump(), status)
