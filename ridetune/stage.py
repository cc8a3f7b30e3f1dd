"""How a stage is run: arguments -> config -> work -> manifest; errors in one clear sentence.

Every stage's main hands its config class and its work to `run_stage`:

    python -m data --config configs/data.yaml seed=3
"""

import argparse
import errno
import hashlib
import json
import logging
import platform
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

from ridetune.config import load_config

Config = TypeVar("Config")
MANIFEST_FILE = "manifest.json"
_PACKAGES = ("torch", "transformers", "peft", "onnxruntime", "numpy")


def run_stage(
    kind: type[Config], default_yaml: str, work: Callable[[Config], None], about: str | None
) -> int:
    """Parse the command line, run `work` and return the exit code: 0, or 2 for a user's error."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    logging.getLogger("httpx").setLevel(logging.WARNING)
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--config", type=Path, default=Path(default_yaml), help="YAML file")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="change a config value")
    arguments = parser.parse_intermixed_args()
    # A stage that is told to stop tidies up as on Ctrl-C: no half-written folder, no orphan.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        work(load_config(kind, arguments.config, arguments.overrides))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {explain_os_error(error)}", file=sys.stderr)
        return 2
    return 0


def explain_os_error(error: OSError) -> str:
    """An operating system error as one sentence with its remedy."""
    where = f" at {error.filename}" if error.filename else ""
    if error.errno == errno.ENOSPC:
        return (
            f"the disk is full{where}; free some space and run again, nothing half-written was kept"
        )
    if error.errno in (errno.EACCES, errno.EROFS):
        return f"not allowed to write{where}; choose another `out` folder"
    return f"{error.strerror or error}{where}"


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A folder that appears at `out` whole or not at all; an older one is replaced.

    Raises ValueError where `out` is no folder, or holds the working or the home folder.
    """
    _check_replaceable(out)
    partial = out.with_name(f".{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        if out.exists():
            shutil.rmtree(out)
        partial.rename(out)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def _check_replaceable(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file; choose another `out` folder")
    if any(place.is_relative_to(out.resolve()) for place in (Path.cwd(), Path.home())):
        raise ValueError(
            f"{out} holds more than a run, replacing it would delete that; name a new folder"
        )


def write_manifest(folder: Path, *, seconds: float, facts: dict[str, Any]) -> None:
    """manifest.json: versions, hardware, time, peak memory and hashes of every file in a folder."""
    manifest = {
        **facts,
        "seconds": round(seconds, 1),
        "peak_rss_mb": round(peak_rss_mb()),
        "versions": {"python": platform.python_version(), **_versions()},
        "machine": platform.machine(),
        "files": hash_files(folder),
    }
    (folder / MANIFEST_FILE).write_text(json.dumps(manifest, indent=2) + "\n")


def hash_files(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder but its manifest, by relative path."""
    return {
        str(path.relative_to(folder)): hash_file(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != MANIFEST_FILE
    }


def hash_file(path: Path) -> str:
    """SHA-256 of one file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def peak_rss_mb() -> float:
    """Peak resident memory of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


class Stopwatch:
    """Seconds since it was made."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    @property
    def seconds(self) -> float:
        """Elapsed time [s]."""
        return time.monotonic() - self._start


def _versions() -> dict[str, str]:
    found = {}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
