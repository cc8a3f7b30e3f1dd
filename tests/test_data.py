"""The dataset build: deterministic, split by scene and words, and labelled by its own rules."""

import json
import signal
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets import Dataset

import data.build
from data.annotate import draw_matrix
from data.build import DataConfig, build
from ridetune.alignment import conservativeness, style_of
from ridetune.codec import MatrixCodec
from ridetune.config import load_config
from ridetune.matrix import STYLES, ki_limit
from ridetune.sample import ADVERSE, CONDITIONS, Sample
from ridetune.vision import decode_frame

TINY = (
    "train_scenes=24",
    "instructions_per_frame=3",
    "calibration_scenes=4",
    "test_scenes=6",
    "phrases=40",
    "frame_width=224",
    "frame_height=128",
)


@pytest.fixture(scope="module")
def make(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Builds a tiny dataset with some overrides and returns its folder."""

    def run(*overrides: str) -> Path:
        out = tmp_path_factory.mktemp("data") / "set"
        settings = [*TINY, f"ranges={root / 'configs/ranges.yaml'}", *overrides]
        config = load_config(DataConfig, root / "configs/data.yaml", [*settings, f"out={out}"])
        build(config)
        return out

    return run


@pytest.fixture(scope="module")
def folder(make: Any) -> Path:
    built: Path = make()
    return built


@pytest.fixture(scope="module")
def samples(folder: Path) -> list[Sample]:
    found = []
    for split in ("train", "calibration", "test"):
        rows = Dataset.from_parquet(str(folder / f"{split}.parquet"), cache_dir=str(folder))
        found += [Sample.of_row(row) for row in rows]
    return found


def _files(folder: Path) -> dict[str, str]:
    files: dict[str, str] = json.loads((folder / "manifest.json").read_text())["files"]
    return {name: digest for name, digest in files.items() if name != "config.yaml"}


def test_the_same_seed_gives_the_same_files(folder: Path, make: Any) -> None:
    files = _files(folder)
    assert {"train.parquet", "calibration.parquet", "test.parquet", "phrases.jsonl"} <= set(files)
    assert _files(make()) == files


def test_another_seed_gives_other_files(folder: Path, make: Any) -> None:
    files, others = _files(folder), _files(make("seed=8"))
    assert all(files[name] != others[name] for name in ("train.parquet", "test.parquet"))


def test_counts_follow_the_config(folder: Path, samples: list[Sample]) -> None:
    counted = {s: sum(x.split == s for x in samples) for s in ("train", "calibration", "test")}
    assert counted == {"train": 24 * 3, "calibration": 4 * 3, "test": 6 * 3 * 5}
    manifest = json.loads((folder / "manifest.json").read_text())
    assert counted.items() <= manifest["samples"].items()
    assert (folder / "config.yaml").is_file()


def test_no_scene_crosses_the_splits(samples: list[Sample]) -> None:
    splits = defaultdict(set)
    for sample in samples:
        splits[sample.scene_id].add(sample.split)
        splits[str(hash(sample.observation.frame))].add(sample.split)
    assert all(len(found) == 1 for found in splits.values())


def test_no_words_of_the_test_split_are_in_another(folder: Path, samples: list[Sample]) -> None:
    # Calibration is a part of what training may see: it shares the training phrases.
    tested = {s.phrase_id for s in samples if s.split == "test"}
    others = {s.phrase_id for s in samples if s.split != "test"}
    rows = [json.loads(line) for line in (folder / "phrases.jsonl").read_text().splitlines()]
    assert tested and not tested & (others | {row["phrase_id"] for row in rows})
    said = {s.instruction for s in samples if s.split == "test"}
    remembered = {m.instruction for s in samples for m in s.memories}
    assert not said & ({s.instruction for s in samples if s.split != "test"} | remembered)


def test_every_frame_is_readable_and_has_the_configured_size(samples: list[Sample]) -> None:
    for sample in samples[::10]:
        assert decode_frame(sample.observation.frame).shape == (128, 224, 3)


def test_rows_survive_the_round_trip(samples: list[Sample]) -> None:
    assert all(Sample.of_row(sample.as_row()) == sample for sample in samples[::7])


def test_a_row_without_an_image_is_refused(samples: list[Sample]) -> None:
    row = samples[0].as_row()
    row["image"] = {"bytes": None, "path": "x.jpg"}
    with pytest.raises(ValueError, match="the image has no bytes"):
        Sample.of_row(row)


def test_labels_lie_in_their_style_and_keep_the_integral_limit(
    samples: list[Sample], codec: MatrixCodec
) -> None:
    rounding = 1e-6  # rows hold 32-bit numbers
    for sample in samples:
        for value, limits in zip(
            sample.matrix.values, codec.ranges.styles[sample.style], strict=True
        ):
            assert limits.lower - rounding <= value <= limits.upper + rounding
        assert sample.matrix.ki <= ki_limit(sample.matrix.kp) + rounding
        assert style_of(sample.matrix, codec.ranges) == sample.style
        assert codec.encode(sample.matrix)
        for memory in sample.memories:
            assert codec.encode(memory.matrix)


def test_drawn_labels_keep_the_integral_limit_exactly(codec: MatrixCodec) -> None:
    rng = np.random.default_rng(0)
    for i in range(3000):
        matrix = draw_matrix(STYLES[i % 3], CONDITIONS[i % 5], None, codec, rng)
        assert matrix.ki <= ki_limit(matrix.kp)


def test_a_test_scene_is_seen_in_every_condition_with_the_same_words(
    samples: list[Sample],
) -> None:
    scenes = defaultdict(set)
    for sample in samples:
        if sample.split == "test":
            scenes[sample.scene_id, sample.instruction].add(sample.condition)
    assert scenes and all(seen == set(CONDITIONS) for seen in scenes.values())


def test_adverse_labels_are_more_conservative_than_those_of_the_same_clear_scene(
    samples: list[Sample], codec: MatrixCodec
) -> None:
    care = {
        (s.scene_id, s.instruction, s.condition): conservativeness(s.matrix, codec)
        for s in samples
        if s.split == "test"
    }
    for condition in ADVERSE:
        gains = [
            value - care[scene, said, "sunny"]
            for (scene, said, seen), value in care.items()
            if seen == condition
        ]
        assert np.mean(gains) > 0


def test_each_frame_gets_all_three_styles(samples: list[Sample]) -> None:
    styles = defaultdict(set)
    for sample in samples:
        styles[sample.scene_id, sample.condition].add(sample.style)
    assert all(found == set(STYLES) for found in styles.values())


def test_explanation_and_scene_are_one_lower_case_line(samples: list[Sample]) -> None:
    for sample in samples:
        for text in (sample.scene, sample.explanation):
            assert text and text == text.lower() and "\n" not in text
        assert sample.explanation.startswith("because ") and sample.explanation.endswith(".")


@pytest.mark.parametrize("shift", ["too_aggressive", "too_conservative"])
def test_remembered_feedback_shifts_the_label_against_the_complaint(
    shift: Any, codec: MatrixCodec
) -> None:
    rng = np.random.default_rng(1)

    def care(feedback: Any) -> float:
        drawn = [draw_matrix("moderate", "sunny", feedback, codec, rng) for _ in range(200)]
        return float(np.mean([conservativeness(m, codec) for m in drawn]))

    change = care(shift) - care("just_right")
    assert change > 0 if shift == "too_aggressive" else change < 0


def test_a_failed_build_leaves_nothing(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    settings = [*TINY, f"ranges={root / 'configs/ranges.yaml'}", f"out={tmp_path / 'set'}"]
    config = load_config(DataConfig, root / "configs/data.yaml", settings)
    monkeypatch.setattr(data.build, "write_manifest", full)
    with pytest.raises(OSError, match="No space left"):
        build(config)
    assert list(tmp_path.iterdir()) == []


def test_a_build_told_to_stop_leaves_nothing_behind(tmp_path: Path) -> None:
    out = tmp_path / "set"
    command = [sys.executable, "-m", "data", f"out={out}", "train_scenes=100000"]
    build = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while not any(tmp_path.iterdir()) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert list(tmp_path.iterdir()) == [tmp_path / ".set.partial"]
        build.terminate()
        assert build.wait(timeout=60) == 128 + signal.SIGTERM
    finally:
        build.kill()
    assert not list(tmp_path.iterdir())
