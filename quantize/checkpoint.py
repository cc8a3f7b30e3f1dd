"""The checkpoint folder: packed layers, everything else in float16, and what travels with them.

The vision tower, the mergers, the embeddings and the head are not rounded to four bits.
"""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import save_torch_state_dict
from torch import Tensor
from tqdm import tqdm

from ridetune.awq_checkpoint import is_quantized
from ridetune.gemm import BITS, pack
from ridetune.qwen import core
from ridetune.stage import MANIFEST_FILE

from .awq import JOBS, Search, round_layer
from .calibration import Activations

REPORT_FILE = "report.json"
_LAYERS = "model.language_model.layers"
# "visual" alone lets transformers 5 replace the vision tower by empty 4-bit layers.
_NOT_CONVERTED = ["visual", "model.visual", "lm_head"]
_OWN_FILES = ("config.json", REPORT_FILE, MANIFEST_FILE)


def check_source(folder: Path) -> None:
    """ValueError unless the folder holds an unquantized model without a LoRA adapter."""
    if (folder / "adapter_config.json").is_file():
        raise ValueError(
            f"{folder} holds a LoRA adapter; merge it into its base first and quantize the result"
        )
    if is_quantized(folder):
        raise ValueError(
            f"{folder} is already quantized; give the merged model that it was made from"
        )


def quantized_tensors(
    model: Any,
    seen: Sequence[dict[str, Activations]],
    *,
    group_size: int,
    num_exponents: int,
    clip: bool,
) -> tuple[dict[str, Tensor], list[dict[str, Any]]]:
    """All tensors of the checkpoint by key, and what each job found, one row per layer and job."""
    tensors = dict(model.state_dict())
    if model.config.tie_word_embeddings:
        tensors.pop("lm_head.weight", None)
    jobs = []
    layers = core(model).language_model.layers
    for number, layer in enumerate(tqdm(layers, desc="quantize", unit="layer")):
        rounded, others, searches = round_layer(
            layer,
            seen[number],
            group_size=group_size,
            num_exponents=num_exponents,
            clip=clip,
        )
        for name, grouped in rounded.items():
            key = f"{_LAYERS}.{number}.{name}"
            del tensors[f"{key}.weight"]
            packed = pack(grouped.as_levels())
            tensors |= {f"{key}.{part}": torch.from_numpy(x) for part, x in vars(packed).items()}
        tensors |= {f"{_LAYERS}.{number}.{name}": tensor for name, tensor in others.items()}
        jobs += _job_rows(number, searches)
    return {key: _stored(tensor, key) for key, tensor in tensors.items()}, jobs


def write_checkpoint(
    tensors: dict[str, Tensor], source: Path, folder: Path, *, group_size: int
) -> None:
    """Weights, config.json and, from the source folder, tokenizer, preprocessor and contract."""
    save_torch_state_dict(tensors, str(folder), metadata={"format": "pt"})
    for path in sorted(source.iterdir()):
        kept = path.suffix in (".json", ".txt", ".jinja") and path.name not in _OWN_FILES
        if kept and not path.name.endswith(".safetensors.index.json"):
            shutil.copy(path, folder / path.name)
    settings = json.loads((source / "config.json").read_text())
    settings["dtype"] = "float16"
    settings["quantization_config"] = {
        "quant_method": "awq",
        "version": "gemm",
        "bits": BITS,
        "group_size": group_size,
        "zero_point": True,
        "modules_to_not_convert": _NOT_CONVERTED,
    }
    (folder / "config.json").write_text(json.dumps(settings, indent=2) + "\n")


def _job_rows(number: int, searches: dict[str, Search]) -> list[dict[str, Any]]:
    found = [(job.name, searches[job.source]) for job in JOBS]
    return [
        {
            "layer": number,
            "job": name,
            "exponent": search.exponent,
            "error_rounded": search.error_rounded,
            "error_scaled": search.error_scaled,
        }
        for name, search in found
    ]


def _stored(tensor: Tensor, key: str) -> Tensor:
    """A tensor as the file holds it: float16 where it is floating, on the CPU."""
    stored = tensor.to("cpu", torch.float16 if tensor.is_floating_point() else None).contiguous()
    if stored.is_floating_point() and not stored.isfinite().all():
        raise ValueError(
            f"{key} does not fit into float16: its largest value is {tensor.abs().max():.3g}, "
            "the limit is 65504; check the source model"
        )
    return stored
