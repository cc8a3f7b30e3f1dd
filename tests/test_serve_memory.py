"""Passengers at the server: recalled, remembered once on the disk, private, erased."""

import asyncio
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import chain
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient

from ridetune.matrix import ControllerMatrix
from ridetune.memory import PassengerMemory
from ridetune.sample import Memory
from serve.app import ServeConfig, create_app
from serve.audit.__main__ import verify
from serve.audit.log import AuditLog
from serve.recollection import NUM_HELD, Held, Recollection
from serve.wire import FeedbackIn, RequestError
from tests.fake_policy import CONTRACT, GOAL, RANGES, TOKENIZER, WorkerAtHand, frame

CONFIG = ServeConfig(
    bundle=Path("none"),
    host="127.0.0.1",
    port=0,
    threads=1,
    deadline_s=20.0,
    explanation_s=3.0,
    max_sessions=4,
    queue=2,
)
SAID, FELT = "hurry I am late", "slow"  # words of the fake model


class Car:
    """A server in this process, with its memory and its audit log."""

    def __init__(self, folder: Path, memory: PassengerMemory | None) -> None:
        self.worker = WorkerAtHand()
        self.memory = memory
        self.log = AuditLog(folder / "audit")
        worker: Any = self.worker
        self.client = TestClient(create_app(worker, CONFIG, memory=memory, log=self.log))

    def ask(self, instruction: str = SAID, **fields: str) -> Any:
        form = {"instruction": instruction, **fields}
        return self.client.post("/v1/decide", data=form, files={"frame": frame()})

    def feed_back(self, decision: str, passenger: str, feedback: str = FELT) -> Any:
        body = {"decision": decision, "passenger": passenger, "feedback": feedback}
        return self.client.post("/v1/feedback", json=body)

    def ride(self, passenger: str, instruction: str = SAID, feedback: str = FELT) -> int:
        """One decision with feedback; the number of its entry."""
        decision = self.ask(instruction, passenger=passenger).json()["decision"]
        return int(self.feed_back(decision, passenger, feedback).json()["number"])

    def look_up(self, passenger: str) -> Any:
        return self.client.get(f"/v1/passengers/{passenger}").json()

    def set_privacy(self, passenger: str, on: bool) -> Any:
        return self.client.put(f"/v1/passengers/{passenger}/privacy", json={"on": on})


@pytest.fixture
def car(tmp_path: Path) -> Iterator[Car]:
    with PassengerMemory(tmp_path / "memory", CONTRACT.codec) as memory:
        started = Car(tmp_path, memory)
        yield started
        started.log.close()


def bytes_below(folder: Path) -> bytes:
    return b"".join(path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file())


def assert_one_sentence(response: Any, status: int, words: str) -> None:
    assert response.status_code == status, response.text
    assert set(response.json()) == {"error"}
    assert words in response.json()["error"]


def test_feedback_is_in_the_prompt_of_the_next_decision(car: Car) -> None:
    first = car.ask(passenger="anna", session="s1", condition="rain").json()
    assert first["recalled"] == []
    answer = car.feed_back(first["decision"], "anna")
    assert (answer.status_code, answer.json()["remembered"]) == (200, True)
    number = answer.json()["number"]
    assert car.ask("keep it like this", passenger="anna").json()["recalled"] == [number]
    before, after = car.worker.prompts()
    assert SAID in after and SAID not in after.rpartition("says")[2]
    assert FELT in after and FELT not in before
    actions = CONTRACT.prompts(TOKENIZER).ids.actions
    bins = CONTRACT.codec.encode(ControllerMatrix.of([*chain(*first["matrix"])]))
    shown = [token for token in car.worker.engine.suffixes[1] if token in actions]
    assert shown == [actions[b] for b in bins]
    (entry,) = car.look_up("anna")["entries"]
    provenance = ("rain", "s1", "fake", "clear day, 40 m ahead", first["matrix"])
    names = ("condition", "session", "bundle", "scene", "matrix")
    assert tuple(entry[name] for name in names) == provenance


def test_the_newest_three_are_recalled_newest_first(car: Car) -> None:
    numbers = [car.ride("anna") for _ in range(4)]
    assert car.ask(passenger="anna").json()["recalled"] == numbers[:0:-1]


def test_a_drive_outside_this_bundles_envelope_is_not_recalled(tmp_path: Path) -> None:
    styles = {
        style: (replace(limits[0], maximum=9.0), *limits[1:])
        for style, limits in RANGES.styles.items()
    }
    wide = replace(CONTRACT, ranges=replace(RANGES, styles=styles))
    with PassengerMemory(tmp_path / "memory", wide.codec) as memory:
        numbers = []
        for kp in (GOAL.kp, 8.0):
            drive = Memory(SAID, "", replace(GOAL, kp=kp), FELT)
            entry = memory.add("anna", drive, condition=None, session="s", bundle="b")
            assert entry is not None
            numbers.append(entry.number)
        assert Car(tmp_path, memory).ask(passenger="anna").json()["recalled"] == numbers[:1]


def test_no_passenger_reads_or_takes_the_words_of_another(car: Car) -> None:
    number = car.ride("anna")
    assert car.ask(passenger="bo").json()["recalled"] == []
    assert car.look_up("bo") == {"count": 0, "private": False, "entries": []}
    annas = car.ask(passenger="anna").json()["decision"]
    assert_one_sentence(car.feed_back(annas, "bo"), 404, "no such decision of this passenger")
    nobodys = car.ask().json()["decision"]
    assert car.feed_back(nobodys, "anna").json()["remembered"]
    assert_one_sentence(car.feed_back(nobodys, "bo"), 404, "no such decision")
    assert car.client.delete("/v1/passengers/bo").json() == {"erased": 0}
    assert car.look_up("anna")["entries"][1]["number"] == number


def test_erasure_leaves_no_byte_of_the_words_in_memory_and_audit_log(
    car: Car, tmp_path: Path
) -> None:
    words = [b"Muesli42", b"Kittens43"]
    for _ in range(3):
        car.ride("anna", "hurry I am late Muesli42", "slow Kittens43")
    waiting = car.ask("hurry I am late Muesli42", passenger="anna").json()["decision"]
    assert all(word in bytes_below(tmp_path / "memory") for word in words)
    assert car.client.delete("/v1/passengers/anna").json() == {"erased": 3}
    assert_one_sentence(car.feed_back(waiting, "anna"), 404, "no such decision")
    left = bytes_below(tmp_path)
    assert b'"decision"' in left
    assert not any(word in left for word in [*words, b"anna"])
    assert car.look_up("anna")["count"] == 0
    assert car.ask(passenger="anna").json()["recalled"] == []


def test_privacy_mode_writes_nothing_personal(car: Car, tmp_path: Path) -> None:
    assert car.set_privacy("anna", True).json() == {"private": True}
    before = bytes_below(tmp_path / "memory")
    decision = car.ask("hurry I am late Muesli42", passenger="anna", session="seat-3").json()[
        "decision"
    ]
    assert car.feed_back(decision, "anna").json() == {"remembered": False, "number": None}
    assert bytes_below(tmp_path / "memory") == before
    recorded = bytes_below(tmp_path / "audit")
    assert b'"instruction_digest":null' in recorded and b'"session":null' in recorded
    assert not any(word in recorded for word in (b"Muesli42", b"seat-3", b"anna"))
    car.set_privacy("anna", False)
    assert car.feed_back(decision, "anna").json()["remembered"] is False  # it was said in private
    assert car.look_up("anna") == {"count": 0, "private": False, "entries": []}


def test_privacy_switched_on_after_the_decision_counts(car: Car) -> None:
    decision = car.ask(passenger="anna").json()["decision"]
    car.set_privacy("anna", True)
    assert car.feed_back(decision, "anna").json() == {"remembered": False, "number": None}


def test_only_the_last_decisions_are_held(car: Car) -> None:
    recollection = Recollection(car.memory, CONTRACT.codec, "fake")
    drive = Memory(SAID, "", RANGES.default, "")
    names = [f"{number:032x}" for number in range(NUM_HELD + 1)]
    for name in names:
        recollection.hold(name, Held("anna", drive, None, "s1"))

    def remember(name: str) -> int | None:
        said = FeedbackIn(decision=name, passenger="anna", feedback=FELT)
        return asyncio.run(recollection.remember(said))

    with pytest.raises(RequestError, match=f"last {NUM_HELD}"):
        remember(names[0])
    assert (remember(names[1]), remember(names[-1])) == (1, 2)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({}, "decision: Field required"),
        ({"decision": "x", "passenger": "anna", "feedback": FELT}, "decision: String should match"),
        ({"decision": "0" * 32, "passenger": "../x", "feedback": FELT}, "passenger: String"),
        ({"decision": "0" * 32, "passenger": "a", "feedback": " \n"}, "say how the drive felt"),
        ({"decision": "0" * 32, "passenger": "a", "feedback": "x" * 401}, "at most 400"),
        ({"decision": "0" * 32, "passenger": "a", "feedback": FELT, "mood": 1}, "mood: Extra"),
        ([], "should be an object"),
    ],
)
def test_unusable_feedback_is_refused_in_one_sentence(car: Car, body: Any, words: str) -> None:
    assert_one_sentence(car.client.post("/v1/feedback", json=body), 422, words)


def test_other_unusable_requests_are_refused_in_one_sentence(car: Car) -> None:
    plain = {"content-type": "text/plain"}
    assert_one_sentence(car.client.post("/v1/feedback", content="{}", headers=plain), 415, "json")
    large = {"feedback": "x" * 20_000}
    assert_one_sentence(car.client.post("/v1/feedback", json=large), 413, "too large")
    assert_one_sentence(car.feed_back("0" * 32, "anna"), 404, "no such decision")
    assert_one_sentence(car.client.get("/v1/passengers/a b"), 422, "passenger must be")
    assert_one_sentence(car.client.delete("/v1/passengers/" + "a" * 65), 422, "passenger must be")
    privacy = "/v1/passengers/anna/privacy"
    assert_one_sentence(car.client.put(privacy, json={"on": "yes"}), 422, "on: Input should be")
    assert_one_sentence(car.ask(passenger="a b"), 422, "passenger must be")
    assert_one_sentence(car.ask(passenger="anna", memories="[]"), 422, "not both")


def test_without_a_memory_the_server_says_so_and_decides(tmp_path: Path) -> None:
    car = Car(tmp_path, None)
    answer = car.ask(passenger="anna").json()
    assert answer["recalled"] == []
    sentence = "keeps no memory of passengers"
    assert_one_sentence(car.feed_back(answer["decision"], "anna"), 404, sentence)
    assert_one_sentence(car.client.get("/v1/passengers/anna"), 404, sentence)
    assert_one_sentence(car.client.delete("/v1/passengers/anna"), 404, sentence)
    assert_one_sentence(car.set_privacy("anna", True), 404, sentence)


def test_a_memory_that_fails_costs_no_decision_and_acknowledges_nothing(
    car: Car, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decision = car.ask(passenger="anna").json()["decision"]

    def fail(*_: object, **__: object) -> None:
        raise OSError(5, "the memory's disk failed")

    for name in ("newest", "add", "erase"):
        monkeypatch.setattr(PassengerMemory, name, fail)
    answer = car.ask("hurry I am late Muesli42", passenger="anna", session="seat-3")
    assert (answer.status_code, answer.json()["recalled"]) == (200, [])
    assert b"seat-3" not in bytes_below(tmp_path / "audit")  # whether she is private is not known
    assert_one_sentence(car.feed_back(decision, "anna"), 503, "disk failed")
    assert_one_sentence(car.client.delete("/v1/passengers/anna"), 503, "disk failed")


def test_a_memory_that_is_late_costs_no_decision(car: Car, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PassengerMemory, "newest", lambda *_: time.sleep(0.1))
    recollection = Recollection(car.memory, CONTRACT.codec, "fake")
    assert asyncio.run(recollection.recall("anna", within_s=0.01)).private


def test_entries_beyond_the_retention_go_at_the_start_of_the_server(tmp_path: Path) -> None:
    now = datetime.now(UTC)
    times = [now - timedelta(days=80), now]
    with PassengerMemory(tmp_path / "memory", CONTRACT.codec, clock=lambda: times[0]) as memory:
        car = Car(tmp_path, memory)
        car.ride("anna", "hurry I am late Muesli42")
        times[0] = now + timedelta(days=11)
        with car.client:
            until = time.monotonic() + 20
            while b"Muesli42" in bytes_below(tmp_path / "memory"):
                assert time.monotonic() < until
                time.sleep(0.01)


def start_server(folder: Path) -> tuple["subprocess.Popen[bytes]", str]:
    """The real server process on the fake model; its address once it is ready."""
    log = folder / "log"
    keeps = [f"memory={folder / 'memory'}", f"audit={folder / 'audit'}", "deadline_s=20"]
    command = [sys.executable, "-m", "tests.fake_policy", "port=0", *keeps]
    with log.open("wb") as file:
        process = subprocess.Popen(command, stdout=file, stderr=file)
    until = time.monotonic() + 90
    while time.monotonic() < until and process.poll() is None:
        found = re.search(r"url=(http://\S+)", log.read_text())
        if found and "event=worker_warm" in log.read_text():
            return process, found[1]
        time.sleep(0.05)
    process.kill()
    raise AssertionError(log.read_text())


def keep_riding(url: str, acknowledged: list[int]) -> None:
    """Decisions with feedback until the server is gone."""
    form = {"instruction": SAID, "passenger": "anna"}
    with httpx.Client(base_url=url, timeout=30) as client, suppress(httpx.TransportError):
        while True:
            asked = client.post("/v1/decide", data=form, files={"frame": frame()}).json()
            said = {"decision": asked["decision"], "passenger": "anna", "feedback": FELT}
            acknowledged.append(client.post("/v1/feedback", json=said).json()["number"])


@pytest.mark.slow
def test_no_acknowledged_feedback_is_lost_when_the_server_is_killed(tmp_path: Path) -> None:
    process, url = start_server(tmp_path)
    acknowledged: list[int] = []
    riding = threading.Thread(target=keep_riding, args=(url, acknowledged))
    riding.start()
    while riding.is_alive() and len(acknowledged) < 8:
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)  # in the middle of a request
    process.wait()
    riding.join()
    process, url = start_server(tmp_path)  # no lock outlives the process
    try:
        kept = httpx.get(f"{url}/v1/passengers/anna", timeout=30).json()["entries"]
    finally:
        process.terminate()
        assert process.wait(20) == 0
    assert len(acknowledged) >= 8
    numbers = sorted(entry["number"] for entry in kept)
    assert numbers[: len(acknowledged)] == acknowledged  # one more may have been on its way
    assert verify(tmp_path / "audit").fault is None
