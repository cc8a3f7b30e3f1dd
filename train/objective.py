"""The training loss: ordinal cross-entropy on the six bins, cross-entropy on the text.

A label is one draw from a range, so its neighbours are nearly as right: the target is a Gaussian
over the bins around the label, in the sense of soft ordinal labels (Diaz & Marathe, 2019).
"""

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ridetune.codec import NUM_BINS
from ridetune.prompt import TokenIds
from ridetune.qwen import VisionFeatures, action_logits, run_tokens

from .collate import Batch

BIN_SPREAD = 6.0  # standard deviation of the soft target, in bins


@dataclass(frozen=True)
class Loss:
    """Mean losses of one batch; `total` is what is minimised."""

    actions: Tensor
    text: Tensor
    total: Tensor


def batch_loss(
    model: Any,
    batch: Batch,
    features: VisionFeatures | None,
    token_ids: TokenIds,
    *,
    text_weight: float,
    fixed_vocabulary: bool = False,
) -> tuple[Loss, Tensor]:
    """One forward pass: the losses and the last hidden states [sample, token, hidden].

    fixed_vocabulary: no gradient from the text to the output table. Where it is tied to the word
    embeddings, an answer would push the embedding of every word that it does not hold.
    """
    hidden = run_tokens(model, batch.ids, batch.positions, features, token_ids)
    actions = _action_loss(model, batch, hidden, token_ids)
    text = _text_loss(model, batch, hidden, fixed_vocabulary)
    return Loss(actions, text, actions + text_weight * text), hidden


def _action_loss(model: Any, batch: Batch, hidden: Tensor, token_ids: TokenIds) -> Tensor:
    if len(batch.query_rows) == 0:
        return hidden.new_zeros(())
    at_queries = hidden[batch.query_rows[:, None], batch.queries]  # [n, 6, hidden]
    logits = action_logits(model, at_queries, token_ids).float()
    return F.cross_entropy(logits.flatten(0, 1), soft_bins(batch.bins).flatten(0, 1))


def _text_loss(model: Any, batch: Batch, hidden: Tensor, fixed_vocabulary: bool) -> Tensor:
    if len(batch.text_rows) == 0:
        return hidden.new_zeros(())
    before = hidden[batch.text_rows, batch.text_at]  # [targets, hidden]
    table = model.get_output_embeddings()
    logits = F.linear(before, table.weight.detach()) if fixed_vocabulary else table(before)
    return F.cross_entropy(logits.float(), batch.text_ids)


def soft_bins(bins: Tensor) -> Tensor:
    """Labels [..., 6] -> target distributions [..., 6, 256]."""
    levels = torch.arange(NUM_BINS, device=bins.device)
    distance = (levels - bins[..., None]) / BIN_SPREAD
    return torch.softmax(-0.5 * distance.square(), dim=-1)
