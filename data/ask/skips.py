"""The list of the pairs that got no answer."""

import csv
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from ..proposals import Proposal
from .answers import Refusal

SKIPPED_FILE = "skipped.csv"


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
