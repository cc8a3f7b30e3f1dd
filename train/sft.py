"""Fine-tune a base with LoRA on the dataset, merge, and check the merge.

base + train.parquet -> adapter/ (with a checkpoint to resume from) -> merged model folder

python -m train --config configs/train.yaml
"""

import hashlib
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ridetune.config import save_config
from ridetune.contract import TOKENIZER_FILE, Contract, load_tokenizer
from ridetune.qwen import VisionFeatures, encode_frames, load_model
from ridetune.sample import read_samples, some_of
from ridetune.stage import Stopwatch, hash_file, new_folder, write_manifest

from .collate import collate, tokenize
from .lora import AdapterCheckpoint, LoraShape, add_adapter, check_merge, merge, save_adapter
from .objective import batch_loss
from .pixels import patches_of
from .rows import read_pixels
from .schedule import Steps, train_steps
from .score import decode_matrices, query_logits, summary


@dataclass(frozen=True)
class TrainConfig:
    """What to fine-tune, on what, how; `out` gets the merged model, `adapter` the adapter."""

    base: Path
    data: Path
    adapter: Path
    out: Path
    seed: int
    threads: int
    plan: Steps
    lora: LoraShape
    as_text_share: float
    text_weight: float
    checkpoint_every: int
    watch_samples: int


def finetune(config: TrainConfig) -> None:
    """Train the adapter (resuming where a run stopped), merge it and write both folders."""
    watch = Stopwatch()
    torch.set_num_threads(config.threads)
    model = load_model(config.base)
    contract = Contract.load(config.base)
    prompts = contract.prompts(load_tokenizer(config.base))
    samples = read_samples(config.data / "train.parquet")
    held_out = some_of(read_samples(config.data / "test.parquet"), config.watch_samples)
    features = encode_all(model, read_pixels(samples, contract.vision), contract)
    seen = encode_all(model, read_pixels(held_out, contract.vision), contract)
    before = summary(decode_matrices(model, contract, prompts, held_out, seen), held_out, contract)
    print(f"base:  {before}")

    torch.manual_seed(config.seed)
    model = add_adapter(model, config.lora, prompts.ids)
    as_bins = [tokenize(sample, prompts) for sample in samples]
    as_text = [tokenize(sample, prompts, as_text=True) for sample in samples]

    def loss_of(chosen: list[int], rng: np.random.Generator) -> Tensor:
        rows = [(as_text if rng.random() < config.as_text_share else as_bins)[i] for i in chosen]
        own = features.select(chosen)
        loss, _ = batch_loss(model, collate(rows), own, prompts.ids, text_weight=config.text_weight)
        return loss.total

    checkpoint = AdapterCheckpoint(
        config.adapter / "checkpoint.pt", model, fingerprint(config), config.checkpoint_every
    )
    lengths = [len(e.ids) for e in as_bins]
    model.train()
    train_steps("LoRA", [model], lengths, loss_of, config.plan, config.seed, checkpoints=checkpoint)
    model.eval()
    after = summary(decode_matrices(model, contract, prompts, held_out, seen), held_out, contract)
    print(f"tuned: {after}")
    adapted = query_logits(model, prompts, held_out, seen)
    with new_folder(config.adapter) as folder:
        save_adapter(model, folder)
        save_config(config, folder / "config.yaml")
    merged = merge(model)
    with new_folder(config.out) as folder:
        write_model(merged, config.base, folder)
        difference = check_merge(adapted, query_logits(load_model(folder), prompts, held_out, seen))
        save_config(config, folder / "config.yaml")
        facts = {"base": before, "tuned": after, "merge_difference": difference}
        write_manifest(folder, seconds=watch.seconds, facts=facts)
    print(f"merged model in {config.out}, merge difference {difference:.2g}, {watch.seconds:.0f} s")


@torch.no_grad()
def encode_all(model: Any, pixels: Any, contract: Contract) -> VisionFeatures:
    """The visual tokens of all frames, once: the tower is frozen."""
    parts = [
        encode_frames(model, patches_of(pixels[at : at + 32], contract.vision), contract.vision)
        for at in range(0, len(pixels), 32)
    ]
    depth = len(parts[0].deepstack)
    return VisionFeatures(
        torch.cat([p.tokens for p in parts]),
        tuple(torch.cat([p.deepstack[i] for p in parts]) for i in range(depth)),
    )


def write_model(model: Any, base: Path, folder: Path) -> None:
    """Weights in fp16 beside the tokenizer, processor and contract files of the base."""
    model.half().save_pretrained(folder)
    for name in (TOKENIZER_FILE, "tokenizer_config.json", "preprocessor_config.json"):
        shutil.copy(base / name, folder / name)
    Contract.load(base).save(folder)


def fingerprint(config: TrainConfig) -> str:
    """What a checkpoint belongs to: the data, the base and everything that shapes the steps."""
    parts = [
        hash_file(config.data / "train.parquet"),
        hash_file(config.base / "config.json"),
        *(hash_file(path) for path in sorted(config.base.glob("*.safetensors"))),
        repr((config.seed, config.plan, config.lora, config.as_text_share, config.text_weight)),
    ]
    return hashlib.sha256("|".join(parts).encode()).hexdigest()
