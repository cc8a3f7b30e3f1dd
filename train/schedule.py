"""The training loop of every stage here: AdamW, warm-up and cosine, batches of equal length.

All randomness of a step comes from (seed, step), so a resumed run takes the very same steps.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from .processes import average_gradients, is_first, own_share

LossOf = Callable[[list[int], np.random.Generator], Tensor]


@dataclass(frozen=True)
class Steps:
    """How long and how hard a stage trains."""

    steps: int
    batch: int
    learning_rate: float
    weight_decay: float = 0.02


class Checkpoints(Protocol):
    """Where a run can be taken up again."""

    def load(self, optimizer: torch.optim.Optimizer) -> int:
        """Restore weights and optimizer; the number of steps already done."""

    def save(self, optimizer: torch.optim.Optimizer, steps_done: int) -> None:
        """Write both; called after every step, keeps to its own rhythm."""


def train_steps(
    about: str,
    parts: Sequence[nn.Module],
    lengths: Sequence[int],
    loss_of: LossOf,
    plan: Steps,
    seed: int,
    *,
    watch: Callable[[], str] | None = None,
    checkpoints: Checkpoints | None = None,
) -> None:
    """Minimise `loss_of(sample numbers, rng)` over the trainable parameters of `parts`.

    Several processes share each batch.

    lengths: tokens of each sample. watch: asked every tenth of the way, its answer is printed.
    """
    parameters = [p for part in parts for p in part.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(
        parameters, lr=plan.learning_rate, weight_decay=plan.weight_decay, betas=(0.9, 0.98)
    )
    done = checkpoints.load(optimizer) if checkpoints is not None else 0
    batches = islice(endless_batches(lengths, plan.batch, seed), done, None)
    mean: float | None = None
    with tqdm(
        total=plan.steps, initial=done, desc=about, unit="step", disable=not is_first()
    ) as bar:
        for step in range(done, plan.steps):
            torch.manual_seed(hash((seed, step)) % 2**31)
            set_rate(optimizer, plan.learning_rate * cosine(step, plan.steps))
            loss = loss_of(own_share(next(batches)), np.random.default_rng([seed, step]))
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            average_gradients(parameters)
            torch.nn.utils.clip_grad_norm_(parameters, 1.0)
            optimizer.step()
            if checkpoints is not None:
                checkpoints.save(optimizer, step + 1)
            mean = loss.item() if mean is None else 0.98 * mean + 0.02 * loss.item()
            bar.set_postfix(loss=f"{mean:.3f}", refresh=False)
            bar.update()
            if watch is not None and is_first() and (step + 1) % max(plan.steps // 10, 1) == 0:
                tqdm.write(f"{about} step={step + 1} loss={mean:.4f} {watch()}")


def set_rate(optimizer: Any, rate: float) -> None:
    """Set the learning rate of every parameter group."""
    for group in optimizer.param_groups:
        group["lr"] = rate


def cosine(step: int, steps: int, warmup: float = 0.03) -> float:
    """The share of the peak learning rate at a step: linear up, cosine down to 2 %."""
    rise = max(int(steps * warmup), 1)
    if step < rise:
        return (step + 1) / rise
    share = (step - rise) / max(steps - rise, 1)
    return float(0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * share)))


def endless_batches(lengths: Sequence[int], size: int, seed: int) -> Iterator[list[int]]:
    """Sample numbers in batches of about equal length, epoch after epoch in random order.

    Samples are sorted by length only within random pools, so that batches stay well mixed.
    """
    rng = np.random.default_rng(seed)
    pool = size * 50
    while True:
        order = rng.permutation(len(lengths))
        for at in range(0, len(order), pool):
            near = sorted(order[at : at + pool], key=lambda i: lengths[i])
            batches = [near[k : k + size] for k in range(0, len(near), size)]
            for number in rng.permutation(len(batches)):
                yield [int(i) for i in batches[number]]
