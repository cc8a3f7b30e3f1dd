"""Qwen3-VL as two torch modules that export to ONNX, for one camera grid.

    VisionGraph     patches [num_patches, 3 * t * p * p] -> wide tokens [tokens, (1 + n) * H]
    DecoderGraph    wide [1, S, (1 + n) * H], cos, sin [S, head_dim / 2], wanted [W],
                    past key and value of each layer [1, kv_heads, P, head_dim]
                    -> hidden states [1, W, H] of the wanted tokens, longer keys and values

DeepStack travels in the width: slice i + 1 of a token is added after layer i, zero for text. Only
the wanted tokens pass through the rest of the last layer: a prefill needs keys and values alone.
The modules hold fused operators (`quantize.operators`) that run only in the exported graph, so
parity with torch is checked there (`quantize.parity`).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from transformers.vision_utils import (
    get_vision_interpolation_indices_and_weights,
    get_vision_position_ids,
)

from ridetune.bundle import ModelShape
from ridetune.gemm import PackedLinear
from ridetune.qwen import core
from ridetune.vision import VisionSpec

from .operators import Int4Linear, RmsNorm, attend_causally, attend_freely, rotate


class DecoderLayer(nn.Module):
    """One layer of the language model; linears that are in `packed` become Int4Linear."""

    def __init__(self, layer: Any, shape: ModelShape, packed: Mapping[str, PackedLinear]) -> None:
        super().__init__()

        def linear(name: str) -> nn.Module:
            found = packed.get(name)
            whole: nn.Linear = layer.get_submodule(name)
            return whole if found is None else Int4Linear(found, whole.bias)

        self.before_attention = RmsNorm(layer.input_layernorm)
        self.before_mlp = RmsNorm(layer.post_attention_layernorm)
        self.query_norm = RmsNorm(layer.self_attn.q_norm)
        self.key_norm = RmsNorm(layer.self_attn.k_norm)
        self.query = linear("self_attn.q_proj")
        self.key = linear("self_attn.k_proj")
        self.value = linear("self_attn.v_proj")
        self.out = linear("self_attn.o_proj")
        self.gate = linear("mlp.gate_proj")
        self.up = linear("mlp.up_proj")
        self.down = linear("mlp.down_proj")
        self.head_dim, self.kv_heads = shape.head_dim, shape.kv_heads
        self.heads: int = layer.self_attn.config.num_attention_heads

    def forward(
        self,
        x: Tensor,
        cos: Tensor,
        sin: Tensor,
        past: tuple[Tensor, Tensor],
        wanted: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Tokens [1, S, H] -> tokens [1, S or W, H], keys and values [1, kv_heads, P + S, dim]."""
        length = x.shape[1]
        h = self.before_attention(x)
        q = self.query_norm(self.query(h).view(1, length, self.heads, self.head_dim))
        k = self.key_norm(self.key(h).view(1, length, self.kv_heads, self.head_dim))
        q, k = (
            rotate(q.flatten(2), cos, sin, self.heads),
            rotate(k.flatten(2), cos, sin, self.kv_heads),
        )
        mixed, keys, values = attend_causally(q, k, self.value(h), past, heads=self.heads)
        if wanted is not None:
            x, mixed = x[:, wanted], mixed[:, wanted]
        x = x + self.out(mixed)
        h = self.before_mlp(x)
        x = x + self.down(nn.functional.silu(self.gate(h)) * self.up(h))
        return x, keys, values


class DecoderGraph(nn.Module):
    """The language model without embedding and head."""

    def __init__(self, model: Any, shape: ModelShape, packed: Mapping[str, PackedLinear]) -> None:
        super().__init__()
        text = core(model).language_model
        self.hidden, self.num_deepstack = shape.hidden, shape.num_deepstack
        self.layers = nn.ModuleList(
            DecoderLayer(layer, shape, _below(packed, f"model.language_model.layers.{number}."))
            for number, layer in enumerate(text.layers)
        )
        self.norm = RmsNorm(text.norm)

    def forward(
        self, wide: Tensor, cos: Tensor, sin: Tensor, wanted: Tensor, past: Sequence[Tensor]
    ) -> tuple[Tensor, ...]:
        """See the module docstring; past holds key and value of each layer in turn."""
        slices = torch.split(wide, self.hidden, dim=-1)
        x, present = slices[0], []
        for number, layer in enumerate(self.layers):
            is_last = number == len(self.layers) - 1
            pair = (past[2 * number], past[2 * number + 1])
            x, keys, values = layer(x, cos, sin, pair, wanted if is_last else None)
            present += [keys, values]
            if number < self.num_deepstack:
                x = x + (slices[number + 1][:, wanted] if is_last else slices[number + 1])
        return (self.norm(x), *present)


class VisionGraph(nn.Module):
    """The vision tower on one grid: positions and rotary angles are constants."""

    places: Tensor
    cos: Tensor
    sin: Tensor

    def __init__(self, model: Any, spec: VisionSpec) -> None:
        super().__init__()
        visual = core(model).visual
        grid = torch.tensor([spec.grid_thw])
        convolution = visual.patch_embed.proj  # kernel = stride: a matrix product
        self.patch_weight = nn.Parameter(convolution.weight.flatten(1), requires_grad=False)
        places = _position_embeddings(visual, grid)  # [num_patches, width]
        self.register_buffer("places", (places + convolution.bias).detach())
        ids = get_vision_position_ids(grid, visual.spatial_merge_size)
        cos, sin = visual.rotary_pos_emb(places, ids)
        half = cos.shape[-1] // 2
        self.register_buffer("cos", cos[:, :half].contiguous())
        self.register_buffer("sin", sin[:, :half].contiguous())
        self.blocks, self.merger = visual.blocks, visual.merger
        self.deepstack = visual.deepstack_merger_list
        self.taken_after = list(visual.deepstack_visual_indexes)
        self.heads: int = visual.config.num_heads

    def forward(self, patches: Tensor) -> Tensor:
        """Patches [num_patches, 3 * t * p * p] -> wide visual tokens [tokens, (1 + n) * H]."""
        x = patches @ self.patch_weight.T + self.places
        taken = []
        for number, block in enumerate(self.blocks):
            x = x + self._attend(block.attn, block.norm1(x))
            x = x + block.mlp(block.norm2(x))
            if number in self.taken_after:
                taken.append(self.deepstack[self.taken_after.index(number)](x))
        return torch.cat([self.merger(x), *taken], dim=-1)

    def _attend(self, attention: Any, x: Tensor) -> Tensor:
        """Every patch attends to every patch: one image, no windows."""
        q, k, v = attention.qkv(x)[None].chunk(3, dim=-1)
        q, k = (rotate(each, self.cos, self.sin, self.heads) for each in (q, k))
        mixed = attend_freely(q, k, v, heads=self.heads)
        out: Tensor = attention.proj(mixed[0])
        return out


def _position_embeddings(visual: Any, grid: Tensor) -> Tensor:
    """The learned position grid resampled to the camera's, as the tower's forward does it."""
    indices, weights = get_vision_interpolation_indices_and_weights(
        grid,
        num_grid_per_side=visual.num_grid_per_side,
        mode=visual.interpolation_mode,
        align_corners=visual.interpolation_align_corners,
        spatial_merge_size=visual.spatial_merge_size,
    )
    places: Tensor = (visual.pos_embed(indices) * weights[:, :, None]).sum(1)
    return places.detach()


def _below(packed: Mapping[str, PackedLinear], prefix: str) -> dict[str, PackedLinear]:
    return {k.removeprefix(prefix): v for k, v in packed.items() if k.startswith(prefix)}
