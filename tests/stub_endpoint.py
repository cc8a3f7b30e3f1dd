"""A chat endpoint on loopback that says what a test has it say, and keeps what it was sent."""

import json
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

KEY = "sk-test-0123456789abcdef"
GOOD = {
    "scene": "rainy straight road in the city, a vehicle close ahead, dense traffic",
    "condition": "rain",
    "style": "conservative",
    "explanation": "because you feel queasy, i drive more gently on the wet road.",
    "confidence": 0.8,
}
Answerer = Callable[[dict[str, Any]], "Said"]


class Said:
    """What the stub says to one request."""

    def __init__(
        self, text: str = "", *, status: int = 200, after_s: float = 0.0, **headers: str
    ) -> None:
        self.text, self.status, self.after_s, self.headers = text, status, after_s, headers
        self.together: threading.Barrier | None = None  # with so many other requests


def good(**changed: object) -> Said:
    return Said(json.dumps({**GOOD, **changed}))


class Stub:
    """A chat endpoint on loopback: says `script` in turn, then `otherwise`; keeps what it got."""

    def __init__(self) -> None:
        self.script: list[Said] = []
        self.otherwise: Answerer = lambda _: good()
        self.got: list[dict[str, Any]] = []
        self.keys: list[str | None] = []
        self.times: list[float] = []
        self.usage: dict[str, int] | None = {"prompt_tokens": 1000, "completion_tokens": 100}
        self.body: bytes | None = None  # in place of a completion
        self.most = 0
        self._open = 0
        self._lock = threading.Lock()
        stub = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                stub.answer(self)

            def log_message(self, format: str, *args: object) -> None:  # noqa: A002
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        threading.Thread(target=self.server.serve_forever, args=(0.02,), daemon=True).start()
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}/v1"

    def answer(self, handler: BaseHTTPRequestHandler) -> None:
        request = json.loads(handler.rfile.read(int(handler.headers["Content-Length"])))
        with self._lock:
            self._open += 1
            self.most = max(self.most, self._open)
            assert handler.path == "/v1/chat/completions"
            self.got.append(request)
            self.keys.append(handler.headers["Authorization"])
            self.times.append(time.monotonic())
            said = self.script.pop(0) if self.script else self.otherwise(request)
        if said.together:
            said.together.wait(30)
        time.sleep(said.after_s)
        choice = {"index": 0, "message": {"role": "assistant", "content": said.text}}
        completion = {"id": "1", "object": "chat.completion", "choices": [choice]}
        body = json.dumps({**completion, "usage": self.usage}).encode()
        if said.status != 200:
            body = f"the key {KEY} is not welcome".encode()
        body = self.body or body
        with self._lock:
            self._open -= 1
        try:
            handler.send_response(said.status)
            for name, value in said.headers.items():
                handler.send_header(name.replace("_", "-"), value)
            handler.send_header("Content-Length", str(len(body)))
            handler.end_headers()
            handler.wfile.write(body)
        except OSError:
            pass  # it did not wait
