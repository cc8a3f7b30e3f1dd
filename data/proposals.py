"""A proposed pair and where it comes from, as the reviewers and the build read it.

    frame + facts + instruction -> Proposal -> (review) -> Sample of the dataset

A folder of proposals holds parts (part-00000.parquet, ...), each written whole or not at all.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from ridetune.sample import Sample, dataset_features

_OWN = ("proposal_id", "source", "licence", "frame_name", "annotator", "confidence")


@dataclass(frozen=True)
class Proposal:
    """One pair that a person may look at before it is learned from.

    frame_name: of the picture within its source, with its variant behind a `+`. annotator: who
    proposed the label, with the version. confidence: 0..1, how much of what it went by was known.
    """

    sample: Sample
    source: str
    licence: str
    frame_name: str
    annotator: str
    confidence: float

    @property
    def proposal_id(self) -> str:
        """The same for the same frame, words and annotator, in every run."""
        said = (self.source, self.frame_name, self.sample.instruction, self.annotator)
        return hashlib.blake2b("\0".join(said).encode(), digest_size=8).hexdigest()

    def as_row(self) -> dict[str, Any]:
        """The row of a part; `Proposal.of_row` is its inverse."""
        return {**self.sample.as_row(), **{name: getattr(self, name) for name in _OWN}}

    @staticmethod
    def of_row(row: dict[str, Any]) -> "Proposal":
        """Read a row with its image undecoded."""
        own = {name: row[name] for name in _OWN if name != "proposal_id"}
        return Proposal(sample=Sample.of_row(row), **own)


def write_part(proposals: Iterable[Proposal], path: Path) -> None:
    """Write one part; it appears whole or not at all."""
    write_whole(part_bytes(proposals), path)


def part_bytes(proposals: Iterable[Proposal]) -> bytes:
    """The content of a part's file."""
    from datasets import Dataset, Features, Value, disable_progress_bars

    disable_progress_bars()  # a part takes a moment; the run has a bar of its own
    own = {name: Value("float32" if name == "confidence" else "string") for name in _OWN}
    features = Features({**dataset_features(), **own})
    content = BytesIO()
    Dataset.from_list([p.as_row() for p in proposals], features=features).to_parquet(content)
    return content.getvalue()


def write_whole(content: bytes, path: Path) -> None:
    """Write a file that appears whole or not at all."""
    partial = path.with_suffix(".partial")
    try:
        partial.write_bytes(content)
        partial.rename(path)
    finally:
        partial.unlink(missing_ok=True)  # on a full disk


def part_path(folder: Path, number: int) -> Path:
    """The file of a part."""
    return folder / f"part-{number:05d}.parquet"


def read_proposals(folder: Path) -> Iterator[Proposal]:
    """All proposals of a folder, one part in memory at a time.

    ValueError where there are none or a part is damaged.
    """
    for path in part_paths(folder):
        yield from read_part(path)


def part_paths(folder: Path) -> list[Path]:
    """The parts of a folder of proposals, in order; ValueError where there are none."""
    paths = sorted(folder.glob("part-*.parquet"))
    if not paths:
        raise ValueError(f"{folder} holds no proposals; run `python -m data.propose` first")
    return paths


def read_part(path: Path) -> list[Proposal]:
    """The proposals of one part; ValueError where it is damaged."""
    import pyarrow.parquet as parquet

    return [Proposal.of_row(row) for row in _whole(parquet.read_table, path).to_pylist()]


def num_rows(paths: Sequence[Path]) -> int:
    """How many proposals the parts hold; ValueError where one is damaged."""
    import pyarrow.parquet as parquet

    return sum(_whole(parquet.read_metadata, path).num_rows for path in paths)


def _whole(read: Callable[[Path], Any], path: Path) -> Any:
    from pyarrow import ArrowInvalid

    try:
        return read(path)
    except (OSError, ArrowInvalid) as error:
        raise ValueError(f"{path} is damaged ({error}); propose again") from error
