"""Matrix <-> action bins, and matrix <-> the fixed-width text of the paper's way.

Each parameter is cut into 256 levels, evenly spaced on the scale log(1 + x / knee), which is
linear below the knee and logarithmic above it: gains and weights matter by ratio, and several
reach zero. The first and the last level are the envelope's bounds exactly.
"""

import math
import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ridetune.matrix import NUM_PARAMETERS, PARAMETERS, ControllerMatrix, Ranges

NUM_BINS = 256
# Where the scale turns from linear to logarithmic, per parameter in the order of PARAMETERS.
KNEES = (0.05, 0.001, 0.1, 0.02, 1.0, 0.05)
# The exponent of a distribution before its median is read: a belief of 45 % in one style and 55 %
# in two others should not come out between them. docs/experiments.md has what others gave.
SHARPNESS = 1.5
# A matrix that went through float32 may miss a bound by its last digit.
ROUNDING = 1e-6

_NUMBER = r"(\d{1,2}\.\d{3,4})"
_TEXT = re.compile(
    r"\s*".join([r"\[\s*\[", _NUMBER, ",", _NUMBER, ",", _NUMBER, r"\]\s*,\s*\[", _NUMBER, ","])
    + r"\s*"
    + r"\s*".join([_NUMBER, ",", _NUMBER, r"\]\s*\]"])
)


class MatrixCodec:
    """Turns a matrix into six bins in [0, 255] and back, on one vehicle's envelope."""

    def __init__(self, ranges: Ranges) -> None:
        self.ranges = ranges
        self._low = [_warp(x, i) for i, x in enumerate(ranges.lowest)]
        self._span = [_warp(x, i) - self._low[i] for i, x in enumerate(ranges.highest)]

    def share(self, value: float, parameter: int) -> float:
        """Position of a value within the envelope on the codec's scale: 0 lowest, 1 highest."""
        return (_warp(value, parameter) - self._low[parameter]) / self._span[parameter]

    def value(self, share: float, parameter: int) -> float:
        """The inverse of `share`, clipped into the envelope."""
        x = math.expm1(self._low[parameter] + share * self._span[parameter]) * KNEES[parameter]
        return min(max(x, self.ranges.lowest[parameter]), self.ranges.highest[parameter])

    def encode(self, matrix: ControllerMatrix) -> tuple[int, ...]:
        """Six bins in [0, 255]; ValueError if a value lies outside the envelope."""
        bins = []
        for i, value in enumerate(matrix.values):
            low, high = self.ranges.lowest[i], self.ranges.highest[i]
            slack = ROUNDING * (high - low)
            if not low - slack <= value <= high + slack:  # also catches NaN
                raise ValueError(f"{PARAMETERS[i]} = {value} lies outside [{low}, {high}]")
            share = self.share(min(max(value, low), high), i)
            bins.append(round(share * (NUM_BINS - 1)))
        return tuple(bins)

    def decode(self, bins: Sequence[float]) -> ControllerMatrix:
        """The matrix at six (also fractional) bin positions in [0, 255]."""
        if len(bins) != NUM_PARAMETERS:
            raise ValueError(f"expected {NUM_PARAMETERS} bins, got {len(bins)}")
        return ControllerMatrix.of([self.value(b / (NUM_BINS - 1), i) for i, b in enumerate(bins)])

    def expect(self, logits: NDArray[np.float32]) -> tuple[ControllerMatrix, tuple[float, ...]]:
        """The median level of each parameter's sharpened distribution, and its confidence.

        logits: [6, 256]. The median keeps to the middle of the style that the model believes in,
        where the highest single bin would follow the noise of the labels; unlike the mean it does
        not fall between two styles. Confidence: probability within +-10 % of the envelope.
        """
        shifted = logits.astype(np.float64) - logits.max(axis=1, keepdims=True)
        mass, sharp = _normal(np.exp(shifted)), _normal(np.exp(SHARPNESS * shifted))
        below = np.cumsum(sharp, axis=1)
        bins = [_median(below[i], sharp[i]) for i in range(NUM_PARAMETERS)]
        levels = np.arange(NUM_BINS)
        near = [np.abs(levels - b) <= 0.1 * NUM_BINS for b in bins]
        confidence = tuple(float(mass[i][near[i]].sum()) for i in range(NUM_PARAMETERS))
        return self.decode(bins), confidence

    def text(self, matrix: ControllerMatrix) -> str:
        """Fixed width, six characters a value: [[0.3500, 0.0050, ...], [...]]."""
        p, i, d, lateral, heading, steering = (f"{v:.4f}"[:6] for v in matrix.values)
        return f"[[{p}, {i}, {d}], [{lateral}, {heading}, {steering}]]"

    def parse(self, text: str) -> ControllerMatrix | None:
        """The matrix in a model's text, or None where the format does not hold."""
        found = _TEXT.search(text)
        return ControllerMatrix.of([float(x) for x in found.groups()]) if found else None


def _warp(value: float, parameter: int) -> float:
    return math.log1p(value / KNEES[parameter])


def _normal(mass: NDArray[np.float64]) -> NDArray[np.float64]:
    shares: NDArray[np.float64] = mass / mass.sum(axis=1, keepdims=True)
    return shares


def _median(below: NDArray[np.float64], mass: NDArray[np.float64]) -> float:
    """The fractional level at which half of the probability lies below."""
    level = int(np.searchsorted(below, 0.5))
    level = min(level, NUM_BINS - 1)
    before = below[level] - mass[level]
    inside = (0.5 - before) / max(float(mass[level]), 1e-12)
    return min(max(level - 0.5 + float(inside), 0.0), NUM_BINS - 1.0)
