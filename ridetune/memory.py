"""What each passenger said and felt, kept for good on board: the record of the memory.

    decision + feedback -> add -> one entry (I, C, P, F), on the disk -> acknowledged
    passenger           -> newest, entries, count, export, erase

I: instruction, C: scene, P: matrix, F: feedback. A decision is remembered once the passenger has
said how it felt. Every question names one passenger and sees the entries of that passenger alone.
"""

import sqlite3
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType

from ridetune.codec import MatrixCodec
from ridetune.memory_entry import (
    Entry,
    bounded,
    check_condition,
    check_name,
    clean_memory,
    microseconds,
    moment,
)
from ridetune.memory_file import EntryFile
from ridetune.memory_seal import Checksum, KeySeal, Seal, SealError
from ridetune.sample import Condition, Memory

MEMORY_FILE = "memory.sqlite"
QUOTA = 10_000
RETENTION_DAYS = 90
_MAX_RETENTION_DAYS = 36_500


class PassengerMemory:
    """The entries of all passengers of one car, in <folder>/memory.sqlite; threads may share it.

    key: 32 bytes that the entries are encrypted with; without one they lie open. quota: of entries
    for each passenger, beyond it the oldest go. Entries older than retention_days are never read,
    and leave the file at the start and with `retire`, which a server calls now and then. clock:
    the time, with its zone; where it stands before the newest entry, that entry's time is taken.

    ValueError where the file cannot be used (damaged, foreign, in use, another key), or an argument
    cannot. OSError where the disk is full or fails; what was to be added is not there then.
    """

    def __init__(
        self,
        folder: Path,
        codec: MatrixCodec,
        *,
        key: bytes | None = None,
        quota: int = QUOTA,
        retention_days: float = RETENTION_DAYS,
        clock: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        if quota < 1 or not 0 < retention_days <= _MAX_RETENTION_DAYS:
            raise ValueError(
                f"a memory keeps at least one entry, for up to {_MAX_RETENTION_DAYS} days; "
                f"got quota={quota} and retention_days={retention_days}"
            )
        self._codec = codec
        self._seal: Seal = Checksum() if key is None else KeySeal(key)
        self._quota = quota
        self._retention = timedelta(days=retention_days)
        self._clock = clock
        self._file = EntryFile(folder / MEMORY_FILE, self._seal)
        try:
            self.retire()
        except BaseException:
            self.close()
            raise

    def add(
        self,
        passenger: str,
        memory: Memory,
        *,
        condition: Condition | None,
        session: str,
        bundle: str,
    ) -> Entry | None:
        """Keep one decision with its feedback; when this returns an entry, it is on the disk.

        None: the passenger is in privacy mode and nothing was written. ValueError: the words are
        too many or none, the matrix lies outside the vehicle's envelope, a name is none.
        """
        label = self._label(passenger)
        check_name("session", session)
        bundle = bounded("bundle", bundle)
        check_condition(condition)
        said = clean_memory(memory, self._codec)
        with self._file.transaction() as db:
            if db.execute("SELECT 1 FROM private WHERE label = ?", (label,)).fetchone():
                return None
            newest_us = db.execute("SELECT max(time_us) FROM entries").fetchone()[0]
            time_us = max(microseconds(self._clock()), newest_us or 0)
            entry = Entry(0, moment(time_us), passenger, said, condition, session, bundle)
            number = db.execute(
                "INSERT INTO entries (label, time_us, body) VALUES (?, ?, ?)",
                (label, time_us, entry.sealed(self._seal)),
            ).lastrowid
            self._keep_to_quota(db, label)
        assert number is not None
        return replace(entry, number=number)

    def newest(self, passenger: str, count: int) -> list[Entry]:
        """The last `count` entries of a passenger, the newest first."""
        if count < 0:
            raise ValueError(f"cannot read {count} entries; ask for none or more")
        label = self._label(passenger)
        with self._file.transaction() as db:
            rows = db.execute(
                "SELECT number, time_us, body FROM entries WHERE label = ? AND +time_us >= ?"
                " ORDER BY number DESC LIMIT ?",
                (label, self._oldest_us(), count),
            ).fetchall()
        return [self._read(passenger, *row) for row in rows]

    def entries(self, passenger: str) -> list[Entry]:
        """All entries of a passenger, the newest first."""
        return self.newest(passenger, self._quota)

    def count(self, passenger: str) -> int:
        """How many entries a passenger has."""
        label = self._label(passenger)
        with self._file.transaction() as db:
            found = db.execute(
                "SELECT count(*) FROM entries WHERE label = ? AND +time_us >= ?",
                (label, self._oldest_us()),
            ).fetchone()
        return int(found[0])

    def export(self, passenger: str) -> str:
        """Everything that is kept about a passenger: one JSON line for each entry, oldest first."""
        return "".join(entry.json_line() for entry in reversed(self.entries(passenger)))

    def erase(self, passenger: str) -> int:
        """Remove all entries of a passenger without a trace in any file; how many there were.

        The passenger's privacy mode stays as it is. OSError: they may have left traces; the next
        removal or start takes those away.
        """
        return self._remove("label = ?", self._label(passenger))

    def erase_entry(self, passenger: str, number: int) -> bool:
        """Remove one entry of a passenger as `erase` does; False where there is none."""
        return bool(self._remove("label = ? AND number = ?", self._label(passenger), number))

    def retire(self) -> int:
        """Remove what is older than the retention as `erase` does; how many entries there were."""
        return self._remove("time_us < ?", self._oldest_us())

    def set_privacy(self, passenger: str, on: bool) -> None:
        """Privacy mode: while it is on, nothing is added; what is there stays until erased.

        All that the file keeps of it is a digest of the passenger's name.
        """
        label = (self._label(passenger),)
        if not on:
            self._remove("label = ?", *label, table="private")
            return
        with self._file.transaction() as db:
            db.execute("INSERT OR IGNORE INTO private VALUES (?)", label)

    def is_private(self, passenger: str) -> bool:
        """Whether the passenger is in privacy mode."""
        label = self._label(passenger)
        with self._file.transaction() as db:
            found = db.execute("SELECT 1 FROM private WHERE label = ?", (label,)).fetchone()
        return found is not None

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    def __enter__(self) -> "PassengerMemory":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _keep_to_quota(self, db: sqlite3.Connection, label: bytes) -> None:
        gone = db.execute(
            "DELETE FROM entries WHERE number IN (SELECT number FROM entries WHERE label = ?"
            " ORDER BY number DESC LIMIT -1 OFFSET ?)",
            (label, self._quota),
        ).rowcount
        if gone:  # the wipe waits for the next removal or start: it writes the whole file anew
            db.execute("UPDATE about SET traces = 1")

    def _remove(self, where: str, *values: object, table: str = "entries") -> int:
        with self._file.transaction() as db:
            gone = db.execute(f"DELETE FROM {table} WHERE {where}", values).rowcount
            if gone:
                db.execute("UPDATE about SET traces = 1")
        self._file.wipe()
        return gone

    def _read(self, passenger: str, number: int, time_us: int, body: bytes) -> Entry:
        try:
            entry = Entry.unsealed(self._seal, number=number, time_us=time_us, body=body)
            if entry.passenger != passenger:
                raise SealError("it is another passenger's")
        except SealError as error:
            raise ValueError(
                f"entry {number} in {self._file.path} is damaged: {error}; "
                "erase it, or restore the file from a backup"
            ) from error
        return entry

    def _label(self, passenger: str) -> bytes:
        check_name("passenger", passenger)
        return self._seal.label(passenger)

    def _oldest_us(self) -> int:
        return microseconds(self._clock() - self._retention)
