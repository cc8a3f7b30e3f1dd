"""What the reviewers said, kept for good: one JSON line per action in <folder>/reviews.jsonl.

    action -> one line, written and fsynced -> acknowledged
    lines  -> replayed -> the opinions that stand, by proposal

Lines are only ever appended; an undo is a line too. A last line that a crash tore off was never
acknowledged and is cut off at the next start. Any other damaged line is an error.
"""

import fcntl
import logging
import os
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Annotated, Literal

from pydantic import AwareDatetime, ConfigDict, Field, TypeAdapter, ValidationError, with_config

from ridetune.matrix import NUM_PARAMETERS, Style

REVIEWS_FILE = "reviews.jsonl"
Action = Literal["accept", "edit", "reject", "skip", "undo"]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Six = Annotated[
    tuple[Finite, ...], Field(min_length=NUM_PARAMETERS, max_length=NUM_PARAMETERS)
]  # a matrix in the order of PARAMETERS

log = logging.getLogger(__name__)


@with_config(ConfigDict(extra="forbid"))
@dataclass(frozen=True)
class Review:
    """One action of one annotator, as a line of the log holds it.

    number: of the line, from 1. style, values: what the annotator stands for: with `edit` their
    own, else the proposed ones; with `undo` those of the action that is taken back. seconds: spent
    looking at the pair.
    """

    number: Annotated[int, Field(ge=1)]
    proposal_id: Annotated[str, Field(min_length=1)]
    annotator: Annotated[str, Field(min_length=1)]
    action: Action
    style: Style
    values: Six
    seconds: Annotated[Finite, Field(ge=0)]
    time: AwareDatetime


_REVIEW = TypeAdapter(Review)


class Ledger:
    """What stands after the lines so far: opinions and skips without what was taken back."""

    def __init__(self, lines: Sequence[Review] = ()) -> None:
        self._standing: dict[str, list[Review]] = {}  # by proposal, oldest first
        self._of: defaultdict[str, list[Review]] = defaultdict(list)  # by annotator, oldest first
        self._speakers: defaultdict[str, list[str]] = defaultdict(list)  # of each line, by proposal
        for line in lines:
            self.add(line)

    def add(self, line: Review) -> None:
        """Replay one line; ValueError where an undo takes back what is not the last of its own."""
        mine = self._of[line.annotator]
        if line.action != "undo":
            mine.append(line)
            self._standing.setdefault(line.proposal_id, []).append(line)
        elif mine and mine[-1].proposal_id == line.proposal_id:
            self._standing[line.proposal_id].remove(mine.pop())
        else:
            raise ValueError(
                f"{line.annotator} takes back an action on {line.proposal_id}, "
                "which is not the last that stands"
            )
        self._speakers[line.proposal_id].append(line.annotator)

    def opinions(self, proposal_id: str) -> tuple[Review, ...]:
        """What stands on a proposal, the first answer first: accepts, edits and rejections."""
        lines = self._standing.get(proposal_id, ())
        return tuple(line for line in lines if line.action != "skip")

    @property
    def all_opinions(self) -> dict[str, tuple[Review, ...]]:
        """The opinions of every proposal that has one."""
        found = {proposal_id: self.opinions(proposal_id) for proposal_id in self._standing}
        return {proposal_id: opinions for proposal_id, opinions in found.items() if opinions}

    def standing_of(self, annotator: str) -> tuple[Review, ...]:
        """What an annotator did and did not take back, skips too, the oldest first."""
        return tuple(self._of.get(annotator, ()))

    def speakers(self, proposal_id: str) -> tuple[str, ...]:
        """Who acted on a proposal, line by line; also what was taken back, and taking it back."""
        return tuple(self._speakers.get(proposal_id, ()))


class Store:
    """The log, open for writing by this process alone; close it, or use it as a context.

    ValueError if another process writes there or a line is damaged.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / REVIEWS_FILE
        self._file = self.path.open("a+b", buffering=0)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            _sync_folder(folder)
            lines, self._length = _read(self.path)
            self._cut_torn_line()
        except BlockingIOError as error:
            self._file.close()
            raise ValueError(
                f"another review server writes {self.path}; stop it or name another reviews=folder"
            ) from error
        except BaseException:
            self._file.close()
            raise
        self.ledger = Ledger(lines)
        self._next = len(lines) + 1

    def append(
        self,
        *,
        proposal_id: str,
        annotator: str,
        action: Action,
        style: Style,
        values: Sequence[float],
        seconds: float,
    ) -> Review:
        """Write one action; when this returns, it is on the disk. OSError: nothing was kept."""
        line = Review(
            self._next,
            proposal_id,
            annotator,
            action,
            style,
            tuple(values),
            round(seconds, 1),
            datetime.now(UTC).replace(microsecond=0),
        )
        self._write(_REVIEW.dump_json(line) + b"\n")
        self.ledger.add(line)
        self._next += 1
        return line

    def _write(self, data: bytes) -> None:
        descriptor = self._file.fileno()
        if os.fstat(descriptor).st_size != self._length:
            raise OSError(f"{self.path} was changed by someone else; start the review again")
        try:
            if os.write(descriptor, data) != len(data):
                raise OSError(f"{self.path} took only a part of a line; is the disk full?")
            os.fsync(descriptor)
        except OSError:
            os.ftruncate(descriptor, self._length)
            raise
        self._length += len(data)

    def _cut_torn_line(self) -> None:
        torn = self.path.read_bytes()[self._length :]
        if torn:
            log.warning(
                "event=cut_torn_line file=%s: it was never acknowledged: %r", self.path, torn
            )
            os.ftruncate(self._file.fileno(), self._length)
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    def __enter__(self) -> "Store":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def read_reviews(folder: Path) -> dict[str, tuple[Review, ...]]:
    """The opinions that stand by proposal, the first answer first; the file is not changed.

    ValueError with file and line where there are none or a line is damaged.
    """
    path = folder / REVIEWS_FILE
    if not path.is_file():
        raise ValueError(f"no reviews at {path}; run `python -m data.review` first")
    lines, length = _read(path)
    if length < path.stat().st_size:
        log.warning("event=torn_line file=%s: the last line is left out", path)
    return Ledger(lines).all_opinions


def _read(path: Path) -> tuple[list[Review], int]:
    """All whole lines, and how many bytes they take; what is behind them was torn off."""
    content = path.read_bytes()
    length = content.rfind(b"\n") + 1
    lines: list[Review] = []
    ledger = Ledger()
    for number, text in enumerate(content[:length].split(b"\n")[:-1], start=1):
        try:
            line = _REVIEW.validate_json(text)
            if line.number != number:
                raise ValueError(f"it says that it is number {line.number}")
            ledger.add(line)
        except ValueError as error:
            raise ValueError(
                f"{path}, line {number} is damaged ({_first(error)}); repair it from a backup"
            ) from error
        lines.append(line)
    return lines, length


def _first(error: ValueError) -> str:
    if not isinstance(error, ValidationError):
        return str(error)
    first = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(part) for part in first["loc"])
    return f"{where}: {first['msg']}" if where else str(first["msg"])


def _sync_folder(folder: Path) -> None:
    """A new file's name survives a power cut only once its folder is on the disk too."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
