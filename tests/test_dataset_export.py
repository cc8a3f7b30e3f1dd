"""Proposals -> dataset: no unfit pair, none that crosses the split, no half-made folder."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data.export import export
from data.feedback import write_feedback
from data.proposals import Proposal, write_part
from data.review.store import Store
from ridetune.codec import MatrixCodec
from ridetune.matrix import ControllerMatrix
from ridetune.sample import Observation, read_samples
from ridetune.stage import hash_files
from tests.proposed_pairs import as_stored, changed, export_config, exported, picture, proposed


@pytest.fixture
def pairs(codec: MatrixCodec) -> list[Proposal]:
    return proposed(codec)


def _skipped(folder: Path) -> list[dict[str, str]]:
    with (folder / "skipped.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def _card(folder: Path) -> str:
    return (folder / "README.md").read_text()


@pytest.mark.parametrize(
    ("changes", "kind", "reason"),
    [
        ({"observation": Observation(picture(3)[:-150])}, "picture", "damaged"),
        ({"observation": Observation(b"GIF89a")}, "picture", "JPEG or PNG"),
        ({"instruction": " ... "}, "instruction", "no words"),
        ({"instruction": "slower " * 60}, "instruction", "the limit is 400"),
        ({"matrix": ControllerMatrix(0.2, 0.001, 0.1, 0.05, 1.0, np.nan)}, "matrix", "W_s = nan"),
        ({"matrix": ControllerMatrix(9.0, 0.001, 0.1, 0.05, 1.0, 1.0)}, "matrix", "K_p = 9"),
        ({"matrix": ControllerMatrix(0.15, 0.004, 0.1, 0.05, 1, 1)}, "matrix", "above K_p^2/8"),
        ({"matrix": ControllerMatrix(0.9, 0.001, 0.1, 0.05, 1, 1)}, "matrix", "conservative range"),
        ({"condition": "hail"}, "label", "its condition 'hail' is none of sunny, rain"),
        ({"level": "IV"}, "label", "its level 'IV'"),
        ({"style": "wild"}, "label", "its style 'wild'"),
        ({"split": "dev"}, "label", "its split 'dev'"),
        ({"observation": Observation(picture(3), float("nan"))}, "number", "its speed is nan"),
    ],
)
def test_an_unfit_pair_is_left_out_and_listed(
    pairs: list[Proposal], changes: dict[str, Any], kind: str, reason: str, tmp_path: Path
) -> None:
    unfit = changed(pairs[0], **changes)
    folder = exported([unfit, *pairs[1:]], tmp_path)
    (line,) = _skipped(folder)
    assert (line["kind"], line["frame"]) == (kind, "train-0.jpg")
    assert reason in line["reason"] and line["proposal_id"] == unfit.proposal_id
    assert len(read_samples(folder / "train.parquet")) == 20
    assert f"1 pair was left out, with its reason in `skipped.csv`: {kind} 1." in _card(folder)


def test_the_same_frame_and_instruction_is_kept_once(pairs: list[Proposal], tmp_path: Path) -> None:
    said = f"{pairs[0].sample.instruction.upper()} "
    folder = exported([*pairs, changed(pairs[0], instruction=said)], tmp_path)
    (line,) = _skipped(folder)
    assert line["kind"] == "repeat" and line["instruction"] == said
    assert len(read_samples(folder / "train.parquet")) == 21


@pytest.mark.parametrize(("field", "called"), [("scene_id", "scene"), ("phrase_id", "phrase")])
@pytest.mark.parametrize("learned_from", ["train", "calibration"])
def test_what_stands_on_both_sides_of_the_split_is_refused(
    pairs: list[Proposal], field: str, called: str, learned_from: str, tmp_path: Path
) -> None:
    at = next(i for i, pair in enumerate(pairs) if pair.sample.split == learned_from)
    tested = getattr(pairs[-1].sample, field)
    pairs[at] = changed(pairs[at], **{field: tested})
    with pytest.raises(ValueError, match=f"the {called} {tested} stands in the test split"):
        exported(pairs, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["proposals"]


@pytest.mark.parametrize(
    ("field", "reason"),
    [
        ("instruction", "its instruction is in the test split too"),
        ("observation", "its picture is in the test split too"),
    ],
)
def test_words_and_pictures_of_the_test_split_are_not_learned_from(
    pairs: list[Proposal], field: str, reason: str, tmp_path: Path
) -> None:
    pairs[0] = changed(pairs[0], **{field: getattr(pairs[-1].sample, field)})
    folder = exported(pairs, tmp_path)
    assert [line["reason"] for line in _skipped(folder)] == [reason]
    assert len(read_samples(folder / "test.parquet")) == 6


def test_without_a_pair_to_train_on_the_export_is_refused(
    pairs: list[Proposal], tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match="leaves no pair to train on; propose from more"):
        exported([pair for pair in pairs if pair.sample.split != "train"], tmp_path)
    wordless = [changed(p, instruction="?") if p.sample.split == "train" else p for p in pairs]
    with pytest.raises(ValueError, match="21 were left out for 'instruction'"):
        exported(wordless, tmp_path)
    assert not (tmp_path / "set").exists()


def test_without_calibration_and_test_the_card_warns(pairs: list[Proposal], tmp_path: Path) -> None:
    folder = exported([pair for pair in pairs if pair.sample.split == "train"], tmp_path)
    assert "No pair is for calibration" in _card(folder)
    assert "No pair is for testing" in _card(folder)
    assert not (folder / "test.parquet").exists() and not (folder / "jsonl/test.jsonl").exists()
    assert list(json.loads((folder / "dataset_info.json").read_text())) == ["ridetune_own_train"]


@pytest.mark.parametrize("out", ["proposals", "."])
def test_an_export_over_its_own_proposals_is_refused(
    pairs: list[Proposal], tmp_path: Path, out: str
) -> None:
    with pytest.raises(ValueError, match="would replace the proposals"):
        exported(pairs, tmp_path, f"out={tmp_path / out}")
    assert len(list((tmp_path / "proposals").iterdir())) == 2


def test_the_same_proposals_give_the_same_bytes(pairs: list[Proposal], tmp_path: Path) -> None:
    first = hash_files(exported(pairs, tmp_path))
    assert first == hash_files(exported(pairs, tmp_path))
    assert {"README.md", "contact_sheet.jpg", "plots/values.svg", "config.yaml"} <= set(first)


def test_feedback_is_what_the_build_writes(pairs: list[Proposal], tmp_path: Path) -> None:
    (tmp_path / "proposals").mkdir()
    write_part(pairs, tmp_path / "proposals/part-00000.parquet")
    export(export_config(tmp_path))
    write_feedback(["en"], tmp_path)
    for name in ("feedback-train.json", "feedback-test.json"):
        assert (tmp_path / "set" / name).read_bytes() == (tmp_path / name).read_bytes()


def test_reviews_decide_what_is_kept(pairs: list[Proposal], tmp_path: Path) -> None:
    calmer = ControllerMatrix(0.2, 0.001, 0.1, 0.05, 1.0, 1.0)
    with Store(tmp_path / "reviews") as store:

        def say(pair: Proposal, action: Any, annotator: str = "ann", **other: Any) -> None:
            own = {"style": pair.sample.style, "values": pair.sample.matrix.values, **other}
            store.append(
                proposal_id=pair.proposal_id, annotator=annotator, action=action, seconds=3, **own
            )

        say(pairs[0], "accept")
        say(pairs[1], "edit", style="conservative", values=calmer.values)
        say(pairs[2], "reject")
        say(pairs[3], "accept")
        say(pairs[3], "edit", "bob", style="aggressive", values=calmer.values)
    reviews = f"reviews={tmp_path / 'reviews'}"
    folder = exported(pairs, tmp_path, reviews, "keep_unreviewed=true")
    kinds = [line["kind"] for line in _skipped(folder)]
    assert kinds == ["rejected", "reviewers differ"]
    kept = read_samples(folder / "train.parquet")
    assert len(kept) == 19
    assert (kept[1].style, kept[1].matrix) == ("conservative", as_stored(calmer))
    assert "| yes | 2 |" in _card(folder) and "| no | 17 |" in _card(folder)
    assert [
        sample.style
        for sample in read_samples(exported(pairs, tmp_path, reviews) / "train.parquet")
    ] == [
        "conservative",
        "conservative",
    ]


_SLOW_CARD = """
import sys, time
import data.export as stage
stage.write_card = lambda *_, **__: time.sleep(600)
stage.run_stage(stage.DataExportConfig, "configs/data-export.yaml", stage.export, "")
"""


@pytest.mark.slow
def test_a_killed_export_leaves_nothing_that_looks_whole(
    pairs: list[Proposal], root: Path, tmp_path: Path
) -> None:
    asked = exported(pairs, tmp_path).rename(tmp_path / "asked")
    settings = [f"proposals={tmp_path / 'proposals'}", f"out={tmp_path / 'set'}"]
    command = [sys.executable, "-c", _SLOW_CARD, *settings]
    partial = tmp_path / ".set.partial"
    process = subprocess.Popen(command, cwd=root, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 300
        while not (partial / "dataset_info.json").exists() and time.monotonic() < deadline:
            assert process.poll() is None
            time.sleep(0.05)
        assert (partial / "train.parquet").exists()
        os.kill(process.pid, signal.SIGKILL)
        assert process.wait(timeout=60) == -signal.SIGKILL
    finally:
        process.kill()
    assert not (tmp_path / "set").exists() and partial.is_dir()
    again = exported(pairs, tmp_path)
    assert not partial.exists() and hash_files(again) == hash_files(asked)
