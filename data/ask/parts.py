"""The parts of a folder of proposals as they are read, and the list of what got no answer."""

import csv
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

from ..proposals import Proposal
from .answers import Refusal

SKIPPED_FILE = "skipped.csv"


def part_paths(folder: Path) -> list[Path]:
    """The parts of a folder of proposals, in order; ValueError where there are none."""
    paths = sorted(folder.glob("part-*.parquet"))
    if not paths:
        raise ValueError(f"{folder} holds no proposals; run `python -m data.propose` first")
    return paths


def num_rows(paths: Sequence[Path]) -> int:
    """How many proposals the parts hold."""
    import pyarrow.parquet as parquet

    return sum(_whole(parquet.read_metadata, path).num_rows for path in paths)


def read_part(path: Path) -> list[Proposal]:
    """The proposals of one part."""
    import pyarrow.parquet as parquet

    return [Proposal.of_row(row) for row in _whole(parquet.read_table, path).to_pylist()]


def _whole(read: Callable[[Path], Any], path: Path) -> Any:
    try:
        return read(path)
    except OSError as error:
        raise ValueError(f"{path} is damaged ({error}); propose again") from error


@dataclass(frozen=True)
class Skip:
    """A pair without an answer: its part, frame and words, and the reason."""

    part: str
    frame: str
    instruction: str
    reason: str

    @staticmethod
    def of(path: Path, proposal: Proposal, refusal: Refusal) -> "Skip":
        """The skip of a proposal of a part."""
        words = proposal.sample.instruction
        return Skip(path.name, proposal.frame_name, words, refusal.reason)


def read_skips(folder: Path) -> list[Skip]:
    """The skips of the finished parts of a folder; those of others are asked again."""
    path = folder / SKIPPED_FILE
    if not path.exists():
        return []
    with path.open(newline="") as file:
        skips = [Skip(**row) for row in csv.DictReader(file)]
    return [skip for skip in skips if (folder / skip.part).exists()]


def write_skips(skips: Sequence[Skip], folder: Path) -> None:
    """Write the list whole or not at all."""
    partial = folder / f".{SKIPPED_FILE}"
    with partial.open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow([field.name for field in fields(Skip)])
        lines.writerows(map(astuple, skips))
    partial.rename(folder / SKIPPED_FILE)
