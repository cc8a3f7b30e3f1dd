"""The decorator of the functions that are compiled, and the type of their arrays.

Compiled code is kept on disk, so that a car's computer compiles once. Numba notices a change of the
function's own file only, while these functions call each other across files; therefore the folder
carries a hash of all their sources, and a changed line anywhere compiles everything again.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]
Function = TypeVar("Function", bound=Callable[..., Any])

_PACKAGE = Path(__file__).parents[1]
_FOLDERS = ("control", "sim")
# Numba makes the names of its settings at run time.
_SETTINGS: Any = numba.config


def kernel(function: Function) -> Function:
    """Compile a numeric function on its first call; divisions by zero give inf or NaN."""
    if _SETTINGS.DISABLE_JIT:
        return function
    compiled = numba.njit(error_model="numpy")(function)
    if _KEPT is not None:
        before = _SETTINGS.CACHE_DIR
        _SETTINGS.CACHE_DIR = str(_KEPT)
        try:
            compiled.enable_caching()
        finally:
            _SETTINGS.CACHE_DIR = before
    return cast(Function, compiled)


def sources_hash(package: Path) -> str:
    """Sixteen hex digits over every source file that may hold a compiled function."""
    digest = hashlib.sha256()
    for folder in _FOLDERS:
        for path in sorted((package / folder).glob("*.py")):
            digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def _folder() -> Path | None:
    """Where compiled code is kept: beside the sources or in the user's cache; None for nowhere."""
    name = f"kernels-{sources_hash(_PACKAGE)}"
    for place in (_PACKAGE / "__pycache__", Path("~/.cache/ridetune").expanduser()):
        try:
            (place / name).mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(place / name, os.W_OK):
            return place / name
    return None


_KEPT = _folder()
