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
from .feedback import write_feedback
from .instructions import Speakers, Speech, fill, pick, read_own
from .phrases import Bank, Phrase, load_bank, load_reasons

JPEG_QUALITY = 88
_SPLIT_SEED: dict[Split, int] = {"train": 0, "calibration": 1, "test": 2}


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
    speech: Speech
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
    speakers = Speakers(config.speech, read_own(config.speech))
    codec = MatrixCodec(Ranges.load(config.ranges))
    with new_folder(config.out) as folder:
        counts = {
            split: _write_split(split, config, speakers, codec, folder)
            for split in ("train", "calibration", "test")
        }
        write_feedback(config.speech.languages, folder)
        if config.phrases:
            counts["phrases"] = _write_phrases(config, speakers, codec, folder)
            counts["held-out phrases"] = _write_held_out(config, speakers, codec, folder)
        save_config(config, folder / "config.yaml")
        facts = {"samples": counts, "bank": speakers.about()}
        write_manifest(folder, seconds=watch.seconds, facts=facts)
    print(f"dataset: {counts} in {config.out}, {watch.seconds:.0f} s")


def _write_split(
    split: Split, config: DataConfig, speakers: Speakers, codec: MatrixCodec, folder: Path
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
        for sample in _scene_samples(f"{split}-{number:06d}", split, config, speakers, codec, rng)
    ]
    if rows:
        dataset = Dataset.from_list(rows, features=dataset_features())
        dataset.to_parquet(folder / f"{split}.parquet")
    return len(rows)


def _scene_samples(
    scene_id: str,
    split: Split,
    config: DataConfig,
    speakers: Speakers,
    codec: MatrixCodec,
    rng: np.random.Generator,
) -> Iterator[Sample]:
    """One scene's samples: a test scene is seen in every condition with the same instructions."""
    scene = sample_scene(rng)
    styles = [STYLES[i % len(STYLES)] for i in _shuffled(config.instructions_per_frame, rng)]
    banks = [speakers.bank(rng) for _ in styles]
    drawn = [
        speakers.draw(bank, style, split, rng) for bank, style in zip(banks, styles, strict=True)
    ]
    pasts = [
        remember(style, split, speakers, bank, codec, rng)
        if split != "test" and rng.random() < config.memory_share
        else Remembered((), None)
        for bank, style in zip(banks, styles, strict=True)
    ]
    conditions = CONDITIONS if split == "test" else (scene.condition,)
    for condition in conditions:
        seen = with_condition(scene, condition)
        frame = encode(render(seen, config.frame_width, config.frame_height))
        for (phrase, text), past in zip(drawn, pasts, strict=True):
            yield _sample(scene_id, split, seen, frame, phrase, text, past, codec, rng)


def _sample(
    scene_id: str,
    split: Split,
    scene: Scene,
    frame: bytes,
    phrase: Phrase,
    text: str,
    past: Remembered,
    codec: MatrixCodec,
    rng: np.random.Generator,
) -> Sample:
    reason = load_reasons()[phrase.intent][phrase.style]
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
        language=phrase.language,
    )


def remember(
    style: Style,
    split: Split,
    speakers: Speakers,
    bank: Bank,
    codec: MatrixCodec,
    rng: np.random.Generator,
) -> Remembered:
    """One or two remembered drives of the same style and language, with feedback of one kind."""
    kind = pick(FEEDBACK_KINDS, rng)
    memories = []
    for _ in range(1 + (rng.random() < 0.25)):
        scene = sample_scene(rng)
        _, said = speakers.draw(bank, style, split, rng)
        matrix = draw_matrix(style, scene.condition, None, codec, rng)
        feedback = pick(bank.feedback.of(kind, split), rng)
        memories.append(Memory(said, describe(scene), matrix, feedback))
    return Remembered(tuple(memories), kind)


def encode(pixels: NDArray[np.uint8], quality: int = JPEG_QUALITY) -> bytes:
    """RGB pixels [height, width, 3] -> JPEG bytes."""
    done, jpeg = cv2.imencode(
        ".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    assert done
    return bytes(jpeg.tobytes())


def _write_phrases(config: DataConfig, speakers: Speakers, codec: MatrixCodec, folder: Path) -> int:
    """Text-only rows: instruction, memories and the label of a clear scene."""
    rng = np.random.default_rng([config.seed, 3])
    with (folder / "phrases.jsonl").open("w") as file:
        for number in tqdm(range(config.phrases), desc="phrases", unit="row"):
            style = STYLES[number % len(STYLES)]
            past = Remembered((), None)
            bank = speakers.bank(rng)
            if rng.random() < config.memory_share:
                past = remember(style, "train", speakers, bank, codec, rng)
            phrase, text = speakers.draw(bank, style, "train", rng)
            if rng.random() < 0.15:
                _, more = speakers.draw(bank, style, "train", rng)
                text = f"{text.rstrip('.')}. {more}"
            _write_text_row(file, number, "train", phrase, text, past, codec, rng)
    return config.phrases


def _write_held_out(
    config: DataConfig, speakers: Speakers, codec: MatrixCodec, folder: Path
) -> int:
    """Every held-out phrase once, to score the understanding of words alone."""
    rng = np.random.default_rng([config.seed, 4])
    phrases = [p for style in STYLES for p in speakers.phrases if p.held_out and p.style == style]
    with (folder / "phrases-test.jsonl").open("w") as file:
        for number, phrase in enumerate(phrases):
            text = fill(phrase.text, load_bank(phrase.language), rng)
            past = Remembered((), None)
            _write_text_row(file, number, "test", phrase, text, past, codec, rng)
    return len(phrases)


def _write_text_row(
    file: TextIO,
    number: int,
    split: Split,
    phrase: Phrase,
    text: str,
    past: Remembered,
    codec: MatrixCodec,
    rng: np.random.Generator,
) -> None:
    scene = replace(sample_scene(rng), condition="sunny")
    name = f"phrase-{split}-{number:06d}"
    row = _sample(name, split, scene, b"", phrase, text, past, codec, rng).as_row()
    del row["image"]
    file.write(json.dumps(row) + "\n")


def _shuffled(count: int, rng: np.random.Generator) -> list[int]:
    """Style numbers: all three in turn from a random start."""
    start = int(rng.integers(len(STYLES)))
    return [start + i for i in range(count)]
