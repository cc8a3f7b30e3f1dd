"""The AutoAWQ gemm layout: nibble order, exact round trip, dequantization."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ridetune.gemm import NIBBLE_COLUMNS, GroupedLevels, pack, unpack


def _random(words: int, groups: int, group: int, seed: int) -> GroupedLevels:
    rng = np.random.default_rng(seed)
    outputs = 8 * words
    return GroupedLevels(
        levels=rng.integers(0, 16, (outputs, groups * group), np.uint8),
        zeros=rng.integers(0, 16, (outputs, groups), np.uint8),
        scales=rng.uniform(1e-4, 1, (outputs, groups)).astype(np.float16),
    )


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 4), st.integers(1, 3), st.sampled_from([8, 32, 128]), st.integers(0, 99))
def test_unpack_inverts_pack_bit_for_bit(words: int, groups: int, group: int, seed: int) -> None:
    grouped = _random(words, groups, group, seed)
    packed = pack(grouped)
    assert packed.qweight.shape == (groups * group, words)
    assert packed.qzeros.shape == (groups, words)
    assert packed.scales.shape == (groups, 8 * words)
    assert packed.group_size == group
    back = unpack(packed)
    for name in ("levels", "zeros", "scales"):
        found, expected = getattr(back, name), getattr(grouped, name)
        assert found.dtype == expected.dtype
        assert np.array_equal(found, expected)


def test_nibble_i_holds_the_column_that_the_layout_names() -> None:
    for nibble, column in enumerate(NIBBLE_COLUMNS):
        levels = np.zeros((8, 8), np.uint8)
        levels[column] = 15
        word = pack(GroupedLevels(levels, np.zeros((8, 1), np.uint8), np.ones((8, 1), np.float16)))
        assert np.all(word.qweight.view(np.uint32) == 15 << 4 * nibble)


def test_dequantize_takes_the_zero_and_the_scale_of_the_group() -> None:
    grouped = _random(words=1, groups=2, group=8, seed=3)
    weight = grouped.dequantize()
    assert weight.dtype == np.float32
    for o, i in ((0, 0), (3, 7), (5, 8), (7, 15)):
        step = int(grouped.levels[o, i]) - int(grouped.zeros[o, i // 8])
        assert weight[o, i] == np.float32(step) * np.float32(grouped.scales[o, i // 8])


def test_pack_refuses_outputs_that_do_not_fill_a_word() -> None:
    odd = GroupedLevels(
        np.zeros((12, 8), np.uint8), np.zeros((12, 1), np.uint8), np.ones((12, 1), np.float16)
    )
    with pytest.raises(ValueError, match="12 x 8"):
        pack(odd)
