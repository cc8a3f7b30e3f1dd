"""Ask a bundle three things about some frames and print what the car would do.

Starts a server of its own on this machine, waits until it is ready, asks, prints, stops it.

    python -m serve.demo --config configs/demo.yaml frames=my/photos
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Annotated, Any

import httpx
from pydantic import Field, TypeAdapter

from ridetune.sample import Condition
from ridetune.stage import run_stage

from .__main__ import listen
from .layout import GUIDE, WIDTH, answer_lines, wrapped
from .wire import DecisionOut

QUESTIONS = (
    "I am going to be late for work.",
    "I feel a bit motion-sick.",
    "Keep it like this.",
)
SUFFIXES = (".jpg", ".jpeg", ".png")
START_S = 300.0
STOP_S = 5.0
ANSWER_S = 60.0  # a demo may run on a slow machine; a car's limits are in serve.yaml
_SERVE_YAML = Path(__file__).parents[1] / "configs/serve.yaml"
_DECISION = TypeAdapter(DecisionOut)


@dataclass(frozen=True)
class DemoConfig:
    """What to ask about; `frames` is a folder, or empty for a frame of the dataset `data`.

    condition: of the road on the frames of the folder, for the gate; None if it is not known.
    """

    bundle: Path
    data: Path
    frames: str | None
    max_frames: Annotated[int, Field(ge=1)] | None
    condition: Condition | None
    port: Annotated[int, Field(ge=0, le=65535)]


@dataclass(frozen=True)
class Frame:
    """An encoded image, what to call it, and the condition of the road where it is known."""

    name: str
    content: bytes
    condition: Condition | None


def demo(config: DemoConfig) -> None:
    """Print three answers per frame; ValueError if there is no frame or no server to be had."""
    if config.frames:
        frames = folder_frames(Path(config.frames), config.max_frames or 6, config.condition)
    else:
        frames = dataset_frames(config.data, config.max_frames or 1)
    unusable: list[str] = []
    with running_server(config) as url, _client(url) as client:
        print(GUIDE)
        for number, frame in enumerate(frames, start=1):
            print(f"\n{'━' * WIDTH}\nFrame {number} of {len(frames)}   {frame.name}\n{'━' * WIDTH}")
            fault = _show_answers(client, frame)
            if fault is not None:
                print("\n".join(wrapped("  not usable  ", fault)))
                unusable.append(f"{frame.name}: {fault}")
    print(f"\n{'━' * WIDTH}\n{len(frames) - len(unusable)} of {len(frames)} frames answered")
    for line in unusable:
        print("\n".join(wrapped("  not usable  ", line)))
    if len(unusable) == len(frames):
        raise ValueError("no frame was usable; set frames=<a folder of JPEG or PNG camera images>")


def folder_frames(folder: Path, count: int, condition: Condition | None) -> list[Frame]:
    """Up to `count` images, spread evenly over the sub-folders; ValueError if there is none."""
    if not folder.is_dir():
        raise ValueError(f"no folder at {folder}; set frames=<a folder of camera images>")
    groups: dict[Path, list[Path]] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in SUFFIXES and path.is_file():
            groups.setdefault(path.parent, []).append(path)
    if not groups:
        raise ValueError(
            f"no {', '.join(SUFFIXES)} image in {folder} or its sub-folders; "
            "set frames=<a folder of camera images>"
        )
    chosen = pick_evenly(list(groups.values()), count)
    return [Frame(str(path.relative_to(folder)), path.read_bytes(), condition) for path in chosen]


def pick_evenly(groups: list[list[Path]], count: int) -> list[Path]:
    """At most `count` of all paths: as many of each group as there are, then evenly within it."""
    groups = _spread(groups, count)
    shares = [0] * len(groups)
    for _ in range(min(count, sum(len(group) for group in groups))):
        open_groups = [i for i, group in enumerate(groups) if shares[i] < len(group)]
        shares[min(open_groups, key=lambda i: shares[i])] += 1
    return [path for group, n in zip(groups, shares, strict=True) for path in _spread(group, n)]


def dataset_frames(data: Path, count: int) -> list[Frame]:
    """The first clear-day frames of a dataset's test split, one a scene; ValueError if none."""
    import pyarrow.parquet

    path = data / "test.parquet"
    if not path.is_file():
        raise ValueError(f"no dataset at {data}; run `python -m data`, or set frames=<a folder>")
    table = pyarrow.parquet.read_table(path, columns=["image", "condition", "scene_id"])
    found: dict[str, bytes] = {}
    for row in range(table.num_rows):
        if len(found) == count:
            break
        if table["condition"][row].as_py() == "sunny":
            name = table["scene_id"][row].as_py()
            found.setdefault(name, table["image"][row].as_py()["bytes"])
    if not found:
        raise ValueError(f"{path} holds no sunny frame; build it with `python -m data`")
    return [Frame(f"{name}, rendered, sunny", content, "sunny") for name, content in found.items()]


@contextmanager
def running_server(config: DemoConfig) -> Iterator[str]:
    """The address of a ready server, stopped in the end; ValueError with its sentence if none."""
    with listen("127.0.0.1", config.port) as probe:  # so that no other server answers in its place
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "serve", "--config", str(_SERVE_YAML)]
    limits = [f"deadline_s={ANSWER_S}", f"explanation_s={ANSWER_S}"]
    nothing_kept = ["memory=null", "audit=null"]  # and no lock that another server holds
    values = [f"bundle={config.bundle.resolve()}", f"port={port}", *limits, *nothing_kept]
    with tempfile.TemporaryFile("w+") as log:
        server = subprocess.Popen([*command, *values], stdout=log, stderr=log)
        try:
            _wait_until_ready(server, f"http://127.0.0.1:{port}", log)
            yield f"http://127.0.0.1:{port}"
        finally:
            server.terminate()
            try:
                server.wait(STOP_S)
            except subprocess.TimeoutExpired:
                server.kill()


def _wait_until_ready(server: "subprocess.Popen[bytes]", url: str, log: IO[str]) -> None:
    start = time.monotonic()
    reason, shown = "loading the bundle", ""
    print("starting the server", file=sys.stderr)
    while (seconds := time.monotonic() - start) < START_S:
        if server.poll() is not None:
            raise ValueError(_last_error(log))
        try:
            answer = httpx.get(f"{url}/readyz", timeout=2.0)
            if answer.status_code == 200:
                print(f"server ready after {seconds:.1f} s at {url}\n", file=sys.stderr)
                return
            reason = answer.json()["reason"]
        except httpx.TransportError:
            pass  # it does not listen yet
        progress = f"  {seconds // 5 * 5:3.0f} s: {reason}"
        if progress != shown:
            print(progress, file=sys.stderr)
            shown = progress
        time.sleep(0.1)
    raise ValueError(f"the server was not ready within {START_S:.0f} s: {reason}")


def _last_error(log: IO[str]) -> str:
    log.seek(0)
    lines = log.read().splitlines() or ["it said nothing"]
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    return errors[-1] if errors else f"the server stopped: {lines[-1]}"


def _show_answers(client: httpx.Client, frame: Frame) -> str | None:
    """Print the answers on a frame, or return why there is none."""
    for question in QUESTIONS:
        asked = {"instruction": question, "condition": frame.condition or ""}
        try:
            answer = client.post("/v1/decide", data=asked, files={"frame": frame.content})
        except httpx.TransportError as error:
            return f"the server gave no answer ({type(error).__name__})"
        if answer.status_code != 200:
            return str(answer.json()["error"])
        print("\n" + "\n".join(answer_lines(question, _DECISION.validate_json(answer.content))))
        sys.stdout.flush()  # also where the output is piped
    return None


def _client(url: str) -> httpx.Client:
    return httpx.Client(base_url=url, timeout=3 * ANSWER_S)


def _spread(items: list[Any], count: int) -> list[Any]:
    """At most `count` items at even distances."""
    count = min(count, len(items))
    return [items[int((i + 0.5) * len(items) / count)] for i in range(count)]


if __name__ == "__main__":
    sys.exit(run_stage(DemoConfig, "configs/demo.yaml", demo, __doc__))
