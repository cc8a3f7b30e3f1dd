"""What crosses the wire: the messages of questions, answers, feedback and passengers.

Unknown fields are errors. What is wrong is said in one sentence.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
)

from ridetune.gate import Outcome
from ridetune.matrix import ControllerMatrix
from ridetune.prompt import MAX_INSTRUCTION_CHARACTERS, MAX_MEMORIES, quote
from ridetune.sample import Condition, Memory

Rows = list[list[float | None]]


class RequestError(ValueError):
    """A request that cannot be used, with its HTTP status.

    quotes: whether the sentence shows what the client sent; then the audit log does not keep it.
    """

    def __init__(self, status: int, sentence: str, *, quotes: bool = False) -> None:
        super().__init__(sentence)
        self.status = status
        self.quotes = quotes


def _flat(matrix: object) -> object:
    if isinstance(matrix, list) and len(matrix) == 2:
        matrix = [cell for row in matrix if isinstance(row, list) for cell in row]
    if not isinstance(matrix, list) or len(matrix) != 6:
        raise ValueError("a matrix is six numbers or two rows of three")
    return matrix


def _with_words(text: str) -> str:
    if not quote(text):
        raise ValueError("it is empty; say how the drive felt")
    return text


Text = Annotated[str, Field(max_length=MAX_INSTRUCTION_CHARACTERS)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,64}$")]
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


MEMORIES = TypeAdapter(Annotated[list[MemoryIn], Field(max_length=MAX_MEMORIES)])


@dataclass(frozen=True)
class Question:
    """A checked request; the frame is not decoded yet. session is empty for a new one.

    passenger: whose memory is recalled; empty for nobody's, and then `memories` may be given.
    condition: what the car's own sensors say of the road; None if they say nothing.
    """

    frame: bytes
    instruction: str
    memories: tuple[Memory, ...]
    passenger: str
    session: str
    condition: Condition | None


class VerdictOut(BaseModel):
    """What the gate said."""

    outcome: Outcome
    reasons: list[str]


class DecisionOut(BaseModel):
    """The answer to a question; matrices are 2x3, times in milliseconds.

    `matrix` is what the car may run, `proposal` what the model asked for (null where it gave no
    finite number). scene and explanation are null where they came too late. `decision` names it for
    feedback; recalled: the numbers of the remembered drives that went into the prompt.
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
    decision: str
    recalled: list[int]


class FallbackOut(BaseModel):
    """No answer from the model in time: the car stays on `matrix`, the session's last safe one."""

    error: str
    matrix: Rows
    default: Rows
    session: str


class FeedbackIn(BaseModel):
    """How a decision felt to a passenger, in the passenger's words."""

    model_config = ConfigDict(extra="forbid")

    decision: Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]
    passenger: Name
    feedback: Annotated[Text, AfterValidator(_with_words)]


class FeedbackOut(BaseModel):
    """The entry is on the disk under this number; none is written in privacy mode."""

    remembered: bool
    number: int | None


class PrivacyIn(BaseModel):
    """Privacy mode on or off."""

    model_config = ConfigDict(extra="forbid")

    on: Annotated[bool, Field(strict=True)]


class PrivacyOut(BaseModel):
    """Whether the passenger is in privacy mode now."""

    private: bool


class EntryOut(BaseModel):
    """One remembered drive with its provenance."""

    number: int
    time: AwareDatetime
    instruction: str
    scene: str
    matrix: Rows
    feedback: str
    condition: Condition | None
    session: str
    bundle: str


class PassengerOut(BaseModel):
    """All that is kept about a passenger, the newest entry first."""

    count: int
    private: bool
    entries: list[EntryOut]


class ErasedOut(BaseModel):
    """How many entries of the passenger were removed without a trace."""

    erased: int


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


def finite(values: Sequence[float]) -> list[float | None]:
    """The values with null for what is not finite."""
    return [value if math.isfinite(value) else None for value in values]


def first_fault(error: ValidationError, *field: str) -> str:
    """Where and what is wrong, in a few words; it may show names that the client sent."""
    first = error.errors(include_url=False, include_input=False)[0]
    where = ".".join([*field, *(str(part) for part in first["loc"])])
    return f"{where}: {first['msg'].removeprefix('Value error, ')}".removeprefix(": ")


_NAME = TypeAdapter(Name)


def check_name(field: str, name: str) -> str:
    """A passenger's or a session's name; RequestError 422 for anything but plain characters."""
    try:
        return _NAME.validate_python(name)
    except ValidationError as error:
        raise RequestError(
            422, f"{field} must be 1 to 64 letters, digits, dots, dashes or underscores"
        ) from error
