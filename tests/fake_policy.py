"""A policy without a model: a word tokenizer and an engine that proposes what it is told to.

python -m tests.fake_policy port=0 memory=some/folder    the real server on this policy
"""

import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray
from tokenizers import AddedToken, Tokenizer, decoders, models, pre_tokenizers

from ridetune.codec import NUM_BINS
from ridetune.contract import Contract
from ridetune.engines import ActionPass, Prefix
from ridetune.matrix import ControllerMatrix, Ranges
from ridetune.policy import Policy
from ridetune.prompt import ACTION_TOKENS, CHAT_TOKENS, QUERY_TOKENS, InstructionError
from ridetune.stage import run_stage
from ridetune.vision import FrameError, VisionSpec
from serve.__main__ import serve
from serve.app import ServeConfig
from serve.inference import Decided, Job, Served
from serve.worker import InputRejectedError, Reply, WorkerUnavailableError

RANGES = Ranges.load(Path(__file__).parents[1] / "configs/ranges.yaml")
CONTRACT = Contract(VisionSpec(2, 3, 16, 2, 2, (0.5,) * 3, (0.5,) * 3), RANGES)
WORDS = (
    "scene : clear day . ahead because you are late hurry slow 4 0 m ' , I am the says "
    "crash hang dream keep it like this"
)


def word_tokenizer() -> Tokenizer:
    words = ["[UNK]", *WORDS.split(" ")]
    tokenizer = Tokenizer(models.WordPiece({w: i for i, w in enumerate(words)}, unk_token="[UNK]"))
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [pre_tokenizers.BertPreTokenizer(), pre_tokenizers.Digits(individual_digits=True)]
    )
    tokenizer.decoder = decoders.WordPiece()
    special = [*CHAT_TOKENS, *ACTION_TOKENS, *QUERY_TOKENS]
    tokenizer.add_special_tokens([AddedToken(t, special=True) for t in special])
    return tokenizer


TOKENIZER = word_tokenizer()
END_ID = CONTRACT.prompts(TOKENIZER).ids.end


class FakeEngine:
    """Proposes `matrix` with certainty and says `answer`.

    The words "crash" and "hang" do that to it before the matrix, "dream" hangs it after.
    """

    def __init__(self, matrix: ControllerMatrix, answer: str) -> None:
        self.logits = np.full((6, NUM_BINS), -50, np.float32)
        self.logits[np.arange(6), CONTRACT.codec.encode(matrix)] = 50
        self.answer = answer
        self.suffixes: list[list[int]] = []
        self.bins: tuple[int, ...] = ()

    def prefill(self, patches: NDArray[np.float32]) -> Prefix:
        return Prefix(patches.shape, 10, 10)

    def decide(self, prefix: Prefix, suffix: Sequence[int]) -> ActionPass:
        self.suffixes.append(list(suffix))
        if TOKENIZER.token_to_id("crash") in suffix:
            os._exit(1)
        if TOKENIZER.token_to_id("hang") in suffix:
            time.sleep(600)
        return ActionPass(self.logits, prefix)

    def explain(self, decided: ActionPass, bins: Sequence[int], max_tokens: int) -> Iterator[int]:
        self.bins = tuple(bins)
        if TOKENIZER.token_to_id("dream") in self.suffixes[-1]:
            time.sleep(600)
        ids = TOKENIZER.encode(self.answer, add_special_tokens=False).ids
        yield from [*ids, END_ID, *ids][:max_tokens]

    def write_matrix(self, prefix: Prefix, suffix: Sequence[int], max_tokens: int) -> list[int]:
        return []


GOAL = replace(RANGES.default, kp=0.5)
ANSWER = "scene: clear day, 40 m ahead. because you are late, hurry."


def frame() -> bytes:
    """A small JPEG."""
    ramp = np.tile(np.linspace(0, 255, 96, dtype=np.uint8)[None, :, None], (64, 1, 3))
    return cv2.imencode(".jpg", ramp)[1].tobytes()


def served() -> Served:
    """What the inference process loads in the tests of the server."""
    return Served(Policy(FakeEngine(GOAL, ANSWER), CONTRACT, TOKENIZER), "fake")


def broken() -> Served:
    """A bundle that does not load."""
    raise ValueError("bundle file decoder.onnx was changed after export; export again")


def dies() -> Served:
    """A process that ends while it loads."""
    os._exit(7)


def served_anyway(*config: object) -> Served:
    """In place of `serve.inference.load_served`."""
    return served()


class WorkerAtHand:
    """Answers as an `InferenceWorker` does, but in the process of the test, which sees the prompts.

    It has no answer while `reason` is set.
    """

    contract = CONTRACT
    bundle_id = "fake"

    def __init__(self) -> None:
        self.engine = FakeEngine(GOAL, ANSWER)
        self.reason: str | None = None
        self._policy = Policy(self.engine, CONTRACT, TOKENIZER)

    @property
    def ready(self) -> bool:
        return self.reason is None

    def decide(self, job: Job, *, until_s: float) -> Reply:
        if self.reason is not None:
            raise WorkerUnavailableError(self.reason)
        try:
            decision = self._policy.decide(
                job.frame, job.instruction, job.memories, last_safe=job.last_safe
            )
        except (FrameError, InstructionError) as error:
            raise InputRejectedError(str(error)) from error
        decided = Decided(
            **{name: getattr(decision, name) for name in Decided.__dataclass_fields__}
        )
        return Reply(decided, self._policy.explain(decision))

    def stop(self) -> None:
        self.reason = "stopped"

    def prompts(self) -> list[str]:
        """What each decision was asked with: memories and instruction."""
        ids = self.engine.suffixes
        return [str(TOKENIZER.decode(suffix, skip_special_tokens=True)) for suffix in ids]


def main() -> int:
    """The server as `python -m serve` runs it."""
    with patch("serve.__main__.load_served", served_anyway):
        return run_stage(ServeConfig, "configs/serve.yaml", serve, __doc__)


if __name__ == "__main__":
    sys.exit(main())
