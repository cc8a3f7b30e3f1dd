"""Where the files of the instruction bank lie, and in which languages."""

from pathlib import Path
from typing import Any, Literal, get_args

import yaml

Language = Literal["en", "de", "es", "zh"]
LANGUAGES: tuple[Language, ...] = get_args(Language)
BANK = Path(__file__).parent / "bank"

# The C reader loads the bank in a second, the Python one in eight.
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def read_yaml(path: Path, or_else: Any = None) -> Any:
    """The content of a file; ValueError where it is missing and nothing can stand for it."""
    if path.is_file():
        return yaml.load(path.read_text(encoding="utf-8"), Loader=_LOADER)
    if or_else is None:
        raise ValueError(f"the instruction bank lacks {path.name} in {path.parent}")
    return or_else
