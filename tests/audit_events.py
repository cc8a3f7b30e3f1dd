"""Events of every kind, and a log of them."""

from datetime import UTC, datetime
from pathlib import Path

from serve.audit.events import (
    DecisionEvent,
    Event,
    FallbackEvent,
    OverrideEvent,
    RefusalEvent,
    StartEvent,
    StopEvent,
)
from serve.audit.log import AuditLog

ROOT = Path(__file__).parents[1]
SIX = (0.3, 0.004, 0.1, 0.2, 1.0, 0.4)
WORDS = "Müsli spilled, please roll gently"
NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)
KEY = bytes(range(32))

DECISION = DecisionEvent(
    requested=NOON,
    session="anna",
    frame_sha256="ab" * 32,
    instruction=WORDS,
    condition="rain",
    bundle="tiny-1",
    last_safe=SIX,
    proposal=(None, *SIX[1:]),
    confidence=(0.5, 0.5, 0.5, 0.5, None, 1.0),
    outcome="limited",
    reasons=("K_p moves from 1 to 0.3: no further is verified for rain",),
    matrix=SIX,
    applied=True,
    timings_ms={"gate": 1.25, "total": 9.5},
    frame_age_ms=12.0,
)
FALLBACK = FallbackEvent(
    requested=NOON,
    session=None,
    frame_sha256="cd" * 32,
    instruction=WORDS,
    condition=None,
    bundle="tiny-1",
    reason="the model did not answer in time",
    matrix=SIX,
    expired=True,
)
EVENTS: tuple[Event, ...] = (
    StartEvent(bundle="tiny-1"),
    DECISION,
    FALLBACK,
    OverrideEvent(session="anna", source="driver", matrix=SIX),
    RefusalEvent(session=None, route="/v1/decide", status=429, reason="8 are waiting already"),
    StopEvent(reason="SIGTERM"),
)


def at_noon() -> datetime:
    """A clock that stands still, so that no test meets midnight."""
    return NOON


def write(folder: Path, *events: Event, keep_words: bool = True, **limits: int) -> None:
    with AuditLog(folder, keep_words=keep_words, key=KEY, clock=at_noon, **limits) as log:
        for event in events:
            log.append(event)


def contents(folder: Path) -> bytes:
    return b"".join(path.read_bytes() for path in sorted(folder.iterdir()))
