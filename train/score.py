"""Scores while training, always by decoding: style accuracy and command alignment."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ridetune.alignment import command_alignment, style_of
from ridetune.contract import Contract
from ridetune.matrix import ControllerMatrix
from ridetune.prompt import PromptBuilder
from ridetune.qwen import VisionFeatures, action_logits, run_tokens
from ridetune.sample import Sample

from .collate import collate, tokenize, without_answer


@torch.no_grad()
def query_logits(
    model: Any,
    prompts: PromptBuilder,
    samples: Sequence[Sample],
    features: VisionFeatures | None = None,
    batch_size: int = 64,
) -> Tensor:
    """Action logits [sample, 6, 256]; features None leaves the image out of the prompt."""
    found = []
    for at in range(0, len(samples), batch_size):
        chosen = range(at, min(at + batch_size, len(samples)))
        rows = [tokenize(samples[i], prompts, image=features is not None) for i in chosen]
        batch = collate([without_answer(row) for row in rows]).to(model.device)
        own = None if features is None else features.select(list(chosen))
        hidden = run_tokens(model, batch.ids, batch.positions, own, prompts.ids)
        at_queries = hidden[batch.query_rows[:, None], batch.queries]
        found.append(action_logits(model, at_queries, prompts.ids).float())
    return torch.cat(found)


def decode_matrices(
    model: Any,
    contract: Contract,
    prompts: PromptBuilder,
    samples: Sequence[Sample],
    features: VisionFeatures | None = None,
) -> list[ControllerMatrix]:
    """The matrix that the model proposes for each sample."""
    training = model.training
    model.eval()
    logits = query_logits(model, prompts, samples, features).cpu().numpy()
    model.train(training)
    return [contract.codec.expect(row)[0] for row in logits]


def score_phrases(
    model: Any, contract: Contract, prompts: PromptBuilder, samples: Sequence[Sample]
) -> str:
    """How well the words alone are understood, as one line."""
    matrices = decode_matrices(model, contract, prompts, samples)
    return summary(matrices, samples, contract)


def summary(
    matrices: Sequence[ControllerMatrix], samples: Sequence[Sample], contract: Contract
) -> str:
    """Style accuracy, command alignment and accuracy by directness level, as key=value."""
    ranges = contract.ranges
    right = [style_of(m, ranges) == s.style for m, s in zip(matrices, samples, strict=True)]
    aligned = [
        command_alignment(m, s.style, ranges) for m, s in zip(matrices, samples, strict=True)
    ]
    by_level: dict[str, list[bool]] = defaultdict(list)
    for hit, sample in zip(right, samples, strict=True):
        by_level[sample.level].append(hit)
    levels = " ".join(f"{level}={np.mean(by_level[level]):.2f}" for level in sorted(by_level))
    return f"style={np.mean(right):.3f} alignment={np.mean(aligned):.1f} {levels}"
