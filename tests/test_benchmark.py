"""The benchmark runs end to end on a small bundle and puts its profile into it."""

import json
import os
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest

from quantize.benchmark import (
    STAGES,
    BenchmarkConfig,
    _requests,
    benchmark,
    camera_frame,
    quantiles,
    stage_memory,
)
from quantize.served_memory import measure_served, peak_mb, process_tree
from ridetune.bundle import load_bundle
from ridetune.config import load_config
from ridetune.sample import read_samples
from ridetune.vision import decode_frame
from tests.small_base import RANGES, small_data
from tests.tiny_bundle import copy_of_bundle


def benchmark_config(folder: Path) -> BenchmarkConfig:
    config = load_config(BenchmarkConfig, RANGES.with_name("benchmark.yaml"))
    return replace(
        config,
        bundle=folder / "bundle",
        data=small_data(),
        run=folder / "run",
        out=folder / "profile",
        warm_ups=1,
        requests=4,
        text_requests=2,
        frame_width=320,
        frame_height=180,
        served_requests=2,
    )


@pytest.fixture(scope="module")
def profiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose bundle went through the benchmark."""
    folder = tmp_path_factory.mktemp("benchmark")
    copy_of_bundle(folder)
    for stage, peak in (("data", 120), ("merged", 900)):
        (folder / "run" / stage).mkdir(parents=True)
        (folder / "run" / stage / "manifest.json").write_text(json.dumps({"peak_rss_mb": peak}))
    benchmark(benchmark_config(folder))
    return folder


@pytest.fixture(scope="module")
def profile(profiled: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((profiled / "profile/profile.json").read_text())
    return found


def test_profile_goes_into_the_bundle_which_still_loads(
    profiled: Path, profile: dict[str, Any]
) -> None:
    assert load_bundle(profiled / "bundle").facts.profile == profile


def test_profile_holds_every_latency_in_rising_quantiles(profile: dict[str, Any]) -> None:
    for name, requests in (
        ("cold_ms", 4),
        ("warm_ms", 4),
        ("parallel_ms", 2),
        ("as_text_ms", 2),
        ("full_gate_ms", 4),
    ):
        row = profile[name]
        assert 0 < row["p50"] <= row["p90"] <= row["p99"] <= row["max"]
        assert row["requests"] == requests
    assert set(profile["stages_p50_ms"]) == set(STAGES)
    assert set(profile["spread_p50"]) == {"cold_ms", "warm_ms"}
    assert profile["as_text_tokens"] > 0
    assert profile["first_ms"] > 0
    assert {"cpu", "cores", "threads", "device"} <= set(profile["hardware"])


def test_profile_holds_the_memory_of_the_server_and_of_the_stages(
    profile: dict[str, Any],
) -> None:
    served = profile["served"]
    assert served["requests"] == 2
    assert 0 < served["peak_rss_mb_worker"] < served["peak_rss_mb_all"]  # gateway and worker
    assert profile["stage_peak_rss_mb"] == {"data": 120, "merged": 900}


def test_requests_are_camera_sized_and_used_once(tmp_path: Path) -> None:
    config = benchmark_config(tmp_path)
    requests = _requests(config)
    assert len(requests) == 5
    assert len(set(requests)) == 5
    assert {decode_frame(frame).shape for frame, _ in requests} == {(180, 320, 3)}


def test_small_dataset_is_asked_again_rather_than_refused(tmp_path: Path) -> None:
    config = replace(benchmark_config(tmp_path), warm_ups=20, requests=30)  # of 30 samples
    assert len(_requests(config)) == 50


def test_camera_frame_is_the_sample_enlarged(tmp_path: Path) -> None:
    config = benchmark_config(tmp_path)
    sample = read_samples(config.data / "test.parquet")[0]
    small, large = (
        decode_frame(jpeg) for jpeg in (sample.observation.frame, camera_frame(sample, config))
    )
    again = cv2.resize(large, (small.shape[1], small.shape[0]), interpolation=cv2.INTER_AREA)
    assert cv2.PSNR(again, small) > 25


def test_quantiles_of_a_known_row() -> None:
    found = quantiles([float(value) for value in range(101)])
    assert found == {"p50": 50.0, "p90": 90.0, "p99": 99.0, "max": 100.0, "requests": 101}
    assert quantiles([3.0]) == {"p50": 3.0, "p90": 3.0, "p99": 3.0, "max": 3.0, "requests": 1}


def test_stage_memory_of_an_empty_run_is_empty(tmp_path: Path) -> None:
    assert stage_memory(tmp_path) == {}


def test_server_that_cannot_start_is_reported_in_its_own_words(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"the server did not start: .*no bundle at"):
        measure_served(tmp_path / "nowhere", [])


def test_process_tree_holds_the_children_of_every_thread() -> None:
    started: list[subprocess.Popen[bytes]] = []
    done = threading.Event()

    def start() -> None:
        started.append(subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE))
        done.wait()

    thread = threading.Thread(target=start)
    thread.start()
    try:
        while not started:
            time.sleep(0.01)
        tree = process_tree(os.getpid())
        assert tree[0] == os.getpid()
        assert started[0].pid in tree
        assert peak_mb(os.getpid()) > 10
    finally:
        done.set()
        thread.join()
        for child in started:
            child.communicate(b"\n")
