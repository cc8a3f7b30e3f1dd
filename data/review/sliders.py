"""The six sliders: their stops on the codec's scale, the styles' bands, and what may be saved.

A slider's stops are the codec's levels, which are what the model can say.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ridetune.codec import NUM_BINS, ROUNDING, MatrixCodec
from ridetune.matrix import (
    NUM_PARAMETERS,
    PARAMETERS,
    STYLES,
    ControllerMatrix,
    Ranges,
    Style,
    ki_limit,
)

# Units follow from the equations in ridetune/control/pid.py and mpc.py (the paper's Eq. 4 and 5): a
# weight's is one over the square of what it weighs; the steering's is scaled by the speed's square.
_ABOUT = (
    ("1/s", "answer to speed error"),
    ("1/s²", "lasting speed error"),
    ("", "damping of speed"),
    ("1/m²", "weight of lateral error"),
    ("1/rad²", "weight of heading error"),
    ("s²/m²", "weight of steering"),
)


@dataclass(frozen=True)
class Slider:
    """One parameter: bands are [minimum, lower, upper, maximum] of each style as shares 0..1."""

    name: str
    unit: str
    about: str
    stops: tuple[float, ...]
    bands: dict[Style, tuple[float, ...]]


def sliders_of(codec: MatrixCodec) -> tuple[Slider, ...]:
    """The sliders of one vehicle, from its lowest to its highest limit over all styles."""
    return tuple(
        Slider(
            name,
            *_ABOUT[i],
            tuple(codec.value(level / (NUM_BINS - 1), i) for level in range(NUM_BINS)),
            {style: _band(codec, style, i) for style in STYLES},
        )
        for i, name in enumerate(PARAMETERS)
    )


def transpose(
    matrix: ControllerMatrix, style: Style, other: Style, codec: MatrixCodec
) -> ControllerMatrix:
    """The matrix at the same place of another style's [lower, upper], on the codec's scale.

    Where a corrected style starts from: the scene asks for as much care as before.
    """
    if style == other:
        return matrix
    values = []
    for i, value in enumerate(matrix.values):
        (_, low, high, _), (_, to_low, to_high, _) = (_band(codec, s, i) for s in (style, other))
        place = min(max((codec.share(value, i) - low) / (high - low), 0.0), 1.0)
        values.append(codec.value(to_low + place * (to_high - to_low), i))
    values[1] = min(values[1], ki_limit(values[0]))
    return ControllerMatrix.of(values)


def matrix_fault(values: Sequence[float], ranges: Ranges) -> str | None:
    """Why a matrix cannot be saved, in words; None if it can.

    What only float32 moved across a limit is let through.
    """
    return limits_fault(values, ranges) or _coupling_fault(values)


def limits_fault(values: Sequence[float], ranges: Ranges) -> str | None:
    """Which value is not finite or outside the vehicle's limits, in words; None if none is."""
    if len(values) != NUM_PARAMETERS or not all(math.isfinite(value) for value in values):
        return f"a matrix is {NUM_PARAMETERS} finite numbers"
    for name, value, low, high in zip(
        PARAMETERS, values, ranges.lowest, ranges.highest, strict=True
    ):
        slack = ROUNDING * (high - low)
        if not low - slack <= value <= high + slack:
            return f"{name} = {value:.4g} lies outside the vehicle's {low:.4g} to {high:.4g}"
    return None


def _coupling_fault(values: Sequence[float]) -> str | None:
    limit = ki_limit(values[0])
    if values[1] <= limit * (1.0 + ROUNDING):
        return None
    return (
        f"K_i = {values[1]:.4g} is above K_p²/8 = {limit:.4g}, where the speed overshoots; "
        "lower K_i or raise K_p"
    )


def _band(codec: MatrixCodec, style: Style, parameter: int) -> tuple[float, ...]:
    limits = codec.ranges.styles[style][parameter]
    ends = (limits.minimum, limits.lower, limits.upper, limits.maximum)
    return tuple(codec.share(end, parameter) for end in ends)
