"""A dataset in the forms that others read: parquet, JSON lines, LLaMA-Factory, Qwen-VL.

    pair -> SplitFiles -> <split>.parquet            rows of `ridetune.sample` with their provenance
                          jsonl/<split>.jsonl        the same rows, the picture by its file name
                          sharegpt/<split>.json      messages as LLaMA-Factory reads them
                          qwen/<split>.json          conversations as the Qwen-VL repositories do
                          images/<digest>.jpg|.png   each picture once, its bytes as they are

The answer is the paper's way: the matrix as fixed-width text, then the explanation. Only one row
group of pairs is in memory at a time.
"""

import json
import re
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from ridetune.codec import MatrixCodec
from ridetune.prompt import MAX_MEMORIES, SYSTEM, clean_instruction, quote
from ridetune.sample import Sample, Split, dataset_features

from .checks import SPLITS, picture_digest
from .proposals import Proposal

IMAGES, JSONL, SHAREGPT, QWEN = "images", "jsonl", "sharegpt", "qwen"
DATASET_INFO_FILE = "dataset_info.json"
# A row group ends at whichever comes first.
_GROUP_ROWS, _GROUP_BYTES = 100, 32 * 1024 * 1024
# The styles of one picture follow each other: a dictionary keeps its bytes once in a row group.
_DICTIONARY_BYTES = 2 * _GROUP_BYTES
# What those who read messages would take for a picture of its own.
_MEDIA = re.compile(r"<(image|video|audio)>", re.IGNORECASE)
_PNG = b"\x89PNG"


class SplitFiles:
    """All files of one split, open for writing; made with the first pair, none without."""

    def __init__(self, folder: Path, split: Split, codec: MatrixCodec) -> None:
        for name in (IMAGES, JSONL, SHAREGPT, QWEN):
            (folder / name).mkdir(exist_ok=True)
        self._folder = folder
        self._codec = codec
        self._open = ExitStack()
        self._parquet = self._open.enter_context(_Parquet(folder / f"{split}.parquet"))
        lines = (folder / JSONL / f"{split}.jsonl").open("w", encoding="utf-8")
        self._lines = self._open.enter_context(lines)
        self._sharegpt = self._open.enter_context(_List(folder / SHAREGPT / f"{split}.json"))
        self._qwen = self._open.enter_context(_List(folder / QWEN / f"{split}.json"))

    def add(self, proposal: Proposal, *, reviewed: bool) -> str:
        """Write one pair in every form; the picture's file, relative to the folder."""
        image = write_image(proposal.sample.observation.frame, self._folder)
        row = {**proposal.as_row(), "reviewed": reviewed}
        self._parquet.add(row)
        self._lines.write(_as_json(_plain_row(row, image)) + "\n")
        self._sharegpt.add(as_messages(proposal.sample, image, self._codec))
        name = proposal.proposal_id
        self._qwen.add(as_conversation(name, proposal.sample, image, self._codec))
        return image

    def close(self) -> None:
        """Write what is still in memory."""
        self._open.close()


def export_features() -> Any:
    """The `datasets.Features` of an exported row: `load_dataset` shows the picture."""
    from datasets import Features, Image, Value

    text = Value("string")
    names = ("proposal_id", "source", "licence", "frame_name", "annotator")
    own = {**dict.fromkeys(names, text), "confidence": Value("float32"), "reviewed": Value("bool")}
    return Features({**dataset_features(), "image": Image(), **own})


def write_image(frame: bytes, folder: Path) -> str:
    """Keep a picture under the name of its content, once; its file, relative to the folder."""
    ending = "png" if frame.startswith(_PNG) else "jpg"
    name = f"{IMAGES}/{picture_digest(frame)}.{ending}"
    path = folder / name
    if not path.exists():
        path.write_bytes(frame)
    return name


def as_messages(sample: Sample, image: str, codec: MatrixCodec) -> dict[str, Any]:
    """One pair as LLaMA-Factory's `sharegpt` form with roles; the prompt reads as ours does."""
    return {
        "messages": [
            {"role": "system", "content": SYSTEM},
            {"role": "user", "content": f"<image>{_asked(sample, codec)}"},
            {"role": "assistant", "content": _answer(sample, codec)},
        ],
        "images": [image],
    }


def as_conversation(name: str, sample: Sample, image: str, codec: MatrixCodec) -> dict[str, Any]:
    """One pair as the Qwen-VL fine-tuning repositories read it.

    They know no system turn and would learn one as an answer: it opens the question.
    """
    return {
        "id": name,
        "image": image,
        "conversations": [
            {"from": "human", "value": f"<image>\n{SYSTEM}\n{_asked(sample, codec)}"},
            {"from": "gpt", "value": _answer(sample, codec)},
        ],
    }


def write_dataset_info(folder: Path, name: str, splits: list[Split]) -> None:
    """What LLaMA-Factory needs beside the files: `dataset_dir` is the folder."""
    about = {
        "formatting": "sharegpt",
        "columns": {"messages": "messages", "images": "images"},
        "tags": {
            "role_tag": "role",
            "content_tag": "content",
            "user_tag": "user",
            "assistant_tag": "assistant",
            "system_tag": "system",
        },
    }
    sets = {
        dataset_name(name, split): {"file_name": f"{SHAREGPT}/{split}.json", **about}
        for split in SPLITS
        if split in splits
    }
    (folder / DATASET_INFO_FILE).write_text(json.dumps(sets, indent=2) + "\n")


def dataset_name(name: str, split: Split) -> str:
    """The name of a split for LLaMA-Factory, whose lists part at commas."""
    return f"{re.sub(r'[^a-z0-9]+', '_', name.lower()).strip('_') or 'dataset'}_{split}"


def _asked(sample: Sample, codec: MatrixCodec) -> str:
    """Memories and instruction in the words of `ridetune.prompt`, a matrix as text."""
    remembered = [
        f"remember: {_harmless(m.instruction)} | {_harmless(m.scene)} | "
        f"{codec.text(m.matrix)} | {_harmless(m.feedback)}"
        for m in sample.memories[:MAX_MEMORIES]
    ]
    said = _harmless(clean_instruction(sample.instruction))
    return "\n".join([*remembered, f"the passenger says: {said}"])


def _answer(sample: Sample, codec: MatrixCodec) -> str:
    return f"{codec.text(sample.matrix)}\n{_harmless(sample.explanation)}"


def _harmless(text: str) -> str:
    """No special token and no place for a picture can hide in it."""
    return _MEDIA.sub(r"< \1 >", quote(text))


def _plain_row(row: dict[str, Any], image: str) -> dict[str, Any]:
    """A row with 32-bit numbers in their shortest form and the picture by name."""
    plain: dict[str, Any] = _shortened({**row, "image": image})
    return plain


def _shortened(value: Any) -> Any:
    if isinstance(value, float):
        return float(str(np.float32(value)))
    if isinstance(value, dict):
        return {key: _shortened(inner) for key, inner in value.items()}
    return [_shortened(inner) for inner in value] if isinstance(value, list) else value


def _as_json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


class _Parquet(ExitStack):
    """A parquet file that grows by row groups, with the metadata that `datasets` reads."""

    def __init__(self, path: Path) -> None:
        import pyarrow.parquet as parquet

        super().__init__()
        self._schema = export_features().arrow_schema
        writer = parquet.ParquetWriter(
            path, self._schema, dictionary_pagesize_limit=_DICTIONARY_BYTES
        )
        self._writer = self.enter_context(writer)
        self.callback(self._flush)
        self._rows: list[dict[str, Any]] = []
        self._bytes = 0

    def add(self, row: dict[str, Any]) -> None:
        self._rows.append(row)
        self._bytes += len(row["image"]["bytes"])
        if len(self._rows) >= _GROUP_ROWS or self._bytes >= _GROUP_BYTES:
            self._flush()

    def _flush(self) -> None:
        import pyarrow

        if self._rows:
            self._writer.write_table(pyarrow.Table.from_pylist(self._rows, schema=self._schema))
        self._rows, self._bytes = [], 0


class _List(ExitStack):
    """A JSON list that is written item by item."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._file: TextIO = self.enter_context(path.open("w", encoding="utf-8"))
        self.callback(self._file.write, "\n]\n")
        self._before = "[\n"

    def add(self, item: dict[str, Any]) -> None:
        self._file.write(self._before + _as_json(item))
        self._before = ",\n"
