"""Peak memory and answer times of the real server process, as a client sees them."""

import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np

START_S = 60.0


def measure_served(bundle: Path, requests: list[tuple[bytes, str]]) -> dict[str, Any]:
    """Start `python -m serve` on a free port, ask it, stop it; peak MB of each of its processes."""
    with tempfile.TemporaryFile("w+") as log:
        values = [f"bundle={bundle.resolve()}", "port=0", "memory=null", "audit=null"]
        command = [sys.executable, "-m", "serve", *values]
        server = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            url = _address(server, log)
            with httpx.Client(base_url=url, timeout=30.0) as client:
                _wait_ready(client, server)
                answers_ms = [_ask(client, frame, text) for frame, text in requests]
            peaks = {str(pid): peak_mb(pid) for pid in process_tree(server.pid)}
        finally:
            server.send_signal(signal.SIGTERM)
            server.wait(timeout=20)
    worst = max(peaks.values())
    return {
        "peak_rss_mb_worker": worst,
        "peak_rss_mb_all": sum(peaks.values()),
        "answer_with_explanation_p50_ms": round(float(np.median(answers_ms)), 1),
        "requests": len(requests),
    }


def _address(server: subprocess.Popen[bytes], log: Any) -> str:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        log.seek(0)
        said = log.read()
        found = re.search(r"url=(http://\S+)", said)
        if found:
            return found[1]
        if server.poll() is not None:
            raise ValueError(f"the server did not start: {said.strip().splitlines()[-1]}")
        time.sleep(0.1)
    raise ValueError(f"the server gave no address within {START_S:.0f} s")


def _wait_ready(client: httpx.Client, server: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and server.poll() is None:
        try:
            if client.get("/readyz").status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    raise ValueError(f"the server was not ready within {START_S:.0f} s")


def _ask(client: httpx.Client, frame: bytes, instruction: str) -> float:
    start = time.perf_counter()
    answer = client.post(
        "/v1/decide",
        files={"frame": ("frame.jpg", frame, "image/jpeg")},
        data={"instruction": instruction},
    )
    answer.raise_for_status()
    return 1e3 * (time.perf_counter() - start)


def process_tree(pid: int) -> list[int]:
    """A process and all its descendants that still live."""
    found = [pid]
    for parent in found:
        for children in Path(f"/proc/{parent}/task").glob("*/children"):  # of every thread
            found += [int(child) for child in children.read_text().split()]
    return found


def peak_mb(pid: int) -> int:
    """Peak resident memory of a live process [MB]."""
    status = Path(f"/proc/{pid}/status").read_text()
    found = re.search(r"VmHWM:\s+(\d+) kB", status)
    return int(found[1]) // 1024 if found else 0
