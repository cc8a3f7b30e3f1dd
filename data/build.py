"""Build the dataset: frames from the synthetic camera, instructions from the bank, labels.

In: the bank and a config. Out, in one folder: {train,calibration,test}.parquet (rows as
`ridetune.sample`), phrases.jsonl (text-only rows for pretraining), the resolved config and a
manifest with hashes. Deterministic by seed.

    python -m data --config configs/data.yaml
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TextIO

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ridetune.camera.render import render
from ridetune.camera.scene import Scene, describe, sample_scene, with_condition
from ridetune.codec import MatrixCodec
from ridetune.config import Count, Share, save_config
from ridetune.matrix import STYLES, Ranges, Style
from ridetune.sample import (
    CONDITIONS,
    FEEDBACK_KINDS,
    FeedbackKind,
    Memory,
    Observation,
    Sample,
    Split,
)
from ridetune.stage import Stopwatch, new_folder, write_manifest

from .annotate import draw_matrix, explain
from .instructions import Bank, Phrase, load_bank, pick, vary

JPEG_QUALITY = 88
_SPLIT_SEED: dict[Split, int] = {"train": 0, "calibration": 1, "test": 2}
_FEEDBACK_SPLITS: tuple[Split, ...] = ("train", "test")


@dataclass(frozen=True)
class DataConfig:
    """What to build; every count is a number of scenes or of text-only rows."""

    out: Path
    ranges: Path
    seed: int
    train_scenes: Count
    calibration_scenes: Count
    test_scenes: Count
    instructions_per_frame: Count
    memory_share: Share
    grammar_share: Share
    phrases: Count
    frame_width: Count
    frame_height: Count


@dataclass(frozen=True)
class Remembered:
    """Memories of a sample with the taste that they teach."""

    memories: tuple[Memory, ...]
    feedback: FeedbackKind | None


def build(config: DataConfig) -> None:
    """Write the dataset folder; an interrupted build leaves nothing behind."""
    watch = Stopwatch()
    bank = load_bank()
    codec = MatrixCodec(Ranges.load(config.ranges))
    with new_folder(config.out) as folder:
        counts = {
            split: _write_split(split, config, bank, codec, folder)
            for split in ("train", "calibration", "test")
        }
        _write_feedback(bank, folder)
        if config.phrases:
            counts["phrases"] = _write_phrases(config, bank, codec, folder)
            counts["held-out phrases"] = _write_held_out(config, bank, codec, folder)
        save_config(config, folder / "config.yaml")
        facts = {
            "samples": counts,
            "bank": {
                "phrases": len(bank.phrases),
                "held_out": sum(p.held_out for p in bank.phrases),
            },
        }
        write_manifest(folder, seconds=watch.seconds, facts=facts)
    print(f"dataset: {counts} in {config.out}, {watch.seconds:.0f} s")


def _write_split(
    split: Split, config: DataConfig, bank: Bank, codec: MatrixCodec, folder: Path
) -> int:
    from datasets import Dataset

    from ridetune.sample import dataset_features

    scenes = {
        "train": config.train_scenes,
        "calibration": config.calibration_scenes,
        "test": config.test_scenes,
    }[split]
    rng = np.random.default_rng([config.seed, _SPLIT_SEED[split]])
    rows = [
        sample.as_row()
        for number in tqdm(
            range(scenes), desc=f"{split} scenes", unit="scene", disable=scenes < 100
        )
        for sample in _scene_samples(f"{split}-{number:06d}", split, config, bank, codec, rng)
    ]
    if rows:
        dataset = Dataset.from_list(rows, features=dataset_features())
        dataset.to_parquet(folder / f"{split}.parquet")
    return len(rows)


def _scene_samples(
    scene_id: str,
    split: Split,
    config: DataConfig,
    bank: Bank,
    codec: MatrixCodec,
    rng: np.random.Generator,
) -> Iterator[Sample]:
    """One scene's samples: a test scene is seen in every condition with the same instructions."""
    scene = sample_scene(rng)
    styles = [STYLES[i % len(STYLES)] for i in _shuffled(config.instructions_per_frame, rng)]
    drawn = [draw_instruction(style, split, config.grammar_share, bank, rng) for style in styles]
    pasts = [
        remember(style, split, bank, codec, rng)
        if split != "test" and rng.random() < config.memory_share
        else Remembered((), None)
        for style in styles
    ]
    conditions = CONDITIONS if split == "test" else (scene.condition,)
    for condition in conditions:
        seen = with_condition(scene, condition)
        frame = encode(render(seen, config.frame_width, config.frame_height))
        for (phrase, text), past in zip(drawn, pasts, strict=True):
            yield _sample(scene_id, split, seen, frame, phrase, text, past, bank, codec, rng)


def _sample(
    scene_id: str,
    split: Split,
    scene: Scene,
    frame: bytes,
    phrase: Phrase,
    text: str,
    past: Remembered,
    bank: Bank,
    codec: MatrixCodec,
    rng: np.random.Generator,
) -> Sample:
    reason = bank.reasons[phrase.intent][phrase.style]
    return Sample(
        observation=Observation(frame),
        instruction=text,
        memories=past.memories,
        matrix=draw_matrix(phrase.style, scene.condition, past.feedback, codec, rng),
        scene=describe(scene),
        explanation=explain(phrase.style, reason, scene.condition, past.feedback),
        style=phrase.style,
        level=phrase.level,
        intent=phrase.intent,
        condition=scene.condition,
        split=split,
        scene_id=scene_id,
        phrase_id=phrase.phrase_id,
    )


def draw_instruction(
    style: Style, split: Split, grammar_share: float, bank: Bank, rng: np.random.Generator
) -> tuple[Phrase, str]:
    """A phrase of the style with its final wording; test wordings are held out and unvaried."""
    if split == "test":
        phrase = pick(bank.choose(style, "test"), rng)
        return phrase, bank.fill(phrase, rng)
    if rng.random() < grammar_share:
        phrase = bank.grown_phrase(style, rng)
    else:
        phrase = pick(bank.choose(style, "train"), rng)
    return phrase, vary(bank.fill(phrase, rng), rng)


def remember(
    style: Style, split: Split, bank: Bank, codec: MatrixCodec, rng: np.random.Generator
) -> Remembered:
    """One or two remembered drives of the same style, with feedback of one kind."""
    kind = pick(FEEDBACK_KINDS, rng)
    memories = []
    for _ in range(1 + (rng.random() < 0.25)):
        scene = sample_scene(rng)
        _, said = draw_instruction(style, split, 0.3, bank, rng)
        matrix = draw_matrix(style, scene.condition, None, codec, rng)
        feedback = pick(bank.feedback_of(kind, split), rng)
        memories.append(Memory(said, describe(scene), matrix, feedback))
    return Remembered(tuple(memories), kind)


def encode(pixels: NDArray[np.uint8], quality: int = JPEG_QUALITY) -> bytes:
    """RGB pixels [height, width, 3] -> JPEG bytes."""
    done, jpeg = cv2.imencode(
        ".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    assert done
    return bytes(jpeg.tobytes())


def _write_feedback(bank: Bank, folder: Path) -> None:
    """The feedback sentences by kind, and apart those that no training row holds."""
    for split in _FEEDBACK_SPLITS:
        sayings = {kind: bank.feedback_of(kind, split) for kind in FEEDBACK_KINDS}
        (folder / f"feedback-{split}.json").write_text(json.dumps(sayings, indent=2) + "\n")


def _write_phrases(config: DataConfig, bank: Bank, codec: MatrixCodec, folder: Path) -> int:
    """Text-only rows: instruction, memories and the label of a clear scene."""
    rng = np.random.default_rng([config.seed, 3])
    with (folder / "phrases.jsonl").open("w") as file:
        for number in tqdm(range(config.phrases), desc="phrases", unit="row"):
            style = STYLES[number % len(STYLES)]
            past = Remembered((), None)
            if rng.random() < config.memory_share:
                past = remember(style, "train", bank, codec, rng)
            phrase, text = draw_instruction(style, "train", config.grammar_share, bank, rng)
            if rng.random() < 0.15:
                _, more = draw_instruction(style, "train", 0.3, bank, rng)
                text = f"{text.rstrip('.')}. {more}"
            _write_text_row(file, number, "train", phrase, text, past, bank, codec, rng)
    return config.phrases


def _write_held_out(config: DataConfig, bank: Bank, codec: MatrixCodec, folder: Path) -> int:
    """Every held-out phrase once, to score the understanding of words alone."""
    rng = np.random.default_rng([config.seed, 4])
    phrases = [phrase for style in STYLES for phrase in bank.choose(style, "test")]
    with (folder / "phrases-test.jsonl").open("w") as file:
        for number, phrase in enumerate(phrases):
            text = bank.fill(phrase, rng)
            past = Remembered((), None)
            _write_text_row(file, number, "test", phrase, text, past, bank, codec, rng)
    return len(phrases)


def _write_text_row(
    file: TextIO,
    number: int,
    split: Split,
    phrase: Phrase,
    text: str,
    past: Remembered,
    bank: Bank,
    codec: MatrixCodec,
    rng: np.random.Generator,
) -> None:
    scene = replace(sample_scene(rng), condition="sunny")
    name = f"phrase-{split}-{number:06d}"
    row = _sample(name, split, scene, b"", phrase, text, past, bank, codec, rng).as_row()
    del row["image"]
    file.write(json.dumps(row) + "\n")


def _shuffled(count: int, rng: np.random.Generator) -> list[int]:
    """Style numbers: all three in turn from a random start."""
    start = int(rng.integers(len(STYLES)))
    return [start + i for i in range(count)]
