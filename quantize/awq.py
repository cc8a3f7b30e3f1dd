"""Activation-aware weight quantization (AWQ, Lin et al. 2023) of the language model's layers.

Rounding hurts most in the few input channels that carry large activations. A channel's weights
are multiplied by s >= 1 before rounding, and what feeds the channel is divided by s: exact in the
unrounded model, a finer grid for that channel in the rounded one (Eq. 2, 4, 5):

    s*  = argmin_s || Q(W diag(s)) diag(s)^-1 X - W X ||        s -> scales [in]
    s   = mean|X|^r / mean|W|^(1 - r),  r in {0, 1/n, ...}      r -> exponent

The division is folded into the norm before q, k, v and before gate, up, and into the rows of
up_proj before down. v -> o is left out: under grouped-query attention v has fewer rows than o
has columns. No model is changed here: a layer goes in, new tensors come out.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ridetune.gemm import MAX_LEVEL, PER_WORD, GroupedLevels

from .calibration import Activations

_ATTENTION = ("self_attn.q_proj", "self_attn.k_proj", "self_attn.v_proj")
LINEARS = (*_ATTENTION, "self_attn.o_proj", "mlp.gate_proj", "mlp.up_proj", "mlp.down_proj")
_INPUT_OF = {  # the recorded linear that has the same input
    **dict.fromkeys(_ATTENTION, "self_attn.q_proj"),
    "self_attn.o_proj": "self_attn.o_proj",
    "mlp.gate_proj": "mlp.gate_proj",
    "mlp.up_proj": "mlp.gate_proj",
    "mlp.down_proj": "mlp.down_proj",
}
# Clipping q and k disturbs their products, where errors multiply (as in the paper's code).
_CLIPPED = tuple(name for name in LINEARS if name not in _ATTENTION[:2])
_SHRINKS = tuple(1 - 0.05 * step for step in range(11))  # of a group's range: 1 ... 0.5
_SMALLEST_SCALE = 1e-6  # float16 is subnormal below 6e-5; here its step is still 6 %


@dataclass(frozen=True)
class Job:
    """One search: the scales of `linears`, which share an input, are folded into `source`."""

    name: str
    source: str
    linears: tuple[str, ...]


JOBS = (
    Job("norm -> q, k, v", "input_layernorm", _ATTENTION),
    Job("norm -> gate, up", "post_attention_layernorm", ("mlp.gate_proj", "mlp.up_proj")),
    Job("up -> down", "mlp.up_proj", ("mlp.down_proj",)),
)


@dataclass(frozen=True)
class Search:
    """What a job found: the relative output errors summed over its linears, before and after.

    exponent is r, or None where no scaling was best.
    """

    scales: Tensor
    exponent: float | None
    error_rounded: float
    error_scaled: float


@dataclass(frozen=True)
class Grouped:
    """A weight rounded in groups: levels [out, groups, group], zeros and scales [out, groups, 1].

    scales are float16 values held in float32.
    """

    levels: Tensor
    zeros: Tensor
    scales: Tensor

    def dequantize(self) -> Tensor:
        """The rounded weight [out, in]."""
        return ((self.levels - self.zeros) * self.scales).flatten(1)

    def as_levels(self) -> GroupedLevels:
        """The same as numpy arrays, for the packer."""
        return GroupedLevels(
            levels=self.levels.flatten(1).to("cpu", torch.uint8).numpy(),
            zeros=self.zeros[..., 0].to("cpu", torch.uint8).numpy(),
            scales=self.scales[..., 0].to("cpu", torch.float16).numpy(),
        )


def check_layer(layer: Any, group_size: int) -> None:
    """ValueError unless a layer has the seven linears and they divide into groups and words."""
    modules = dict(layer.named_modules())
    for name in LINEARS:
        if name not in modules:
            raise ValueError(f"a layer without {name}: only dense Qwen-VL models can be quantized")
        num_outputs, num_inputs = modules[name].weight.shape
        if num_inputs % group_size or num_outputs % PER_WORD:
            raise ValueError(
                f"{name} is {num_outputs} x {num_inputs}: inputs must divide by group_size "
                f"{group_size} and outputs by {PER_WORD}; choose a smaller group_size"
            )


def round_groups(weight: Tensor, group_size: int, shrink: Tensor | float = 1.0) -> Grouped:
    """Asymmetric 4-bit rounding of a weight [out, in] in groups along its inputs.

    shrink: share of each group's range that the grid spans, one or [out, groups, 1]. The range
    always includes zero, so that the zero point fits into four bits.
    """
    groups = weight.float().reshape(weight.shape[0], -1, group_size)
    low = groups.amin(2, keepdim=True).clamp(max=0) * shrink
    high = groups.amax(2, keepdim=True).clamp(min=0) * shrink
    scales = ((high - low) / MAX_LEVEL).clamp(min=_SMALLEST_SCALE)
    scales = scales.to(torch.float16).float()  # first, so that the levels fit the stored scale
    zeros = (-low / scales).round().clamp(0, MAX_LEVEL)
    levels = (groups / scales).round().add(zeros).clamp(0, MAX_LEVEL)
    return Grouped(levels, zeros, scales)


def search_scales(
    weights: list[Tensor], activations: Activations, *, group_size: int, num_exponents: int
) -> Search:
    """Find the scales [in] of linear layers [out, in] that share one input.

    No scaling at all is a candidate too: r = 0 is not the identity in the formula.
    """
    tokens = activations.tokens.to(weights[0].device, torch.float32)
    mean_abs = activations.mean_abs.to(tokens.device).clamp(min=1e-4)
    salience = _weight_salience(weights, group_size)
    energies = [(tokens @ weight.T).square().sum() for weight in weights]

    def error(scales: Tensor) -> float:
        total = 0.0
        for weight, energy in zip(weights, energies, strict=True):
            change = round_groups(weight * scales, group_size).dequantize() / scales - weight
            total += float((tokens @ change.T).square().sum() / energy.clamp(min=1e-12))
        return total

    ones = torch.ones_like(mean_abs)
    rounded = error(ones)
    best = Search(ones, None, rounded, rounded)
    for step in range(num_exponents):
        r = step / num_exponents
        scales = (mean_abs**r / salience ** (1 - r)).clamp(min=1e-4)
        scales = scales / (scales.max() * scales.min()).sqrt()
        found = error(scales)
        if found < best.error_scaled:
            best = Search(scales, r, rounded, found)
    return best


def fold(layer: Any, searches: dict[str, Search]) -> dict[str, Tensor]:
    """A layer's tensors in float32 with the scales of each job folded in; the layer is unchanged.

    searches: by the name of the job's source; a job left out is not scaled.
    """
    tensors = {
        name: parameter.detach().float()
        for name, parameter in layer.named_parameters()
        if name.rpartition(".")[0] in (*LINEARS, *(job.source for job in JOBS))
    }
    for job in JOBS:
        if job.source not in searches:
            continue
        scales = searches[job.source].scales
        for name in job.linears:
            tensors[f"{name}.weight"] = tensors[f"{name}.weight"] * scales
        for part in ("weight", "bias"):
            key = f"{job.source}.{part}"
            if key in tensors:  # a norm [in], a bias [out], or the rows of up_proj [out, in]
                shape = (-1, 1) if tensors[key].ndim == 2 else (-1,)
                tensors[key] = tensors[key] / scales.view(shape)
    return tensors


def search_clip(weight: Tensor, tokens: Tensor, group_size: int) -> Tensor:
    """Share of each group's range to keep [out, groups, 1], by the group's own output error.

    weight: [out, in] after folding; tokens: [n, in] divided by the same scales.
    """
    x = tokens.reshape(tokens.shape[0], -1, group_size)  # [n, group, channel]
    gram = torch.einsum("ngi,ngj->gij", x, x)
    groups = weight.reshape(weight.shape[0], -1, group_size)
    least = torch.full(groups.shape[:2], torch.inf, device=weight.device)
    best = torch.ones_like(least)
    for shrink in _SHRINKS:
        change = round_groups(weight, group_size, shrink).dequantize().view_as(groups) - groups
        error = (torch.einsum("ogi,gij->ogj", change, gram) * change).sum(2)
        better = error < least
        least, best = torch.where(better, error, least), best.masked_fill(better, shrink)
    return best[..., None]


def round_layer(
    layer: Any,
    seen: dict[str, Activations] | None,
    *,
    group_size: int,
    num_exponents: int,
    clip: bool,
) -> tuple[dict[str, Grouped], dict[str, Tensor], dict[str, Search]]:
    """Quantize one layer: rounded linears by name, the other tensors by key, and the searches.

    seen: recorded inputs, or None for plain rounding to nearest. The other tensors are norms
    with scales folded in and biases, float32.
    """
    searches = {}
    for job in JOBS if seen is not None else ():
        assert seen is not None
        weights = [layer.get_submodule(name).weight.detach().float() for name in job.linears]
        searches[job.source] = search_scales(
            weights,
            seen[_INPUT_OF[job.linears[0]]],
            group_size=group_size,
            num_exponents=num_exponents,
        )
    tensors = fold(layer, searches)
    rounded = {}
    for name in LINEARS:
        weight = tensors.pop(f"{name}.weight")
        shrink: Tensor | float = 1.0
        if clip and seen is not None and name in _CLIPPED:
            tokens = _scaled_tokens(name, seen, searches).to(weight.device)
            shrink = search_clip(weight, tokens, group_size)
        rounded[name] = round_groups(weight, group_size, shrink)
    return rounded, tensors, searches


def _scaled_tokens(name: str, seen: dict[str, Activations], searches: dict[str, Search]) -> Tensor:
    tokens = seen[_INPUT_OF[name]].tokens.float()
    for job in JOBS:
        if name in job.linears:
            return tokens / searches[job.source].scales.to(tokens.device)
    return tokens


def _weight_salience(weights: list[Tensor], group_size: int) -> Tensor:
    """Mean over all rows of |w| relative to the largest of its group [in]."""
    rows = torch.cat(weights).abs()
    groups = rows.reshape(rows.shape[0], -1, group_size)
    relative: Tensor = groups / groups.amax(2, keepdim=True).clamp(min=1e-12)
    return relative.mean(0).flatten().clamp(min=1e-4)
