"""What a source hands over: a frame with what is known of its scene, or why it was left out."""

from collections.abc import Iterator
from dataclasses import dataclass

from ridetune.camera.scene import Lead, Road, Surroundings, Traffic
from ridetune.sample import Condition, Observation
from ridetune.vision import FrameError, decode_frame

_ADJECTIVE: dict[Condition, str] = {
    "sunny": "sunny",
    "rain": "rainy",
    "fog": "foggy",
    "snow": "snowy",
    "night": "night-time",
}
_LEAD: dict[Lead, str] = {
    "none": "no vehicle ahead",
    "near": "a vehicle close ahead",
    "far": "a vehicle far ahead",
}
_WHERE: dict[Surroundings, str] = {
    "city": "in the city",
    "highway": "on the highway",
    "country": "in the country",
}
# Enough to find a JPEG that breaks off, at an eighth of the work.
_GLANCE_PX = (64, 64)


@dataclass(frozen=True)
class Facts:
    """What is known of a scene; None where the source does not say.

    condition: what weighs most for the driving; rain at night is rain, and dark. low_sun: the sun
    stands in the picture.
    """

    condition: Condition | None = None
    dark: bool | None = None
    low_sun: bool | None = None
    road: Road | None = None
    lead: Lead | None = None
    traffic: Traffic | None = None
    surroundings: Surroundings | None = None


@dataclass(frozen=True)
class Seen:
    """One frame. name is its own within the source; frames of one drive share a scene_id."""

    name: str
    scene_id: str
    observation: Observation
    facts: Facts


@dataclass(frozen=True)
class Skipped:
    """A frame that was left out, and the reason in words."""

    name: str
    reason: str


Frames = Iterator[Seen | Skipped]


def describe_facts(facts: Facts) -> str:
    """One short lower-case line, as `camera.scene.describe`; what is not known is left out."""
    words = [_ADJECTIVE[facts.condition]] if facts.condition else []
    words.append("straight road" if facts.road == "straight" else facts.road or "road")
    if facts.surroundings:
        words.append(_WHERE[facts.surroundings])
    if facts.dark and facts.condition != "night":
        words.append("at night")
    if facts.low_sun:
        words.append("against a low sun")
    parts = [" ".join(words)]
    if facts.lead:
        parts.append(_LEAD[facts.lead])
    if facts.traffic:
        parts.append(f"{facts.traffic} traffic")
    return ", ".join(parts)


def fault_of_frame(frame: bytes) -> str | None:
    """Why a frame cannot be used, in words; None if it can."""
    try:
        decode_frame(frame, _GLANCE_PX)
    except FrameError as error:
        return str(error)
    return None
