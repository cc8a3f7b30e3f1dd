"""LoRA on the language model of a Qwen-VL, its checkpoints, and the merge with a parity gate.

LoRA, Hu et al. 2021: W' = W + (alpha / r) B A. The vision tower stays frozen, so each frame is
encoded once. The adapter is merged in fp32 into the unquantized base, never into packed weights.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from peft import LoraConfig, get_peft_model, get_peft_model_state_dict, set_peft_model_state_dict
from safetensors.torch import save_file
from torch import Tensor

from ridetune.prompt import TokenIds

TARGETS = r".*language_model\.layers\.\d+\.(self_attn\.(q|k|v|o)_proj|mlp\.(gate|up|down)_proj)"
# Largest difference of action logits between adapter and merged weights, in standard deviations.
MERGE_TOLERANCE = 0.02


@dataclass(frozen=True)
class LoraShape:
    """Rank, scale (alpha / rank) and dropout of the adapter.

    train_tokens: also train the rows of the action and query tokens, new to a published base.
    """

    rank: int
    alpha: int
    dropout: float
    train_tokens: bool = False


def add_adapter(model: Any, shape: LoraShape, token_ids: TokenIds) -> Any:
    """The model under a fresh adapter; only the adapter trains."""
    rows = sorted([*token_ids.actions, *token_ids.queries])
    # Both tables: the 7-8 B models have a head of their own (peft keeps tied ones tied).
    tables = {"embed_tokens": rows, "lm_head": rows} if shape.train_tokens else None
    config = LoraConfig(
        r=shape.rank,
        lora_alpha=shape.alpha,
        lora_dropout=shape.dropout,
        target_modules=TARGETS,
        bias="none",
        trainable_token_indices=tables,
    )
    return get_peft_model(model, config)


class AdapterCheckpoint:
    """The adapter and its optimizer in one file, written whole or not at all.

    A checkpoint belongs to a fingerprint of data, base and config; another fingerprint is refused
    with a sentence, because steps on other data would not continue the same run.
    """

    def __init__(self, path: Path, model: Any, fingerprint: str, every: int) -> None:
        self.path, self.model, self.fingerprint, self.every = path, model, fingerprint, every

    def load(self, optimizer: torch.optim.Optimizer) -> int:
        """Restore weights and optimizer; 0 steps where there is no checkpoint."""
        if not self.path.is_file():
            return 0
        state = torch.load(self.path, weights_only=True)
        if state["fingerprint"] != self.fingerprint:
            raise ValueError(
                f"{self.path} belongs to a run on other data, another base or another config; "
                "delete it to start afresh, or restore what it was started with"
            )
        set_peft_model_state_dict(self.model, state["adapter"])
        optimizer.load_state_dict(state["optimizer"])
        return int(state["steps_done"])

    def save(self, optimizer: torch.optim.Optimizer, steps_done: int) -> None:
        """Write after every `every` steps."""
        if steps_done % self.every:
            return
        state = {
            "fingerprint": self.fingerprint,
            "adapter": get_peft_model_state_dict(self.model),
            "optimizer": optimizer.state_dict(),
            "steps_done": steps_done,
        }
        self.path.parent.mkdir(parents=True, exist_ok=True)
        partial = self.path.with_suffix(".partial")
        try:
            with partial.open("wb") as file:
                torch.save(state, file)
                file.flush()
                os.fsync(file.fileno())
            partial.rename(self.path)
        finally:
            partial.unlink(missing_ok=True)


def save_adapter(model: Any, folder: Path) -> None:
    """The adapter alone, as peft reads it."""
    model.peft_config["default"].save_pretrained(folder)
    weights = {name: w.contiguous() for name, w in get_peft_model_state_dict(model).items()}
    save_file(weights, folder / "adapter_model.safetensors")


def merge(model: Any) -> Any:
    """The base with the adapter folded into its weights."""
    return model.merge_and_unload(safe_merge=True)


def check_merge(adapted: Tensor, merged: Tensor) -> float:
    """Compare action logits [sample, 6, 256] before and after; ValueError if they disagree.

    Returns the largest difference as a share of the logits' standard deviation.
    """
    difference = float((adapted - merged).abs().max() / adapted.std())
    if not difference <= MERGE_TOLERANCE:  # also catches NaN
        raise ValueError(
            f"the merged weights disagree with the adapter: action logits differ by "
            f"{difference:.3g} of their spread, the limit is {MERGE_TOLERANCE}; "
            "the base must be unquantized and the adapter trained on this very base"
        )
    return difference
