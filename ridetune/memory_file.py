"""The file below the passengers' memory: SQLite, durable when it says so, clean after a removal.

    transaction -> COMMIT: the WAL is fsynced (synchronous=FULL) -> acknowledged
    removal     -> COMMIT -> VACUUM -> the WAL is emptied: no byte of it is left -> acknowledged

secure_delete zeroes what is deleted where it stands now, but not the copies that earlier moves of
rows between pages left behind; only VACUUM, which writes the whole file anew, removes those.
"""

import errno
import os
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ridetune.memory_seal import Seal, SealError

FORMAT = 1
_APPLICATION = 0x52544D31  # "RTM1" in the header: this file is ours
_CHECK = b"ridetune memory"
_SCHEMA = (
    "CREATE TABLE about (seal TEXT NOT NULL, proof BLOB NOT NULL, traces INTEGER NOT NULL) STRICT",
    # AUTOINCREMENT: the number of an erased entry is never given to another.
    "CREATE TABLE entries (number INTEGER PRIMARY KEY AUTOINCREMENT, label BLOB NOT NULL,"
    " time_us INTEGER NOT NULL, body BLOB NOT NULL) STRICT",
    "CREATE INDEX by_label ON entries (label, number, time_us)",
    "CREATE INDEX by_time ON entries (time_us)",
    "CREATE TABLE private (label BLOB PRIMARY KEY) STRICT, WITHOUT ROWID",
)
_PRAGMAS = (
    "locking_mode = EXCLUSIVE",  # no second process, and no -shm file
    "synchronous = FULL",
    "secure_delete = ON",
    "temp_store = MEMORY",  # VACUUM puts no copy into a folder for temporary files
)


class EntryFile:
    """One SQLite file, open for this process alone; threads take turns on one connection.

    One connection and a lock: commits wait for the same disk anyway, a read of the newest entries
    takes a fraction of a millisecond, and the WAL can only be emptied while nobody reads.

    ValueError: the file is damaged, foreign, in use, or sealed in another way. OSError: the disk is
    full or fails; then nothing of the transaction was kept.
    """

    def __init__(self, path: Path, seal: Seal) -> None:
        self.path = path
        self._lock = threading.Lock()
        _make(path)
        with _said_plainly(path):
            self._db = sqlite3.connect(
                path, timeout=1.0, isolation_level=None, check_same_thread=False
            )
        try:
            self._open(seal)
        except BaseException:
            self._db.close()
            raise

    def _open(self, seal: Seal) -> None:
        with _said_plainly(self.path):
            for pragma in _PRAGMAS:
                self._db.execute(f"PRAGMA {pragma}").fetchall()
            is_new = self._ask("PRAGMA schema_version") == 0
            if not is_new:
                self._check_ours()
            if self._ask("PRAGMA journal_mode = WAL") != "wal":
                raise ValueError(
                    f"{self.path} lies on a disk without shared locks; use a local one"
                )
            if not is_new and self._ask("PRAGMA integrity_check(1)") != "ok":
                raise ValueError(_damaged(self.path))
        if is_new:
            self._create(seal)
        self._check_seal(seal)
        self.wipe()  # what a removal that was cut short left behind

    def _create(self, seal: Seal) -> None:
        with self.transaction() as db:
            for statement in _SCHEMA:
                db.execute(statement)
            proof = seal.close(_CHECK, b"")
            db.execute("INSERT INTO about VALUES (?, ?, 0)", (seal.name, proof))
            db.execute(f"PRAGMA application_id = {_APPLICATION}")
            db.execute(f"PRAGMA user_version = {FORMAT}")

    def _check_ours(self) -> None:
        if self._ask("PRAGMA application_id") != _APPLICATION:
            raise ValueError(f"{self.path} belongs to another program; name another folder")
        version = self._ask("PRAGMA user_version")
        if version != FORMAT:
            raise ValueError(
                f"{self.path} has format {version}, this version reads {FORMAT}; "
                "use the version that wrote it"
            )
        found = self._db.execute("SELECT sql FROM sqlite_schema").fetchall()
        if not {(statement,) for statement in _SCHEMA} <= set(found):
            raise ValueError(_damaged(self.path))

    def _check_seal(self, seal: Seal) -> None:
        with self.transaction() as db:
            rows = db.execute("SELECT seal, proof FROM about").fetchall()
        if len(rows) != 1:
            raise ValueError(_damaged(self.path))
        name, proof = rows[0]
        if name != seal.name:
            wrong = "is sealed with a key; give it" if name == "sealed" else "is not sealed"
            remedy = "" if name == "sealed" else "; open it without a key, or name another folder"
            raise ValueError(f"{self.path} {wrong}{remedy}")
        try:
            seal.open(proof, b"")
        except SealError as error:
            if name == "sealed":
                raise ValueError(f"the key does not fit {self.path}; give its own key") from error
            raise ValueError(_damaged(self.path)) from error

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """All or nothing; when the block is left without an error, it is on the disk."""
        with self._lock, _said_plainly(self.path):
            self._db.execute("BEGIN")
            try:
                yield self._db
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:  # some errors have rolled back already
                    self._db.execute("ROLLBACK")
                raise

    def wipe(self) -> None:
        """Leave no trace of removed rows in any file; OSError where that failed: wipe again."""
        with self._lock, _said_plainly(self.path):
            if self._ask("SELECT traces FROM about"):
                self._db.execute("VACUUM")
                self._db.execute("UPDATE about SET traces = 0")
            if self._ask("PRAGMA wal_checkpoint(TRUNCATE)"):
                raise OSError(errno.EBUSY, "the memory's log could not be emptied", str(self.path))

    def close(self) -> None:
        """Let go of the file; further calls raise sqlite3.ProgrammingError."""
        with self._lock:
            self._db.close()

    def _ask(self, statement: str) -> object:
        return self._db.execute(statement).fetchone()[0]


def _make(path: Path) -> None:
    """The folder and an empty file that nobody else may read, both on the disk."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    path.touch(mode=0o600)
    descriptor = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _damaged(path: Path) -> str:
    return f"{path} is damaged or no memory of ridetune; restore it from a backup or move it away"


@contextmanager
def _said_plainly(path: Path) -> Iterator[None]:
    """SQLite's errors as ValueError (the file is not usable) or OSError (the disk failed)."""
    try:
        yield
    except UnicodeDecodeError as error:  # raised instead of an error whose text is damaged too
        raise ValueError(_damaged(path)) from error
    except sqlite3.Error as error:
        if isinstance(error, sqlite3.ProgrammingError):
            raise  # a mistake of the caller, such as a closed file
        # Without a code: the text of a column is no UTF-8.
        primary = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF
        # SQLITE_ERROR: a statement that does not fit, and ours fit every file that is whole.
        if primary in (sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_ERROR):
            raise ValueError(_damaged(path)) from error
        if primary in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            raise ValueError(
                f"another process uses {path}; stop it or name another folder"
            ) from error
        if primary == sqlite3.SQLITE_FULL:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from error
        if primary == sqlite3.SQLITE_READONLY and os.access(path, os.W_OK):
            raise ValueError(_damaged(path)) from error  # its header forbids what the disk allows
        if primary in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM):
            raise OSError(errno.EACCES, os.strerror(errno.EACCES), str(path)) from error
        raise OSError(errno.EIO, f"the memory's disk failed ({error})", str(path)) from error
