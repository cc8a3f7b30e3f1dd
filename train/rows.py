"""Read what the data stage wrote: text-only phrases and the pixels of frames."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ridetune.sample import FEEDBACK_KINDS, Sample
from ridetune.vision import VisionSpec, read_fitted


def read_phrases(path: Path) -> list[Sample]:
    """Text-only samples of a phrases file."""
    if not path.is_file():
        raise ValueError(f"no phrases at {path}; run `python -m data` with `phrases` above 0")
    with path.open() as file:
        rows = [json.loads(line) for line in file]
    return [Sample.of_row({**row, "image": {"bytes": b"-"}}) for row in rows]


def read_feedback(path: Path) -> dict[str, int]:
    """Sentences of feedback with the number of their kind in FEEDBACK_KINDS."""
    sayings = json.loads(path.read_text())
    return {text: FEEDBACK_KINDS.index(kind) for kind, texts in sayings.items() for text in texts}


def read_pixels(samples: Sequence[Sample], spec: VisionSpec) -> NDArray[np.uint8]:
    """The fitted frames of samples [sample, height, width, 3]."""
    shape = (len(samples), spec.height_px, spec.width_px, 3)
    pixels = np.empty(shape, np.uint8)
    for i, sample in enumerate(tqdm(samples, desc="frames", unit="frame")):
        pixels[i] = read_fitted(sample.observation.frame, spec)
    return pixels
