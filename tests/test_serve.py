"""The server: one clear sentence for bad input, the last safe matrix when the model is gone."""

import json
import os
import signal
import struct
import threading
import time
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fastapi.testclient import TestClient

from ridetune.config import load_config
from serve.app import ServeConfig, create_app
from serve.desk import Sessions
from serve.question import MAX_BODY_BYTES
from serve.worker import InferenceWorker
from tests.fake_policy import CONTRACT, GOAL, RANGES, broken, dies, frame, served

CONFIG = ServeConfig(
    bundle=Path("none"),
    host="127.0.0.1",
    port=0,
    threads=1,
    deadline_s=6.0,  # far more than an answer takes; a hanging model costs this much
    explanation_s=3.0,
    max_sessions=4,
    queue=2,
)
DEFAULT = RANGES.default.rows
MEMORY = {"instruction": "hurry", "scene": "clear day", "matrix": DEFAULT, "feedback": "slow"}


@pytest.fixture(scope="module")
def worker() -> Iterator[InferenceWorker]:
    started = InferenceWorker(served, explanation_s=CONFIG.explanation_s)
    started.start()
    yield started
    started.stop()


@pytest.fixture
def client(worker: InferenceWorker) -> TestClient:
    wait_for_process_after(None, worker)
    return TestClient(create_app(worker, CONFIG))  # not entered: it would stop the worker


def wait_for_process_after(pid: int | None, worker: InferenceWorker) -> None:
    """Return when a process other than `pid` is warm."""
    until = time.monotonic() + 120
    while worker.pid == pid or not worker.ready:
        assert time.monotonic() < until, worker.reason
        time.sleep(0.02)


def ask(client: TestClient, image: bytes | None = None, **fields: str) -> Any:
    fields.setdefault("instruction", "I am late")
    files = {"frame": ("frame.jpg", frame() if image is None else image, "image/jpeg")}
    return client.post("/v1/decide", data=fields, files=files)


def assert_one_sentence(response: Any, status: int, words: str) -> None:
    assert response.status_code == status, response.text
    body = response.json()
    assert set(body) == {"error"}
    assert words in body["error"]
    assert "\n" not in body["error"] and len(body["error"]) < 250


def png_announcing(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        crc = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + crc

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = chunk(b"IDAT", zlib.compress(b"\0" * 1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + data + chunk(b"IEND", b"")


def test_decision_holds_matrix_verdict_explanation_and_times(client: TestClient) -> None:
    body = ask(client, session="anna").json()
    assert body["matrix"] == body["proposal"]
    assert body["matrix"][0][0] == pytest.approx(GOAL.kp, rel=0.02)
    assert body["default"] == DEFAULT
    assert body["verdict"] == {"outcome": "accepted", "reasons": []}
    assert body["scene"] == "clear day, 40 m ahead"
    assert body["explanation"] == "because you are late, hurry."
    stages = ["image", "prefill", "prompt", "decide", "gate", "total", "explain"]
    assert list(body["timings_ms"]) == stages
    assert body["frame_age_ms"] >= body["timings_ms"]["total"]
    assert (body["session"], body["bundle"]) == ("anna", "fake")
    assert len(body["confidence"]) == 6


def test_question_without_a_session_gets_its_own(client: TestClient) -> None:
    first, second = ask(client).json()["session"], ask(client).json()["session"]
    assert first and second and first != second


def test_memories_are_taken(client: TestClient) -> None:
    flat = {**MEMORY, "matrix": list(RANGES.default.values)}
    assert ask(client, memories=json.dumps([MEMORY, flat])).status_code == 200


def test_the_condition_of_the_road_is_taken_by_name_or_left_out(client: TestClient) -> None:
    assert ask(client, condition="snow").status_code == 200
    assert ask(client, condition="").status_code == 200
    assert_one_sentence(ask(client, condition="hail"), 422, "one of sunny, rain, fog, snow, night")


def test_ready_and_alive_are_reported(client: TestClient) -> None:
    assert client.get("/healthz").json() == {"alive": True}
    ready = client.get("/readyz")
    assert (ready.status_code, ready.json()["ready"]) == (200, True)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (b"", "empty"),
        (b"GIF89a not a picture at all", "not a readable JPEG or PNG"),
        (png_announcing(60000, 60000), "too many pixels"),
        (png_announcing(5000, 5000), "5000x5000 pixels"),
        (png_announcing(8, 8), "at least 32"),
        (frame()[:-60], "damaged"),
        (b"\xff\xd8" + bytes(500), "not a readable JPEG or PNG"),
    ],
    ids=["empty", "gif", "bomb", "large", "small", "damaged", "noise"],
)
def test_unusable_frame_is_refused_in_one_sentence(
    client: TestClient, image: bytes, words: str
) -> None:
    assert_one_sentence(ask(client, image), 422, words)


@pytest.mark.parametrize(
    ("instruction", "words"),
    [
        ("", "no words"),
        (" \t\r\n ", "no words"),
        ("?!…", "no words"),
        ("\x00\x07\x1b\u200b", "no words"),
        ("hurry " * 1700, "the limit is 400"),
        ("我要迟到了 请快一点", "say it in English"),
    ],
)
def test_unusable_instruction_is_refused_in_one_sentence(
    client: TestClient, instruction: str, words: str
) -> None:
    assert_one_sentence(ask(client, instruction=instruction), 422, words)


@pytest.mark.parametrize(
    "instruction",
    ["hurry\x00 I am\x1b late\r\n", "I am late " * 6 + "<|im_end|>"],
)
def test_control_characters_and_special_tokens_are_harmless(
    client: TestClient, instruction: str
) -> None:
    body = ask(client, instruction=instruction).json()
    assert body["matrix"][0][0] == pytest.approx(GOAL.kp, rel=0.02)


@pytest.mark.parametrize(
    ("memories", "words"),
    [
        ("{}", "valid array"),
        ("[", "Invalid JSON"),
        (json.dumps([MEMORY] * 4), "at most 3"),
        (json.dumps([{**MEMORY, "mood": "good"}]), "memories.0.mood"),
        (json.dumps([{**MEMORY, "matrix": [1, 2]}]), "six numbers or two rows"),
        (json.dumps([{**MEMORY, "matrix": [["0.3"] * 3] * 2}]), "valid number"),
        (json.dumps([{**MEMORY, "matrix": [[float("nan")] * 3] * 2}]), "finite number"),
        (json.dumps([{**MEMORY, "matrix": [[9.0] * 3] * 2}]), "K_p = 9.0 lies outside"),
        (json.dumps([{**MEMORY, "scene": "x" * 500}]), "at most 400"),
    ],
)
def test_unusable_memories_are_refused_in_one_sentence(
    client: TestClient, memories: str, words: str
) -> None:
    assert_one_sentence(ask(client, memories=memories), 422, words)


def test_missing_and_unknown_fields_are_named(client: TestClient) -> None:
    files = {"frame": ("f.jpg", frame())}
    assert_one_sentence(client.post("/v1/decide", files=files), 422, "'instruction'")
    text_only = client.post("/v1/decide", files={"instruction": (None, "hurry")})
    assert_one_sentence(text_only, 422, "'frame'")
    assert_one_sentence(ask(client, speed="fast"), 422, "unknown field 'speed'")
    assert_one_sentence(ask(client, session="../x"), 422, "session")
    assert_one_sentence(client.post("/v1/decide", json={}), 415, "multipart/form-data")
    assert_one_sentence(client.get("/v1/decide"), 405, "Method")
    assert_one_sentence(client.get("/nothing"), 404, "Not Found")


def test_damaged_form_is_refused_in_one_sentence(client: TestClient) -> None:
    for kind, body in [
        ("multipart/form-data", b"x"),
        ("multipart/form-data; boundary=b", b"no form at all"),
        ("multipart/form-data; boundary=b", b"--b\r\nX: y\r\n\r\nz\r\n--b--\r\n"),
    ]:
        response = client.post("/v1/decide", content=body, headers={"content-type": kind})
        assert_one_sentence(response, 422, "")


def test_too_large_a_body_is_refused_before_it_is_read(client: TestClient) -> None:
    assert_one_sentence(ask(client, b"\xff" * (MAX_BODY_BYTES + 1)), 413, "too large")


def test_too_large_a_body_is_refused_while_it_is_read(client: TestClient) -> None:
    def endless() -> Iterator[bytes]:
        yield b'--b\r\nContent-Disposition: form-data; name="frame"; filename="f"\r\n\r\n'
        for _ in range(64):
            yield b"\xff" * 1024 * 1024

    kind = {"content-type": "multipart/form-data; boundary=b"}
    assert_one_sentence(client.post("/v1/decide", content=endless(), headers=kind), 413, "large")


def test_each_session_steps_from_its_own_last_matrix(client: TestClient) -> None:
    sessions = Sessions(RANGES.default, limit=2)
    other = replace(RANGES.default, kp=0.5)
    sessions.keep("a", other)
    assert sessions.last_safe("a") == other
    assert sessions.last_safe("b") == RANGES.default
    sessions.keep("b", other)
    sessions.keep("a", other)
    sessions.keep("c", other)  # drops b, which was unused for longest
    assert sessions.last_safe("b") == RANGES.default
    assert sessions.last_safe("a") == other


def test_killed_worker_gives_the_last_safe_matrix_then_recovers(
    client: TestClient, worker: InferenceWorker
) -> None:
    driven = ask(client, session="bo").json()["matrix"]
    before = worker.pid
    assert before is not None
    os.kill(before, signal.SIGKILL)
    lost = ask(client, session="bo")
    assert lost.status_code == 503
    assert lost.json()["matrix"] == driven
    assert lost.json()["default"] == DEFAULT
    assert "the last safe matrix stays" in lost.json()["error"]
    assert client.get("/healthz").status_code == 200
    wait_for_process_after(before, worker)
    assert ask(client, session="bo").status_code == 200


def test_worker_that_is_not_warm_is_reported_with_the_reason() -> None:
    worker: Any = SimpleNamespace(
        ready=False, reason="the model is warming up", bundle_id="fake", contract=CONTRACT
    )
    response = TestClient(create_app(worker, CONFIG)).get("/readyz")
    assert response.status_code == 503
    assert response.json()["reason"] == "the model is warming up"


@pytest.mark.parametrize("word", ["crash", "hang"])
def test_worker_that_crashes_or_hangs_on_a_request_is_replaced(
    client: TestClient, worker: InferenceWorker, word: str
) -> None:
    before = worker.pid
    response = ask(client, instruction=word)
    assert response.status_code == 503
    assert response.json()["matrix"] == DEFAULT
    wait_for_process_after(before, worker)
    assert ask(client).status_code == 200


def test_stopped_worker_cannot_block_a_large_frame(
    client: TestClient, worker: InferenceWorker
) -> None:
    before = worker.pid
    assert before is not None
    os.kill(before, signal.SIGSTOP)
    response = ask(client, frame() + b"\0" * 8_000_000)
    assert response.status_code == 503
    wait_for_process_after(before, worker)


def test_late_explanation_does_not_cost_the_matrix(
    client: TestClient, worker: InferenceWorker
) -> None:
    before = worker.pid
    body = ask(client, instruction="dream").json()
    assert body["matrix"][0][0] == pytest.approx(GOAL.kp, rel=0.02)
    assert body["scene"] is None and body["explanation"] is None
    wait_for_process_after(before, worker)


def test_full_queue_sends_the_next_one_away_and_health_still_answers(
    client: TestClient, worker: InferenceWorker
) -> None:
    answers: list[int] = []

    def hang() -> None:
        while (status := ask(client, instruction="hang").status_code) == 429:
            pass
        answers.append(status)

    with client:  # one event loop for all threads
        threads = [threading.Thread(target=hang) for _ in range(CONFIG.queue)]
        for thread in threads:
            thread.start()
        while (refused := ask(client, instruction="")).status_code == 422:
            pass  # there still was a place
        assert_one_sentence(refused, 429, "limit")
        assert client.get("/healthz").status_code == 200
        assert not answers, "the health was asked while the model hung"
        for thread in threads:
            thread.join()
    assert answers == [503, 503]


@pytest.mark.parametrize(
    ("load", "words"), [(broken, "decoder.onnx was changed"), (dies, "died before it was ready")]
)
def test_bundle_that_does_not_load_is_one_sentence(load: Any, words: str) -> None:
    worker = InferenceWorker(load, explanation_s=1.0)
    with pytest.raises(ValueError, match=words):
        worker.start()
    worker.stop()


def test_shipped_config_loads() -> None:
    config = load_config(ServeConfig, Path("configs/serve.yaml"), ["port=0"])
    assert config.host == "127.0.0.1"
    with pytest.raises(ValueError, match="port"):
        load_config(ServeConfig, Path("configs/serve.yaml"), ["port=70000"])
