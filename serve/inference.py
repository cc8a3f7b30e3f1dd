"""The life of the inference process: load, warm up, answer jobs from a pipe.

Out, in this order: Loaded or Fault, Warm, and for each Job either Fault (the input cannot be used)
or Decided and then the explanation. Anything else that goes wrong ends the process; the parent
sees the pipe break and starts a new one.
"""

import hashlib
import json
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import cv2
import numpy as np

from ridetune.contract import Contract, load_tokenizer
from ridetune.control.vehicle import Vehicle
from ridetune.gate import Verdict
from ridetune.matrix import ControllerMatrix
from ridetune.policy import Policy
from ridetune.prompt import InstructionError
from ridetune.sample import Condition, Memory
from ridetune.vision import FrameError


@dataclass(frozen=True)
class Served:
    """What the child runs, and the name of the bundle that it comes from."""

    policy: Policy
    bundle_id: str


@dataclass(frozen=True)
class Job:
    """One question to the model; captured_s is monotonic, which processes share on Linux [s].

    condition: of the road, for the gate; None if not known.
    """

    frame: bytes
    instruction: str
    memories: tuple[Memory, ...]
    last_safe: ControllerMatrix
    condition: Condition | None
    captured_s: float


@dataclass(frozen=True)
class Decided:
    """A decision as it crosses the pipe, without the engine's cache; units as in Decision."""

    proposal: ControllerMatrix
    verdict: Verdict
    confidence: tuple[float, ...]
    timings_ms: dict[str, float]
    frame_age_ms: float


@dataclass(frozen=True)
class Loaded:
    """The bundle is checked and in memory."""

    contract: Contract
    bundle_id: str


@dataclass(frozen=True)
class Warm:
    """A first frame was answered; from now on jobs are taken."""

    seconds: float


@dataclass(frozen=True)
class Fault:
    """A load that failed, or an input that cannot be used."""

    sentence: str


def load_served(bundle: Path, threads: int, vehicle: Path, envelope: Path) -> Served:
    """The policy on a bundle folder, its gate with envelope and rollout check.

    ValueError if a file is missing, was tampered with or belongs to another vehicle. The gate
    drives the default matrix when it is made, so its simulation is compiled before `Warm`.
    """
    from ridetune.bundle import load_bundle
    from ridetune.ort_engine import OrtEngine
    from ridetune.sim.check import load_gate

    loaded = load_bundle(bundle)
    engine = OrtEngine(loaded, threads=threads)
    gate = load_gate(loaded.contract, Vehicle.load(vehicle), envelope)
    policy = Policy(engine, loaded.contract, load_tokenizer(loaded.folder), gate=gate)
    content = json.dumps([loaded.facts.contract, loaded.facts.files], sort_keys=True)
    digest = hashlib.sha256(content.encode()).hexdigest()
    return Served(policy, f"{bundle.resolve().name}-{digest[:12]}")


def warm_up(policy: Policy) -> None:
    """One full decision with explanation on a synthetic frame."""
    spec = policy.contract.vision
    ramp = np.linspace(0, 255, spec.width_px, dtype=np.uint8)
    pixels = np.tile(ramp[None, :, None], (spec.height_px, 1, 3))
    done, jpeg = cv2.imencode(".jpg", pixels)
    assert done
    default = policy.contract.ranges.default
    policy.explain(policy.decide(jpeg.tobytes(), "Keep it like this.", last_safe=default))


def work(pipe: Connection, load: Callable[[], Served]) -> None:
    """The life of the inference process; it ends with the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the group; the parent decides
    try:
        served = load()
    except (ValueError, OSError) as error:
        pipe.send(Fault(str(error)))
        return
    pipe.send(Loaded(served.policy.contract, served.bundle_id))
    start = time.monotonic()
    warm_up(served.policy)
    pipe.send(Warm(time.monotonic() - start))
    try:
        while True:
            _answer(pipe, served.policy, pipe.recv())
    except (EOFError, BrokenPipeError):
        return


def _answer(pipe: Connection, policy: Policy, job: Job) -> None:
    try:
        decision = policy.decide(
            job.frame,
            job.instruction,
            job.memories,
            last_safe=job.last_safe,
            condition=job.condition,
            captured_s=job.captured_s,
        )
    except (FrameError, InstructionError) as error:
        pipe.send(Fault(str(error)))
        return
    names = Decided.__dataclass_fields__
    pipe.send(Decided(**{name: getattr(decision, name) for name in names}))
    pipe.send(policy.explain(decision))
