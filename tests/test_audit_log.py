"""The audit log as it is written: what was acknowledged is there, and nothing that must not be."""

import errno
import logging
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest

from serve.audit.__main__ import verify
from serve.audit.chain import DamageError, log_files, replay
from serve.audit.events import GapEvent, PrunedEvent
from serve.audit.log import AuditLog, LogStoppedError
from tests.audit_events import DECISION, EVENTS, NOON, ROOT, SIX, WORDS, at_noon, contents, write


def test_a_line_torn_anywhere_is_cut_off_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path, EVENTS[0])
    (path,) = log_files(tmp_path)
    kept = path.stat().st_size
    write(tmp_path, DECISION)
    content = path.read_bytes()
    for end in [*range(kept + 1, len(content), 7), len(content) - 1]:
        path.write_bytes(content[:end])
        assert "line 2: it is torn off" in str(verify(tmp_path).fault)
        assert [line.number for line in replay(tmp_path)] == [1]
        assert path.stat().st_size == end  # reading changes nothing
        caplog.clear()
        with caplog.at_level(logging.WARNING), AuditLog(tmp_path, clock=at_noon) as log:
            assert f"num_bytes={end - kept}" in caplog.text
            assert "spilled" not in caplog.text
            assert log.append(EVENTS[5]).number == 2
        assert verify(tmp_path).fault is None


def test_a_file_that_a_crash_left_without_a_line_is_removed(tmp_path: Path) -> None:
    write(tmp_path, EVENTS[0])
    begun = tmp_path / "audit-000000000002.jsonl"
    begun.write_bytes(b'{"event":')
    write(tmp_path, DECISION)
    assert begun not in log_files(tmp_path)
    assert verify(tmp_path).fault is None and len(list(replay(tmp_path))) == 2


@pytest.mark.parametrize("damage", [b"", b"{}", b"\xff\x00", b'{"number":1}', b"null"])
def test_a_damaged_log_is_not_written_on(tmp_path: Path, damage: bytes) -> None:
    write(tmp_path, *EVENTS[:3])
    (path,) = log_files(tmp_path)
    lines = path.read_bytes().split(b"\n")
    lines[1] = damage
    path.write_bytes(b"\n".join(lines))
    with pytest.raises(ValueError, match=r"000001\.jsonl, line 2: .* not written on"):
        AuditLog(tmp_path)
    with pytest.raises(DamageError, match=r"000001\.jsonl, line 2: "):
        list(replay(tmp_path))
    assert path.read_bytes() == b"\n".join(lines)


def test_an_acknowledged_last_line_whose_end_was_damaged_is_not_cut_off(tmp_path: Path) -> None:
    write(tmp_path, *EVENTS[:3])
    (path,) = log_files(tmp_path)
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(ValueError, match=r"line 3: .* not written on"):
        AuditLog(tmp_path)
    with pytest.raises(DamageError, match="line 3: "):
        list(replay(tmp_path))


def test_an_event_is_on_disk_before_it_is_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with AuditLog(tmp_path, clock=at_noon) as log:
        log.append(EVENTS[0])
        synced: list[bytes] = []
        real = os.fsync

        def watched(descriptor: int) -> None:
            real(descriptor)
            synced.append(contents(tmp_path))

        monkeypatch.setattr(os, "fsync", watched)
        line = log.append(EVENTS[1])
        assert len(synced) == 1 and line.sha256.encode() in synced[0].splitlines()[-1]


def test_threads_share_one_chain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda _: time.sleep(0.001))  # lets others run
    with AuditLog(tmp_path, max_bytes=3000, clock=at_noon) as log, ThreadPoolExecutor(8) as pool:
        lines = list(pool.map(lambda _: log.append(DECISION), range(40)))
    assert sorted(line.number for line in lines) == list(range(1, 41))
    assert verify(tmp_path).fault is None
    assert {line.link for line in replay(tmp_path)} == {line.link for line in lines}


def test_files_are_closed_by_size_and_by_day_and_the_chain_goes_on(tmp_path: Path) -> None:
    times = iter([NOON, NOON, NOON + timedelta(days=1), NOON, NOON])
    with AuditLog(tmp_path, max_bytes=2000, clock=lambda: next(times)) as log:
        for _ in range(4):
            log.append(DECISION)
    with AuditLog(tmp_path, max_bytes=2000, clock=lambda: next(times)) as log:
        log.append(DECISION)
    assert [int(path.stem[-3:]) for path in log_files(tmp_path)] == [1, 3, 4]
    assert all(path.stat().st_size <= 2000 for path in log_files(tmp_path))
    assert verify(tmp_path).fault is None and len(list(replay(tmp_path))) == 5


def test_a_second_writer_is_refused_until_the_first_is_gone(tmp_path: Path) -> None:
    with (
        AuditLog(tmp_path, clock=at_noon),
        pytest.raises(ValueError, match="another process writes"),
    ):
        AuditLog(tmp_path, clock=at_noon)
    AuditLog(tmp_path, clock=at_noon).close()


def test_a_full_disk_keeps_nothing_and_says_later_how_much_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.write
    with AuditLog(tmp_path, clock=at_noon) as log:
        log.append(EVENTS[0])
        before = contents(tmp_path)
        monkeypatch.setattr(os, "write", lambda to, data: real(to, data[:20]))
        for _ in range(3):
            with pytest.raises(LogStoppedError, match="the disk is full; free some space"):
                log.append(DECISION)
            assert contents(tmp_path) == before
        monkeypatch.setattr(os, "write", real)
        assert log.append(EVENTS[5]).number == 3
    assert verify(tmp_path).fault is None
    assert [line.event for line in replay(tmp_path)] == [
        EVENTS[0],
        GapEvent(num_events=3, since=NOON),
        EVENTS[5],
    ]


def test_a_disk_that_fails_to_sync_stops_the_log_until_it_is_opened_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(descriptor: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    with AuditLog(tmp_path, clock=at_noon) as log:
        log.append(EVENTS[0])
        before = contents(tmp_path)
        with monkeypatch.context() as broken:
            broken.setattr(os, "fsync", fails)
            with pytest.raises(LogStoppedError, match="Input/output error"):
                log.append(DECISION)
        assert contents(tmp_path) == before
        with pytest.raises(LogStoppedError, match="has stopped: Input/output error"):
            log.append(DECISION)
    write(tmp_path, DECISION)
    assert verify(tmp_path).fault is None and len(list(replay(tmp_path))) == 2


def test_a_file_that_somebody_changed_or_moved_is_not_written_on(tmp_path: Path) -> None:
    def move(path: Path) -> None:
        path.write_bytes(path.rename(path.with_name("old")).read_bytes())

    def lengthen(path: Path) -> None:
        path.write_bytes(path.read_bytes() + b"hello")

    for change in (lengthen, move, Path.unlink):
        folder = tmp_path / change.__name__
        with AuditLog(folder, clock=at_noon) as log:
            log.append(EVENTS[0])
            change(log_files(folder)[0])
            with pytest.raises(LogStoppedError, match="took nothing"):
                log.append(DECISION)


def test_a_closed_log_takes_nothing(tmp_path: Path) -> None:
    log = AuditLog(tmp_path)
    log.close()
    log.close()
    with pytest.raises(LogStoppedError, match="closed"):
        log.append(DECISION)


def test_no_word_of_the_passenger_is_written_unless_the_log_is_told_to(tmp_path: Path) -> None:
    said = [word.strip(",").encode() for word in WORDS.split()]
    write(tmp_path / "with", *EVENTS)
    assert all(word in contents(tmp_path / "with") for word in said)
    write(tmp_path / "without", *EVENTS, keep_words=False)
    assert not any(word in contents(tmp_path / "without") for word in said)


def test_words_cannot_be_guessed_from_their_digest_without_the_key(tmp_path: Path) -> None:
    def digest() -> str:
        with AuditLog(tmp_path, clock=at_noon) as log:
            first, again = (log.append(DECISION).event for _ in range(2))
        assert first == again
        assert isinstance(first, type(DECISION)) and first.instruction_digest is not None
        return first.instruction_digest

    assert digest() != digest()  # each run has its own key
    with pytest.raises(ValueError, match="3 bytes, it needs 32"):
        AuditLog(tmp_path, key=b"abc")


def test_an_event_that_could_not_be_read_back_is_refused_without_quoting_it(
    tmp_path: Path,
) -> None:
    with AuditLog(tmp_path, keep_words=True, clock=at_noon) as log:
        for wrong, words in (
            (replace(DECISION, matrix=(float("nan"), *SIX[1:])), "JSON compliant"),
            (replace(DECISION, matrix=SIX[:5]), "at least 6 items"),
            (replace(DECISION, frame_sha256=WORDS), "should match pattern"),
        ):
            with pytest.raises(ValueError, match=words) as refused:
                log.append(wrong)
            assert "spilled" not in str(refused.value)
        assert not log_files(tmp_path)
        assert log.append(DECISION).number == 1


def test_old_files_are_deleted_whole_and_the_chain_accounts_for_them(tmp_path: Path) -> None:
    days = iter(NOON + timedelta(days=day) for day in (0, 0, 1, 2, 50, 50, 50))
    with AuditLog(tmp_path, clock=lambda: next(days)) as log:
        for _ in range(5):
            log.append(DECISION)
        assert log.prune(NOON) == 0
        assert log.prune(NOON + timedelta(days=2)) == 3
        assert log.append(EVENTS[5]).number == 7
    assert [int(path.stem[-3:]) for path in log_files(tmp_path)] == [4, 5]
    lines = list(replay(tmp_path))
    assert [line.number for line in lines] == [4, 5, 6, 7]
    assert lines[2].event == PrunedEvent(through=3, sha256=lines[0].previous)
    assert verify(tmp_path).fault is None
    log_files(tmp_path)[0].unlink()  # more than was accounted for
    assert "not pruned" in str(verify(tmp_path).fault)


def test_a_crash_between_the_account_and_the_deletion_leaves_a_whole_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dies(path: Path) -> None:
        raise KeyboardInterrupt

    days = iter(NOON + timedelta(days=day) for day in range(9))
    with AuditLog(tmp_path, clock=lambda: next(days)) as log:
        for _ in range(4):
            log.append(DECISION)
        with monkeypatch.context() as crash:
            crash.setattr(Path, "unlink", dies)
            with pytest.raises(KeyboardInterrupt):
                log.prune(NOON + timedelta(days=3))
        assert verify(tmp_path).fault is None
        log_files(tmp_path)[0].unlink()
        assert verify(tmp_path).fault is None
        assert log.prune(NOON + timedelta(days=3)) == 2
    assert verify(tmp_path).fault is None


_WRITER = """
import sys
from pathlib import Path
from serve.audit.log import AuditLog
from tests.audit_events import DECISION
with AuditLog(Path(sys.argv[1]), max_bytes=10_000) as log:
    print("ready", flush=True)
    while True:
        print(log.append(DECISION).link, flush=True)
"""


@pytest.mark.slow
def test_nothing_acknowledged_is_lost_when_the_writer_is_killed(tmp_path: Path) -> None:
    acknowledged: list[str] = []
    for kill_after in (1, 7, 20, 3, 40):
        command = [sys.executable, "-c", _WRITER, str(tmp_path)]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as writer:
            assert writer.stdout is not None
            assert writer.stdout.readline() == "ready\n"
            acknowledged += [writer.stdout.readline() for _ in range(kill_after)]
            writer.send_signal(signal.SIGKILL)
            acknowledged += writer.stdout.readlines()
        links = [str(line.link) for line in replay(tmp_path)]
        # A number that was torn on its way out of the process is no acknowledgement.
        assert {link.strip() for link in acknowledged if link.endswith("\n")} <= set(links)
        assert len(links) >= len(acknowledged) - 5
    assert len(log_files(tmp_path)) > 1
    AuditLog(tmp_path).close()
    assert verify(tmp_path).fault is None
