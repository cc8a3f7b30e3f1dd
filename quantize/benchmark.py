"""The latency benchmark: what a decision costs, cold and warm, by stage, beside the paper's way.

Cold starts at the JPEG bytes of a 1600x900 frame and the instruction; warm starts at the
instruction with the frame already prefilled. Both end when six floats have passed the gate.
Decoding, resize, tokenising, de-binning and the gate's format, coupling and slew are inside;
speech recognition is not, nor is what a served car's gate adds: the verified envelope and the
rollout check. That is timed by itself on what was proposed, with the road's condition known.
Every request has a fresh frame and instruction. In the same run the same model writes its
matrix as text, token by token. Two rounds; the spread between them is reported.

    python -m quantize.benchmark --config configs/benchmark.yaml
"""

import json
import os
import platform
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from ridetune.bundle import Bundle, add_profile, load_bundle
from ridetune.contract import load_tokenizer
from ridetune.control.vehicle import Vehicle
from ridetune.matrix import ControllerMatrix
from ridetune.ort_engine import OrtEngine
from ridetune.policy import MAX_MATRIX_TOKENS, Policy
from ridetune.sample import CONDITIONS, Sample, read_samples
from ridetune.sim.check import load_gate
from ridetune.stage import MANIFEST_FILE, run_stage
from ridetune.vision import read_patches

from .served_memory import measure_served

STAGES = ("image", "prefill", "prompt", "decide", "gate")


@dataclass(frozen=True)
class BenchmarkConfig:
    """What to time and how often; `run` is the folder whose stages' peak memory is listed."""

    bundle: Path
    data: Path
    run: Path
    vehicle: Path
    envelope: Path
    out: Path
    threads: int
    warm_ups: int
    requests: int
    text_requests: int
    frame_width: int
    frame_height: int
    served_requests: int


def benchmark(config: BenchmarkConfig) -> None:
    """Time everything, add the profile to the bundle, print a table and one JSON line."""
    cv2.setNumThreads(config.threads)
    bundle = load_bundle(config.bundle)
    requests = _requests(config)
    rounds = [_round(bundle, requests, config) for _ in range(2)]
    profile: dict[str, Any] = dict(rounds[-1])
    profile["spread_p50"] = {
        name: round(abs(rounds[0][name]["p50"] / rounds[1][name]["p50"] - 1), 3)
        for name in ("cold_ms", "warm_ms")
    }
    profile["served"] = measure_served(
        config.bundle, [(frame, text) for frame, text in requests[: config.served_requests]]
    )
    profile["stage_peak_rss_mb"] = stage_memory(config.run)
    profile["hardware"] = hardware(config.threads)
    config.out.mkdir(parents=True, exist_ok=True)
    (config.out / "profile.json").write_text(json.dumps(profile, indent=2) + "\n")
    add_profile(config.bundle, profile)
    print_table(profile)
    print(json.dumps(profile))


def _requests(config: BenchmarkConfig) -> list[tuple[bytes, str]]:
    """Frames at camera size with instructions, each used once in a round."""
    samples = read_samples(config.data / "test.parquet")
    rng = np.random.default_rng(0)
    count = config.warm_ups + config.requests
    chosen = rng.choice(len(samples), count, replace=len(samples) < count)
    return [(camera_frame(samples[i], config), samples[i].instruction) for i in chosen]


def camera_frame(sample: Sample, config: BenchmarkConfig) -> bytes:
    """The sample's frame enlarged to the camera's size, as JPEG."""
    small = cv2.imdecode(np.frombuffer(sample.observation.frame, np.uint8), cv2.IMREAD_COLOR)
    assert small is not None, "the dataset's own frames decode"
    size = (config.frame_width, config.frame_height)
    large = cv2.resize(small, size, interpolation=cv2.INTER_CUBIC)
    done, jpeg = cv2.imencode(".jpg", large, [cv2.IMWRITE_JPEG_QUALITY, 90])
    assert done
    return jpeg.tobytes()


def _round(
    bundle: Bundle, requests: list[tuple[bytes, str]], config: BenchmarkConfig
) -> dict[str, Any]:
    engine = OrtEngine(bundle, threads=config.threads)
    policy = Policy(engine, bundle.contract, load_tokenizer(bundle.folder))
    default = bundle.contract.ranges.default
    cold: list[float] = []
    warm: list[float] = []
    stages: dict[str, list[float]] = {name: [] for name in STAGES}
    proposals: list[ControllerMatrix] = []
    first_ms = None
    for number, (frame, text) in enumerate(tqdm(requests, desc="decisions", unit="request")):
        start = time.perf_counter()
        policy.decide(frame, text, last_safe=default)
        cold_ms = 1e3 * (time.perf_counter() - start)
        first_ms = cold_ms if first_ms is None else first_ms
        prepared = policy.prepare(frame)
        start = time.perf_counter()
        decision = policy.decide(prepared, text, last_safe=default)
        warm_ms = 1e3 * (time.perf_counter() - start)
        if number >= config.warm_ups:
            cold.append(cold_ms)
            warm.append(warm_ms)
            proposals.append(decision.proposal)
            for name in STAGES:
                stages[name].append(decision.timings_ms[name])
    return {
        "cold_ms": quantiles(cold),
        "warm_ms": quantiles(warm),
        "first_ms": round(first_ms or 0.0, 2),
        "stages_p50_ms": {name: round(float(np.median(v)), 3) for name, v in stages.items()},
        **_decoding(engine, bundle, requests[: config.text_requests]),
        "full_gate_ms": quantiles(_judging(bundle, proposals, config)),
    }


def _judging(
    bundle: Bundle, proposals: list[ControllerMatrix], config: BenchmarkConfig
) -> list[float]:
    """The gate of a served car, envelope and rollout check included, on each proposal [ms]."""
    gate = load_gate(bundle.contract, Vehicle.load(config.vehicle), config.envelope)
    spent = []
    for number, matrix in enumerate(proposals):
        condition = CONDITIONS[number % len(CONDITIONS)]
        start = time.perf_counter()
        gate.judge(matrix, matrix, condition)
        spent.append(1e3 * (time.perf_counter() - start))
    return spent


def _decoding(
    engine: OrtEngine, bundle: Bundle, requests: list[tuple[bytes, str]]
) -> dict[str, Any]:
    """Six bins in one pass against the matrix as text, from the same prefilled frames."""
    prompts = bundle.prompts()
    parallel: list[float] = []
    as_text: list[float] = []
    tokens: list[int] = []
    for frame, text in tqdm(requests, desc="as text", unit="request"):
        prefix = engine.prefill(read_patches(frame, bundle.contract.vision))
        suffix = prompts.suffix(text)
        start = time.perf_counter()
        bundle.contract.codec.expect(engine.decide(prefix, suffix).logits)
        parallel.append(1e3 * (time.perf_counter() - start))
        start = time.perf_counter()
        tokens.append(len(engine.write_matrix(prefix, suffix, MAX_MATRIX_TOKENS)))
        as_text.append(1e3 * (time.perf_counter() - start))
    return {
        "parallel_ms": quantiles(parallel),
        "as_text_ms": quantiles(as_text),
        "as_text_tokens": round(float(np.mean(tokens)), 1),
        "speedup_p50": round(float(np.median(np.array(as_text) / np.array(parallel))), 1),
    }


def quantiles(values: list[float]) -> dict[str, float]:
    """p50, p90, p99 and the maximum [ms]."""
    p50, p90, p99 = np.quantile(values, [0.5, 0.9, 0.99])
    return {
        "p50": round(float(p50), 2),
        "p90": round(float(p90), 2),
        "p99": round(float(p99), 2),
        "max": round(max(values), 2),
        "requests": len(values),
    }


def stage_memory(run: Path) -> dict[str, int]:
    """Peak resident memory [MB] that each stage noted in its manifest."""
    return {
        path.parent.name: int(json.loads(path.read_text())["peak_rss_mb"])
        for path in sorted(run.glob(f"*/{MANIFEST_FILE}"))
    }


def hardware(threads: int) -> dict[str, Any]:
    """What this ran on."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [
            line.split(":")[1] for line in info.read_text().splitlines() if "model name" in line
        ]
        model = names[0].strip() if names else model
    return {"cpu": model, "cores": os.cpu_count(), "threads": threads, "device": "CPU"}


def print_table(profile: dict[str, Any]) -> None:
    """The latencies for a person."""
    print(f"{'ms':34}{'p50':>9}{'p90':>9}{'p99':>9}{'max':>9}")
    for name, about in (
        ("cold_ms", "cold: JPEG + words -> gated matrix"),
        ("warm_ms", "warm: words -> gated matrix"),
        ("parallel_ms", "decoding, six bins in one pass"),
        ("as_text_ms", "decoding, the matrix as text"),
        ("full_gate_ms", "full gate: envelope, rollout"),
    ):
        row = profile[name]
        print(f"{about:34}" + "".join(f"{row[q]:>9.2f}" for q in ("p50", "p90", "p99", "max")))
    print(f"one pass is {profile['speedup_p50']} times as fast as text in the median request")


if __name__ == "__main__":
    sys.exit(run_stage(BenchmarkConfig, "configs/benchmark.yaml", benchmark, __doc__))
