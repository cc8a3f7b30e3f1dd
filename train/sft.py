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
from ridetune.sample import Sample, read_samples, some_of
from ridetune.stage import Stopwatch, hash_file, new_folder, write_manifest

from .collate import collate, tokenize, without_answer
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
    device: str
    threads: int
    plan: Steps
    lora: LoraShape
    as_text_share: float
    explained_share: float
    text_weight: float
    checkpoint_every: int
    watch_samples: int


def finetune(config: TrainConfig) -> None:
    """Train the adapter (resuming where a run stopped), merge it and write both folders."""
    watch = Stopwatch()
    torch.set_num_threads(config.threads)
    model = load_model(config.base).to(torch.device(config.device))
    contract = Contract.load(config.base)
    prompts = contract.prompts(load_tokenizer(config.base))
    samples = read_samples(config.data / "train.parquet")
    held_out = some_of(read_samples(config.data / "test.parquet"), config.watch_samples)
    features = encode_all(model, samples, contract)
    seen = encode_all(model, held_out, contract)
    before = summary(decode_matrices(model, contract, prompts, held_out, seen), held_out, contract)
    print(f"base:  {before}")

    torch.manual_seed(config.seed)
    model = add_adapter(model, config.lora, prompts.ids)
    explained = [tokenize(sample, prompts) for sample in samples]
    as_text = [tokenize(sample, prompts, as_text=True) for sample in samples]

    def loss_of(chosen: list[int], rng: np.random.Generator) -> Tensor:
        rows = []
        for i, draw in zip(chosen, rng.random(len(chosen)), strict=True):
            if draw < config.as_text_share:
                rows.append(as_text[i])
            elif draw < config.as_text_share + config.explained_share:
                rows.append(explained[i])
            else:
                rows.append(without_answer(explained[i]))
        own = features.select(chosen)
        loss, _ = batch_loss(
            model, collate(rows).to(model.device), own, prompts.ids, text_weight=config.text_weight
        )
        return loss.total

    checkpoint = AdapterCheckpoint(
        config.adapter / "checkpoint.pt", model, fingerprint(config), config.checkpoint_every
    )
    lengths = [len(e.ids) for e in explained]
    model.train()
    train_steps("LoRA", [model], lengths, loss_of, config.plan, config.seed, checkpoints=checkpoint)
    model.eval()
    after = summary(decode_matrices(model, contract, prompts, held_out, seen), held_out, contract)
    print(f"tuned: {after}")
    adapted = query_logits(model, prompts, held_out, seen)
    # The adapter's folder takes the place of the checkpoint, so it comes last: a full disk or a
    # refused merge must not cost the training.
    with new_folder(config.adapter) as kept, new_folder(config.out) as folder:
        save_adapter(model, kept)
        save_config(config, kept / "config.yaml")
        write_model(merge(model), config.base, folder)
        reloaded = load_model(folder).to(torch.device(config.device))
        difference = check_merge(adapted, query_logits(reloaded, prompts, held_out, seen))
        save_config(config, folder / "config.yaml")
        facts = {"base": before, "tuned": after, "merge_difference": difference}
        write_manifest(folder, seconds=watch.seconds, facts=facts)
    print(f"merged model in {config.out}, merge difference {difference:.2g}, {watch.seconds:.0f} s")


@torch.no_grad()
def encode_all(model: Any, samples: list[Sample], contract: Contract) -> VisionFeatures:
    """The visual tokens of each sample's frame; the tower is frozen, so each frame runs once."""
    first_with = {sample.observation.frame: sample for sample in samples}
    row_of = {frame: row for row, frame in enumerate(first_with)}
    pixels = read_pixels(list(first_with.values()), contract.vision)
    batches = [pixels[at : at + 32] for at in range(0, len(pixels), 32)]
    parts = [
        encode_frames(model, patches_of(b, contract.vision).to(model.device), contract.vision)
        for b in batches
    ]
    depth = len(parts[0].deepstack)
    distinct = VisionFeatures(
        torch.cat([p.tokens for p in parts]),
        tuple(torch.cat([p.deepstack[i] for p in parts]) for i in range(depth)),
    )
    return distinct.select([row_of[sample.observation.frame] for sample in samples])


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
        *(hash_file(path) for path in sorted(config.base.glob("*.json"))),
        *(hash_file(path) for path in sorted(config.base.glob("*.safetensors"))),
        repr(
            (
                config.seed,
                config.plan,
                config.lora,
                config.as_text_share,
                config.explained_share,
                config.text_weight,
            )
        ),
    ]
    return hashlib.sha256("|".join(parts).encode()).hexdigest()
