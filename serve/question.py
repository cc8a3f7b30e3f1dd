"""A multipart question, read and checked: sizes while the body arrives, then every field.

Unknown fields are errors. What is wrong is said in one sentence.
"""

import asyncio
from collections.abc import AsyncGenerator

from fastapi import Request
from pydantic import TypeAdapter, ValidationError
from starlette.datastructures import FormData, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import ClientDisconnect

from ridetune.sample import CONDITIONS, Condition, Memory
from ridetune.vision import MAX_BYTES

from .wire import MEMORIES, Question, RequestError, check_name, first_fault

BODY_S = 10.0
MAX_BODY_BYTES = MAX_BYTES + 256 * 1024
MAX_FIELD_BYTES = 64 * 1024
_FIELDS = ("frame", "instruction", "memories", "passenger", "session", "condition")
_TOO_LARGE = f"the request is too large, a frame may have {MAX_BYTES} bytes; send a smaller frame"
_CONDITION: TypeAdapter[Condition] = TypeAdapter(Condition)


async def read_question(request: Request) -> Question:
    """Read and check a multipart request; RequestError if it cannot be used."""
    form = await _read_form(request)
    try:
        for name in form:
            if name not in _FIELDS:
                sentence = f"unknown field {name[:40]!r}; the fields are {', '.join(_FIELDS)}"
                raise RequestError(422, sentence, quotes=True)
        passenger, memories = _text(form, "passenger"), _text(form, "memories")
        if passenger and memories:
            raise RequestError(
                422, "send a passenger, whose drives are remembered here, or memories; not both"
            )
        session = _text(form, "session")
        return Question(
            frame=await _frame(form),
            instruction=_text(form, "instruction", required=True),
            memories=_memories(memories),
            passenger=passenger and check_name("passenger", passenger),
            session=session and check_name("session", session),
            condition=_condition(_text(form, "condition")),
        )
    finally:
        await form.close()


async def _read_form(request: Request) -> FormData:
    if not request.headers.get("content-type", "").lower().startswith("multipart/form-data"):
        raise RequestError(415, "send the frame and the instruction as multipart/form-data")
    announced = request.headers.get("content-length", "0")
    if announced.isdecimal() and int(announced) > MAX_BODY_BYTES:
        raise RequestError(413, _TOO_LARGE)
    parser = MultiPartParser(
        request.headers,
        arriving(request, MAX_BODY_BYTES, _TOO_LARGE),
        max_files=1,
        max_fields=8,
        max_part_size=MAX_FIELD_BYTES,
    )
    try:
        async with asyncio.timeout(BODY_S):
            return await parser.parse()
    except TimeoutError as error:
        raise RequestError(408, f"the request took longer than {BODY_S:.0f} s to arrive") from error
    except ClientDisconnect as error:
        raise RequestError(400, "the request ended before it was complete") from error
    except (MultiPartException, KeyError, UnicodeError, LookupError) as error:
        detail = getattr(error, "message", "the form cannot be parsed")
        sentence = f"the multipart form is damaged: {detail}"
        raise RequestError(422, sentence, quotes=True) from error


async def arriving(request: Request, max_bytes: int, too_large: str) -> AsyncGenerator[bytes, None]:
    """The body in chunks; RequestError 413 with the sentence `too_large` beyond the limit."""
    size = 0
    async for chunk in request.stream():
        size += len(chunk)
        if size > max_bytes:
            raise RequestError(413, too_large)
        yield chunk


async def _frame(form: FormData) -> bytes:
    found = form.getlist("frame")
    if len(found) != 1 or not isinstance(found[0], UploadFile):
        raise RequestError(
            422, "the field 'frame' must hold one file, a JPEG or PNG camera frame; send it"
        )
    frame = await found[0].read()
    if len(frame) > MAX_BYTES:
        raise RequestError(413, _TOO_LARGE)
    return frame


def _text(form: FormData, name: str, *, required: bool = False) -> str:
    found = form.getlist(name)
    if not found and not required:
        return ""
    if len(found) != 1 or not isinstance(found[0], str):
        raise RequestError(422, f"the field {name!r} must be sent once, as text")
    return found[0]


def _memories(text: str) -> tuple[Memory, ...]:
    try:
        return tuple(m.memory() for m in MEMORIES.validate_json(text or "[]"))
    except ValidationError as error:
        raise RequestError(422, first_fault(error, "memories"), quotes=True) from error


def _condition(text: str) -> Condition | None:
    if not text:
        return None
    try:
        return _CONDITION.validate_python(text)
    except ValidationError as error:
        raise RequestError(
            422, f"condition must be one of {', '.join(CONDITIONS)}, or left out if not known"
        ) from error
