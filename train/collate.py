"""Samples -> padded batches of token ids and targets.

    parallel   prefix  suffix  query x 6 | action x 6  scene; explanation  END
    as text    prefix  suffix            | matrix as text  END                (the paper's way)

Loss is taken at the six queries (a soft target over the bins) and on the text behind the bar.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ridetune.prompt import PromptBuilder
from ridetune.sample import Sample


@dataclass(frozen=True)
class Example:
    """One tokenized sample; `first_target` is the index of the first token to be predicted."""

    ids: list[int]
    positions: NDArray[np.int64]
    first_query: int | None
    bins: tuple[int, ...]
    first_target: int


@dataclass(frozen=True)
class Batch:
    """Tensors of several examples; ids [sample, token], positions [3, sample, token].

    queries [n, 6] holds token indices of the samples in query_rows [n], bins [n, 6] their labels.
    text_rows, text_at and text_ids say which token follows which position.
    """

    ids: Tensor
    positions: Tensor
    query_rows: Tensor
    queries: Tensor
    bins: Tensor
    text_rows: Tensor
    text_at: Tensor
    text_ids: Tensor

    def to(self, device: torch.device) -> "Batch":
        """The same batch on another device."""
        return Batch(**{name: tensor.to(device) for name, tensor in vars(self).items()})


def answer_text(sample: Sample) -> str:
    """What the model says after the matrix."""
    return f"scene: {sample.scene}. {sample.explanation}"


def tokenize(
    sample: Sample, prompts: PromptBuilder, *, image: bool = True, as_text: bool = False
) -> Example:
    """One sample as ids and targets; ValueError names a sample whose label cannot be coded.

    image: False leaves the prefix out, for learning from words alone at the same positions.
    """
    suffix = prompts.suffix(sample.instruction, sample.memories)
    prefix = prompts.prefix()
    prompt = [*prefix, *suffix] if image else suffix
    start = 0 if image else prompts.next_position(prefix)
    try:
        bins = prompts.codec.encode(sample.matrix)
    except ValueError as error:
        raise ValueError(f"sample {sample.scene_id}, {sample.instruction!r}: {error}") from error
    if as_text:
        answer = prompts.text(prompts.codec.text(sample.matrix))
        first_query, first_target = None, len(prompt)
    else:
        actions = [prompts.ids.actions[b] for b in bins]
        answer = [*prompts.ids.queries, *actions, *prompts.text(answer_text(sample))]
        first_query, first_target = len(prompt), len(prompt) + 2 * len(bins)
    ids = [*prompt, *answer, prompts.ids.end]
    positions = prompts.positions(ids, start)
    return Example(ids, positions, first_query, bins, first_target)


def collate(examples: Sequence[Example]) -> Batch:
    """Pad on the right and gather the targets of all examples."""
    longest = max(len(e.ids) for e in examples)
    ids = torch.zeros(len(examples), longest, dtype=torch.long)
    positions = torch.zeros(3, len(examples), longest, dtype=torch.long)
    query_rows, queries, bins = [], [], []
    text_rows: list[int] = []
    text_at: list[int] = []
    text_ids: list[int] = []
    for row, e in enumerate(examples):
        ids[row, : len(e.ids)] = torch.tensor(e.ids)
        positions[:, row, : len(e.ids)] = torch.from_numpy(e.positions)
        if e.first_query is not None:
            query_rows.append(row)
            queries.append(range(e.first_query, e.first_query + len(e.bins)))
            bins.append(e.bins)
        for at in range(e.first_target, len(e.ids)):
            text_rows.append(row)
            text_at.append(at - 1)
            text_ids.append(e.ids[at])
    return Batch(
        ids=ids,
        positions=positions,
        query_rows=torch.tensor(query_rows, dtype=torch.long),
        queries=torch.tensor([list(q) for q in queries], dtype=torch.long).view(-1, 6),
        bins=torch.tensor(bins, dtype=torch.long).view(-1, 6),
        text_rows=torch.tensor(text_rows),
        text_at=torch.tensor(text_at),
        text_ids=torch.tensor(text_ids),
    )


def without_answer(example: Example) -> Example:
    """The example up to its last query: for stages that learn the matrix alone."""
    assert example.first_query is not None
    end = example.first_query + len(example.bins)
    return replace(
        example, ids=example.ids[:end], positions=example.positions[:, :end], first_target=end
    )
