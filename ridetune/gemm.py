"""The AutoAWQ `gemm` layout of 4-bit weights: eight nibbles to an int32 word, and back, exactly.

    qweight [in, out / 8]          int32   the levels, transposed
    qzeros  [in / group, out / 8]  int32   the zero points
    scales  [in / group, out]      float16

    weight[o, i] = (level[o, i] - zero[o, i // group]) * scale[o, i // group]

Nibble i (from the low end) of word j holds output column 8 j + NIBBLE_COLUMNS[i]. This is the
layout that vLLM, SGLang, LMDeploy and the ONNX builders read. Plain numpy: the exporter, the
evaluation and the quantizer share it without torch.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BITS = 4
MAX_LEVEL = 2**BITS - 1
PER_WORD = 32 // BITS
NIBBLE_COLUMNS = (0, 2, 4, 6, 1, 3, 5, 7)


@dataclass(frozen=True)
class PackedLinear:
    """One linear layer as the checkpoint file holds it; shapes as in the module docstring."""

    qweight: NDArray[np.int32]
    qzeros: NDArray[np.int32]
    scales: NDArray[np.float16]

    @property
    def group_size(self) -> int:
        """Input channels that share one scale and zero point."""
        return int(self.qweight.shape[0] // self.scales.shape[0])


@dataclass(frozen=True)
class GroupedLevels:
    """One linear layer unpacked: levels [out, in], zeros and scales [out, in / group]."""

    levels: NDArray[np.uint8]
    zeros: NDArray[np.uint8]
    scales: NDArray[np.float16]

    def dequantize(self) -> NDArray[np.float32]:
        """The weight [out, in] in float32."""
        group = self.levels.shape[1] // self.zeros.shape[1]
        steps = self.levels.astype(np.float32)
        steps -= np.repeat(self.zeros, group, axis=1)
        steps *= np.repeat(self.scales, group, axis=1)
        return steps


def pack(grouped: GroupedLevels) -> PackedLinear:
    """Levels, zeros and scales -> the layout on disk; ValueError where it cannot hold them."""
    num_outputs, num_inputs = grouped.levels.shape
    num_groups = grouped.zeros.shape[1]
    if num_outputs % PER_WORD or num_inputs % num_groups:
        raise ValueError(
            f"a weight of {num_outputs} x {num_inputs} in {num_groups} groups does not fit the "
            f"gemm layout: outputs must divide by {PER_WORD} and inputs by the group"
        )
    return PackedLinear(
        qweight=_pack_columns(grouped.levels.T),
        qzeros=_pack_columns(grouped.zeros.T),
        scales=np.ascontiguousarray(grouped.scales.T),
    )


def unpack(packed: PackedLinear) -> GroupedLevels:
    """The inverse of `pack`, bit for bit."""
    return GroupedLevels(
        levels=np.ascontiguousarray(_unpack_columns(packed.qweight).T),
        zeros=np.ascontiguousarray(_unpack_columns(packed.qzeros).T),
        scales=np.ascontiguousarray(packed.scales.T),
    )


def _pack_columns(levels: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Levels [row, column] in [0, 15] -> words [row, column / 8]."""
    assert levels.size == 0 or int(levels.max()) <= MAX_LEVEL, "a level needs more than four bits"
    rows, columns = levels.shape
    byword = levels.reshape(rows, columns // PER_WORD, PER_WORD)
    words = np.zeros(byword.shape[:2], np.uint32)
    for nibble, column in enumerate(NIBBLE_COLUMNS):
        words |= byword[:, :, column].astype(np.uint32) << np.uint32(BITS * nibble)
    return words.view(np.int32)


def _unpack_columns(words: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Words [row, column / 8] -> levels [row, column]."""
    unsigned = np.ascontiguousarray(words).view(np.uint32)
    levels = np.empty((*unsigned.shape, PER_WORD), np.uint8)
    for nibble, column in enumerate(NIBBLE_COLUMNS):
        levels[:, :, column] = (unsigned >> np.uint32(BITS * nibble)) & np.uint32(MAX_LEVEL)
    return levels.reshape(unsigned.shape[0], -1)
