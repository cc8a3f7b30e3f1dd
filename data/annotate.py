"""The label of a sample: a matrix inside the style's range, shifted by what adds risk or taste.

position 0 is the conservative end of the style's [lower, upper], 1 the aggressive end. A clear
scene draws near 0.65; rain, fog, snow and night shift towards 0, and so does what else asks for
care; remembered feedback shifts against the complaint. The label always keeps K_i <= K_p^2 / 8.
"""

import numpy as np

from ridetune.alignment import CONSERVATIVE_SIGN
from ridetune.codec import MatrixCodec
from ridetune.gate import SafetyGate
from ridetune.matrix import ControllerMatrix, Ranges, Style, ki_limit
from ridetune.sample import Condition, FeedbackKind

from .sources.seen import Facts

CLEAR_POSITION = 0.65
CONDITION_SHIFT: dict[Condition, float] = {
    "sunny": 0.0,
    "rain": -0.30,
    "fog": -0.35,
    "snow": -0.40,
    "night": -0.25,
}
FEEDBACK_SHIFT: dict[FeedbackKind, float] = {
    "too_aggressive": -0.30,
    "just_right": 0.0,
    "too_conservative": +0.30,
}
# Where it is known: darkness beside another condition, glare, dense traffic, a lead car close by,
# speed.
DARK_SHIFT, GLARE_SHIFT, DENSE_SHIFT, CLOSE_SHIFT, FAST_SHIFT = -0.10, -0.10, -0.08, -0.05, -0.10
FAST_MPS = 25.0
COMMON_SPREAD = 0.06  # one draw for all parameters: people differ
OWN_SPREAD = 0.05  # one draw for each parameter
# W_h carries no style: drawn around this share of its lower..upper.
HEADING_POSITION = 0.4

_MANNER: dict[Style, str] = {
    "aggressive": "i react faster and follow more closely",
    "moderate": "i keep the usual balance",
    "conservative": "i drive more gently and leave more room",
}
_CARE: dict[Condition, str] = {
    "sunny": "",
    "rain": ", a little softer on the wet road",
    "fog": ", with extra care in the fog",
    "snow": ", with much softer inputs on the snow",
    "night": ", more carefully in the dark",
}
_TASTE: dict[FeedbackKind, str] = {
    "too_aggressive": ", calmer than last time",
    "just_right": ", as you liked it last time",
    "too_conservative": ", brisker than last time",
}


class Rules:
    """Labels by rule for one vehicle; the gate accepts each."""

    def __init__(self, ranges: Ranges) -> None:
        self._codec = MatrixCodec(ranges)
        self._gate = SafetyGate(ranges, self._codec)

    def label(
        self, style: Style, facts: Facts, speed_mps: float | None, rng: np.random.Generator
    ) -> ControllerMatrix:
        """A matrix of the style, drawn for what is known of the scene and the speed [m/s]."""
        assert facts.condition is not None, "frames of unknown condition are skipped"
        care = shift_for_care(facts, speed_mps)
        matrix = draw_matrix(style, facts.condition, None, self._codec, rng, care=care)
        verdict = self._gate.judge(matrix, matrix)
        assert verdict.outcome == "accepted", verdict.reasons
        return matrix


def draw_matrix(
    style: Style,
    condition: Condition,
    feedback: FeedbackKind | None,
    codec: MatrixCodec,
    rng: np.random.Generator,
    *,
    care: float = 0.0,
) -> ControllerMatrix:
    """A labelled matrix inside [lower, upper] of the style.

    care: a further shift of the position, as `shift_for_care` has it.
    """
    position = CLEAR_POSITION + CONDITION_SHIFT[condition] + rng.normal(0, COMMON_SPREAD) + care
    if feedback is not None:
        position += FEEDBACK_SHIFT[feedback]
    values = []
    for i, limits in enumerate(codec.ranges.styles[style]):
        place = (HEADING_POSITION if CONSERVATIVE_SIGN[i] == 0 else position) + rng.normal(
            0, OWN_SPREAD
        )
        place = float(np.clip(place, 0.02, 0.98))
        if CONSERVATIVE_SIGN[i] > 0:
            place = 1.0 - place
        low, high = codec.share(limits.lower, i), codec.share(limits.upper, i)
        values.append(codec.value(low + place * (high - low), i))
    values[1] = min(values[1], ki_limit(values[0]))
    return ControllerMatrix.of(values)


def shift_for_care(facts: Facts, speed_mps: float | None) -> float:
    """What a scene asks for beyond its condition: a shift of the position, never above 0."""
    shift = 0.0
    if facts.dark and facts.condition != "night":
        shift += DARK_SHIFT
    if facts.low_sun:
        shift += GLARE_SHIFT
    if facts.traffic == "dense":
        shift += DENSE_SHIFT
    if facts.lead == "near":
        shift += CLOSE_SHIFT
    if speed_mps is not None and speed_mps > FAST_MPS:
        shift += FAST_SHIFT
    return shift


def explain(style: Style, reason: str, condition: Condition, feedback: FeedbackKind | None) -> str:
    """One sentence that says why, in lower case: reason, manner, care, taste."""
    taste = _TASTE[feedback] if feedback is not None else ""
    return f"because {reason}, {_MANNER[style]}{_CARE[condition]}{taste}."
