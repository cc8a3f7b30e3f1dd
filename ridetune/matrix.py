"""The controller matrix and what each driving style may ask of it.

    P = [[K_p, K_i, K_d],     longitudinal PID: speed error [m/s] -> acceleration [m/s^2]
         [W_l, W_h, W_s]]     lateral MPC: weights of lateral error, heading error, steering input

Source: the on-board VLM paper, Eq. 2 (matrix), Eq. 4 (PID), Eq. 5 (MPC), Eq. 7 (ranges).
In: `configs/ranges.yaml`. Out: frozen values that every stage shares.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import yaml

Style = Literal["conservative", "moderate", "aggressive"]
STYLES: tuple[Style, ...] = ("conservative", "moderate", "aggressive")

PARAMETERS = ("K_p", "K_i", "K_d", "W_l", "W_h", "W_s")
NUM_PARAMETERS = len(PARAMETERS)


@dataclass(frozen=True)
class ControllerMatrix:
    """Six controller parameters; nothing is checked here, the gate does that."""

    kp: float
    ki: float
    kd: float
    wl: float
    wh: float
    ws: float

    @property
    def values(self) -> tuple[float, ...]:
        """The six values in the order of `PARAMETERS`."""
        return (self.kp, self.ki, self.kd, self.wl, self.wh, self.ws)

    @property
    def rows(self) -> list[list[float]]:
        """The 2x3 form [[K_p, K_i, K_d], [W_l, W_h, W_s]]."""
        return [[self.kp, self.ki, self.kd], [self.wl, self.wh, self.ws]]

    @staticmethod
    def of(values: Sequence[float]) -> "ControllerMatrix":
        """Build from six values in the order of `PARAMETERS`; ValueError for another count."""
        if len(values) != NUM_PARAMETERS:
            raise ValueError(
                f"a controller matrix has {NUM_PARAMETERS} values "
                f"({', '.join(PARAMETERS)}), got {len(values)}"
            )
        return ControllerMatrix(*(float(value) for value in values))


def ki_limit(kp: float) -> float:
    """The largest integral gain that does not overshoot at this proportional gain: K_p^2 / 8."""
    return kp * kp / 8.0


@dataclass(frozen=True)
class ParameterRange:
    """One parameter's range for one style: full score within [lower, upper] (Eq. 7)."""

    minimum: float
    lower: float
    upper: float
    maximum: float


@dataclass(frozen=True)
class Ranges:
    """Ranges per style, the certified default, and the slew limit of one vehicle."""

    vehicle: str
    default: ControllerMatrix
    slew: float
    styles: dict[Style, tuple[ParameterRange, ...]]

    @property
    def lowest(self) -> tuple[float, ...]:
        """The envelope's lower bound of each parameter, over all styles."""
        return tuple(
            min(self.styles[style][i].minimum for style in STYLES) for i in range(NUM_PARAMETERS)
        )

    @property
    def highest(self) -> tuple[float, ...]:
        """The envelope's upper bound of each parameter, over all styles."""
        return tuple(
            max(self.styles[style][i].maximum for style in STYLES) for i in range(NUM_PARAMETERS)
        )

    def as_dict(self) -> dict[str, object]:
        """The YAML/JSON form that `Ranges.parse` reads."""
        return {
            "vehicle": self.vehicle,
            "default": self.default.rows,
            "slew": self.slew,
            "styles": {
                style: {
                    name: [r.minimum, r.lower, r.upper, r.maximum]
                    for name, r in zip(PARAMETERS, self.styles[style], strict=True)
                }
                for style in STYLES
            },
        }

    @staticmethod
    def parse(raw: object, *, where: str) -> "Ranges":
        """Read the form that `as_dict` writes; ValueError names the wrong entry."""
        if not isinstance(raw, dict):
            raise ValueError(f"{where}: expected a mapping with vehicle, default, slew and styles")
        try:
            default = ControllerMatrix.of([value for row in raw["default"] for value in row])
            styles = {style: _style_ranges(raw["styles"][style], style, where) for style in STYLES}
            ranges = Ranges(
                vehicle=str(raw["vehicle"]),
                default=default,
                slew=float(raw["slew"]),
                styles=styles,
            )
        except KeyError as error:
            raise ValueError(f"{where}: the entry {error} is missing") from error
        except TypeError as error:
            raise ValueError(f"{where}: an entry has the wrong form: {error}") from error
        _check_vehicle(ranges, where)
        return ranges

    @staticmethod
    def load(path: Path) -> "Ranges":
        """Read a ranges YAML file; ValueError names the file and the wrong entry."""
        if not path.is_file():
            raise ValueError(f"no ranges file at {path}; configs/ranges.yaml is the shipped one")
        try:
            raw = yaml.safe_load(path.read_text())
        except yaml.YAMLError as error:
            raise ValueError(f"{path} is not valid YAML: {error}") from error
        return Ranges.parse(raw, where=str(path))


def _check_vehicle(ranges: Ranges, where: str) -> None:
    if not 0 < ranges.slew <= 1:
        raise ValueError(f"{where}: slew must be a share in (0, 1], got {ranges.slew}")
    for name, value, low, high in zip(
        PARAMETERS, ranges.default.values, ranges.lowest, ranges.highest, strict=True
    ):
        if low == high:
            raise ValueError(f"{where}: {name} has no room, all its limits are {low}")
        if not low <= value <= high:  # also catches NaN
            raise ValueError(f"{where}: the default {name} = {value} is outside [{low}, {high}]")
    if ranges.default.ki > ki_limit(ranges.default.kp):
        raise ValueError(f"{where}: the default matrix breaks K_i <= K_p^2/8")


def _style_ranges(
    raw: dict[str, list[float]], style: str, where: str
) -> tuple[ParameterRange, ...]:
    ranges = []
    for name in PARAMETERS:
        try:
            minimum, lower, upper, maximum = (float(value) for value in raw[name])
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"{where}: styles.{style}.{name} needs 4 numbers, got {raw[name]}"
            ) from error
        numbers = (minimum, lower, upper, maximum)
        if not all(math.isfinite(n) for n in numbers) or list(numbers) != sorted(numbers):
            raise ValueError(
                f"{where}: styles.{style}.{name} must rise from minimum to maximum, got {raw[name]}"
            )
        if minimum < 0:
            raise ValueError(f"{where}: styles.{style}.{name} must not be negative, got {minimum}")
        ranges.append(ParameterRange(minimum, lower, upper, maximum))
    return tuple(ranges)
