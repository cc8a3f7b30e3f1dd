"""The server's hold on the inference process: start it, ask it, replace it.

Each answer has a deadline; a process that dies or misses it is killed and replaced, and until the
new one is warm there is no inference. A crash of the model never takes the server down.
"""

import logging
import multiprocessing
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from ridetune.contract import Contract
from ridetune.policy import Explanation

from .inference import Decided, Fault, Job, Loaded, Served, Warm, work

_log = logging.getLogger(__name__)
_SPAWN = multiprocessing.get_context("spawn")
_LONGEST_PAUSE_S = 5.0
_STOP_S = 1.0


class InputRejectedError(ValueError):
    """The frame or the words cannot be used; the message says why and what to send instead."""


class WorkerUnavailableError(RuntimeError):
    """No answer from the model: it is starting, died, or missed the deadline."""


@dataclass(frozen=True)
class Reply:
    """A decision with its explanation, None where that came too late."""

    decided: Decided
    explanation: Explanation | None


class InferenceWorker:
    """Starts, watches and replaces the inference process; safe to call from any thread."""

    def __init__(
        self, load: Callable[[], Served], *, explanation_s: float, start_s: float = 300.0
    ) -> None:
        self._load = load
        self._explanation_s = explanation_s
        self._start_s = start_s
        self._turn = threading.Lock()
        self._ready = threading.Event()
        self._settled = threading.Event()
        self._stopping = threading.Event()
        self._loaded: Loaded | None = None
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None
        self._thread = threading.Thread(target=self._supervise, name="worker", daemon=True)
        self.reason = "the model is being loaded"

    def start(self) -> None:
        """Return when the bundle is loaded; ValueError with its one sentence if it cannot be."""
        self._thread.start()
        self._settled.wait()
        if self._loaded is None:
            raise ValueError(self.reason)

    def stop(self) -> None:
        """End the process; a job under way is given up."""
        self._stopping.set()
        self._ready.clear()
        self.reason = "the server is stopping"
        process = self._process
        if process is not None:
            process.terminate()
            process.join(_STOP_S)
            process.kill()

    @property
    def ready(self) -> bool:
        """Whether the process is warm; `reason` says why not."""
        return self._ready.is_set()

    @property
    def pid(self) -> int | None:
        """The process id of the current inference process."""
        return self._process.pid if self._process else None

    @property
    def contract(self) -> Contract:
        """What the served weights were trained with; known once started."""
        assert self._loaded is not None
        return self._loaded.contract

    @property
    def bundle_id(self) -> str:
        """The name of the served bundle; known once started."""
        assert self._loaded is not None
        return self._loaded.bundle_id

    def decide(self, job: Job, *, until_s: float) -> Reply:
        """Ask the model; until_s is the monotonic time [s] by which the matrix must be here.

        Raises InputRejectedError, or WorkerUnavailableError when there is no answer in time.
        """
        with self._turn:
            process, pipe = self._process, self._pipe
            if not self.ready or process is None or pipe is None:
                raise WorkerUnavailableError(self.reason)
            with _killed_at(process, until_s) as late:
                answer = _exchange(pipe, job, late)
            if isinstance(answer, Fault):
                raise InputRejectedError(answer.sentence)
            assert isinstance(answer, Decided)
            with _killed_at(process, time.monotonic() + self._explanation_s) as late:
                return Reply(answer, _explanation(pipe, late))

    def _supervise(self) -> None:
        losses = 0
        while not self._stopping.is_set():
            process = self._spawn()
            if self._greet():
                losses = 0
                process.join()
                self.reason = "the model is being restarted"
            process.join(_STOP_S)
            process.kill()
            process.join()
            self._ready.clear()
            if self._loaded is None:
                break
            if not self._stopping.is_set():
                _log.warning("event=worker_lost exit_code=%s losses=%s", process.exitcode, losses)
                self._stopping.wait(min(0.1 * 2**losses, _LONGEST_PAUSE_S))
                losses += 1
        self._settled.set()

    def _spawn(self) -> BaseProcess:
        ours, theirs = _SPAWN.Pipe()
        process = _SPAWN.Process(target=work, args=(theirs, self._load), daemon=True)
        process.start()
        theirs.close()
        self._process, self._pipe = process, ours
        if self._stopping.is_set():  # stop() may have seen only the process before this one
            process.kill()
        return process

    def _greet(self) -> bool:
        """Wait until the new process has loaded and warmed up; False if it does not."""
        assert self._pipe is not None
        try:
            while self._pipe.poll(self._start_s):
                message = self._pipe.recv()
                if isinstance(message, Fault):
                    self.reason = message.sentence
                    return False
                if isinstance(message, Loaded):
                    self._loaded = message
                    self.reason = "the model is warming up"
                    self._settled.set()
                if isinstance(message, Warm):
                    _log.info("event=worker_warm pid=%s warm_up_s=%.2f", self.pid, message.seconds)
                    self._ready.set()
                    return True
            self.reason = f"the model did not load within {self._start_s:.0f} s"
        except (EOFError, OSError):
            self.reason = "the inference process died before it was ready; the log says why"
        return False


def _exchange(pipe: Connection, job: Job, late: threading.Event) -> Any:
    try:
        pipe.send(job)
        return pipe.recv()
    except (EOFError, OSError) as error:
        why = "did not answer in time" if late.is_set() else "stopped"
        raise WorkerUnavailableError(f"the model {why} and is being restarted") from error


def _explanation(pipe: Connection, late: threading.Event) -> Explanation | None:
    try:
        explanation = pipe.recv()
    except (EOFError, OSError):
        _log.warning("event=no_explanation late=%s", late.is_set())
        return None
    assert isinstance(explanation, Explanation)
    return explanation


@contextmanager
def _killed_at(process: BaseProcess, until_s: float) -> Iterator[threading.Event]:
    """Kill a process at a monotonic time [s] if the block still runs; the event says if it was.

    A killed process breaks the pipe, so that a blocked send or receive ends at once.
    """
    late = threading.Event()

    def kill() -> None:
        late.set()
        process.kill()

    timer = threading.Timer(max(until_s - time.monotonic(), 0.0), kill)
    timer.daemon = True
    timer.start()
    try:
        yield late
    finally:
        timer.cancel()
