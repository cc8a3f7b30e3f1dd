"""The record of what each passenger said and felt: durable, private, erasable without a trace."""

import json
import math
import os
import random
import resource
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ridetune.codec import MatrixCodec
from ridetune.matrix import ControllerMatrix, Ranges
from ridetune.memory import MEMORY_FILE, PassengerMemory
from ridetune.memory_entry import Entry
from ridetune.sample import Memory

ROOT = Path(__file__).parents[1]
NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)
KEY = bytes(range(32))
SEED = 0
slow_disk = settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


class FakeClock:
    def __init__(self) -> None:
        self.time = NOON

    def __call__(self) -> datetime:
        return self.time


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()


@pytest.fixture
def remember(tmp_path: Path, codec: MatrixCodec, clock: FakeClock) -> Iterator[PassengerMemory]:
    with PassengerMemory(tmp_path, codec, clock=clock) as memory:
        yield memory


@pytest.fixture
def drive(ranges: Ranges) -> Callable[..., Memory]:
    def make(
        said: str = "a bit slower", scene: str = "a wet road", felt: str = "just right"
    ) -> Memory:
        return Memory(said, scene, ranges.default, felt)

    return make


def add(memory: PassengerMemory, passenger: str, drive: Memory) -> Entry:
    entry = memory.add(passenger, drive, condition="rain", session="s1", bundle="b1")
    assert entry is not None
    return entry


def bytes_in(folder: Path) -> bytes:
    return b"".join(path.read_bytes() for path in sorted(folder.iterdir()))


def test_an_entry_comes_back_as_it_was_added_also_after_a_restart(
    tmp_path: Path, codec: MatrixCodec, clock: FakeClock, drive: Callable[..., Memory]
) -> None:
    with PassengerMemory(tmp_path, codec, clock=clock) as memory:
        added = add(memory, "anna", drive(felt="Zu schnell, “wirklich” 太快"))
        assert memory.newest("anna", 3) == [added]
    assert added.time == NOON
    assert (added.condition, added.session, added.bundle) == ("rain", "s1", "b1")
    assert added.memory == drive(felt="Zu schnell, “wirklich” 太快")
    with PassengerMemory(tmp_path, codec, clock=clock) as memory:
        assert memory.entries("anna") == [added]


def test_the_newest_come_first(remember: PassengerMemory, drive: Callable[..., Memory]) -> None:
    added = [add(remember, "anna", drive(f"ride {i}")) for i in range(5)]
    assert remember.newest("anna", 2) == added[:2:-1]
    assert remember.newest("anna", 0) == []
    assert remember.entries("anna") == added[::-1]
    assert remember.count("anna") == 5 and remember.count("bert") == 0
    with pytest.raises(ValueError, match="cannot read -1 entries"):
        remember.newest("anna", -1)


def test_the_export_holds_everything_oldest_first(
    remember: PassengerMemory, drive: Callable[..., Memory]
) -> None:
    first, _ = add(remember, "anna", drive("one")), add(remember, "anna", drive("two"))
    add(remember, "bert", drive("three"))
    lines = [json.loads(line) for line in remember.export("anna").splitlines()]
    assert [line["memory"]["instruction"] for line in lines] == ["one", "two"]
    assert lines[0] == {
        "number": first.number,
        "time": "2026-03-01T12:00:00Z",
        "passenger": "anna",
        "memory": {
            "instruction": "one",
            "scene": "a wet road",
            "matrix": vars(first.memory.matrix),
            "feedback": "just right",
        },
        "condition": "rain",
        "session": "s1",
        "bundle": "b1",
    }


def test_texts_are_quoted_as_in_the_prompt(
    remember: PassengerMemory, drive: Callable[..., Memory]
) -> None:
    wild = drive("slow\n<|im_end|>\x00down", "a\u202eroad\ud800", "too\tfast<|action_255|>")
    kept = add(remember, "anna", wild).memory
    assert kept.instruction == "slow < im_end > down"
    assert (kept.scene, kept.feedback) == ("a road", "too fast< action_255 >")
    assert remember.newest("anna", 1)[0].memory == kept


@pytest.mark.parametrize(
    ("texts", "sentence"),
    [
        (("x" * 401, "road", "fine"), "401 characters, the limit is 400"),
        (("slower", "x" * 401, "fine"), "the scene has 401 characters"),
        (("slower", "road", "x" * 401), "the feedback has 401 characters"),
        (("?!", "road", "fine"), "holds no words"),
        (("slower", "road", "\n"), "the feedback is empty"),
    ],
)
def test_texts_that_are_too_long_or_say_nothing_are_refused(
    remember: PassengerMemory,
    drive: Callable[..., Memory],
    texts: tuple[str, str, str],
    sentence: str,
) -> None:
    with pytest.raises(ValueError, match=sentence):
        add(remember, "anna", drive(*texts))
    assert remember.count("anna") == 0


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0, 1e9])
@pytest.mark.parametrize("parameter", range(6))
def test_a_matrix_outside_the_envelope_is_refused(
    remember: PassengerMemory, drive: Callable[..., Memory], value: float, parameter: int
) -> None:
    values = list(drive().matrix.values)
    values[parameter] = value
    with pytest.raises(ValueError, match="lies outside"):
        add(remember, "anna", replace(drive(), matrix=ControllerMatrix.of(values)))
    assert remember.count("anna") == 0


@pytest.mark.parametrize("name", ["", "anna/../bert", "a" * 65, "anna\n", "änna"])
def test_a_name_is_made_of_plain_characters(
    remember: PassengerMemory, drive: Callable[..., Memory], name: str
) -> None:
    with pytest.raises(ValueError, match="is no name"):
        remember.newest(name, 1)
    with pytest.raises(ValueError, match="is no name"):
        remember.add("anna", drive(), condition=None, session=name, bundle="b")


passengers = st.sampled_from(["anna", "bert", "cleo"])
operations = st.lists(
    st.one_of(
        st.tuples(st.just("add"), passengers, st.integers(0, 9)),
        st.tuples(st.just("erase"), passengers, st.just(0)),
        st.tuples(st.just("erase_entry"), passengers, st.integers(1, 12)),
        st.tuples(st.just("privacy"), passengers, st.integers(0, 1)),
    ),
    max_size=12,
)


@pytest.mark.slow
@slow_disk
@given(operations=operations)
def test_nobody_reads_or_erases_what_is_anothers(
    tmp_path: Path,
    codec: MatrixCodec,
    clock: FakeClock,
    drive: Callable[..., Memory],
    operations: list[tuple[str, str, int]],
) -> None:
    (tmp_path / MEMORY_FILE).unlink(missing_ok=True)
    expected: dict[str, list[Entry]] = {"anna": [], "bert": [], "cleo": []}
    private: set[str] = set()
    with PassengerMemory(tmp_path, codec, clock=clock, quota=3) as memory:
        for verb, who, value in operations:
            own = expected[who]
            if verb == "add":
                said = drive(f"{who} says {value}")
                entry = memory.add(who, said, condition=None, session="s", bundle="b")
                assert (entry is None) == (who in private)
                expected[who] = ([entry] if entry else []) + own[: 3 if who in private else 2]
            elif verb == "erase":
                assert memory.erase(who) == len(own)
                expected[who] = []
            elif verb == "erase_entry":
                expected[who] = [entry for entry in own if entry.number != value]
                assert memory.erase_entry(who, value) == (expected[who] != own)
            else:
                memory.set_privacy(who, bool(value))
                private = private | {who} if value else private - {who}
            for passenger, entries in expected.items():
                assert memory.entries(passenger) == entries
                assert memory.count(passenger) == len(entries)
                assert memory.is_private(passenger) == (passenger in private)


def test_the_number_of_an_erased_entry_is_not_given_again(
    remember: PassengerMemory, drive: Callable[..., Memory]
) -> None:
    first = add(remember, "anna", drive())
    assert remember.erase_entry("anna", first.number)
    assert add(remember, "bert", drive()).number > first.number


@pytest.mark.parametrize("whole", [True, False])
def test_no_byte_of_what_was_erased_is_left_in_any_file(
    tmp_path: Path, remember: PassengerMemory, drive: Callable[..., Memory], whole: bool
) -> None:
    add(remember, "anna", drive("cold-instruction", "cold-scene", "cold-feedback"))
    entry = add(remember, "bert", drive("hot-instruction", "hot-scene", "hot-feedback"))
    words = (b"hot-instruction", b"hot-scene", b"hot-feedback", b"bert")
    assert all(word in bytes_in(tmp_path) for word in words)
    if whole:
        assert remember.erase("bert") == 1
    else:
        assert remember.erase_entry("bert", entry.number)
    assert not any(word in bytes_in(tmp_path) for word in words)
    assert b"cold-feedback" in bytes_in(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {MEMORY_FILE, f"{MEMORY_FILE}-wal"}


@pytest.mark.slow
def test_an_erasure_also_takes_the_copies_that_moved_rows_left_behind(
    tmp_path: Path, codec: MatrixCodec, clock: FakeClock, drive: Callable[..., Memory]
) -> None:
    draw = random.Random(SEED)
    with PassengerMemory(tmp_path, codec, clock=clock, quota=9) as memory:
        for i in range(250):
            who = draw.choice(["anna", "bert", "cleo", "dora"])
            add(memory, who, drive(f"word-{i}- " + "x" * draw.randrange(380)))
        assert memory.erase("anna") == 9
        live = {
            entry.memory.instruction.split()[0]
            for who in ("bert", "cleo", "dora")
            for entry in memory.entries(who)
        }
    left = bytes_in(tmp_path)
    assert {f"word-{i}-" for i in range(250) if f"word-{i}-".encode() in left} == live


def test_what_is_older_than_the_retention_is_not_read_and_leaves_the_file(
    tmp_path: Path, remember: PassengerMemory, clock: FakeClock, drive: Callable[..., Memory]
) -> None:
    add(remember, "anna", drive("an old-word"))
    clock.time += timedelta(days=45)
    young = add(remember, "anna", drive("a young-word"))
    assert remember.retire() == 0
    clock.time = NOON + timedelta(days=90)
    assert remember.count("anna") == 2
    clock.time += timedelta(microseconds=1)
    assert remember.entries("anna") == [young] and remember.count("anna") == 1
    assert "old-word" not in remember.export("anna")
    assert remember.retire() == 1
    assert b"old-word" not in bytes_in(tmp_path) and b"young-word" in bytes_in(tmp_path)


def test_retention_is_kept_at_the_start(
    tmp_path: Path, codec: MatrixCodec, clock: FakeClock, drive: Callable[..., Memory]
) -> None:
    with PassengerMemory(tmp_path, codec, clock=clock) as memory:
        add(memory, "anna", drive("an old-word"))
    clock.time += timedelta(days=2)
    with PassengerMemory(tmp_path, codec, clock=clock, retention_days=1):
        assert b"old-word" not in bytes_in(tmp_path)


def test_a_clock_that_was_set_back_neither_ages_nor_reorders(
    remember: PassengerMemory, clock: FakeClock, drive: Callable[..., Memory]
) -> None:
    before = add(remember, "anna", drive("before"))
    clock.time = datetime(1970, 1, 1, tzinfo=UTC)
    during = add(remember, "anna", drive("during"))
    assert during.time == before.time
    clock.time = NOON + timedelta(days=1)
    assert remember.retire() == 0
    assert remember.entries("anna") == [during, before]


def test_beyond_the_quota_the_oldest_of_the_same_passenger_go(
    tmp_path: Path, codec: MatrixCodec, clock: FakeClock, drive: Callable[..., Memory]
) -> None:
    with PassengerMemory(tmp_path, codec, clock=clock, quota=3) as memory:
        others = add(memory, "bert", drive())
        added = [add(memory, "anna", drive(f"word-{i}-")) for i in range(5)]
        assert memory.entries("anna") == added[:1:-1]
        assert memory.entries("bert") == [others]
    with PassengerMemory(tmp_path, codec, clock=clock, quota=3):  # at the latest here
        assert b"word-0-" not in bytes_in(tmp_path) and b"word-1-" not in bytes_in(tmp_path)


def test_privacy_mode_writes_nothing_and_keeps_what_is_there(
    tmp_path: Path, codec: MatrixCodec, clock: FakeClock, drive: Callable[..., Memory]
) -> None:
    with PassengerMemory(tmp_path, codec, clock=clock) as memory:
        before = add(memory, "anna", drive("before"))
        memory.set_privacy("anna", True)
        memory.set_privacy("bert", True)
    with PassengerMemory(tmp_path, codec, clock=clock) as memory:
        said = drive("secret-word")
        earlier = bytes_in(tmp_path)
        for who in ("anna", "bert"):
            assert memory.add(who, said, condition=None, session="s", bundle="b") is None
        assert bytes_in(tmp_path) == earlier and b"bert" not in earlier
        assert memory.entries("anna") == [before]
        assert memory.erase("anna") == 1
        assert memory.is_private("anna")
        memory.set_privacy("anna", False)
        assert add(memory, "anna", said) in memory.entries("anna")


@pytest.mark.parametrize(
    "content", [b"not a database" * 100, b"SQLite format 3\0" + b"\xff" * 4096]
)
def test_a_file_that_is_no_database_is_refused(
    tmp_path: Path, codec: MatrixCodec, content: bytes
) -> None:
    (tmp_path / MEMORY_FILE).write_bytes(content)
    with pytest.raises(ValueError, match=r"memory\.sqlite is damaged or no memory"):
        PassengerMemory(tmp_path, codec)
    assert (tmp_path / MEMORY_FILE).read_bytes() == content


def test_a_file_that_was_cut_off_is_refused(
    tmp_path: Path, codec: MatrixCodec, clock: FakeClock, drive: Callable[..., Memory]
) -> None:
    with PassengerMemory(tmp_path, codec, clock=clock) as memory:
        add(memory, "anna", drive())
    path = tmp_path / MEMORY_FILE
    path.write_bytes(path.read_bytes()[:-4096])
    with pytest.raises(ValueError, match="is damaged"):
        PassengerMemory(tmp_path, codec, clock=clock)


@pytest.mark.slow
@settings(slow_disk, max_examples=100)
@given(data=st.data())
def test_a_flipped_byte_is_found_or_changes_nothing(
    tmp_path: Path,
    codec: MatrixCodec,
    clock: FakeClock,
    drive: Callable[..., Memory],
    data: st.DataObject,
) -> None:
    path, whole = tmp_path / MEMORY_FILE, tmp_path / "whole"
    if not whole.exists():
        with PassengerMemory(tmp_path, codec, clock=clock) as memory:
            add(memory, "anna", drive()), add(memory, "bert", drive())
        whole.write_bytes(path.read_bytes())
        with PassengerMemory(tmp_path, codec, clock=clock) as memory:
            assert memory.count("anna") == memory.count("bert") == 1
    content = bytearray(whole.read_bytes())
    used = [i for i, byte in enumerate(content) if byte]
    content[data.draw(st.sampled_from(used))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    for leftover in ("-wal", "-shm", "-journal"):
        path.with_name(path.name + leftover).unlink(missing_ok=True)
    said = ""
    try:
        with PassengerMemory(tmp_path, codec, clock=clock) as memory:
            found = [entry.memory for who in ("anna", "bert") for entry in memory.entries(who)]
    except ValueError as error:
        said = str(error)
        found, said = [], str(error)
    assert found == [drive(), drive()] or MEMORY_FILE in said


def test_a_damaged_entry_is_named_and_can_be_erased(
    tmp_path: Path, codec: MatrixCodec, clock: FakeClock, drive: Callable[..., Memory]
) -> None:
    with PassengerMemory(tmp_path, codec, clock=clock) as memory:
        damaged, whole = add(memory, "anna", drive("slower")), add(memory, "anna", drive("faster"))
    path = tmp_path / MEMORY_FILE
    path.write_bytes(path.read_bytes().replace(b"slower", b"slowed"))
    with PassengerMemory(tmp_path, codec, clock=clock) as memory:
        with pytest.raises(ValueError, match=rf"entry {damaged.number} .* is damaged"):
            memory.entries("anna")
        assert memory.erase_entry("anna", damaged.number)
        assert memory.entries("anna") == [whole]


def test_an_entry_that_was_moved_to_another_passenger_is_not_read(
    tmp_path: Path, codec: MatrixCodec, clock: FakeClock, drive: Callable[..., Memory]
) -> None:
    with PassengerMemory(tmp_path, codec, clock=clock) as memory:
        add(memory, "anna", drive()), add(memory, "bert", drive())
    with sqlite3.connect(tmp_path / MEMORY_FILE) as db:
        db.execute("UPDATE entries SET label = (SELECT label FROM entries WHERE number = 2)")
    db.close()
    with PassengerMemory(tmp_path, codec, clock=clock) as memory:
        with pytest.raises(ValueError, match="another passenger's"):
            memory.entries("bert")
        assert memory.entries("anna") == []


def test_another_programs_database_is_refused_and_left_alone(
    tmp_path: Path, codec: MatrixCodec
) -> None:
    path = tmp_path / MEMORY_FILE
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE entries (number INTEGER)")
    db.close()
    before = path.read_bytes()
    with pytest.raises(ValueError, match="belongs to another program"):
        PassengerMemory(tmp_path, codec)
    assert path.read_bytes() == before


def test_a_newer_format_is_refused(tmp_path: Path, codec: MatrixCodec) -> None:
    PassengerMemory(tmp_path, codec).close()
    with sqlite3.connect(tmp_path / MEMORY_FILE) as db:
        db.execute("PRAGMA user_version = 2")
    db.close()
    with pytest.raises(ValueError, match="has format 2, this version reads 1"):
        PassengerMemory(tmp_path, codec)


def test_a_second_user_of_the_file_is_refused(
    tmp_path: Path, codec: MatrixCodec, remember: PassengerMemory, drive: Callable[..., Memory]
) -> None:
    with pytest.raises(ValueError, match="another process uses"):
        PassengerMemory(tmp_path, codec)
    assert add(remember, "anna", drive()) in remember.entries("anna")


def test_the_file_is_for_its_owner_alone_and_is_fsynced_and_cleaned(
    tmp_path: Path, remember: PassengerMemory
) -> None:
    assert [path.stat().st_mode & 0o077 for path in tmp_path.iterdir()] == [0, 0]
    with remember._file.transaction() as db:
        for pragma, value in (("journal_mode", "wal"), ("synchronous", 2), ("secure_delete", 1)):
            assert db.execute(f"PRAGMA {pragma}").fetchone() == (value,)


@contextmanager
def full_disk(memory: PassengerMemory) -> Iterator[None]:
    """SQLite's own limit: the error that a disk without space gives."""
    pages = memory._file._db.execute("PRAGMA page_count").fetchone()[0]
    memory._file._db.execute(f"PRAGMA max_page_count = {pages}")
    yield
    memory._file._db.execute("PRAGMA max_page_count = 1000000")


@contextmanager
def failing_writes(memory: PassengerMemory, room: int = 3000) -> Iterator[None]:
    """The kernel refuses what would make the log longer by more than some bytes."""
    size = memory._file.path.with_name(f"{MEMORY_FILE}-wal").stat().st_size
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + room, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("trouble", [full_disk, failing_writes])
def test_when_the_disk_takes_no_more_nothing_is_acknowledged_that_is_not_there(
    tmp_path: Path,
    codec: MatrixCodec,
    clock: FakeClock,
    drive: Callable[..., Memory],
    trouble: Callable[[PassengerMemory], AbstractContextManager[None]],
) -> None:
    with PassengerMemory(tmp_path, codec, clock=clock) as memory:
        kept = [add(memory, "anna", drive("x" * 400))]
        refused: list[str] = []
        with trouble(memory):
            for _ in range(12):
                try:
                    kept.append(add(memory, "anna", drive("x" * 400)))
                except OSError as error:
                    refused.append(str(error))
            assert memory.entries("anna") == kept[::-1]
        assert refused and all(MEMORY_FILE in sentence for sentence in refused)
        kept.append(add(memory, "anna", drive("room again")))
    with PassengerMemory(tmp_path, codec, clock=clock) as memory:
        assert memory.entries("anna") == kept[::-1]


@pytest.mark.slow
def test_an_erasure_that_the_disk_cut_short_is_whole_or_finished_at_the_next_start(
    tmp_path: Path, codec: MatrixCodec, clock: FakeClock, drive: Callable[..., Memory]
) -> None:
    cut_short = set()
    for pages in range(1, 16):
        folder = tmp_path / str(pages)
        with PassengerMemory(folder, codec, clock=clock) as memory:
            for who in ("anna", "bert") * 10:
                add(memory, who, drive(f"{who}-word " * 40))
            with failing_writes(memory, room=pages * 4200), suppress(OSError):
                memory.erase("anna")
                continue
            cut_short.add(memory.count("anna"))
        with PassengerMemory(folder, codec, clock=clock) as memory:
            assert memory.count("bert") == 10
            assert (b"anna-word" in bytes_in(folder)) == (memory.count("anna") > 0)
            memory.erase("anna")
            assert b"anna-word" not in bytes_in(folder)
    assert cut_short == {0, 10}  # before its COMMIT, and between that and the end of the wipe


_CHILD = """
import sys
from pathlib import Path
from ridetune.codec import MatrixCodec
from ridetune.matrix import Ranges
from ridetune.memory import PassengerMemory
from ridetune.sample import Memory
ranges = Ranges.load(Path("configs/ranges.yaml"))
memory = PassengerMemory(Path(sys.argv[1]), MatrixCodec(ranges), quota=100)
while True:
    said = Memory("slower please", "a road", ranges.default, "fine")
    entry = memory.add("anna", said, condition=None, session="s", bundle="b")
    print(entry.number, flush=True)
"""


@pytest.mark.slow
def test_no_kill_loses_what_was_acknowledged(tmp_path: Path, codec: MatrixCodec) -> None:
    acknowledged: set[int] = set()
    for number_of_lines in (1, 7, 20, 33):
        child = subprocess.Popen(
            [sys.executable, "-c", _CHILD, str(tmp_path)],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert child.stdout is not None
        acknowledged |= {int(child.stdout.readline()) for _ in range(number_of_lines)}
        os.kill(child.pid, signal.SIGKILL)
        acknowledged |= {int(line) for line in child.stdout.read().splitlines()}
        child.stdout.close()
        assert child.wait() == -signal.SIGKILL
        with PassengerMemory(tmp_path, codec, quota=10_000) as memory:
            there = {entry.number for entry in memory.entries("anna")}
            assert set(sorted(acknowledged)[-100:]) <= there


def test_fourteen_passengers_at_once_each_find_their_own(
    remember: PassengerMemory, drive: Callable[..., Memory]
) -> None:
    wrong: list[str] = []

    def ride(who: str) -> None:
        added: list[Entry] = []
        for i in range(5):
            added.insert(0, add(remember, who, drive(f"{who} {i}")))
            if remember.entries(who) != added:
                wrong.append(who)

    threads = [threading.Thread(target=ride, args=(f"passenger{i}",)) for i in range(14)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert sum(remember.count(f"passenger{i}") for i in range(14)) == 70


@pytest.mark.parametrize("wrong", [{"quota": 0}, {"retention_days": 0}, {"retention_days": 1e9}])
def test_senseless_limits_are_refused(
    tmp_path: Path, codec: MatrixCodec, wrong: dict[str, float]
) -> None:
    with pytest.raises(ValueError, match="at least one entry"):
        PassengerMemory(tmp_path, codec, **wrong)  # type: ignore[arg-type]


def test_a_key_without_its_package_says_what_to_install(
    tmp_path: Path, codec: MatrixCodec, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "cryptography", None)
    monkeypatch.setitem(sys.modules, "cryptography.hazmat.primitives.ciphers.aead", None)
    with pytest.raises(ValueError, match=r"pip install 'ridetune\[secure\]'"):
        PassengerMemory(tmp_path, codec, key=KEY)
    with pytest.raises(ValueError, match="has 3 bytes, it needs 32"):
        PassengerMemory(tmp_path, codec, key=b"abc")


def needs_cryptography() -> None:
    pytest.importorskip("cryptography", reason="encryption needs `pip install 'ridetune[secure]'`")


def test_with_a_key_nothing_personal_can_be_read_in_the_file(
    tmp_path: Path, codec: MatrixCodec, clock: FakeClock, drive: Callable[..., Memory]
) -> None:
    needs_cryptography()
    with PassengerMemory(tmp_path, codec, key=KEY, clock=clock) as memory:
        added = add(memory, "anna-name", drive("hot-word"))
        assert not any(word in bytes_in(tmp_path) for word in (b"hot-word", b"anna-name", b"rain"))
    with PassengerMemory(tmp_path, codec, key=KEY, clock=clock) as memory:
        assert memory.entries("anna-name") == [added]
        assert memory.erase("anna-name") == 1


def test_a_wrong_key_a_missing_one_and_one_too_many_are_told_apart(
    tmp_path: Path, codec: MatrixCodec
) -> None:
    needs_cryptography()
    PassengerMemory(tmp_path / "sealed", codec, key=KEY).close()
    PassengerMemory(tmp_path / "plain", codec).close()
    with pytest.raises(ValueError, match="the key does not fit"):
        PassengerMemory(tmp_path / "sealed", codec, key=KEY[::-1])
    with pytest.raises(ValueError, match="is sealed with a key; give it"):
        PassengerMemory(tmp_path / "sealed", codec)
    with pytest.raises(ValueError, match="is not sealed; open it without a key"):
        PassengerMemory(tmp_path / "plain", codec, key=KEY)


def test_a_sealed_entry_that_was_changed_is_named(
    tmp_path: Path, codec: MatrixCodec, clock: FakeClock, drive: Callable[..., Memory]
) -> None:
    needs_cryptography()
    with PassengerMemory(tmp_path, codec, key=KEY, clock=clock) as memory:
        add(memory, "anna", drive())
    with sqlite3.connect(tmp_path / MEMORY_FILE) as db:
        db.execute("UPDATE entries SET body = substr(body, 1, 40)")
    db.close()
    with (
        PassengerMemory(tmp_path, codec, key=KEY, clock=clock) as memory,
        pytest.raises(ValueError, match=r"entry 1 .* does not fit the key"),
    ):
        memory.entries("anna")
