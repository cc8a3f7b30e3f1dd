"""Scores of a matrix against what the passenger and the scene ask for.

Command alignment: the on-board VLM paper, Eq. 7, the plain mean over six parameters.
Scenario alignment: share of adverse scenes whose matrix is more conservative than the matrix of
the same scene in clear daylight.
"""

from collections.abc import Sequence

from ridetune.codec import MatrixCodec
from ridetune.matrix import STYLES, ControllerMatrix, ParameterRange, Ranges, Style

# Which way each parameter grows more conservative; W_h carries no order between the styles.
CONSERVATIVE_SIGN = (-1, -1, +1, -1, 0, +1)
# Two matrices closer than this (share of the envelope) count as equally conservative: half a bin.
TIE = 0.5 / 255


def command_alignment(matrix: ControllerMatrix, style: Style, ranges: Ranges) -> float:
    """Eq. 7 in [0, 100]: the mean over six parameters of a trapezoid on the style's range."""
    scores = [_trapezoid(v, r) for v, r in zip(matrix.values, ranges.styles[style], strict=True)]
    return sum(scores) / len(scores)


def style_of(matrix: ControllerMatrix, ranges: Ranges) -> Style:
    """The style whose ranges the matrix meets best; ties go to the more conservative style."""
    return max(STYLES, key=lambda style: command_alignment(matrix, style, ranges))


def conservativeness(matrix: ControllerMatrix, codec: MatrixCodec) -> float:
    """Mean position towards the conservative end of each ordered parameter, in [-1, 1]."""
    terms = [
        sign * codec.share(value, i)
        for i, (sign, value) in enumerate(zip(CONSERVATIVE_SIGN, matrix.values, strict=True))
        if sign
    ]
    return sum(terms) / len(terms)


def scenario_alignment(
    pairs: Sequence[tuple[ControllerMatrix, ControllerMatrix]], codec: MatrixCodec
) -> float:
    """Share in [0, 1] of (clear, adverse) pairs in which the adverse matrix is more conservative.

    A tie is no success, so a policy that ignores the image scores 0.
    """
    wins = sum(
        conservativeness(adverse, codec) > conservativeness(clear, codec) + TIE
        for clear, adverse in pairs
    )
    return wins / len(pairs)


def _trapezoid(value: float, r: ParameterRange) -> float:
    if r.lower <= value <= r.upper:
        return 100.0
    if r.minimum <= value < r.lower:
        return 100.0 * (value - r.minimum) / (r.lower - r.minimum)
    if r.upper < value <= r.maximum:
        return 100.0 * (r.maximum - value) / (r.maximum - r.upper)
    return 0.0
