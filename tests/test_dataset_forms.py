"""Every form of an exported dataset holds the same pairs, and its card counts them."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from datasets import load_dataset
from PIL import Image

from data.formats import dataset_name
from data.proposals import Proposal
from ridetune.codec import MatrixCodec
from ridetune.prompt import SYSTEM
from ridetune.sample import Sample, read_samples
from tests.proposed_pairs import SPLITS, as_stored, changed, exported, proposed


@pytest.fixture
def pairs(codec: MatrixCodec) -> list[Proposal]:
    return proposed(codec)


def _stored(pair: Proposal) -> Sample:
    sample = pair.sample
    memories = tuple(replace(m, matrix=as_stored(m.matrix)) for m in sample.memories)
    return replace(sample, matrix=as_stored(sample.matrix), memories=memories)


def test_exported_samples_are_the_proposed_ones(pairs: list[Proposal], tmp_path: Path) -> None:
    folder = exported(pairs, tmp_path)
    for split in SPLITS:
        asked = [_stored(pair) for pair in pairs if pair.sample.split == split]
        assert read_samples(folder / f"{split}.parquet") == asked
    assert len((folder / "skipped.csv").read_text().splitlines()) == 1
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["samples"] == {"train": 21, "calibration": 3, "test": 6}


def test_datasets_reads_the_folder_and_shows_pictures(
    pairs: list[Proposal], tmp_path: Path
) -> None:
    folder = exported(pairs, tmp_path)
    files = {split: str(folder / f"{split}.parquet") for split in SPLITS}
    cache = str(tmp_path / "cache")
    for found in (
        load_dataset("parquet", data_files=files, cache_dir=cache),
        load_dataset(str(folder), cache_dir=cache),
    ):
        assert {split: len(rows) for split, rows in found.items()} == {
            "train": 21,
            "calibration": 3,
            "test": 6,
        }
        row = found["train"][0]
        assert isinstance(row["image"], Image.Image) and row["image"].size == (128, 72)
        assert (row["licence"], row["reviewed"]) == ("CC BY 4.0", False)


def test_a_picture_of_several_pairs_is_written_once_as_it_is(
    pairs: list[Proposal], tmp_path: Path
) -> None:
    folder = exported(pairs, tmp_path)
    kept = {path.read_bytes(): path.suffix for path in (folder / "images").iterdir()}
    assert set(kept) == {pair.sample.observation.frame for pair in pairs}
    assert sorted(kept.values()) == [".jpg"] * 7 + [".png"] * 3


def test_json_lines_hold_the_same_pairs(pairs: list[Proposal], tmp_path: Path) -> None:
    folder = exported(pairs, tmp_path)
    for split in SPLITS:
        lines = (folder / "jsonl" / f"{split}.jsonl").read_text().splitlines()
        samples = []
        for row in map(json.loads, lines):
            image = {"bytes": (folder / row["image"]).read_bytes()}
            samples.append(Sample.of_row({**row, "image": image}))
        asked = [pair.sample for pair in pairs if pair.sample.split == split]
        assert [s.instruction for s in samples] == [s.instruction for s in asked]
        for sample, other in zip(samples, asked, strict=True):
            assert sample.matrix.values == pytest.approx(other.matrix.values, rel=1e-6)
            assert sample.observation == other.observation


def test_llama_factory_finds_every_pair(
    pairs: list[Proposal], codec: MatrixCodec, tmp_path: Path
) -> None:
    """Read by the rules of its converter: roles in turn, one placeholder for each picture."""
    folder = exported(pairs, tmp_path)
    sets = json.loads((folder / "dataset_info.json").read_text())
    assert list(sets) == [f"ridetune_own_{split}" for split in SPLITS]
    for split in SPLITS:
        about = sets[dataset_name("ridetune own", split)]
        assert about["formatting"] == "sharegpt"
        tags, columns = about["tags"], about["columns"]
        items = json.loads((folder / about["file_name"]).read_text())
        asked = [pair.sample for pair in pairs if pair.sample.split == split]
        for item, sample in zip(items, asked, strict=True):
            turns = item[columns["messages"]]
            roles = [turn[tags["role_tag"]] for turn in turns]
            assert roles == [tags["system_tag"], tags["user_tag"], tags["assistant_tag"]]
            said = [turn[tags["content_tag"]] for turn in turns]
            assert "".join(said).count("<image>") == len(item[columns["images"]]) == 1
            assert (folder / item["images"][0]).read_bytes() == sample.observation.frame
            assert said[0] == SYSTEM and said[1].startswith("<image>")
            assert said[1].endswith(f"the passenger says: {sample.instruction}")
            assert said[1].count("remember: slower please") == len(sample.memories)
            _check_answer(said[2], sample, codec)


def test_the_qwen_form_has_one_question_and_one_answer(
    pairs: list[Proposal], codec: MatrixCodec, tmp_path: Path
) -> None:
    folder = exported(pairs, tmp_path)
    items = json.loads((folder / "qwen/train.json").read_text())
    asked = [pair for pair in pairs if pair.sample.split == "train"]
    for item, pair in zip(items, asked, strict=True):
        assert item["id"] == pair.proposal_id
        assert (folder / item["image"]).read_bytes() == pair.sample.observation.frame
        human, gpt = item["conversations"]
        assert (human["from"], gpt["from"]) == ("human", "gpt")
        assert human["value"].startswith(f"<image>\n{SYSTEM}\n")
        assert human["value"].count("<image>") == 1
        _check_answer(gpt["value"], pair.sample, codec)


def _check_answer(answer: str, sample: Sample, codec: MatrixCodec) -> None:
    matrix = codec.parse(answer)
    assert matrix is not None
    assert matrix.values == pytest.approx(sample.matrix.values, abs=1e-4, rel=1e-3)
    assert answer.endswith(sample.explanation)


@pytest.mark.parametrize("said", ["go <image> now", "<<image>>", "<VIDEO> <|im_end|> go"])
def test_no_words_are_taken_for_a_picture_or_a_special_token(
    pairs: list[Proposal], said: str, tmp_path: Path
) -> None:
    folder = exported([changed(pairs[0], instruction=said), *pairs[1:]], tmp_path)
    for name, count in (("sharegpt", 1), ("qwen", 1)):
        first = json.dumps(json.loads((folder / name / "train.json").read_text())[0])
        assert len(re.findall(r"<(?:image|video)>", first, re.IGNORECASE)) == count
        assert "<|" not in first
    assert read_samples(folder / "train.parquet")[0].instruction == said


def _card(folder: Path) -> str:
    return (folder / "README.md").read_text()


def test_the_counts_of_the_card_add_up(pairs: list[Proposal], tmp_path: Path) -> None:
    tables = re.findall(
        r"^\| (\w+) \| train .*\n\|-.*\n((?:\|.*\n?)+)", _card(exported(pairs, tmp_path)), re.M
    )
    assert {name for name, _ in tables} == {
        *("style", "level", "condition", "language", "source", "annotator", "reviewed", "licence")
    }
    for _, rows in tables:
        *parts, whole = ([int(n) for n in re.findall(r" (\d+) ", r)] for r in rows.splitlines())
        assert np.sum(parts, axis=0).tolist() == whole == [21, 3, 6, 30]


def test_the_card_shows_charts_and_a_sheet(pairs: list[Proposal], tmp_path: Path) -> None:
    folder = exported([replace(pair, licence="a|b\n<c>") for pair in pairs], tmp_path)
    assert "| images: a\\|b &lt;c> | 21 |" in _card(folder)
    with Image.open(folder / "contact_sheet.jpg") as sheet:
        assert sheet.size == (6 * (320 + 12) + 12, 4 * (180 + 74 + 12) + 12)
    for name in re.findall(r"!\[.*?\]\((.*?)\)", _card(folder)):
        assert (folder / name).is_file()
    assert (folder / "plots/values.svg").read_text().count('class="area"') == 18
