"""Proposals for the tests of the export: three styles for each of a few drawn pictures."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import data.export
from data.annotate import draw_matrix
from data.export import DataExportConfig, export
from data.proposals import Proposal, write_part
from ridetune.codec import MatrixCodec
from ridetune.config import load_config
from ridetune.matrix import STYLES, ControllerMatrix
from ridetune.sample import CONDITIONS, LEVELS, Memory, Observation, Sample, Split

CONFIGS = Path(__file__).parents[1] / "configs"
SPLITS: tuple[Split, ...] = ("train", "calibration", "test")


def picture(number: int, ending: str = ".jpg") -> bytes:
    pixels = np.full((72, 128, 3), 40 + number % 200, np.uint8)
    cv2.line(pixels, (64, 20), (10 + number % 100, 71), (230, 230, 230), 2)
    return bytes(cv2.imencode(ending, pixels)[1].tobytes())


def _pairs(codec: MatrixCodec, split: Split, scenes: int) -> list[Proposal]:
    """Three styles for each scene's picture; every second one has a remembered drive."""
    rng = np.random.default_rng([3, SPLITS.index(split)])
    found = []
    for number in range(scenes):
        frame = picture(number + 60 * SPLITS.index(split), ".png" if number == 0 else ".jpg")
        for i, style in enumerate(STYLES):
            name = f"{split}-{number}"
            condition = CONDITIONS[number % len(CONDITIONS)]
            matrix = draw_matrix(style, condition, None, codec, rng)
            drive = Memory("slower please", "rainy road", matrix, "that was too hasty")
            sample = Sample(
                observation=Observation(frame, 12.5 if number % 2 else None),
                instruction=f"{split} passenger {number} wants it {style}",
                memories=(drive,) * (number % 2),
                matrix=matrix,
                scene="sunny road",
                explanation=f"because {style} suits.",
                style=style,
                level=LEVELS[i],
                intent="speed",
                condition=condition,
                split=split,
                scene_id=f"images/{name}",
                phrase_id=f"{split}/{i}",
            )
            found.append(Proposal(sample, "images", "CC BY 4.0", f"{name}.jpg", "rules-1", 0.4))
    return found


def proposed(codec: MatrixCodec) -> list[Proposal]:
    """21 pairs to train on, 3 for calibration, 6 to test."""
    sets = (_pairs(codec, s, n) for s, n in zip(SPLITS, (7, 1, 2), strict=True))
    return [pair for found in sets for pair in found]


def exported(pairs: Sequence[Proposal], tmp_path: Path, *overrides: str) -> Path:
    """The folder of an export of pairs, proposed in two parts; without the feedback of the bank."""
    (tmp_path / "proposals").mkdir(exist_ok=True)
    write_part(pairs[:5], tmp_path / "proposals/part-00000.parquet")
    write_part(pairs[5:], tmp_path / "proposals/part-00001.parquet")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(data.export, "write_feedback", lambda *_: None)
        export(export_config(tmp_path, *overrides))
    return tmp_path / "set"


def export_config(tmp_path: Path, *overrides: str) -> DataExportConfig:
    """The shipped config with the places of a test."""
    places = [f"proposals={tmp_path / 'proposals'}", f"out={tmp_path / 'set'}"]
    ranges = f"ranges={CONFIGS / 'ranges.yaml'}"
    return load_config(
        DataExportConfig, CONFIGS / "data-export.yaml", [*places, ranges, *overrides]
    )


def changed(pair: Proposal, **changes: Any) -> Proposal:
    """A pair with another sample."""
    return replace(pair, sample=replace(pair.sample, **changes))


def as_stored(matrix: ControllerMatrix) -> ControllerMatrix:
    """As it comes back from 32-bit numbers."""
    return ControllerMatrix.of([float(np.float32(value)) for value in matrix.values])
