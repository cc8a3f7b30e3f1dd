"""Reads a checkpoint in the AutoAWQ gemm layout, as `python -m quantize` writes it.

`load_packed` gives the packed layers as they are, for the exporter; `load_quantized` a torch model
with the weights written out again, for evaluation and parity tests. What the 4-bit kernels of a
serving engine compute is the second one up to the rounding of the activations.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from torch import Tensor
from transformers import MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING, AutoConfig, PreTrainedModel

from ridetune.gemm import PackedLinear, unpack

_PARTS = ("qweight", "qzeros", "scales")
_FAULTS = ("missing_keys", "unexpected_keys", "mismatched_keys")


@dataclass(frozen=True)
class PackedCheckpoint:
    """Packed layers by module name (`model.language_model.layers.0...q_proj`), the rest by key."""

    linears: dict[str, PackedLinear]
    tensors: dict[str, Tensor]


def is_quantized(folder: Path) -> bool:
    """Whether the config of a model folder names a quantization."""
    path = folder / "config.json"
    return path.is_file() and "quantization_config" in json.loads(path.read_text())


def load_packed(folder: Path) -> PackedCheckpoint:
    """Read all tensors of a checkpoint; ValueError if it is not in the gemm layout."""
    _check_layout(folder)
    parts: dict[str, dict[str, Tensor]] = {}
    tensors = {}
    for key, tensor in _read_tensors(folder):
        module, _, part = key.rpartition(".")
        if part in _PARTS:
            parts.setdefault(module, {})[part] = tensor
        else:
            tensors[key] = tensor
    linears = {}
    for module, found in parts.items():
        if set(found) != set(_PARTS):
            raise ValueError(
                f"{folder}: {module} has {sorted(found)}, needs {list(_PARTS)}; quantize again"
            )
        linears[module] = PackedLinear(*(found[part].numpy() for part in _PARTS))
    return PackedCheckpoint(linears, tensors)


def load_quantized(folder: Path, *, dtype: torch.dtype = torch.float32) -> PreTrainedModel:
    """The torch model with dequantized weights; ValueError if keys are missing or left over."""
    checkpoint = load_packed(folder)
    state = {key: tensor.to(dtype) for key, tensor in checkpoint.tensors.items()}
    for module, packed in checkpoint.linears.items():
        state[f"{module}.weight"] = torch.from_numpy(unpack(packed).dequantize()).to(dtype)
    config = AutoConfig.from_pretrained(folder, local_files_only=True)
    # transformers would replace the layers by those of an int4 package that is not needed here.
    del config.quantization_config
    kind: Any = MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING[type(config)]
    model, info = kind.from_pretrained(
        None,
        config=config,
        state_dict=state,
        dtype=dtype,
        attn_implementation="sdpa",
        output_loading_info=True,
    )
    wrong = {key: sorted(info[key]) for key in _FAULTS if info[key]}
    if wrong:
        raise ValueError(f"{folder} does not fit its config: {wrong}; quantize again")
    quantized: PreTrainedModel = model.eval()
    return quantized


def _check_layout(folder: Path) -> None:
    if not is_quantized(folder):
        raise ValueError(f"{folder} is no quantized model; `python -m quantize` writes one")
    found = json.loads((folder / "config.json").read_text())["quantization_config"]
    wanted = {"quant_method": "awq", "version": "gemm", "bits": 4}
    if any(found.get(key) != value for key, value in wanted.items()):
        raise ValueError(f"{folder} is quantized as {found}, only {wanted} can be read here")


def _read_tensors(folder: Path) -> Iterator[tuple[str, Tensor]]:
    for path in sorted(folder.glob("*.safetensors")):
        with safe_open(path, framework="pt") as file:
            for key in file.keys():  # noqa: SIM118 (safe_open is no mapping)
                yield key, file.get_tensor(key)
