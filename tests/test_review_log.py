"""The log of the reviews: nothing acknowledged is lost, and damage is named."""

import json
import logging
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from data.review.store import REVIEWS_FILE, Store, read_reviews
from tests.review_pairs import CALMER, ROOT, SIX, say


def test_an_action_is_on_disk_before_it_is_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Store(tmp_path) as store:
        synced: list[bytes] = []

        def watched(descriptor: int) -> None:
            synced.append(store.path.read_bytes())

        monkeypatch.setattr(os, "fsync", watched)
        assert not store.ledger.all_opinions
        say(store)
        assert len(synced) == 1 and synced[0].endswith(b"}\n")
        raw = json.loads(store.path.read_text())
    assert raw["number"] == 1 and raw["proposal_id"] == "p0" and raw["annotator"] == "ann"
    assert raw["values"] == list(SIX) and raw["seconds"] == 1.5 and raw["time"].endswith("Z")


def test_the_log_is_replayed_without_what_was_taken_back(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        say(store)
        say(store, "reject", about="p1")
        say(store, "undo", about="p1")
        say(store, "edit", who="bob", values=CALMER)
        say(store, "skip", about="p2")
        before = store.ledger.all_opinions
    with Store(tmp_path) as store:
        assert store.ledger.all_opinions == before == read_reviews(tmp_path)
        assert [o.annotator for o in before["p0"]] == ["ann", "bob"]
        assert set(before) == {"p0"}
        assert say(store, about="p3").number == 6


def test_an_undo_takes_back_only_the_last_of_ones_own(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        say(store)
        say(store, about="p1")
        say(store, who="bob", about="p0")
    line = json.loads((tmp_path / REVIEWS_FILE).read_text().splitlines()[0])
    wrong = {**line, "number": 4, "action": "undo"}  # p0, but p1 was last
    with (tmp_path / REVIEWS_FILE).open("a") as file:
        file.write(json.dumps(wrong) + "\n")
    with pytest.raises(ValueError, match=r"line 4 is damaged .*not the last"):
        read_reviews(tmp_path)


def test_a_line_torn_anywhere_is_cut_off_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Store(tmp_path) as store:
        say(store)
        whole = store.path.stat().st_size
        say(store, about="p1")
    content = (tmp_path / REVIEWS_FILE).read_bytes()
    for end in range(whole + 1, len(content)):
        (tmp_path / REVIEWS_FILE).write_bytes(content[:end])
        assert set(read_reviews(tmp_path)) == {"p0"}  # reading changes nothing
        assert (tmp_path / REVIEWS_FILE).stat().st_size == end
        caplog.clear()
        with caplog.at_level(logging.WARNING), Store(tmp_path) as store:
            assert "cut_torn_line" in caplog.text
            assert set(store.ledger.all_opinions) == {"p0"}
            assert say(store, about="p2").number == 2
        assert set(read_reviews(tmp_path)) == {"p0", "p2"}


@pytest.mark.parametrize(
    "damage",
    [b"", b"{}", b'{"number": 2', b"\xff\x00", b'{"number": 7}', b"null"],
)
def test_a_damaged_line_in_the_middle_names_file_and_line(tmp_path: Path, damage: bytes) -> None:
    with Store(tmp_path) as store:
        for name in ("p0", "p1", "p2"):
            say(store, about=name)
    lines = (tmp_path / REVIEWS_FILE).read_bytes().split(b"\n")
    lines[1] = damage
    (tmp_path / REVIEWS_FILE).write_bytes(b"\n".join(lines))
    for read in (read_reviews, Store):
        with pytest.raises(ValueError, match=r"reviews\.jsonl, line 2 is damaged"):
            read(tmp_path)
    assert (tmp_path / REVIEWS_FILE).read_bytes() == b"\n".join(lines)


def test_a_missing_line_is_noticed(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        for name in ("p0", "p1", "p2"):
            say(store, about=name)
    lines = (tmp_path / REVIEWS_FILE).read_bytes().splitlines(keepends=True)
    (tmp_path / REVIEWS_FILE).write_bytes(lines[0] + lines[2])
    with pytest.raises(ValueError, match=r"line 2 .*number 3"):
        read_reviews(tmp_path)


def test_a_second_server_on_the_same_reviews_is_refused(tmp_path: Path) -> None:
    with Store(tmp_path), pytest.raises(ValueError, match="another review server"):
        Store(tmp_path)
    Store(tmp_path).close()


def test_what_a_full_disk_half_wrote_is_taken_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.write
    with Store(tmp_path) as store:
        say(store)
        monkeypatch.setattr(os, "write", lambda to, data: real(to, data[:20]))
        with pytest.raises(OSError, match="disk full"):
            say(store, about="p1")
        monkeypatch.setattr(os, "write", real)
        assert say(store, about="p2").number == 2
    assert set(read_reviews(tmp_path)) == {"p0", "p2"}


def test_a_log_that_somebody_else_changed_is_not_written_on(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        say(store)
        with store.path.open("a") as file:
            file.write("hello")
        with pytest.raises(OSError, match="changed by someone else"):
            say(store, about="p1")


_WRITER = """
import sys
from pathlib import Path
from data.review.store import Store
with Store(Path(sys.argv[1])) as store:
    print("ready", flush=True)
    while True:
        line = store.append(
            proposal_id=f"p{len(store.ledger.all_opinions)}", annotator="ann", action="accept",
            style="moderate", values=(0.3, 0.004, 0.1, 0.2, 1.0, 0.4), seconds=1.0,
        )
        print(line.number, flush=True)
"""


@pytest.mark.slow
def test_nothing_acknowledged_is_lost_when_the_writer_is_killed(tmp_path: Path) -> None:
    acknowledged = 0
    for kill_after in (1, 7, 20, 3, 40):
        command = [sys.executable, "-c", _WRITER, str(tmp_path)]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as writer:
            assert writer.stdout is not None
            assert writer.stdout.readline() == "ready\n"
            for _ in range(kill_after):
                acknowledged = int(writer.stdout.readline())
            writer.send_signal(signal.SIGKILL)
            said = writer.stdout.read().splitlines()
        # Also what it said between the last look and its end; a torn number is no number.
        acknowledged = max([acknowledged, *(int(n) for n in said[:-1])])
        opinions = read_reviews(tmp_path)
        numbers = sorted(o.number for found in opinions.values() for o in found)
        assert numbers == list(range(1, len(numbers) + 1))
        assert len(numbers) >= acknowledged
