"""A random Qwen3-VL of two layers, its 4-bit form and the bundles of both, made once per run."""

import functools
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow
import pyarrow.parquet as parquet
import torch
from safetensors.torch import save_file

from quantize.export import ExportConfig, export
from quantize.parity import GateConfig
from ridetune.bundle import load_bundle
from ridetune.contract import Contract
from ridetune.gemm import GroupedLevels, pack
from ridetune.matrix import Ranges
from ridetune.sample import Memory, Observation, Sample
from train.base import TinyShape, build_model, build_tokenizer, save_tokenizer, vision_spec

GROUP = 128
SHAPE = TinyShape(
    vocabulary=420,
    hidden=256,
    layers=2,
    heads=4,
    kv_heads=2,
    head_dim=32,
    mlp=384,  # three groups: the odd number that MatMulNBits pads
    vision_hidden=64,
    vision_layers=2,
    vision_heads=2,
    vision_mlp=128,
    deepstack_at=0,
    rows=2,
    columns=3,
)
_FOLDER = tempfile.TemporaryDirectory(prefix="ridetune-tests-")
ROOT = Path(_FOLDER.name)
GATE = GateConfig(samples=2, tolerance=1e-4, max_bins=5)


@functools.cache
def data() -> Path:
    """A dataset folder with a calibration split of three samples."""
    folder = ROOT / "data"
    folder.mkdir()
    rows = [sample(number).as_row() for number in range(3)]
    parquet.write_table(pyarrow.Table.from_pylist(rows), folder / "calibration.parquet")
    return folder


@functools.cache
def plain_model() -> Path:
    """The model in float32, with weights large enough that a fault shows."""
    folder = ROOT / "model"
    torch.manual_seed(0)
    letters = "abcdefghijklmnopqrstuvwxyz0123456789.,:;|"
    pieces = [*letters, *(f"##{letter}" for letter in letters)]
    words = {piece: number for number, piece in enumerate(pieces)}
    tokenizer = build_tokenizer(words, ["the passenger says"], SHAPE.vocabulary)
    model = build_model(SHAPE, tokenizer)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            spread = 0.3 if "norm" in name else 1.5 / max(weight.shape[-1], 1) ** 0.5
            weight.copy_(torch.randn_like(weight) * spread + ("norm" in name))
    model.save_pretrained(folder)
    save_tokenizer(tokenizer, vision_spec(SHAPE), folder)
    Contract(vision_spec(SHAPE), Ranges.load(Path("configs/ranges.yaml"))).save(folder)
    return folder


@functools.cache
def awq_model() -> Path:
    """The same model with its language layers rounded to 4 bits, in the AutoAWQ gemm layout."""
    from ridetune.qwen import load_model

    folder = ROOT / "awq"
    shutil.copytree(plain_model(), folder, ignore=shutil.ignore_patterns("*.safetensors"))
    state: dict[str, Any] = load_model(plain_model()).state_dict()
    state.pop("lm_head.weight")
    for key in [k for k in state if "language_model.layers" in k and "_proj.weight" in k]:
        packed = pack(_round(state.pop(key).numpy()))
        module = key.removesuffix(".weight")
        state |= {f"{module}.{part}": torch.from_numpy(x) for part, x in vars(packed).items()}
    save_file({k: v.contiguous() for k, v in state.items()}, folder / "model.safetensors")
    settings = json.loads((folder / "config.json").read_text())
    layout = {"quant_method": "awq", "version": "gemm", "bits": 4, "group_size": GROUP}
    settings["quantization_config"] = layout
    (folder / "config.json").write_text(json.dumps(settings))
    return folder


def _round(weight: Any) -> GroupedLevels:
    """Round [out, in] to the nearest of 16 levels per group."""
    grouped = weight.reshape(weight.shape[0], -1, GROUP)
    low, high = grouped.min(-1), grouped.max(-1)
    scales = ((high - low) / 15).astype(np.float16)
    zeros = np.clip(np.round(-low / scales), 0, 15)
    levels = np.clip(np.round(grouped / scales[..., None]) + zeros[..., None], 0, 15)
    levels = levels.astype(np.uint8).reshape(weight.shape)
    return GroupedLevels(levels, zeros.astype(np.uint8), scales)


def export_config(model: Path, name: str, *, accuracy_level: Any = 0) -> ExportConfig:
    """The export of a model folder to ROOT / name."""
    return ExportConfig(
        model=model,
        data=data(),
        out=ROOT / name,
        accuracy_level=accuracy_level,
        embedding="float32",
        threads=1,
        gate=GATE,
    )


@functools.cache
def plain_bundle() -> Path:
    """The exported unquantized model."""
    config = export_config(plain_model(), "plain-bundle")
    export(config)
    return config.out


@functools.cache
def awq_bundle() -> Path:
    """The exported 4-bit model at accuracy level 0."""
    config = export_config(awq_model(), "awq-bundle")
    export(config)
    return config.out


def copy_of_bundle(folder: Path) -> Path:
    """The 4-bit bundle in a folder that a test may spoil."""
    copy = folder / "bundle"
    shutil.copytree(awq_bundle(), copy)
    load_bundle(copy)
    return copy


def sample(number: int) -> Sample:
    """A blurred random frame with an instruction; every second one has a memory."""
    rng = np.random.default_rng(number)
    small = rng.integers(0, 255, (6, 9, 3), dtype=np.uint8)
    done, frame = cv2.imencode(".png", cv2.resize(small, (192, 128)))
    assert done
    default = Ranges.load(Path("configs/ranges.yaml")).default
    memory = Memory("go easy", "a wet road", default, "too slow")
    return Sample(
        observation=Observation(frame.tobytes()),
        instruction=f"take it easy on bend {number}",
        memories=(memory,) if number % 2 else (),
        matrix=default,
        scene="a road",
        explanation="as asked",
        style="moderate",
        level="I",
        intent="comfort",
        condition="sunny",
        split="calibration",
        scene_id=f"calibration-{number}",
        phrase_id="phrase",
    )
