"""The real server process on a real bundle, and the demo that drives one."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pyarrow
import pyarrow.parquet as parquet
import pytest

from ridetune.config import load_config
from ridetune.matrix import Ranges
from serve.__main__ import listen
from serve.demo import DemoConfig, dataset_frames, demo, folder_frames, pick_evenly
from serve.layout import WIDTH, answer_lines
from serve.wire import DecisionOut, VerdictOut, rows
from tests.tiny_bundle import awq_bundle, copy_of_bundle, sample

DEFAULT = Ranges.load(Path("configs/ranges.yaml")).default
FRAME = sample(0).observation.frame


@dataclass(frozen=True)
class Server:
    """A running server and its log."""

    process: "subprocess.Popen[bytes]"
    port: int
    log: Path

    def get(self, path: str) -> httpx.Response:
        return httpx.get(f"http://127.0.0.1:{self.port}{path}", timeout=5)

    def ask(self, instruction: str) -> httpx.Response:
        return httpx.post(
            f"http://127.0.0.1:{self.port}/v1/decide",
            data={"instruction": instruction, "session": "anna"},
            files={"frame": FRAME},
            timeout=30,
        )


def free_port() -> int:
    with listen("127.0.0.1", 0) as probe:
        return int(probe.getsockname()[1])


def command(bundle: Path, port: int) -> list[str]:
    values = [f"bundle={bundle}", f"port={port}", "deadline_s=20", "memory=null", "audit=null"]
    return [sys.executable, "-m", "serve", "--config", "configs/serve.yaml", *values]


def wait_for(done: Callable[[], bool], seconds: float) -> None:
    until = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < until
        time.sleep(0.05)


def is_ready(server: Server) -> bool:
    assert server.process.poll() is None, server.log.read_text()
    try:
        return server.get("/readyz").status_code == 200
    except httpx.TransportError:
        return False


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    log, port = tmp_path_factory.mktemp("server") / "log", free_port()
    with log.open("wb") as file:
        process = subprocess.Popen(command(awq_bundle(), port), stdout=file, stderr=file)
    running = Server(process, port, log)
    wait_for(lambda: is_ready(running), 60)
    yield running
    process.kill()
    process.wait()


def test_server_decides_on_a_real_bundle_and_stays_with_it(server: Server) -> None:
    one, two = server.ask("I am late").json(), server.ask("I am late").json()
    assert one["verdict"]["outcome"] in ("accepted", "limited")
    assert one["proposal"] == two["proposal"]
    assert {"image", "prefill", "prompt", "decide", "gate", "total"} < set(one["timings_ms"])
    assert isinstance(one["explanation"], str)


def test_second_server_on_the_port_says_so(server: Server) -> None:
    done = subprocess.run(
        command(awq_bundle(), server.port), capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    errors = [line for line in done.stderr.splitlines() if not line.startswith("event=")]
    assert len(errors) == 1
    assert f"port {server.port} on 127.0.0.1 is in use" in errors[0]


def test_client_that_leaves_in_the_middle_costs_nothing(server: Server) -> None:
    head = (
        "POST /v1/decide HTTP/1.1\r\nHost: car\r\nContent-Length: 5000\r\n"
        "Content-Type: multipart/form-data; boundary=b\r\n\r\n--b\r\n"
    )
    for _ in range(10):  # more than the queue holds
        with socket.create_connection(("127.0.0.1", server.port)) as client:
            client.sendall(head.encode())
    wait_for(lambda: server.ask("I am late").status_code == 200, 30)
    assert "Traceback" not in server.log.read_text()


def test_server_outlives_the_death_of_its_model(server: Server) -> None:
    driven = server.ask("I am late").json()["matrix"]
    pid = int(re.findall(r"event=worker_warm pid=(\d+)", server.log.read_text())[-1])
    os.kill(pid, signal.SIGKILL)
    lost = server.ask("I am late")
    assert (lost.status_code, lost.json()["matrix"]) == (503, driven)
    assert server.get("/healthz").status_code == 200
    wait_for(lambda: is_ready(server), 60)
    assert server.ask("I am late").status_code == 200


def test_sigterm_stops_server_and_model_quickly(server: Server) -> None:
    pid = int(re.findall(r"event=worker_warm pid=(\d+)", server.log.read_text())[-1])
    server.process.send_signal(signal.SIGTERM)
    assert server.process.wait(4) == 0
    assert not Path(f"/proc/{pid}").exists()
    assert "Traceback" not in server.log.read_text()


def test_tampered_bundle_is_refused_in_one_sentence(tmp_path: Path) -> None:
    bundle = copy_of_bundle(tmp_path)
    with (bundle / "decoder.onnx").open("ab") as file:
        file.write(b"x")
    done = subprocess.run(command(bundle, free_port()), capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert re.fullmatch(r"error: bundle file decoder.onnx .* was changed .*\n", done.stderr)


def demo_config(**values: Any) -> DemoConfig:
    overrides = [f"{key}={value}" for key, value in values.items()]
    return load_config(DemoConfig, Path("configs/demo.yaml"), overrides)


def test_demo_shows_three_answers_and_lists_what_it_cannot_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a/one.PNG").write_bytes(FRAME)
    (tmp_path / "two.jpg").write_text("no picture")
    demo(demo_config(bundle=awq_bundle(), frames=tmp_path))
    shown = capsys.readouterr().out
    assert all(len(line) <= WIDTH for line in shown.splitlines())
    assert shown.count("for the car") == 3
    assert "I feel a bit motion-sick." in shown
    assert "1 of 2 frames answered" in shown
    assert shown.count("not a readable JPEG or PNG") == 2  # where it happened, and in the end


def test_demo_without_a_bundle_passes_the_sentence_of_the_server_on(tmp_path: Path) -> None:
    (tmp_path / "one.png").write_bytes(FRAME)
    with pytest.raises(ValueError, match=r"no bundle at .*quantize.export"):
        demo(demo_config(bundle=tmp_path / "none", frames=tmp_path))


def test_demo_without_frames_names_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no image")
    with pytest.raises(ValueError, match="set frames="):
        demo(demo_config(frames=tmp_path))
    with pytest.raises(ValueError, match="python -m data"):
        demo(demo_config(frames="", data=tmp_path))


def test_demo_takes_a_clear_day_frame_of_each_scene(tmp_path: Path) -> None:
    conditions = [("s1", "fog"), ("s1", "sunny"), ("s1", "sunny"), ("s2", "sunny"), ("s3", "sunny")]
    table = [
        {"image": {"bytes": bytes([i]), "path": None}, "condition": c, "scene_id": s}
        for i, (s, c) in enumerate(conditions)
    ]
    parquet.write_table(pyarrow.Table.from_pylist(table), tmp_path / "test.parquet")
    assert [frame.content for frame in dataset_frames(tmp_path, 2)] == [b"\x01", b"\x03"]


def test_frames_are_spread_over_sub_folders(tmp_path: Path) -> None:
    for name, count in (("night", 9), ("rain", 1), ("sunny", 4)):
        (tmp_path / name).mkdir()
        for number in range(count):
            shutil.copy("configs/demo.yaml", tmp_path / name / f"{number}.jpg")
    names = [Path(frame.name).parent.name for frame in folder_frames(tmp_path, 6, None)]
    assert {name: names.count(name) for name in names} == {"night": 3, "rain": 1, "sunny": 2}
    assert len(folder_frames(tmp_path, 100, "fog")) == 14
    many = [[Path(f"{folder}/x.jpg")] for folder in range(10)]
    assert [str(path.parent) for path in pick_evenly(many, 2)] == ["2", "7"]


def test_answer_fits_the_terminal_and_cannot_move_its_cursor() -> None:
    answer = DecisionOut(
        matrix=rows(DEFAULT),
        default=rows(DEFAULT),
        proposal=[[None] * 3] * 2,
        verdict=VerdictOut(outcome="limited", reasons=["K_p moves a little " * 9]),
        confidence=[None] * 6,
        scene="fog\x1b[2J\n" + "far " * 40,
        explanation=None,
        timings_ms={"total": 12.0, "decide": 7.0},
        frame_age_ms=13.0,
        session="s",
        bundle="b",
        decision="d",
        recalled=[],
    )
    lines = answer_lines("hurry", answer)
    assert all(len(line) <= WIDTH and line.isprintable() for line in lines)
    assert "(the model did not say)" in "\n".join(lines)
