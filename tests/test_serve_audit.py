"""The server's audit log: every kind of answer is in it, and nothing is decided without it."""

import errno
import json
import os
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from serve.app import create_app
from serve.audit.__main__ import verify
from serve.audit.chain import log_files, replay
from serve.audit.events import DecisionEvent, Event, FallbackEvent, RefusalEvent
from serve.audit.log import AuditLog
from tests.fake_policy import GOAL, RANGES, WorkerAtHand, frame
from tests.test_serve_memory import CONFIG, Car, bytes_below


def events(folder: Path) -> list[Event]:
    return [line.event for line in replay(folder / "audit")]


def stop_the_log(car: Car) -> None:
    """Somebody writes into the file from outside: the log stops for good."""
    with log_files(car.log.folder)[-1].open("ab") as file:
        file.write(b"x")


def test_every_kind_of_answer_is_a_line_of_a_log_that_verifies_whole(tmp_path: Path) -> None:
    car = Car(tmp_path, None)
    with car.client:
        given = car.ask(session="s1", condition="rain").json()
        assert car.ask("").status_code == 422
        car.worker.reason = "the model is being restarted"
        assert car.ask(session="s1").status_code == 503
    car.log.close()
    assert verify(tmp_path / "audit").fault is None
    kinds = [event.kind for event in events(tmp_path)]
    assert kinds == ["start", "decision", "refusal", "fallback", "stop"]
    _, decision, refusal, fallback, _ = events(tmp_path)
    assert isinstance(decision, DecisionEvent) and isinstance(fallback, FallbackEvent)
    assert isinstance(refusal, RefusalEvent)
    assert (decision.session, decision.condition, decision.bundle) == ("s1", "rain", "fake")
    assert decision.last_safe == RANGES.default.values
    assert [*decision.matrix] == [*chain(*given["matrix"])]
    assert decision.applied and decision.outcome == "accepted"
    assert decision.instruction is None and decision.instruction_digest is not None
    assert fallback.matrix == decision.matrix and not fallback.expired
    assert fallback.reason == "the model is being restarted"
    assert fallback.instruction_digest == decision.instruction_digest
    assert (refusal.route, refusal.status, refusal.session) == ("/v1/decide", 422, None)


def test_words_are_kept_only_where_the_config_says_so(tmp_path: Path) -> None:
    with AuditLog(tmp_path / "audit", keep_words=True) as log:
        worker: Any = WorkerAtHand()
        client = TestClient(create_app(worker, CONFIG, log=log))
        client.post("/v1/decide", data={"instruction": "hurry"}, files={"frame": frame()})
    (decision,) = events(tmp_path)
    assert isinstance(decision, DecisionEvent) and decision.instruction == "hurry"


def test_a_stopped_log_answers_with_the_last_safe_matrix(tmp_path: Path) -> None:
    car = Car(tmp_path, None)
    driven = car.ask(session="s1").json()["matrix"]
    stop_the_log(car)
    for _ in range(2):
        answer = car.ask(session="s1")
        assert answer.status_code == 503
        assert answer.json()["matrix"] == driven
        assert "somebody else changed" in answer.json()["error"]
    fresh = car.ask(session="s2").json()
    assert fresh["matrix"] == RANGES.default.rows != driven  # the proposal did not become safe
    ready = car.client.get("/readyz")
    assert (ready.status_code, ready.json()["ready"]) == (503, False)
    assert "audit log" in ready.json()["reason"]
    assert car.ask("").status_code == 422  # a refusal gives no matrix: it stays one


def test_after_a_full_disk_decisions_go_on_and_the_gap_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    car = Car(tmp_path, None)
    assert car.ask().status_code == 200
    real_write = os.write

    def full(descriptor: int, data: bytes) -> int:
        if data.startswith(b'{"event"'):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real_write(descriptor, data)

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        lost = car.ask()
        assert (lost.status_code, lost.json()["matrix"]) == (503, RANGES.default.rows)
        assert "free some space" in car.client.get("/readyz").json()["reason"]
    assert car.ask().status_code == 200
    assert car.client.get("/readyz").status_code == 200
    car.log.close()
    assert verify(tmp_path / "audit").fault is None
    assert [event.kind for event in events(tmp_path)] == ["decision", "gap", "decision"]


def test_no_refusal_quotes_what_was_sent(tmp_path: Path) -> None:
    car, word = Car(tmp_path, None), "Muesli42"
    post, client = car.client.post, car.client
    memory = {"instruction": "a", "scene": "b", "matrix": list(GOAL.values), "feedback": "c"}
    feedback = {"decision": "0" * 32, "passenger": "anna", "feedback": "d"}
    form = {"content-type": f"multipart/form-data; boundary={word}"}
    refused = [
        car.ask(**{word: "x"}),
        car.ask(memories=json.dumps([{**memory, word: 1}])),
        car.ask(memories=word),
        car.ask(passenger=f"{word} {word}"),
        car.ask(session=f"{word} {word}"),
        car.ask(condition=word),
        car.ask(f"{word} " * 60),
        car.client.post("/v1/decide", data={"instruction": word}, files={"frame": word.encode()}),
        post("/v1/decide", content=f"--{word}\r\n{word}: x\r\n\r\n", headers=form),
        post("/v1/decide", content=f"--{word}{word}", headers=form),
        post("/v1/decide", content=word, headers={"content-type": word}),
        post("/v1/feedback", json={**feedback, word: 1}),
        post("/v1/feedback", content=word, headers={"content-type": "application/json"}),
        post("/v1/feedback", json=feedback),
        client.get(f"/v1/passengers/{word}"),
        client.get(f"/v1/passengers/{word} {word}"),
        client.patch(f"/v1/passengers/{word}"),
        client.get(f"/{word}"),
    ]
    statuses = [response.status_code for response in refused]
    assert all(400 <= status < 500 for status in statuses)
    recorded = events(tmp_path)
    assert [event.status for event in recorded if isinstance(event, RefusalEvent)] == statuses
    assert word.encode() not in bytes_below(tmp_path)
    routes = {event.route for event in recorded if isinstance(event, RefusalEvent)}
    assert "/v1/passengers/{passenger}" in routes and "none of this server" in routes
