"""How far a quantized model's answers lie from those of the unquantized one.

    KL(p || q) = sum p log(p / q)  in nats, p -> unquantized, q -> quantized

Measured twice on prompts held apart: over the 256 action tokens at the six queries, which is what
the car drives by, and over the whole vocabulary at every token after the image.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from ridetune.matrix import NUM_PARAMETERS
from ridetune.qwen import action_logits

from .calibration import CalibrationPrompt, Reader, run_prompt


@dataclass(frozen=True)
class Answer:
    """Log-probabilities of one prompt on the CPU: actions [6, 256], next_token [token, word]."""

    actions: Tensor
    next_token: Tensor

    def is_finite(self) -> bool:
        """Whether the model gave numbers throughout."""
        return bool(self.actions.isfinite().all() and self.next_token.isfinite().all())


@dataclass(frozen=True)
class Divergence:
    """Mean KL of each prompt [prompt] in nats."""

    actions: NDArray[np.float64]
    next_token: NDArray[np.float64]

    def as_dict(self) -> dict[str, float]:
        """The means over the prompts."""
        return {
            "actions_nats": float(self.actions.mean()),
            "next_token_nats": float(self.next_token.mean()),
        }


@torch.inference_mode()
def answer(model: Any, prompt: CalibrationPrompt, reader: Reader) -> Answer:
    """What a model says to one prompt."""
    hidden = run_prompt(model, prompt, reader)
    queries = hidden[prompt.queries_at : prompt.queries_at + NUM_PARAMETERS]
    words = model.get_output_embeddings()(hidden[prompt.text_at :])
    actions = action_logits(model, queries, reader.ids)
    return Answer(actions.float().log_softmax(-1).cpu(), words.float().log_softmax(-1).cpu())


def answers(
    model: Any, prompts: Sequence[CalibrationPrompt], reader: Reader, *, name: str
) -> list[Answer]:
    """What a model says to all prompts, under a progress bar of that name."""
    return [answer(model, prompt, reader) for prompt in tqdm(prompts, desc=name, unit="prompt")]


def divergence(truth: Sequence[Answer], found: Sequence[Answer]) -> Divergence:
    """KL of each prompt between the unquantized model's answers and those found."""
    pairs = list(zip(truth, found, strict=True))
    return Divergence(
        np.array([_mean_kl(p.actions, q.actions) for p, q in pairs]),
        np.array([_mean_kl(p.next_token, q.next_token) for p, q in pairs]),
    )


def is_above(left: NDArray[np.float64], right: NDArray[np.float64]) -> bool:
    """Whether `left` is larger on average by more than two standard errors of the difference."""
    difference = left - right
    if difference.size < 2:
        return bool(difference.mean() > 0)
    noise = difference.std(ddof=1) / np.sqrt(difference.size)
    return bool(difference.mean() > 2 * noise)


def _mean_kl(p: Tensor, q: Tensor) -> float:
    """KL of log-probabilities [row, outcome], averaged over the rows."""
    truth = p.double()
    return float((truth.exp() * (truth - q.double())).sum(-1).mean())
