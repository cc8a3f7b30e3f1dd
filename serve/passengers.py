"""The routes of the passengers: how a drive felt, what is kept of it, and its erasure.

POST   /v1/feedback                  JSON: decision, passenger, feedback
GET    /v1/passengers/{id}           everything that is kept: review and export
DELETE /v1/passengers/{id}           erases it without a trace
PUT    /v1/passengers/{id}/privacy   JSON: on; while it is on, nothing is written
"""

import asyncio
from typing import Any, TypeVar

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, ValidationError
from starlette.requests import ClientDisconnect

from .question import BODY_S, arriving
from .recollection import Recollection
from .wire import (
    ErasedOut,
    ErrorOut,
    FeedbackIn,
    FeedbackOut,
    PassengerOut,
    PrivacyIn,
    PrivacyOut,
    RequestError,
    check_name,
    first_fault,
)

MAX_JSON_BYTES = 16 * 1024
_TOO_LARGE = f"the request is too large, the limit is {MAX_JSON_BYTES} bytes; send less"
_ERRORS: dict[int | str, dict[str, Any]] = {
    status: {"model": ErrorOut} for status in (404, 408, 413, 415, 422, 503)
}
Message = TypeVar("Message", bound=BaseModel)


def passenger_routes(recollection: Recollection) -> APIRouter:
    """The routes on a server's recollection."""
    router = APIRouter(prefix="/v1", responses=_ERRORS)

    @router.post("/feedback", openapi_extra=_takes(FeedbackIn))
    async def feedback(request: Request) -> FeedbackOut:
        number = await recollection.remember(await _read(request, FeedbackIn))
        return FeedbackOut(remembered=number is not None, number=number)

    @router.get("/passengers/{passenger}", responses={200: {"model": PassengerOut}})
    async def review(passenger: str) -> Response:
        found = await recollection.profile(check_name("passenger", passenger))
        return Response(found, media_type="application/json")

    @router.delete("/passengers/{passenger}")
    async def erase(passenger: str) -> ErasedOut:
        return ErasedOut(erased=await recollection.erase(check_name("passenger", passenger)))

    @router.put("/passengers/{passenger}/privacy", openapi_extra=_takes(PrivacyIn))
    async def set_privacy(passenger: str, request: Request) -> PrivacyOut:
        name, privacy = check_name("passenger", passenger), await _read(request, PrivacyIn)
        await recollection.set_privacy(name, privacy.on)
        return PrivacyOut(private=privacy.on)

    return router


def _takes(kind: type[BaseModel]) -> dict[str, Any]:
    content = {"application/json": {"schema": kind.model_json_schema()}}
    return {"requestBody": {"required": True, "content": content}}


async def _read(request: Request, kind: type[Message]) -> Message:
    """A bounded JSON body; RequestError if it cannot be used."""
    # A page of another origin may send a form or plain text here without asking, but no JSON.
    if not request.headers.get("content-type", "").lower().startswith("application/json"):
        raise RequestError(415, "send the request as application/json")
    try:
        async with asyncio.timeout(BODY_S):
            chunks = [chunk async for chunk in arriving(request, MAX_JSON_BYTES, _TOO_LARGE)]
        return kind.model_validate_json(b"".join(chunks))
    except TimeoutError as error:
        raise RequestError(408, f"the request took longer than {BODY_S:.0f} s to arrive") from error
    except ClientDisconnect as error:
        raise RequestError(400, "the request ended before it was complete") from error
    except ValidationError as error:
        raise RequestError(422, first_fault(error), quotes=True) from error
