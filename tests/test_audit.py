"""The chain of the audit log: whatever was changed is found, and its line is named."""

import hashlib
import hmac
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from serve.audit.__main__ import main, verify
from serve.audit.chain import Link, log_files, log_path, replay, write_line
from serve.audit.events import DecisionEvent, FallbackEvent, PrunedEvent, StartEvent
from tests.audit_events import EVENTS, KEY, NOON, ROOT, WORDS, write


def fault_of(folder: Path) -> str:
    fault = verify(folder).fault
    assert fault is not None
    return fault


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of six events in two files, which no test changes."""
    folder = tmp_path_factory.mktemp("audit")
    write(folder, *EVENTS, max_bytes=1800)
    assert [len(path.read_bytes().splitlines()) for path in log_files(folder)] == [3, 3]
    return folder


def test_events_are_read_back_as_they_were_recorded(whole: Path) -> None:
    digest = hmac.new(KEY, WORDS.encode(), "sha256").hexdigest()
    expected = [
        replace(event, instruction_digest=digest)
        if isinstance(event, (DecisionEvent, FallbackEvent))
        else event
        for event in EVENTS
    ]
    assert [line.event for line in replay(whole)] == expected
    assert [line.number for line in replay(whole)] == [1, 2, 3, 4, 5, 6]


def test_each_line_holds_the_hash_of_the_line_before_it(whole: Path) -> None:
    previous = "0" * 64
    for path in log_files(whole):
        for text in path.read_text().splitlines():
            raw = json.loads(text)
            sealed = raw.pop("sha256")
            body = json.dumps(raw, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
            assert hashlib.sha256(body.encode()).hexdigest() == sealed
            assert raw["previous"] == previous
            previous = sealed


@pytest.fixture(scope="module")
def changed(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shutil.copytree(whole, tmp_path_factory.mktemp("changed") / "audit")


@settings(deadline=None)
@given(data=st.data())
def test_any_changed_byte_is_found_and_its_line_named(
    whole: Path, changed: Path, data: st.DataObject
) -> None:
    path = data.draw(st.sampled_from(log_files(whole)))
    content = bytearray(path.read_bytes())
    place = data.draw(st.integers(0, len(content) - 1))
    row = content[:place].count(b"\n") + 1
    content[place] ^= data.draw(st.integers(1, 255))
    (changed / path.name).write_bytes(content)
    try:
        assert f"{path.name}, line {row}: " in fault_of(changed)
    finally:
        shutil.copy(path, changed)


@pytest.mark.parametrize(
    ("order", "row"),
    [
        ([1, 2, 3], 1),
        ([0, 2, 3], 2),
        ([0, 1, 3], 3),
        ([1, 0, 2, 3], 1),
        ([0, 2, 1, 3], 2),
        ([0, 1, 3, 2], 3),
        ([0, 0, 1, 2, 3], 2),
        ([0, 1, 2, 3, 3], 5),
        ([0, 1, 2, 0, 3], 4),
    ],
)
def test_lines_missing_swapped_or_repeated_are_named(
    tmp_path: Path, order: list[int], row: int
) -> None:
    write(tmp_path, *EVENTS[:4])
    (path,) = log_files(tmp_path)
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[i] for i in order))
    assert f"{path.name}, line {row}: number" in fault_of(tmp_path)


def test_a_line_that_was_written_anew_does_not_fit_the_next(tmp_path: Path) -> None:
    write(tmp_path / "true", *EVENTS[:3])
    write(tmp_path / "false", StartEvent(bundle="other"))
    (path,), (other,) = log_files(tmp_path / "true"), log_files(tmp_path / "false")
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([other.read_bytes(), *lines[1:]]))
    assert "line 2: the line before it is not the one" in fault_of(tmp_path / "true")


def test_a_missing_or_renamed_file_is_noticed(whole: Path, tmp_path: Path) -> None:
    first, second = log_files(shutil.copytree(whole, tmp_path / "a"))
    first.unlink()
    assert "missing and were not pruned" in fault_of(tmp_path / "a")
    second.rename(first)
    assert "line 1: number 4 stands where 1 should" in fault_of(tmp_path / "a")
    _, second = log_files(shutil.copytree(whole, tmp_path / "b"))
    second.rename(second.with_name("audit-000000000009.jsonl"))
    assert "in a file of another name" in fault_of(tmp_path / "b")


@pytest.mark.parametrize(("claimed", "fits"), [("1", True), ("2", False)])
def test_an_account_of_deleted_lines_must_name_the_line_before_the_first(
    tmp_path: Path, claimed: str, fits: bool
) -> None:
    account = PrunedEvent(through=3, sha256=claimed * 64)
    _, data = write_line(account, Link(3, "1" * 64), NOON)
    log_path(tmp_path, 4).write_bytes(data)
    assert (verify(tmp_path).fault is None) == fits


def test_a_cut_at_the_end_shows_against_a_line_noted_elsewhere(tmp_path: Path) -> None:
    write(tmp_path, *EVENTS)
    known = list(replay(tmp_path))[-1].link
    assert verify(tmp_path, known=known).fault is None
    (path,) = log_files(tmp_path)
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:-1]))
    assert verify(tmp_path).fault is None  # nothing inside tells
    found = verify(tmp_path, known=known)
    assert found.fault is not None and "ends with line 5 and does not hold 6:" in found.fault
    assert verify(tmp_path, known=Link(5, "0" * 64)).fault is not None


def run_verify(*arguments: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "serve.audit", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_the_command_counts_what_is_there(whole: Path) -> None:
    done = run_verify(str(whole))
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()
    assert said[0] == "files 2, lines 6 in all"
    assert "       1  decision limited" in said and "       1  refusal 429" in said
    assert said[-2] == f"last line {list(replay(whole))[-1].link}"
    assert said[-1].startswith("whole")


def test_the_command_names_the_first_fault(whole: Path, tmp_path: Path) -> None:
    log = shutil.copytree(whole, tmp_path / "log")
    for path in log_files(log):
        path.write_bytes(path.read_bytes().replace(b"driver", b"robber").replace(b":429", b":200"))
    done = run_verify(str(log))
    assert done.returncode == 1
    said = done.stdout.splitlines()
    assert said[0] == "files 2, lines 3 before the fault"
    assert said[-1].startswith(f"NOT WHOLE: {log_files(log)[-1]}, line 1: ")


def test_the_command_looks_for_a_line_noted_elsewhere(
    whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = list(replay(whole))[-1].link
    for known, code in ((str(link), 0), (f"7:{link.sha256}", 1), ("last", 2)):
        monkeypatch.setattr(sys, "argv", ["audit", str(whole), "--known", known])
        assert main() == code


def test_the_command_says_where_there_is_no_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in (tmp_path, tmp_path / "no"):
        monkeypatch.setattr(sys, "argv", ["audit", str(folder)])
        assert main() == 2
        assert capsys.readouterr().err.startswith(f"error: no audit log in {folder}")
