"""A model folder -> the bundle for the car: ONNX graphs, embeddings, contract, parity with torch.

    python -m quantize.export --config configs/export.yaml

In: a 4-bit AWQ folder of `python -m quantize` (or an unquantized model, for comparison) and the
dataset's calibration split. Out: a folder as in `ridetune.bundle`. The integers of the checkpoint
are carried over exactly: the graphs are held to torch in float32 first, then the decisions at the
deployed accuracy level are held to torch's. Where either fails, nothing is written.
"""

import json
import logging
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from ridetune.awq_checkpoint import is_quantized, load_packed, load_quantized
from ridetune.bundle import (
    DECODER_FILE,
    EMBEDDING_FILE,
    HEAD_FILE,
    TOKENIZER_FILE,
    Bundle,
    BundleFacts,
    ModelShape,
    Quantization,
    Rotary,
    Source,
    write_facts,
)
from ridetune.config import save_config
from ridetune.contract import Contract, load_tokenizer
from ridetune.engines import CachedEngine
from ridetune.gemm import BITS, PackedLinear
from ridetune.ort_engine import OrtEngine
from ridetune.qwen import core, load_model
from ridetune.stage import (
    MANIFEST_FILE,
    Stopwatch,
    hash_file,
    hash_files,
    new_folder,
    run_stage,
    write_manifest,
)
from ridetune.torch_engine import TorchEngine
from ridetune.vision import read_patches

from .calibration import read_calibration
from .onnx_files import LoadedModel, set_accuracy_level, write_graphs
from .parity import (
    Answer,
    GateConfig,
    ParityPrompt,
    answers,
    check_decisions,
    check_exact,
    compare_decisions,
    compare_exact,
)

LOG = logging.getLogger(__name__)
FAMILY = "qwen3_vl"


@dataclass(frozen=True)
class ExportConfig:
    """model, data and out are folders; the rest is explained in configs/export.yaml."""

    model: Path
    data: Path
    out: Path
    accuracy_level: Literal[0, 1, 2, 3, 4]
    embedding: Literal["float32", "float16"]
    threads: int
    gate: GateConfig


def export(config: ExportConfig) -> None:
    """Write the bundle folder; ValueError if the model cannot be exported or the gate fails."""
    clock = Stopwatch()
    torch.set_num_threads(config.threads)
    contract = Contract.load(config.model)
    prompts = parity_prompts(config, contract)
    loaded = load(config.model)
    with new_folder(config.out) as folder:
        write_graphs(loaded, contract.vision, folder)
        write_embedding(loaded.model, folder, dtype=config.embedding)
        shutil.copy(config.model / TOKENIZER_FILE, folder / TOKENIZER_FILE)
        save_config(config, folder / "config.yaml")
        draft = Bundle(folder, describe(loaded, contract, config), contract)
        parity = verify(draft, loaded, prompts, config)
        write_manifest(folder, seconds=clock.seconds, facts={"stage": "export", "parity": parity})
        files = {**hash_files(folder), MANIFEST_FILE: hash_file(folder / MANIFEST_FILE)}
        write_facts(folder, draft.facts.model_copy(update={"files": files, "parity": parity}))
        size_mb = sum(path.stat().st_size for path in folder.iterdir()) / 1e6
    print(
        f"bundle: {config.out}, {size_mb:.1f} MB, largest logit difference "
        f"{parity['logits_difference']:.1e}, decisions {parity['bins_p95']:.2f} bins apart (p95), "
        f"{clock.seconds:.0f} s"
    )


def load(folder: Path) -> LoadedModel:
    """Read a model folder; ValueError for a family that has no graphs here."""
    family = read_family(folder)
    if family != FAMILY:
        raise ValueError(
            f"export supports Qwen3-VL so far, {folder} holds {family}; serve it with the torch "
            "engine or through an OpenAI-compatible server"
        )
    if is_quantized(folder):
        model: Any = load_quantized(folder)
        packed: Mapping[str, PackedLinear] = load_packed(folder).linears
    else:
        model, packed = load_model(folder), {}
    text, visual = model.config.text_config, model.config.vision_config
    shape = ModelShape(
        family=family,
        hidden=text.hidden_size,
        layers=text.num_hidden_layers,
        kv_heads=text.num_key_value_heads,
        head_dim=text.head_dim,
        vocabulary=text.vocab_size,
        num_deepstack=len(visual.deepstack_visual_indexes),
    )
    return LoadedModel(model, packed, shape)


def read_family(folder: Path) -> str:
    """The model type that config.json names; ValueError if there is no model."""
    path = folder / "config.json"
    if not path.is_file():
        raise ValueError(f"no model at {folder}; `python -m quantize` writes one")
    return str(json.loads(path.read_text()).get("model_type"))


def parity_prompts(config: ExportConfig, contract: Contract) -> list[ParityPrompt]:
    """Evenly spaced samples of the calibration split as frame and suffix."""
    samples = read_calibration(config.data)
    if config.gate.samples < 1:
        raise ValueError(f"gate.samples is {config.gate.samples}; compare at least one prompt")
    chosen = np.linspace(0, len(samples) - 1, min(config.gate.samples, len(samples))).astype(int)
    prompts = contract.prompts(load_tokenizer(config.model))
    return [
        ParityPrompt(
            read_patches(samples[i].observation.frame, contract.vision),
            prompts.suffix(samples[i].instruction, samples[i].memories),
        )
        for i in chosen
    ]


def describe(loaded: LoadedModel, contract: Contract, config: ExportConfig) -> BundleFacts:
    """bundle.json but for hashes and parity."""
    groups = {linear.group_size for linear in loaded.packed.values()}
    manifest = config.model / MANIFEST_FILE
    return BundleFacts(
        contract=contract.as_dict(),
        model=loaded.shape,
        rotary=rotary(loaded.model),
        quantization=Quantization(
            bits=BITS, group_size=max(groups), accuracy_level=config.accuracy_level
        )
        if groups
        else None,
        source=Source(
            folder=config.model.name,
            manifest_sha256=hash_file(manifest) if manifest.is_file() else None,
        ),
        files={},
        verified_with={name: version(name) for name in ("onnxruntime", "torch", "transformers")},
        parity={},
    )


def rotary(model: Any) -> Rotary:
    """Frequencies and axes of interleaved mRoPE; ValueError for a scaled variant."""
    embedding = core(model).language_model.rotary_emb
    if embedding.rope_type != "default":
        raise ValueError(
            f"the model scales its positions ({embedding.rope_type}), export supports the default; "
            "serve it with the torch engine"
        )
    frequencies = embedding.inv_freq.tolist()
    axes = [0] * len(frequencies)
    for axis in (1, 2):  # height and width take every third channel of their section
        for channel in range(axis, 3 * embedding.mrope_section[axis], 3):
            axes[channel] = axis
    return Rotary(frequencies=tuple(frequencies), axes=tuple(axes))


def write_embedding(model: Any, folder: Path, *, dtype: str) -> None:
    """embedding.npy, and head.npy where the head has weights of its own."""
    table = model.get_input_embeddings().weight
    head = model.get_output_embeddings().weight
    np.save(folder / EMBEDDING_FILE, table.detach().numpy().astype(dtype))
    if head is not table:
        np.save(folder / HEAD_FILE, head.detach().numpy().astype(dtype))


def verify(
    draft: Bundle, loaded: LoadedModel, prompts: Sequence[ParityPrompt], config: ExportConfig
) -> dict[str, float]:
    """The parity figures; leaves the graphs at the deployed accuracy level."""

    def ask(engine: CachedEngine, name: str) -> list[Answer]:
        return answers(engine, prompts, name=name)

    reference = TorchEngine(loaded.model, draft.prompts(), draft.contract.vision)
    truth = ask(reference, "torch")
    exact = ask(OrtEngine(draft, threads=config.threads), "graphs in float32")
    figures = compare_exact(truth, exact)
    LOG.info("event=compared %s", " ".join(f"{k}={v:.3g}" for k, v in figures.items()))
    check_exact(figures, config.gate)
    deployed = exact
    if loaded.packed and config.accuracy_level:
        set_accuracy_level(draft.folder / DECODER_FILE, config.accuracy_level)
        deployed = ask(OrtEngine(draft, threads=config.threads), "graphs as deployed")
    decisions = compare_decisions(truth, deployed, draft.contract.codec)
    LOG.info("event=compared %s", " ".join(f"{k}={v:.3g}" for k, v in decisions.items()))
    check_decisions(decisions, config.gate)
    return {"prompts": len(prompts), **figures, **decisions}


if __name__ == "__main__":
    sys.exit(run_stage(ExportConfig, "configs/export.yaml", export, __doc__))
