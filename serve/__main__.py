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
from contextlib import ExitStack
from functools import partial

import uvicorn
from fastapi import FastAPI

from ridetune.memory import PassengerMemory
from ridetune.stage import run_stage

from .app import ServeConfig, create_app
from .audit.log import AuditLog
from .inference import load_served
from .worker import InferenceWorker

_log = logging.getLogger("serve")
_LOOPBACK = ("127.0.0.1", "::1", "localhost")


def serve(config: ServeConfig) -> None:
    """Serve until SIGTERM or Ctrl-C.

    ValueError if the bundle, the port, the memory or the audit log cannot be had.
    """
    load = partial(load_served, config.bundle, config.threads, config.vehicle, config.envelope)
    worker = InferenceWorker(load, explanation_s=config.explanation_s)
    try:
        worker.start()
        with ExitStack() as opened:
            listener = opened.enter_context(listen(config.host, config.port))
            app = _open_app(worker, config, opened)
            host, port = listener.getsockname()[:2]
            _log.info("event=serving url=http://%s:%s bundle=%s", host, port, worker.bundle_id)
            if config.host not in _LOOPBACK:
                _log.warning("event=open_to_network host=%s: there is no login yet", config.host)
            _run(app, listener)
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


def _open_app(worker: InferenceWorker, config: ServeConfig, opened: ExitStack) -> FastAPI:
    """The application on its memory and its audit log, which close with `opened`."""
    memory = log = None
    if config.memory is not None:
        codec, days = worker.contract.codec, config.retention_days
        memory = opened.enter_context(PassengerMemory(config.memory, codec, retention_days=days))
    if config.audit is not None:
        log = opened.enter_context(AuditLog(config.audit, keep_words=config.audit_words))
    return create_app(worker, config, memory=memory, log=log)


def _run(app: FastAPI, listener: socket.socket) -> None:
    # uvicorn raises the signal that stopped it once more; by then it has done its work.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,
            lifespan="on",
            timeout_graceful_shutdown=1,
        )
    )
    server.run(sockets=[listener])


if __name__ == "__main__":
    sys.exit(run_stage(ServeConfig, "configs/serve.yaml", serve, __doc__))
