"""The gate of an export: the graphs must answer like the torch model, on prompts with images.

Text-only prompts would pass although DeepStack is lost, so every prompt here has its frame.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ridetune.codec import NUM_BINS, MatrixCodec
from ridetune.engines import CachedEngine

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class GateConfig:
    """How many prompts are compared and how far apart the answers may be (configs/export.yaml)."""

    samples: int
    tolerance: float
    max_bins: float


@dataclass(frozen=True)
class ParityPrompt:
    """One frame [num_patches, 3 * t * p * p] and the ids of what follows it."""

    patches: NDArray[np.float32]
    suffix: list[int]


@dataclass(frozen=True)
class Answer:
    """Last hidden states of suffix and queries [token, hidden], logits of the queries [6, 256]."""

    hidden: NDArray[np.float32]
    logits: NDArray[np.float32]


def answer(engine: CachedEngine, prompt: ParityPrompt) -> Answer:
    """What an engine makes of a prompt, split where a drive splits it."""
    queries = engine.ids.queries
    ids = [*prompt.suffix, *queries]
    hidden, _ = engine.advance(engine.prefill(prompt.patches), ids, num_hidden=len(ids))
    return Answer(hidden, engine.action_logits(hidden[-len(queries) :]))


def answers(engine: CachedEngine, prompts: Sequence[ParityPrompt], *, name: str) -> list[Answer]:
    """The answers to all prompts, under a progress bar of that name."""
    return [answer(engine, prompt) for prompt in tqdm(prompts, desc=name, unit="prompt")]


def compare_exact(truth: Sequence[Answer], found: Sequence[Answer]) -> dict[str, float]:
    """Largest absolute differences, and the largest value that they are relative to."""
    pairs = list(zip(truth, found, strict=True))
    return {
        "hidden_difference": max(_difference(t.hidden, f.hidden) for t, f in pairs),
        "hidden_largest": max(float(np.abs(t.hidden).max()) for t, _ in pairs),
        "logits_difference": max(_difference(t.logits, f.logits) for t, f in pairs),
        "logits_largest": max(float(np.abs(t.logits).max()) for t, _ in pairs),
    }


def compare_decisions(
    truth: Sequence[Answer], found: Sequence[Answer], codec: MatrixCodec
) -> dict[str, float]:
    """How many bins the decided (median) levels lie apart, over prompts and parameters."""
    apart = [
        np.abs(_levels(t.logits, codec) - _levels(f.logits, codec))
        for t, f in zip(truth, found, strict=True)
    ]
    return {
        "bins_mean": float(np.mean(apart)),
        "bins_p95": float(np.percentile(apart, 95)),
        "bins_max": float(np.max(apart)),
    }


def check_exact(figures: dict[str, float], gate: GateConfig) -> None:
    """ValueError where the graphs do not compute what torch computes in float32."""
    for name in ("hidden", "logits"):
        difference = figures[f"{name}_difference"]
        limit = gate.tolerance * max(1.0, figures[f"{name}_largest"])
        if not difference <= limit:  # also catches NaN
            raise ValueError(
                f"the exported graphs differ from torch by {difference:.2e} in the {name}, the "
                f"limit is {limit:.2e} (gate.tolerance); this is a fault of the export or of the "
                "installed torch, transformers or onnxruntime: use versions that a release names"
            )


def check_decisions(figures: dict[str, float], gate: GateConfig) -> None:
    """ValueError where the deployed accuracy level changes the decisions."""
    if not figures["bins_p95"] <= gate.max_bins:
        raise ValueError(
            f"the decisions of the bundle differ from torch by {figures['bins_p95']:.1f} bins "
            f"(95th percentile), the limit is {gate.max_bins} (gate.max_bins); "
            "set accuracy_level to 0, which costs speed, or train longer"
        )


def _difference(left: NDArray[np.float32], right: NDArray[np.float32]) -> float:
    return float(np.abs(left - right).max())


def _levels(logits: NDArray[np.float32], codec: MatrixCodec) -> NDArray[np.float64]:
    matrix, _ = codec.expect(logits)
    return np.array([codec.share(v, i) * (NUM_BINS - 1) for i, v in enumerate(matrix.values)])
