"""The lines of the audit log: each names the one before it by hash, so that no change goes unseen.

    {"event":{...},"number":7,"previous":"<sha256 of line 6>","time":"...","sha256":"<of the rest>"}

All but the last field is canonical JSON (sorted keys, no spaces, UTF-8); the last is the SHA-256 of
what stands before it, closed by a brace. A file is named after the number of its first line.
"""

import hashlib
import json
import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from pydantic import AwareDatetime, ConfigDict, TypeAdapter, ValidationError, with_config

from .events import Event, Natural, PrunedEvent, Sha256

_CANONICAL = json.JSONEncoder(
    sort_keys=True,
    separators=(",", ":"),
    ensure_ascii=False,
    allow_nan=False,
    default=datetime.isoformat,
)
_SEAL_LENGTH = len(',"sha256":""}') + 64
_PAST_SEAL = re.compile(rb',"sha256":"[0-9a-f]{64}"\}.', re.DOTALL)
_NAME = re.compile(r"audit-([0-9]{12})\.jsonl")


@dataclass(frozen=True)
class Link:
    """A line by its number and hash: where a chain stands."""

    number: int
    sha256: str

    def __str__(self) -> str:
        return f"{self.number}:{self.sha256}"

    @staticmethod
    def parse(text: str) -> "Link":
        """Read the form NUMBER:SHA256; ValueError for any other."""
        found = re.fullmatch(r"([1-9][0-9]*):([0-9a-f]{64})", text)
        if found is None:
            raise ValueError(f"a line is given as NUMBER:SHA256 (64 hex digits), got {text!r}")
        return Link(int(found[1]), found[2])


GENESIS = Link(0, "0" * 64)  # what the first line follows


@with_config(ConfigDict(extra="forbid"))
@dataclass(frozen=True)
class Line:
    """One event with its place in the chain; time is UTC, of the writing."""

    event: Event
    number: Natural
    previous: Sha256
    time: AwareDatetime
    sha256: Sha256

    @property
    def link(self) -> Link:
        """What the next line has to follow."""
        return Link(self.number, self.sha256)


_LINE = TypeAdapter(Line)
_log = logging.getLogger(__name__)


class DamageError(ValueError):
    """The first line of a log that is not as it was written.

    file, row: where, counted from 1; torn: it is the start of a line that a crash cut short.
    """

    def __init__(self, file: Path, row: int, why: str, *, torn: bool = False) -> None:
        super().__init__(f"{file}, line {row}: {why}")
        self.file, self.row, self.torn = file, row, torn


def log_path(folder: Path, number: int) -> Path:
    """The file that begins with the line of this number."""
    return folder / f"audit-{number:012d}.jsonl"


def log_files(folder: Path) -> list[Path]:
    """The files of a log, oldest first; other files do not count."""
    return sorted(path for path in folder.glob("audit-*.jsonl") if _NAME.fullmatch(path.name))


def write_line(event: Event, last: Link, time: datetime) -> tuple[Line, bytes]:
    """The line that follows `last`, and its bytes; ValueError if it could not be read back."""
    place = {"number": last.number + 1, "previous": last.sha256, "time": time}
    fields = {"event": vars(event), **place}  # an event holds plain values only
    body = _CANONICAL.encode(fields).encode("utf-8", "replace")
    data = body[:-1] + _seal(body) + b"\n"
    return _read(data, last), data


def _seal(body: bytes) -> bytes:
    return f',"sha256":"{hashlib.sha256(body).hexdigest()}"}}'.encode()


def _read(data: bytes, last: Link | None) -> Line:
    """One line with its end, which follows `last` where that is known; ValueError says why not."""
    text = data[:-1]
    if data[-1:] != b"\n" or text[-_SEAL_LENGTH:] != _seal(text[:-_SEAL_LENGTH] + b"}"):
        raise ValueError("these are not the bytes that were written")
    try:
        line = _LINE.validate_json(text)
    except ValidationError as error:
        raise ValueError(_first(error)) from None  # it shows what a passenger said
    if last is not None and line.number != last.number + 1:
        raise ValueError(
            f"number {line.number} stands where {last.number + 1} should: "
            "lines are missing, moved or repeated"
        )
    if last is not None and line.previous != last.sha256:
        raise ValueError("the line before it is not the one that it was written after")
    return line


def _first(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_input=False)[0]
    return f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}"


def walk(path: Path, last: Link | None) -> Iterator[Line]:
    """The lines of one file, of which the first follows `last`; DamageError at the first fault."""
    with path.open("rb") as file:
        for row, data in enumerate(file, start=1):
            if data[-1:] != b"\n" and not _PAST_SEAL.search(data):
                raise DamageError(path, row, "it is torn off, as by a crash", torn=True)
            try:
                line = _read(data, last)
                if row == 1 and path != log_path(path.parent, line.number):
                    raise ValueError(f"number {line.number} stands in a file of another name")
            except ValueError as error:
                raise DamageError(path, row, str(error)) from error
            last = line.link
            yield line


def walk_all(folder: Path) -> Iterator[Line]:
    """The lines of a log, oldest first; DamageError at the first fault, ValueError without a log.

    A log may begin later than with line 1 only if a `PrunedEvent` in it says so.
    """
    files = log_files(folder)
    if not files:
        raise ValueError(f"no audit log in {folder}; the server writes audit-*.jsonl there")
    begin: Line | None = None
    last = GENESIS if files[0] == log_path(folder, 1) else None
    owed = last is None  # an account of the lines before the first
    for path in files:
        for line in walk(path, last):
            begin, last = begin or line, line.link
            pruned = line.event
            if owed and isinstance(pruned, PrunedEvent) and pruned.through >= begin.number - 1:
                # Some of these files may have outlived a crash in the middle of deleting them.
                known = pruned.through == begin.number - 1
                owed = known and pruned.sha256 != begin.previous
            yield line
    if owed:
        raise DamageError(files[0], 1, "the lines before it are missing and were not pruned")


def replay(folder: Path) -> Iterator[Line]:
    """What was recorded, oldest first; as `walk_all`, but a torn last line is left out and said."""
    try:
        yield from walk_all(folder)
    except DamageError as error:
        if not error.torn or error.file != log_files(folder)[-1]:
            raise
        _log.warning("event=torn_line file=%s row=%s: it is left out", error.file, error.row)
