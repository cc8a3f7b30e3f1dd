"""A random base of a few thousand weights and a dataset of twelve samples, made once per run."""

import functools
import json
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from tokenizers import Tokenizer

from data.build import DataConfig, build
from data.instructions import Speech
from ridetune.contract import Contract, load_tokenizer
from ridetune.matrix import Ranges
from ridetune.prompt import SYSTEM, PromptBuilder
from ridetune.sample import Sample, read_samples
from train.base import TinyShape, build_model, build_tokenizer, save_tokenizer, vision_spec

SHAPE = TinyShape(
    vocabulary=900,
    hidden=64,
    layers=1,
    heads=4,
    kv_heads=2,
    head_dim=16,
    mlp=96,
    vision_hidden=32,
    vision_layers=1,
    vision_heads=2,
    vision_mlp=48,
    deepstack_at=0,
    rows=1,
    columns=2,
)
RANGES = Path(__file__).parents[1] / "configs/ranges.yaml"
_FOLDER = tempfile.TemporaryDirectory(prefix="ridetune-small-")
ROOT = Path(_FOLDER.name)
_LETTERS = "abcdefghijklmnopqrstuvwxyz0123456789.,:;|-_<>'[]?!()$%&/"


@functools.cache
def small_data() -> Path:
    """Four training scenes (12 samples), two test scenes (30), 24 phrases, 12 held-out ones."""
    folder = ROOT / "data"
    build(
        DataConfig(
            out=folder,
            ranges=RANGES,
            seed=1,
            train_scenes=4,
            calibration_scenes=1,
            test_scenes=2,
            instructions_per_frame=3,
            memory_share=0.4,
            speech=Speech(("en",), grammar=0.3, own=None, own_share=0.0),
            phrases=24,
            frame_width=224,
            frame_height=128,
        )
    )
    held_out = folder / "phrases-test.jsonl"
    lines = held_out.read_text().splitlines(keepends=True)
    held_out.write_text("".join(lines[:: len(lines) // 12][:12]))
    return folder


def word_pieces() -> dict[str, int]:
    """The vocabulary that a teacher would have: every word of the dataset, and all letters."""
    words = _words(small_data() / "phrases.jsonl")
    pieces = ["[UNK]", *_LETTERS, *(f"##{letter}" for letter in _LETTERS), *words]
    return {piece: number for number, piece in enumerate(dict.fromkeys(pieces))}


def _words(phrases: Path) -> list[str]:
    rows = [json.loads(line) for line in phrases.read_text().splitlines()]
    texts = [f"{r['instruction']} {r['scene']} {r['explanation']}" for r in rows]
    texts += [f"{SYSTEM} remember: assistant user the passenger says"]
    return sorted(set(re.findall(r"[a-z]+", " ".join(texts).lower())))


@functools.cache
def small_base() -> Path:
    """A folder with a random Qwen3-VL of one layer, its tokenizer and its contract."""
    folder = ROOT / "base"
    torch.manual_seed(0)
    pieces = word_pieces()
    tokenizer = build_tokenizer(pieces, [" ".join(pieces)], SHAPE.vocabulary)
    model = build_model(SHAPE, tokenizer)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            spread = 0.1 if "norm" in name else weight.shape[-1] ** -0.5
            weight.copy_(torch.randn_like(weight) * spread + ("norm" in name))
    model.save_pretrained(folder)
    save_tokenizer(tokenizer, vision_spec(SHAPE), folder)
    Contract(vision_spec(SHAPE), Ranges.load(RANGES)).save(folder)
    return folder


def small_tokenizer() -> Tokenizer:
    """The tokenizer of the small base."""
    return load_tokenizer(small_base())


@functools.cache
def small_prompts() -> PromptBuilder:
    """The prompt builder of the small base."""
    return Contract.load(small_base()).prompts(small_tokenizer())


@functools.cache
def small_samples() -> tuple[Sample, ...]:
    """The twelve training samples."""
    return tuple(read_samples(small_data() / "train.parquet"))


def reworded(sample: Sample) -> Sample:
    """The same prompt with another answer: matrix, scene and explanation."""
    ranges = Ranges.load(RANGES)
    return replace(
        sample, matrix=ranges.default, scene="a quite different road", explanation="for no reason"
    )
