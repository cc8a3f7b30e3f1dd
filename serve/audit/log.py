"""The audit log, open for writing: an event is on the disk before it is acknowledged.

    event -> the words become a digest -> one line in the chain -> written, fsynced -> acknowledged

A new file begins when one is full and with each day (UTC), so that old ones can be deleted whole. A
last line that a crash tore off was never acknowledged; it is cut off at the next start.
"""

import errno
import fcntl
import hmac
import logging
import os
import secrets
import threading
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, date, datetime
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import NoReturn

from .chain import GENESIS, DamageError, Line, Link, log_files, log_path, walk, write_line
from .events import Asked, Event, GapEvent, PrunedEvent

MAX_FILE_BYTES = 16 * 1024 * 1024
_KEY_BYTES = 32
_log = logging.getLogger(__name__)


class LogStoppedError(OSError):
    """The event is not on the disk, nor is any part of it; the message says why."""


def _now() -> datetime:
    return datetime.now(UTC)


class AuditLog:
    """The log, open for writing by this process alone; safe to call from any thread.

    keep_words: whether the passengers' words are written; without it only their digest is, an
    HMAC-SHA-256 under `key`, because a plain hash of a short sentence is soon guessed. Without a
    key each run takes a random one: equal words show within a run, and nobody can try sentences
    later. Words once written go only with `prune`. clock: the time of day, with its zone.

    ValueError if another process writes there, the newest file is damaged, or the key is short.
    """

    def __init__(
        self,
        folder: Path,
        *,
        keep_words: bool = False,
        key: bytes | None = None,
        max_bytes: int = MAX_FILE_BYTES,
        clock: Callable[[], datetime] = _now,
    ) -> None:
        if key is not None and len(key) < _KEY_BYTES:
            raise ValueError(f"the audit key has {len(key)} bytes, it needs {_KEY_BYTES}")
        self.folder = folder
        self._keep_words = keep_words
        self._key = secrets.token_bytes(_KEY_BYTES) if key is None else key
        self._max_bytes = max_bytes
        self._clock = clock
        self._turn = threading.Lock()
        self._stopped: str | None = None
        self._gap: GapEvent | None = None
        self._last = GENESIS
        self._file: FileIO | None = None
        self._length = 0
        self._day: date | None = None
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._folder = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        self._open_folder = True
        try:
            fcntl.flock(self._folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._resume()
        except BlockingIOError as error:
            self.close()
            raise ValueError(
                f"another process writes the audit log in {folder}; stop it or name another folder"
            ) from error
        except BaseException:
            self.close()
            raise

    @property
    def last(self) -> Link:
        """The last acknowledged line; noted elsewhere, it shows later whether the end was cut."""
        return self._last

    def append(self, event: Event) -> Line:
        """Write one event; when this returns, it is on the disk.

        LogStoppedError: it is not, nor is any part of it. After a full disk the next append tries
        again and records first how many events are missing; after any other fault the log stays
        stopped until it is opened again. ValueError: a line cannot hold the event.
        """
        with self._turn:
            return self._append(self._private(event))

    def prune(self, before: datetime) -> int:
        """Delete the files whose newest line is older than `before`; returns how many lines went.

        The chain goes on: a line that names the last deleted one is written first. DamageError if
        such a file is damaged; it stays. The file that is written to stays too, so append first.
        """
        with self._turn:
            old: list[Path] = []
            num_lines, end = 0, GENESIS
            for path in log_files(self.folder)[:-1]:
                lines = list(walk(path, None))
                if lines[-1].time >= before:
                    break
                old.append(path)
                num_lines, end = num_lines + len(lines), lines[-1].link
            if old:
                self._append(PrunedEvent(through=end.number, sha256=end.sha256))
            for path in old:
                path.unlink()
            os.fsync(self._folder)
            return num_lines

    def close(self) -> None:
        """Let go of the log; a later append is refused."""
        with self._turn:
            self._stopped = "it was closed"
            if self._file is not None:
                self._file.close()
            if self._open_folder:
                os.close(self._folder)
                self._open_folder = False

    def __enter__(self) -> "AuditLog":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _resume(self) -> None:
        """Go on behind the last whole line; after a crash the newest file may hold none."""
        for path in reversed(log_files(self.folder)):
            lines = _repair(path)
            if lines:
                self._last = lines[-1].link
                self._open(path, lines[0].time)
                return
            path.unlink()
            os.fsync(self._folder)

    def _private(self, event: Event) -> Event:
        """The event without the words, or with them, and with their digest."""
        if not isinstance(event, Asked) or event.instruction is None:
            return event
        said = event.instruction.encode("utf-8", "replace")
        return replace(
            event,
            instruction=event.instruction if self._keep_words else None,
            instruction_digest=hmac.digest(self._key, said, "sha256").hex(),
        )

    def _append(self, event: Event) -> Line:
        if self._stopped is not None:
            raise LogStoppedError(f"the audit log in {self.folder} has stopped: {self._stopped}")
        now = self._clock().astimezone(UTC)
        before = [] if self._gap is None else [self._gap]
        last, data = self._last, b""
        for each in (*before, event):
            line, written = write_line(each, last, now)
            last, data = line.link, data + written
        try:
            self._write(data, now)
        except OSError as error:
            self._fail(error, now)
        self._last, self._gap = last, None
        return line

    def _write(self, data: bytes, now: datetime) -> None:
        full = self._length + len(data) > self._max_bytes
        if self._file is None or full or now.date() != self._day:
            self._open(log_path(self.folder, self._last.number + 1), now)
        assert self._file is not None
        descriptor = self._file.fileno()
        here, there = os.fstat(descriptor), Path(self._file.name).stat()
        if here.st_ino != there.st_ino or here.st_size != self._length:
            raise OSError(f"somebody else changed {self._file.name}")
        try:
            if os.write(descriptor, data) != len(data):
                raise OSError(errno.ENOSPC, "only a part of the line was taken")
            os.fsync(descriptor)
        except OSError:
            os.ftruncate(descriptor, self._length)
            raise
        self._length += len(data)

    def _open(self, path: Path, first: datetime) -> None:
        """Write to this file from now on; first: the time of its first line."""
        file = FileIO(path, "a")
        os.fchmod(file.fileno(), 0o600)
        os.fsync(self._folder)  # a new name survives a power cut only with its folder
        if self._file is not None:
            self._file.close()
        self._file, self._length, self._day = file, os.fstat(file.fileno()).st_size, first.date()

    def _fail(self, error: OSError, now: datetime) -> NoReturn:
        """Remember the event as missing, and stop for good unless the disk is only full."""
        since, missed = (self._gap.since, self._gap.num_events) if self._gap else (now, 0)
        self._gap = GapEvent(num_events=missed + 1, since=since)
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            why = "the disk is full; free some space"
        else:
            why = self._stopped = f"{error.strerror or error}; look after it and start again"
        raise LogStoppedError(f"the audit log in {self.folder} took nothing: {why}") from error


def _repair(path: Path) -> list[Line]:
    """The lines of the newest file, after cutting off one that a crash tore."""
    try:
        return list(walk(path, None))
    except DamageError as error:
        if not error.torn:
            raise ValueError(
                f"{error}; the log is not written on. Move its folder away as it is, "
                "the server begins a new one"
            ) from error
        whole = path.read_bytes().rfind(b"\n") + 1
        # The bytes are not shown: they may hold what a passenger said.
        torn = path.stat().st_size - whole
        _log.warning(
            "event=cut_torn_line file=%s row=%s num_bytes=%s: it was never acknowledged",
            path,
            error.row,
            torn,
        )
    with path.open("r+b") as file:
        file.truncate(whole)
        os.fsync(file.fileno())
    return list(walk(path, None))
