"""Look at proposed pairs: a local page on which annotators accept, edit or reject them.

In: a folder of proposals (`python -m data.propose`). Out: <reviews>/reviews.jsonl, one line an
action, from which the build takes what stands (`data.review.settle.apply_reviews`). The page is
open to this machine alone; from another one, go through `ssh -L 8480:127.0.0.1:8480`.

    python -m data.review --config configs/review.yaml proposals=runs/own/proposals port=8480
"""

import errno
import logging
import signal
import socket
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import uvicorn
from pydantic import Field

from ridetune.config import Share
from ridetune.control.vehicle import Vehicle
from ridetune.matrix import Ranges
from ridetune.stage import run_stage

from .app import LOOPBACK, create_app
from .desk import Desk
from .index import ProposalIndex
from .preview import Previewer
from .queue import Queue
from .store import Store

log = logging.getLogger("review")


@dataclass(frozen=True)
class ReviewConfig:
    """What to review, and where to keep what was said. port 0 takes a free one."""

    proposals: Path
    reviews: Path
    ranges: Path
    vehicle: Path
    second_opinion_share: Share  # of the pairs, chosen by their ids
    claim_s: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    port: Annotated[int, Field(ge=0, le=65535)]


def review(config: ReviewConfig) -> None:
    """Serve until SIGTERM or Ctrl-C; ValueError if there is nothing to review or no port."""
    ranges = Ranges.load(config.ranges)
    previewer = Previewer(Vehicle.load(config.vehicle))
    index = ProposalIndex(config.proposals)
    with listen(config.port) as listener, Store(config.reviews) as store:
        queue = Queue(
            index.ids,
            store.ledger,
            second_opinion_share=config.second_opinion_share,
            claim_s=config.claim_s,
        )
        desk = Desk(index, store, queue, ranges, previewer)
        desk.warm_up()
        url = f"http://{LOOPBACK}:{listener.getsockname()[1]}"
        log.info("event=reviewing url=%s proposals=%d file=%s", url, len(index), store.path)
        _run(desk, listener)


def listen(port: int) -> socket.socket:
    """A listening socket on this machine alone; ValueError if the port cannot be had."""
    try:
        return socket.create_server((LOOPBACK, port))
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise ValueError(
                f"port {port} is in use; stop the other program or set port=<another>"
            ) from error
        raise ValueError(f"cannot listen on port {port}: {error.strerror or error}") from error


def _run(desk: Desk, listener: socket.socket) -> None:
    # uvicorn raises the signal that stopped it once more; by then it has done its work.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    config = uvicorn.Config(
        create_app(desk),
        log_level="warning",
        access_log=False,
        lifespan="off",
        timeout_graceful_shutdown=1,
    )
    uvicorn.Server(config).run(sockets=[listener])


if __name__ == "__main__":
    sys.exit(run_stage(ReviewConfig, "configs/review.yaml", review, __doc__))
