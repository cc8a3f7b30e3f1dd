"""Command alignment (Eq. 7) and scenario alignment: golden values and controls."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from data.annotate import draw_matrix
from ridetune.alignment import (
    CONSERVATIVE_SIGN,
    command_alignment,
    conservativeness,
    scenario_alignment,
    style_of,
)
from ridetune.codec import MatrixCodec
from ridetune.matrix import NUM_PARAMETERS, STYLES, ControllerMatrix, Ranges, Style
from ridetune.sample import ADVERSE

# Full score in every parameter of the moderate style.
MODERATE = ControllerMatrix(0.4, 0.004, 0.08, 0.15, 1.0, 0.4)


@pytest.mark.parametrize(
    ("kp", "score"),
    [
        (0.25, 100.0),  # lower, inclusive
        (0.50, 100.0),  # upper, inclusive
        (0.20, 50.0),  # half way from minimum 0.15 to lower 0.25
        (0.725, 25.0),  # three quarters from upper 0.50 to maximum 0.80
        (0.15, 0.0),
        (0.80, 0.0),
        (0.01, 0.0),
        (9.0, 0.0),
        (float("nan"), 0.0),
    ],
)
def test_each_parameter_counts_a_sixth_of_its_trapezoid(
    kp: float, score: float, ranges: Ranges
) -> None:
    found = command_alignment(replace(MODERATE, kp=kp), "moderate", ranges)
    assert found == pytest.approx((500 + score) / 6)


def test_a_lower_limit_equal_to_the_minimum_scores_full_at_the_minimum(ranges: Ranges) -> None:
    assert command_alignment(replace(MODERATE, wh=0.0), "moderate", ranges) == 100.0


@pytest.mark.parametrize("style", STYLES)
def test_the_middle_of_a_style_scores_full_and_is_recognised(style: Style, ranges: Ranges) -> None:
    middle = ControllerMatrix.of([(r.lower + r.upper) / 2 for r in ranges.styles[style]])
    assert command_alignment(middle, style, ranges) == 100.0
    assert style_of(middle, ranges) == style


def test_a_tie_between_styles_goes_to_the_more_conservative(ranges: Ranges) -> None:
    nowhere = ControllerMatrix.of([1e6] * NUM_PARAMETERS)
    assert style_of(nowhere, ranges) == "conservative"


def _mean_over_styles(ranges: Ranges, answer: Callable[[Style], ControllerMatrix]) -> float:
    return float(np.mean([command_alignment(answer(style), style, ranges) for style in STYLES]))


def test_controls_that_ignore_the_words_score_far_below_the_oracle(
    ranges: Ranges, codec: MatrixCodec
) -> None:
    rng = np.random.default_rng(0)

    def anywhere(_: Style) -> ControllerMatrix:
        return ControllerMatrix.of([codec.value(rng.random(), i) for i in range(NUM_PARAMETERS)])

    def labelled(style: Style) -> ControllerMatrix:
        return draw_matrix(style, "sunny", None, codec, rng)

    oracle = np.mean([_mean_over_styles(ranges, labelled) for _ in range(200)])
    shuffled = np.mean(
        [
            command_alignment(labelled(other), style, ranges)
            for style in STYLES
            for other in STYLES
            if other != style
            for _ in range(100)
        ]
    )
    assert oracle == pytest.approx(100.0)
    assert _mean_over_styles(ranges, lambda _: ranges.default) < 75
    assert np.mean([_mean_over_styles(ranges, anywhere) for _ in range(300)]) < 60
    assert shuffled < 60


def test_conservativeness_follows_the_sign_of_each_parameter(codec: MatrixCodec) -> None:
    for i, sign in enumerate(CONSERVATIVE_SIGN):
        low, high = list(MODERATE.values), list(MODERATE.values)
        low[i], high[i] = codec.ranges.lowest[i], codec.ranges.highest[i]
        rise = conservativeness(ControllerMatrix.of(high), codec) - conservativeness(
            ControllerMatrix.of(low), codec
        )
        assert np.sign(rise) == sign


def test_scenario_alignment_of_equal_matrices_is_zero(codec: MatrixCodec) -> None:
    assert scenario_alignment([(MODERATE, MODERATE)] * 5, codec) == 0.0


def test_scenario_alignment_counts_the_pairs_that_grow_more_conservative(
    codec: MatrixCodec,
) -> None:
    gentler = replace(MODERATE, kp=0.3, ws=0.5)
    pairs = [(MODERATE, gentler), (gentler, MODERATE), (MODERATE, MODERATE), (MODERATE, gentler)]
    assert scenario_alignment(pairs, codec) == 0.5


def test_a_step_smaller_than_half_a_bin_is_no_success(codec: MatrixCodec) -> None:
    bins: NDArray[np.float64] = np.asarray(codec.encode(MODERATE), np.float64)
    clear = codec.decode(list(bins))
    assert (
        scenario_alignment([(clear, codec.decode(list(bins - [0.2, 0, 0, 0, 0, 0])))], codec) == 0
    )


def test_labels_of_adverse_scenes_score_high_and_random_ones_near_half(codec: MatrixCodec) -> None:
    rng = np.random.default_rng(1)
    drawn = [
        (draw_matrix(s, "sunny", None, codec, rng), draw_matrix(s, c, None, codec, rng))
        for s in STYLES
        for c in ADVERSE
        for _ in range(50)
    ]
    assert scenario_alignment(drawn, codec) > 0.95
    clear = [a for a, _ in drawn]
    again = [clear[int(rng.integers(len(clear)))] for _ in clear]
    assert 0.35 < scenario_alignment(list(zip(clear, again, strict=True)), codec) < 0.65
