"""The fused operators of ONNX Runtime that the graphs are made of, as torch modules.

They run in no torch process, only in the exported graph: torch sees their shapes. A plain export
of the same sums has four times as many nodes and is slower.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ridetune.gemm import BITS, PackedLinear, unpack

_OPS: Any = torch.onnx.ops


class Int4Linear(nn.Module):
    """x W^T + b with the checkpoint's levels, zeros and scales, bit for bit (MatMulNBits).

    levels [out, groups, group / 2] and zeros [out, groups / 2] hold two nibbles a byte.
    """

    levels: Tensor
    scales: Tensor
    zeros: Tensor

    def __init__(self, packed: PackedLinear, bias: Tensor | None) -> None:
        super().__init__()
        grouped = unpack(packed)
        num_outputs, num_inputs = grouped.levels.shape
        group = packed.group_size
        zeros = grouped.zeros
        if zeros.shape[1] % 2:  # the operator reads whole bytes
            zeros = np.pad(zeros, ((0, 0), (0, 1)))
        levels = _two_a_byte(grouped.levels).reshape(num_outputs, -1, group // 2)
        self.register_buffer("levels", torch.from_numpy(levels))
        self.register_buffer("scales", torch.from_numpy(grouped.scales.astype(np.float32)))
        self.register_buffer("zeros", torch.from_numpy(_two_a_byte(zeros)))
        self.bias = bias
        self.num_outputs = num_outputs
        self.attributes = {
            "K": num_inputs,
            "N": num_outputs,
            "bits": BITS,
            "block_size": group,
            "accuracy_level": 0,
        }

    def forward(self, x: Tensor) -> Tensor:
        """[..., in] -> [..., out]."""
        inputs = (x, self.levels, self.scales, self.zeros)
        shape = (*x.shape[:-1], self.num_outputs)
        y = _operator("com.microsoft::MatMulNBits", inputs, self.attributes, shape)
        return y if self.bias is None else y + self.bias


class RmsNorm(nn.Module):
    """x / sqrt(mean(x^2) + eps) * weight over the last axis."""

    def __init__(self, norm: Any) -> None:
        super().__init__()
        self.weight = norm.weight
        self.epsilon = norm.variance_epsilon

    def forward(self, x: Tensor) -> Tensor:
        """[..., width] -> [..., width]."""
        attributes = {"axis": -1, "epsilon": self.epsilon, "stash_type": 1}
        inputs = (x, self.weight)
        return _operator("SimplifiedLayerNormalization", inputs, attributes, x.shape)


def attend_causally(
    q: Tensor, k: Tensor, v: Tensor, past: tuple[Tensor, Tensor], *, heads: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Attention of S new tokens on P past ones and, causally, on themselves.

    q [1, S, heads * head_dim], k and v [1, S, kv_heads * head_dim], past key and value
    [1, kv_heads, P, head_dim] -> mixed values like q, keys and values of all P + S tokens.
    """
    _, kv_heads, num_past, head_dim = past[0].shape
    whole = num_past + q.shape[1]
    last = torch.full((1,), whole - 1, dtype=torch.int32)
    total = torch.full((1,), whole, dtype=torch.int32)
    longer = (1, kv_heads, whole, head_dim)
    found: Sequence[Tensor] = _OPS.symbolic_multi_out(
        "com.microsoft::GroupQueryAttention",
        (q, k, v, *past, last, total),
        attrs={"num_heads": heads, "kv_num_heads": kv_heads},
        dtypes=(q.dtype,) * 3,
        shapes=(q.shape, longer, longer),
        version=1,
    )
    mixed, keys, values = found
    return mixed, keys, values


def attend_freely(q: Tensor, k: Tensor, v: Tensor, *, heads: int) -> Tensor:
    """Attention of all tokens on all; [1, S, heads * head_dim] each."""
    attributes = {"num_heads": heads}
    return _operator("com.microsoft::MultiHeadAttention", (q, k, v), attributes, q.shape)


def rotate(x: Tensor, cos: Tensor, sin: Tensor, heads: int) -> Tensor:
    """Turn the halves of each head of [1, S, heads * head_dim] by angles [S, head_dim / 2]."""
    order = torch.arange(x.shape[1])[None]
    attributes = {"num_heads": heads, "interleaved": 0}
    return _operator("com.microsoft::RotaryEmbedding", (x, order, cos, sin), attributes, x.shape)


def _operator(
    name: str, inputs: Sequence[Tensor], attributes: Mapping[str, Any], shape: Sequence[int]
) -> Tensor:
    found: Tensor = _OPS.symbolic(
        name, inputs, attrs=attributes, dtype=inputs[0].dtype, shape=shape, version=1
    )
    return found


def _two_a_byte(nibbles: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[rows, n] in 0..15 -> [rows, n / 2], the first of two in the low half."""
    return np.asarray(nibbles[:, 0::2] | nibbles[:, 1::2] << 4, np.uint8)
