"""The action codec: bins, expectation over logits, and the text form."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ridetune.codec import NUM_BINS, MatrixCodec
from ridetune.matrix import NUM_PARAMETERS, ControllerMatrix, Ranges

RANGES = Ranges.load(Path(__file__).parents[1] / "configs/ranges.yaml")
CODEC = MatrixCodec(RANGES)
BOUNDS = list(zip(RANGES.lowest, RANGES.highest, strict=True))

matrices = st.tuples(*(st.floats(low, high) for low, high in BOUNDS)).map(ControllerMatrix.of)
bins = st.tuples(*[st.integers(0, NUM_BINS - 1)] * NUM_PARAMETERS)


def _one_hot(levels: tuple[int, ...]) -> NDArray[np.float32]:
    logits = np.zeros((NUM_PARAMETERS, NUM_BINS), np.float32)
    logits[range(NUM_PARAMETERS), levels] = 60
    return logits


@given(matrices)
def test_decoding_an_encoded_matrix_stays_within_half_a_bin(matrix: ControllerMatrix) -> None:
    back = CODEC.decode(CODEC.encode(matrix))
    for i, (value, again) in enumerate(zip(matrix.values, back.values, strict=True)):
        assert abs(CODEC.share(value, i) - CODEC.share(again, i)) <= 0.5 / (NUM_BINS - 1) + 1e-9


@given(bins)
def test_every_bin_survives_the_round_trip(levels: tuple[int, ...]) -> None:
    assert CODEC.encode(CODEC.decode(levels)) == levels


@given(matrices, st.integers(0, NUM_PARAMETERS - 1))
def test_a_larger_value_never_gets_a_lower_bin(matrix: ControllerMatrix, at: int) -> None:
    raised = list(matrix.values)
    raised[at] = RANGES.highest[at]
    assert CODEC.encode(ControllerMatrix.of(raised))[at] >= CODEC.encode(matrix)[at]


def test_first_and_last_bin_are_the_bounds_of_the_envelope() -> None:
    low, high = ControllerMatrix.of(RANGES.lowest), ControllerMatrix.of(RANGES.highest)
    assert CODEC.encode(low) == (0,) * NUM_PARAMETERS
    assert CODEC.encode(high) == (NUM_BINS - 1,) * NUM_PARAMETERS
    assert CODEC.decode([0] * NUM_PARAMETERS).values == pytest.approx(low.values, abs=1e-12)
    assert CODEC.decode([NUM_BINS - 1] * NUM_PARAMETERS).values == pytest.approx(high.values)


@given(st.tuples(*[st.floats(-1000, 1000)] * NUM_PARAMETERS))
def test_decoding_never_leaves_the_envelope(levels: tuple[float, ...]) -> None:
    for value, (low, high) in zip(CODEC.decode(levels).values, BOUNDS, strict=True):
        assert low <= value <= high


@pytest.mark.parametrize("wrong", [float("nan"), float("inf"), -float("inf"), -0.01, 1e9])
@pytest.mark.parametrize("at", range(NUM_PARAMETERS))
def test_a_value_outside_the_envelope_is_refused(wrong: float, at: int) -> None:
    values = list(RANGES.default.values)
    values[at] = wrong
    with pytest.raises(ValueError, match="lies outside"):
        CODEC.encode(ControllerMatrix.of(values))


def test_another_number_of_bins_is_refused() -> None:
    with pytest.raises(ValueError, match="expected 6 bins, got 5"):
        CODEC.decode([0] * 5)


@given(bins)
def test_expect_returns_the_level_of_a_certain_model(levels: tuple[int, ...]) -> None:
    matrix, confidence = CODEC.expect(_one_hot(levels))
    assert CODEC.encode(matrix) == levels
    assert min(confidence) == pytest.approx(1.0)


def test_expect_takes_the_likelier_of_two_styles_and_nothing_between() -> None:
    logits = np.full((NUM_PARAMETERS, NUM_BINS), -60, np.float32)
    logits[:, 40], logits[:, 200] = np.log(0.6), np.log(0.4)
    matrix, confidence = CODEC.expect(logits)
    assert CODEC.encode(matrix) == (40,) * NUM_PARAMETERS
    assert confidence == pytest.approx([0.6] * NUM_PARAMETERS, abs=1e-3)


def test_expect_has_little_confidence_in_uniform_logits() -> None:
    _, confidence = CODEC.expect(np.zeros((NUM_PARAMETERS, NUM_BINS), np.float32))
    assert max(confidence) < 0.25


def test_logits_with_nan_give_no_plausible_value_and_no_confidence() -> None:
    logits = _one_hot((100,) * NUM_PARAMETERS)
    logits[2, 7] = np.nan
    matrix, confidence = CODEC.expect(logits)
    assert np.isnan(matrix.kd)
    assert confidence[2] == 0.0
    with pytest.raises(ValueError, match="K_d = nan"):
        CODEC.encode(matrix)


@given(matrices)
def test_text_round_trip_stays_within_the_rounding(matrix: ControllerMatrix) -> None:
    parsed = CODEC.parse(CODEC.text(matrix))
    assert parsed is not None
    for value, again in zip(matrix.values, parsed.values, strict=True):
        assert abs(value - again) <= (0.5e-4 if value < 9.9999 else 1.1e-3) + 1e-9


@given(matrices)
def test_text_has_a_fixed_width_of_six_characters_a_value(matrix: ControllerMatrix) -> None:
    text = CODEC.text(matrix)
    assert [len(n) for n in text.replace("[", "").replace("]", "").split(", ")] == [6] * 6


def test_parse_finds_the_matrix_inside_a_sentence_with_odd_spaces() -> None:
    said = "sure: [ [0.35 , 0.0050,0.080],\n [0.1600, 1.0000, 0.3500] ] because of the rain."
    assert CODEC.parse(said.replace("0.35 ", "0.350 ")) == ControllerMatrix(
        0.35, 0.005, 0.08, 0.16, 1.0, 0.35
    )


@pytest.mark.parametrize(
    "garbage",
    [
        "",
        "drive well",
        "[[0.3500, 0.0050, 0.0800], [0.1600, 1.0000]]",
        "[[0.3500, 0.0050, 0.0800, 0.1600, 1.0000, 0.3500]]",
        "[[nan, 0.0050, 0.0800], [0.1600, 1.0000, 0.3500]]",
        "[[-0.3500, 0.0050, 0.0800], [0.1600, 1.0000, 0.3500]]",
        "[[1e5000, 0.0050, 0.0800], [0.1600, 1.0000, 0.3500]]",
        "[[0.3500, 0.0050, 0.0800], [0.1600, 1.0000, 0.3500",
    ],
)
def test_parse_of_another_format_is_none(garbage: str) -> None:
    assert CODEC.parse(garbage) is None


@given(st.text() | st.text(alphabet="[]., 0123456789\n"))
def test_parse_never_raises(text: str) -> None:
    parsed = CODEC.parse(text)
    assert parsed is None or all(np.isfinite(parsed.values))
