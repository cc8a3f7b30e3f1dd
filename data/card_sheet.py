"""The contact sheet of a dataset card: pictures in a grid with what was said below them.

In: the pairs to show and the folder of their pictures. Out: the bytes of a JPEG.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ridetune.matrix import Style
from ridetune.sample import Condition
from ridetune.vision import decode_frame

from .build import encode

_TILE, _CAPTION, _GAP, _COLUMNS = (320, 180), 74, 12, 6
_SHEET, _BEHIND, _INK = (24, 27, 31), (14, 17, 20), (231, 233, 236)  # RGB
_COLOURS: dict[Style, tuple[int, int, int]] = {
    "conservative": (98, 176, 234),
    "moderate": (227, 176, 75),
    "aggressive": (242, 125, 157),
}
_JPEG_QUALITY = 90


@dataclass(frozen=True, order=True)
class Shown:
    """One pair of the contact sheet; image: its file, relative to the folder."""

    proposal_id: str
    image: str
    instruction: str
    style: Style
    condition: Condition


def draw_sheet(shown: Sequence[Shown], folder: Path) -> bytes:
    """Pictures in a grid, below each its condition, style and instruction; a JPEG."""
    rows = math.ceil(len(shown) / _COLUMNS)
    columns = min(len(shown), _COLUMNS)
    height = _GAP + rows * (_TILE[1] + _CAPTION + _GAP)
    sheet = np.full((height, _GAP + columns * (_TILE[0] + _GAP), 3), _SHEET, np.uint8)
    for number, pair in enumerate(shown):
        row, column = divmod(number, _COLUMNS)
        left = _GAP + column * (_TILE[0] + _GAP)
        top = _GAP + row * (_TILE[1] + _CAPTION + _GAP)
        sheet[top : top + _TILE[1], left : left + _TILE[0]] = _tile(folder / pair.image)
        _caption(sheet, pair, left, top + _TILE[1])
    return encode(sheet, _JPEG_QUALITY)


def _tile(path: Path) -> NDArray[np.uint8]:
    """The whole picture in the middle of a tile."""
    pixels = decode_frame(path.read_bytes(), (2 * _TILE[0], 2 * _TILE[1]))
    scale = min(_TILE[0] / pixels.shape[1], _TILE[1] / pixels.shape[0])
    size = [max(round(side * scale), 1) for side in pixels.shape[1::-1]]
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    tile = np.full((_TILE[1], _TILE[0], 3), _BEHIND, np.uint8)
    top, left = (_TILE[1] - size[1]) // 2, (_TILE[0] - size[0]) // 2
    tile[top : top + size[1], left : left + size[0]] = small
    return tile


def _caption(sheet: NDArray[np.uint8], pair: Shown, left: int, top: int) -> None:
    """Write below a tile, in place."""
    font = cv2.FontFace("sans")
    cv2.putText(
        sheet,
        f"{pair.style}, {pair.condition}",
        (left, top + 19),
        _COLOURS[pair.style],
        font,
        14,
        600,
    )
    for i, line in enumerate(_wrapped(pair.instruction, font)):
        cv2.putText(sheet, line, (left, top + 40 + 20 * i), _INK, font, 14, 400)


def _wrapped(text: str, font: cv2.FontFace, lines: int = 2) -> list[str]:
    """Text in at most so many lines as wide as a tile; what is too long ends in dots."""

    def fits(line: str) -> bool:
        _, _, width, _ = cv2.getTextSize((4000, 100), line, (0, 50), font, 14, 400)
        return bool(width <= _TILE[0])

    wrapped = [""]
    for word in text.split():
        longer = f"{wrapped[-1]} {word}".strip()
        if fits(longer):
            wrapped[-1] = longer
        elif len(wrapped) < lines:
            wrapped.append(word)
        else:
            cut = longer
            while cut and not fits(f"{cut}..."):
                cut = cut[:-1]
            wrapped[-1] = f"{cut.rstrip(' ,.')}..."
            break
    return wrapped
