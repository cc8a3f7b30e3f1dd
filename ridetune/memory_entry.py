"""One remembered decision: checked when it comes in, and its form in the file."""

import json
import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from pydantic import AwareDatetime, TypeAdapter

from ridetune.codec import MatrixCodec
from ridetune.memory_seal import Seal
from ridetune.prompt import MAX_INSTRUCTION_CHARACTERS, clean_instruction, quote
from ridetune.sample import CONDITIONS, Condition, Memory

_NAME = re.compile(r"[A-Za-z0-9._-]{1,64}")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND = timedelta(microseconds=1)


@dataclass(frozen=True)
class Entry:
    """One remembered decision.

    number: names the entry, rises with time, is never given twice. time: when it was remembered.
    condition: what the car's sensors said of the road. session, bundle: where it comes from.
    """

    number: int
    time: AwareDatetime
    passenger: str
    memory: Memory
    condition: Condition | None
    session: str
    bundle: str

    def json_line(self) -> str:
        """Everything about it on one line."""
        return _ENTRY.dump_json(self).decode() + "\n"

    def sealed(self, seal: Seal) -> bytes:
        """Its body in the file; number and time stand beside it."""
        text = _ENTRY.dump_json(self, exclude={"number", "time"})
        return seal.close(text, _beside(microseconds(self.time)))

    @staticmethod
    def unsealed(seal: Seal, *, number: int, time_us: int, body: bytes) -> "Entry":
        """The inverse of `sealed`; SealError where the parts do not belong together."""
        raw = json.loads(seal.open(body, _beside(time_us)))
        return _ENTRY.validate_python({**raw, "number": number, "time": moment(time_us)})


_ENTRY = TypeAdapter(Entry)


def clean_memory(memory: Memory, codec: MatrixCodec) -> Memory:
    """Its texts bounded and quoted as the prompt does it.

    ValueError: a text is too long, instruction or feedback say nothing, or the matrix is not finite
    or lies outside the codec's envelope.
    """
    feedback = bounded("feedback", memory.feedback)
    if not feedback:
        raise ValueError("the feedback is empty; say how the drive felt")
    codec.encode(memory.matrix)
    instruction = clean_instruction(memory.instruction)
    return Memory(instruction, bounded("scene", memory.scene), memory.matrix, feedback)


def check_condition(condition: Condition | None) -> None:
    """ValueError where it is none of the known ones."""
    if condition is not None and condition not in CONDITIONS:
        raise ValueError(f"the condition {condition!r} is none of {', '.join(CONDITIONS)}")


def check_name(what: str, name: str) -> None:
    """ValueError where a passenger or session is named by more than plain characters."""
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"the {what} {name[:80]!r} is no name; use 1 to 64 letters, digits, dots and dashes"
        )


def microseconds(time: datetime) -> int:
    """Since 1970 in UTC, as the file holds it [us]."""
    return (time - _EPOCH) // _MICROSECOND


def moment(time_us: int) -> datetime:
    """The inverse of `microseconds`, in UTC."""
    return _EPOCH + time_us * _MICROSECOND


def bounded(what: str, text: str) -> str:
    """The text quoted as in the prompt; ValueError where it is too long."""
    if len(text) > MAX_INSTRUCTION_CHARACTERS:
        raise ValueError(
            f"the {what} has {len(text)} characters, the limit is {MAX_INSTRUCTION_CHARACTERS}"
        )
    return quote(text)


def _beside(time_us: int) -> bytes:
    return time_us.to_bytes(8, "big", signed=True)
