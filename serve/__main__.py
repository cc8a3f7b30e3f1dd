"""Serve a bundle on this machine.

The bundle is loaded and checked before the port is taken; /readyz answers 200 once the model has
answered a first frame.

    python -m serve --config configs/serve.yaml bundle=runs/tiny/bundle port=8470
"""

import errno
import logging
import signal
import socket
import sys
from functools import partial

import uvicorn

from ridetune.stage import run_stage

from .app import ServeConfig, create_app
from .inference import load_served
from .worker import InferenceWorker

_log = logging.getLogger("serve")
_LOOPBACK = ("127.0.0.1", "::1", "localhost")


def serve(config: ServeConfig) -> None:
    """Serve until SIGTERM or Ctrl-C; ValueError if the bundle or the port cannot be had."""
    load = partial(load_served, config.bundle, config.threads, config.vehicle, config.envelope)
    worker = InferenceWorker(load, explanation_s=config.explanation_s)
    try:
        worker.start()
        with listen(config.host, config.port) as listener:
            host, port = listener.getsockname()[:2]
            _log.info("event=serving url=http://%s:%s bundle=%s", host, port, worker.bundle_id)
            if config.host not in _LOOPBACK:
                _log.warning("event=open_to_network host=%s: there is no login yet", config.host)
            _run(worker, config, listener)
    finally:
        worker.stop()


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; ValueError if the address cannot be had."""
    try:
        return socket.create_server((host, port))
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise ValueError(
                f"port {port} on {host} is in use; stop the other program or set port=<another>"
            ) from error
        raise ValueError(f"cannot listen on {host}:{port}: {error.strerror or error}") from error


def _run(worker: InferenceWorker, config: ServeConfig, listener: socket.socket) -> None:
    # uvicorn raises the signal that stopped it once more; by then it has done its work.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    server = uvicorn.Server(
        uvicorn.Config(
            create_app(worker, config),
            log_level="warning",
            access_log=False,
            lifespan="on",
            timeout_graceful_shutdown=1,
        )
    )
    server.run(sockets=[listener])


if __name__ == "__main__":
    sys.exit(run_stage(ServeConfig, "configs/serve.yaml", serve, __doc__))
