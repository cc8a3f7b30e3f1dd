"""The verified envelope: which matrices one vehicle may run, per condition, and on what evidence.

Per condition one box, an interval for each parameter, inside the vehicle's ranges; within it K_i
stays below K_p^2 / 8. `python -m evaluate.envelope` computes it and writes `configs/verified.yaml`;
the gate loads that. Where the condition is not known, the intersection of all boxes holds.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml

from ridetune.config import load_config
from ridetune.control.vehicle import Vehicle
from ridetune.matrix import PARAMETERS, ControllerMatrix, Ranges, ki_limit
from ridetune.sample import CONDITIONS, Condition

# (least, most) of each parameter, in the order of PARAMETERS.
Box = tuple[tuple[float, float], ...]
_AGAIN = "compute it again with `python -m evaluate.envelope`"


@dataclass(frozen=True)
class Limits:
    """What no drive may do; a collision and a car out of control break them in any case.

    lane_m: farthest from the path. overspeed_share: beyond the path's speed. grip_share: speed x
    yaw rate over friction x gravity; above 1 the car turns faster than its tyres can hold.
    hunting_mps2: peak to peak of either acceleration over the last two seconds.
    """

    lane_m: float = 1.5
    overspeed_share: float = 0.10
    grip_share: float = 1.15
    hunting_mps2: float = 1.0


@dataclass(frozen=True)
class Evidence:
    """Independent runs with matrices of a box: how many broke a limit, and the 95 % interval."""

    runs: int
    violations: int
    lower: float
    upper: float


@dataclass(frozen=True)
class Envelope:
    """Boxes per condition with what they rest on; the hashes name the vehicle and its ranges.

    evidence: of the boxes, per condition. ValueError when it is made without all conditions.
    """

    vehicle: str
    vehicle_sha256: str
    ranges_sha256: str
    seed: int
    limits: Limits
    boxes: dict[Condition, dict[str, tuple[float, float]]]
    evidence: dict[Condition, Evidence]

    def __post_init__(self) -> None:
        for condition in CONDITIONS:
            box = self.boxes.get(condition, {})
            if tuple(box) != PARAMETERS:
                raise ValueError(f"the envelope needs {', '.join(PARAMETERS)} for {condition}")
            for name, (low, high) in box.items():
                if not low <= high:
                    raise ValueError(f"the envelope's {name} for {condition} is [{low}, {high}]")
        for i, (low, high) in enumerate(self.box(None)):
            if not low <= high:
                raise ValueError(f"no {PARAMETERS[i]} is verified for every condition; {_AGAIN}")

    def box(self, condition: Condition | None) -> Box:
        """The box of a condition, or the intersection of all where it is not known."""
        known = CONDITIONS if condition is None else (condition,)
        return tuple(
            (
                max(self.boxes[c][name][0] for c in known),
                min(self.boxes[c][name][1] for c in known),
            )
            for name in PARAMETERS
        )

    def contains(self, matrix: ControllerMatrix, condition: Condition | None) -> bool:
        """Whether a matrix lies in the box and keeps the K_i rule; a NaN never does."""
        inside = (
            low <= value <= high
            for value, (low, high) in zip(matrix.values, self.box(condition), strict=True)
        )
        return all(inside) and matrix.ki <= ki_limit(matrix.kp)

    def save(self, path: Path, *, header: str) -> None:
        """Write the YAML that `Envelope.load` reads, below comment lines."""
        plain = asdict(self)
        plain["boxes"] = {
            condition: {name: list(ends) for name, ends in box.items()}
            for condition, box in self.boxes.items()
        }
        text = yaml.safe_dump(plain, sort_keys=False, default_flow_style=None)
        path.write_text("".join(f"# {line}\n" for line in header.splitlines()) + text)

    @staticmethod
    def load(path: Path, *, vehicle: Vehicle, ranges: Ranges) -> "Envelope":
        """Read an envelope; ValueError where it is of another vehicle or of other ranges."""
        envelope = load_config(Envelope, path)
        for found, expected, what in (
            (envelope.vehicle_sha256, hash_of(asdict(vehicle)), f"vehicle ({vehicle.name})"),
            (envelope.ranges_sha256, hash_of(ranges.as_dict()), f"ranges ({ranges.vehicle})"),
        ):
            if found != expected:
                raise ValueError(f"{path} was computed for another {what}; {_AGAIN}")
        return envelope


def hash_of(content: dict[str, object]) -> str:
    """SHA-256 of a config's content; comments in its file do not count."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def clamp(values: Sequence[float], box: Box) -> list[float]:
    """The nearest values inside a box."""
    return [min(max(v, low), high) for v, (low, high) in zip(values, box, strict=True)]
