"""Several processes with one model: each takes its share of a batch, gradients are averaged.

On a CPU two processes of one thread each beat one process of two threads: nobody waits inside a
step. All processes draw the same random numbers, so they choose the same batches and stay equal.
"""

import os
import socket
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.multiprocessing.spawn import start_processes


def in_processes(count: int, work: Callable[..., None], *args: Any) -> None:
    """Call work(*args) once in each of `count` processes and wait; an error ends them all."""
    if count == 1:
        work(*args)
    else:
        start_processes(_join_in, (count, _free_port(), work, args), nprocs=count)


def is_first() -> bool:
    """Whether this process is the one that prints and writes."""
    return not dist.is_initialized() or dist.get_rank() == 0


def wait_for_all() -> None:
    """Go on when every process has come here."""
    if dist.is_initialized():
        dist.barrier()


def own_share(chosen: Sequence[int]) -> list[int]:
    """What this process takes of a batch; of one too small to share, everything."""
    if not dist.is_initialized() or len(chosen) < dist.get_world_size():
        return list(chosen)
    return list(chosen[dist.get_rank() :: dist.get_world_size()])


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Make the gradients of all processes equal; one without a gradient counts as zero."""
    if not dist.is_initialized():
        return
    parameters = list(parameters)
    for parameter in parameters:
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
    gradients: list[Tensor] = [p.grad for p in parameters if p.grad is not None]
    flat = torch.cat([gradient.flatten() for gradient in gradients])
    dist.all_reduce(flat)
    flat /= dist.get_world_size()
    sizes = [gradient.numel() for gradient in gradients]
    for gradient, mean in zip(gradients, flat.split(sizes), strict=True):
        gradient.copy_(mean.view_as(gradient))


def _join_in(
    rank: int, count: int, port: int, work: Callable[..., None], args: tuple[Any, ...]
) -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    dist.init_process_group(
        "gloo", init_method=f"tcp://127.0.0.1:{port}", rank=rank, world_size=count
    )
    try:
        work(*args)
    finally:
        dist.destroy_process_group()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
