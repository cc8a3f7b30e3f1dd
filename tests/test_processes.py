"""Two processes that share batches take the steps of one."""

import time
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from train.processes import in_processes, is_first, own_share
from train.schedule import Steps, train_steps

ROWS = 8


def fit(out: Path) -> None:
    """Fit a line with a parameter that only even rows use, and keep what came of it."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    line, odd = nn.Linear(3, 1), nn.Linear(1, 1)
    inputs, wanted = torch.randn(ROWS, 3), torch.randn(ROWS, 1)

    def loss_of(chosen: list[int], _: np.random.Generator) -> Tensor:
        guess = line(inputs[chosen])
        if 0 in chosen:  # one process alone has a gradient for `odd`
            guess = guess + odd(torch.ones(1, 1)) * torch.tensor(chosen).eq(0)[:, None]
        return torch.as_tensor((guess - wanted[chosen]).square().mean())

    plan = Steps(steps=12, batch=ROWS, learning_rate=0.1)
    train_steps("line", [line, odd], [1] * ROWS, loss_of, plan, seed=3)
    if is_first():
        torch.save([*line.parameters(), *odd.parameters()], out)


def test_two_processes_take_the_steps_of_one(tmp_path: Path) -> None:
    alone, shared = tmp_path / "alone.pt", tmp_path / "shared.pt"
    in_processes(1, fit, alone)
    in_processes(2, fit, shared)
    for one, two in zip(torch.load(alone), torch.load(shared), strict=True):
        torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-6)


def stumble(_: Path) -> None:
    """Fail in the second process while the first is busy."""
    if not is_first():
        raise ValueError("the second process stumbled")
    time.sleep(600)


def test_an_error_in_one_process_ends_them_all(tmp_path: Path) -> None:
    with pytest.raises(Exception, match="the second process stumbled"):
        in_processes(2, stumble, tmp_path)


def test_alone_a_process_takes_the_whole_batch() -> None:
    assert own_share([3, 1, 2]) == [3, 1, 2]
    assert is_first()
