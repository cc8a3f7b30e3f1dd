"""What the endpoint replies: a completion, a wait that it asks for, and the cache of replies."""

import logging
import os
import threading
from collections.abc import Mapping
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field, ValidationError

from .answers import Refusal

_SHOWN_CHARACTERS = 200  # of a body that is no completion

log = logging.getLogger(__name__)


class Reply(BaseModel):
    """The text of a completion and what it took, as the cache keeps it."""

    text: str
    tokens_in: int | None
    tokens_out: int | None


class _Message(BaseModel):
    content: str | None = None


class _Choice(BaseModel):
    message: _Message


class _Usage(BaseModel):
    prompt_tokens: int
    completion_tokens: int


class _Completion(BaseModel):
    """What is read of a chat completion."""

    choices: Annotated[list[_Choice], Field(min_length=1)]
    usage: _Usage | None = None


def read_completion(said: str) -> Reply | Refusal:
    """The reply in the body of a chat completion."""
    try:
        completion = _Completion.model_validate_json(said)
    except ValidationError:
        return Refusal(f"no chat completion came back: {said[:_SHOWN_CHARACTERS]!r}")
    usage = completion.usage
    return Reply(
        text=completion.choices[0].message.content or "",
        tokens_in=usage.prompt_tokens if usage else None,
        tokens_out=usage.completion_tokens if usage else None,
    )


def pause_asked(headers: Mapping[str, str]) -> float:
    """Retry-After [s], given as seconds or as a date (RFC 9110, 10.2.3); 0 without one."""
    said = headers.get("retry-after", "")
    try:
        return max(0.0, float(said))
    except ValueError:
        pass
    try:
        wait: float = (parsedate_to_datetime(said) - datetime.now(UTC)).total_seconds()
    except (TypeError, ValueError):
        return 0.0
    return max(0.0, wait)


def read_reply(place: Path) -> Reply | None:
    """The reply that the cache keeps at a place, if any."""
    try:
        return Reply.model_validate_json(place.read_bytes())
    except FileNotFoundError:
        return None
    except ValidationError:
        log.warning("damaged cache=%s, asking again", place)
        return None


def keep_reply(reply: Reply, place: Path) -> None:
    """Write a reply whole or not at all."""
    place.parent.mkdir(parents=True, exist_ok=True)
    partial = place.with_suffix(f".{os.getpid()}-{threading.get_ident()}.partial")
    partial.write_text(reply.model_dump_json())
    partial.replace(place)
