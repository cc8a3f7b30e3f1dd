"""What the audit log records, one frozen value per event.

Matrices are six values in the order of `PARAMETERS`. The passenger's words go in as `instruction`;
the log keeps their digest, and the words themselves only if it is told to. Anything else here must
not quote them.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import AwareDatetime, ConfigDict, Field, with_config

from ridetune.gate import Outcome
from ridetune.matrix import NUM_PARAMETERS
from ridetune.sample import Condition

Finite = Annotated[float, Field(allow_inf_nan=False)]
_Count = Field(min_length=NUM_PARAMETERS, max_length=NUM_PARAMETERS)
Six = Annotated[tuple[Finite, ...], _Count]
Foreign = Annotated[tuple[Finite | None, ...], _Count]  # of a model: None for what is not finite
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Natural = Annotated[int, Field(ge=1)]

_strict = with_config(ConfigDict(extra="forbid"))


@_strict
@dataclass(frozen=True, kw_only=True)
class Asked:
    """A question as it arrived; session is None where nothing personal may be written.

    instruction, instruction_digest: the log fills the second in and drops the first.
    condition: of the road as the car's sensors gave it; None if not known.
    """

    requested: AwareDatetime
    session: str | None
    frame_sha256: Sha256
    instruction: str | None
    instruction_digest: Sha256 | None = None
    condition: Condition | None


@_strict
@dataclass(frozen=True, kw_only=True)
class DecisionEvent(Asked):
    """A proposal and what the gate made of it.

    last_safe: what the car ran before; matrix: what it may run now; applied: whether it does, not
    so in shadow mode. timings_ms, frame_age_ms: as in `ridetune.policy.Decision`.
    """

    kind: Literal["decision"] = "decision"
    bundle: str
    last_safe: Six
    proposal: Foreign
    confidence: Foreign
    outcome: Outcome
    reasons: tuple[str, ...]
    matrix: Six
    applied: bool
    timings_ms: dict[str, Finite]
    frame_age_ms: Finite


@_strict
@dataclass(frozen=True, kw_only=True)
class FallbackEvent(Asked):
    """No decision in time: the car runs `matrix`.

    expired: the last safe matrix is too old, `matrix` is the vehicle's default.
    """

    kind: Literal["fallback"] = "fallback"
    bundle: str
    reason: str
    matrix: Six
    expired: bool


@_strict
@dataclass(frozen=True, kw_only=True)
class OverrideEvent:
    """A person set what the car runs; source: who or what, such as `passenger` or `driver`."""

    kind: Literal["override"] = "override"
    session: str | None
    source: str
    matrix: Six


@_strict
@dataclass(frozen=True, kw_only=True)
class RefusalEvent:
    """A request that was sent away with this HTTP status before it reached the model."""

    kind: Literal["refusal"] = "refusal"
    session: str | None
    route: str
    status: Annotated[int, Field(ge=400, le=599)]
    reason: str


@_strict
@dataclass(frozen=True, kw_only=True)
class StartEvent:
    """The server takes requests with this bundle."""

    kind: Literal["start"] = "start"
    bundle: str


@_strict
@dataclass(frozen=True, kw_only=True)
class StopEvent:
    """The server ends on purpose; a start without one before it tells of a crash."""

    kind: Literal["stop"] = "stop"
    reason: str


@_strict
@dataclass(frozen=True, kw_only=True)
class GapEvent:
    """Written by the log itself: so many events before this one found no room on the disk."""

    kind: Literal["gap"] = "gap"
    num_events: Natural
    since: AwareDatetime


@_strict
@dataclass(frozen=True, kw_only=True)
class PrunedEvent:
    """Written by the log itself: the lines up to `through`, whose hash this is, were deleted."""

    kind: Literal["pruned"] = "pruned"
    through: Natural
    sha256: Sha256


Event = Annotated[
    DecisionEvent
    | FallbackEvent
    | OverrideEvent
    | RefusalEvent
    | StartEvent
    | StopEvent
    | GapEvent
    | PrunedEvent,
    Field(discriminator="kind"),
]


def count_as(event: Event) -> str:
    """The heading under which an event is counted: its kind, with the outcome where it has one."""
    match event:
        case DecisionEvent():
            return f"decision {event.outcome}" + ("" if event.applied else " (not applied)")
        case FallbackEvent():
            return "fallback to the default" if event.expired else "fallback"
        case RefusalEvent():
            return f"refusal {event.status}"
        case _:
            return event.kind
