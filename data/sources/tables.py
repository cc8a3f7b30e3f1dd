"""The tables of nuScenes, row by row: some hold millions, more than fits in memory at once.

In: <root>/<version>/<table>.json, one JSON array of objects. Out: the asked fields of each row.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_CHUNK = 1 << 20
_BETWEEN = " \t\r\n,"


def read_table(folder: Path, table: str, *fields: str) -> Iterator[tuple[Any, ...]]:
    """The fields of every row; ValueError names the table and what is wrong with it."""
    path = folder / f"{table}.json"
    if not path.is_file():
        raise ValueError(f"{folder} lacks {path.name}; unpack the whole metadata of nuScenes there")
    for number, row in enumerate(_rows(path)):
        try:
            yield tuple(row[field] for field in fields)
        except (KeyError, TypeError) as error:
            missing = error.args[0] if isinstance(error, KeyError) else "every field"
            raise ValueError(
                f"{path}: row {number} lacks {missing!r}; expected the tables of nuScenes v1.0"
            ) from error


def _rows(path: Path) -> Iterator[Any]:
    decode = json.JSONDecoder().raw_decode
    with path.open(encoding="utf-8") as file:
        text = file.read(_CHUNK).lstrip()
        if not text.startswith("["):
            raise ValueError(f"{path} is no JSON array; expected the tables of nuScenes v1.0")
        at = 1
        while True:
            while at < len(text) and text[at] in _BETWEEN:
                at += 1
            if text.startswith("]", at):
                return
            try:
                row, at = decode(text, at)
            except json.JSONDecodeError:
                more = file.read(_CHUNK)
                if not more:
                    raise ValueError(
                        f"{path} is damaged, it breaks off or is no JSON; unpack it again"
                    ) from None
                text, at = text[at:] + more, 0
                continue
            yield row
