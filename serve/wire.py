"""What crosses the wire: the multipart question in, the JSON answers out.

Every size is checked while the body is read, before anything is decoded; unknown fields are
errors. What is wrong is said in one sentence.
"""

import asyncio
import math
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Request
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError
from starlette.datastructures import FormData, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import ClientDisconnect

from ridetune.gate import Outcome
from ridetune.matrix import ControllerMatrix
from ridetune.prompt import MAX_INSTRUCTION_CHARACTERS, MAX_MEMORIES
from ridetune.sample import CONDITIONS, Condition, Memory
from ridetune.vision import MAX_BYTES

MAX_BODY_BYTES = MAX_BYTES + 256 * 1024
MAX_FIELD_BYTES = 64 * 1024
BODY_S = 10.0
_FIELDS = ("frame", "instruction", "memories", "session", "condition")

Rows = list[list[float | None]]


class RequestError(ValueError):
    """A request that cannot be used, with its HTTP status."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


def _flat(matrix: object) -> object:
    if isinstance(matrix, list) and len(matrix) == 2:
        matrix = [cell for row in matrix if isinstance(row, list) for cell in row]
    if not isinstance(matrix, list) or len(matrix) != 6:
        raise ValueError("a matrix is six numbers or two rows of three")
    return matrix


Text = Annotated[str, Field(max_length=MAX_INSTRUCTION_CHARACTERS)]
Cells = Annotated[
    list[Annotated[float, Field(strict=True, allow_inf_nan=False)]], BeforeValidator(_flat)
]


class MemoryIn(BaseModel):
    """One remembered drive of this passenger."""

    model_config = ConfigDict(extra="forbid")

    instruction: Text
    scene: Text
    matrix: Cells
    feedback: Text

    def memory(self) -> Memory:
        """The library's form."""
        matrix = ControllerMatrix.of(self.matrix)
        return Memory(self.instruction, self.scene, matrix, self.feedback)


_MEMORIES = TypeAdapter(Annotated[list[MemoryIn], Field(max_length=MAX_MEMORIES)])
_CONDITION: TypeAdapter[Condition] = TypeAdapter(Condition)
_SESSION = TypeAdapter(Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,64}$")])


@dataclass(frozen=True)
class Question:
    """A checked request; the frame is not decoded yet. session is empty for a new one.

    condition: what the car's own sensors say of the road; None if they say nothing.
    """

    frame: bytes
    instruction: str
    memories: tuple[Memory, ...]
    session: str
    condition: Condition | None


class VerdictOut(BaseModel):
    """What the gate said."""

    outcome: Outcome
    reasons: list[str]


class DecisionOut(BaseModel):
    """The answer to a question; matrices are 2x3, times in milliseconds.

    `matrix` is what the car may run, `proposal` what the model asked for (null where it gave no
    finite number). scene and explanation are null where they came too late.
    """

    matrix: Rows
    default: Rows
    proposal: Rows
    verdict: VerdictOut
    confidence: list[float | None]
    scene: str | None
    explanation: str | None
    timings_ms: dict[str, float]
    frame_age_ms: float
    session: str
    bundle: str


class FallbackOut(BaseModel):
    """No answer from the model in time: the car stays on `matrix`, the session's last safe one."""

    error: str
    matrix: Rows
    default: Rows
    session: str


class ErrorOut(BaseModel):
    """What is wrong with a request, in one sentence."""

    error: str


class Health(BaseModel):
    """The process is alive."""

    alive: bool = True


class Readiness(BaseModel):
    """Whether decisions are possible, and if not, why."""

    ready: bool
    reason: str | None
    bundle: str


def rows(matrix: ControllerMatrix) -> Rows:
    """The 2x3 form; a value that is not finite becomes null, because JSON has no NaN."""
    return [finite(row) for row in matrix.rows]


def finite(values: list[float]) -> list[float | None]:
    """The values with null for what is not finite."""
    return [value if math.isfinite(value) else None for value in values]


async def read_question(request: Request) -> Question:
    """Read and check a multipart request; RequestError if it cannot be used."""
    form = await _read_form(request)
    try:
        for name in form:
            if name not in _FIELDS:
                raise RequestError(
                    422, f"unknown field {name[:40]!r}; the fields are {', '.join(_FIELDS)}"
                )
        return Question(
            frame=await _frame(form),
            instruction=_text(form, "instruction", required=True),
            memories=_memories(_text(form, "memories")),
            session=_session(_text(form, "session")),
            condition=_condition(_text(form, "condition")),
        )
    finally:
        await form.close()


async def _read_form(request: Request) -> FormData:
    if not request.headers.get("content-type", "").lower().startswith("multipart/form-data"):
        raise RequestError(415, "send the frame and the instruction as multipart/form-data")
    announced = request.headers.get("content-length", "0")
    if announced.isdecimal() and int(announced) > MAX_BODY_BYTES:
        raise _too_large()
    parser = MultiPartParser(
        request.headers,
        _bounded(request.stream()),
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
        raise RequestError(422, f"the multipart form is damaged: {detail}") from error


async def _bounded(stream: AsyncIterator[bytes]) -> Any:
    size = 0
    async for chunk in stream:
        size += len(chunk)
        if size > MAX_BODY_BYTES:
            raise _too_large()
        yield chunk


def _too_large() -> RequestError:
    return RequestError(
        413, f"the request is too large, a frame may have {MAX_BYTES} bytes; send a smaller frame"
    )


async def _frame(form: FormData) -> bytes:
    found = form.getlist("frame")
    if len(found) != 1 or not isinstance(found[0], UploadFile):
        raise RequestError(
            422, "the field 'frame' must hold one file, a JPEG or PNG camera frame; send it"
        )
    frame = await found[0].read()
    if len(frame) > MAX_BYTES:
        raise _too_large()
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
        return tuple(m.memory() for m in _MEMORIES.validate_json(text or "[]"))
    except ValidationError as error:
        raise RequestError(422, _sentence("memories", error)) from error


def _session(text: str) -> str:
    if not text:
        return ""
    try:
        return _SESSION.validate_python(text)
    except ValidationError as error:
        raise RequestError(
            422, "session must be 1 to 64 letters, digits, dots, dashes or underscores"
        ) from error


def _condition(text: str) -> Condition | None:
    if not text:
        return None
    try:
        return _CONDITION.validate_python(text)
    except ValidationError as error:
        raise RequestError(
            422, f"condition must be one of {', '.join(CONDITIONS)}, or left out if not known"
        ) from error


def _sentence(field: str, error: ValidationError) -> str:
    first = error.errors(include_url=False, include_input=False)[0]
    where = ".".join([field, *(str(part) for part in first["loc"])])
    return f"{where}: {first['msg'].removeprefix('Value error, ')}"
