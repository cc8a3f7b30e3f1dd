"""Contact sheet: pictures side by side in a captioned grid, for the human eye.

In: rows of RGB pictures with captions; or, as a command, a folder of pictures as `sources.images`
reads it. Out: one RGB picture; the command shows every clear one of the folder beside its five
weather variants, and lists what it left out.

    python -m data.contact_sheet FOLDER OUT.jpg [seed]    # any CPU, about 0.5 s a picture
"""

import argparse
import sys
import zlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ridetune.camera.weather import Image
from ridetune.vision import decode_frame

from .sources.images import read_images
from .sources.seen import Seen, Skipped
from .variants import MIN_SIDE, VARIANTS, vary_weather

CAPTION_PX = 20  # height of the line over all columns, and of the line over each row
_ENDINGS = (".jpg", ".jpeg", ".png")
_MAX_PX = 65_500  # a side of a JPEG
_ENOUGH_PX = (1280, 720)  # a variant of a larger frame looks no different on a tile
_TILE_PX = (320, 180)
_PAPER, _INK = 24, (235, 235, 235)


def contact_sheet(
    rows: Sequence[Sequence[Image]],
    columns: Sequence[str],
    names: Sequence[str],
    *,
    tile: tuple[int, int] = _TILE_PX,
) -> Image:
    """Grid of RGB pictures, each whole within its tile (width, height) [px], on dark paper.

    columns: captions over the sheet. names: one per row, over its left edge. The sheet is
    CAPTION_PX + len(rows) * (CAPTION_PX + tile height) high and len(columns) tiles wide.
    ValueError where counts do not match or the sheet would be too large for a JPEG.
    """
    _check_counts(rows, columns, names)
    width, height = len(columns) * tile[0], CAPTION_PX + len(rows) * (CAPTION_PX + tile[1])
    if max(width, height) > _MAX_PX:
        raise ValueError(
            f"the sheet would be {width}x{height} px, a JPEG ends at {_MAX_PX}; show fewer pictures"
        )
    sheet = np.full((height, width, 3), _PAPER, np.uint8)
    for i, caption in enumerate(columns):
        _write(sheet[:CAPTION_PX, i * tile[0] : (i + 1) * tile[0]], caption)
    for i, (name, row) in enumerate(zip(names, rows, strict=True)):
        top = CAPTION_PX + i * (CAPTION_PX + tile[1])
        _write(sheet[top : top + CAPTION_PX], name)
        for j, picture in enumerate(row):
            left, below = j * tile[0], top + CAPTION_PX
            _place(sheet[below : below + tile[1], left : left + tile[0]], picture)
    return sheet


def _check_counts(
    rows: Sequence[Sequence[Image]], columns: Sequence[str], names: Sequence[str]
) -> None:
    if not rows or not columns or len(names) != len(rows):
        raise ValueError(
            f"{len(rows)} rows, {len(columns)} columns and {len(names)} names make no sheet; "
            "give at least one row and one column, and a name for each row"
        )
    for name, row in zip(names, rows, strict=True):
        if len(row) != len(columns):
            raise ValueError(f"row {name!r} has {len(row)} pictures for {len(columns)} columns")


def _write(line: Image, text: str) -> None:
    """Write on a view of the sheet, in place; what is too long is cut off."""
    own = np.ascontiguousarray(line)
    at = (4, CAPTION_PX - 6)
    cv2.putText(own, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, _INK, 1, cv2.LINE_AA)
    line[:] = own


def _place(tile: Image, picture: Image) -> None:
    """Put a whole picture into the middle of a tile, a view of the sheet, in place."""
    small = _fit(picture, (tile.shape[1], tile.shape[0]))
    top, left = ((a - b) // 2 for a, b in zip(tile.shape, small.shape[:2], strict=False))
    tile[top : top + small.shape[0], left : left + small.shape[1]] = small


def _fit(picture: Image, size: tuple[int, int]) -> Image:
    height, width = picture.shape[:2]
    scale = min(size[0] / width, size[1] / height)
    fitted = (max(round(width * scale), 1), max(round(height * scale), 1))
    return np.asarray(cv2.resize(picture, fitted, interpolation=cv2.INTER_AREA), np.uint8)


def sheet_of_folder(folder: Path, seed: int) -> tuple[Image, list[Skipped]]:
    """Every clear picture of a folder beside its variants, and what was left out and why.

    A picture's variants depend on its name and the seed alone. ValueError without a clear picture.
    """
    names: list[str] = []
    rows: list[list[Image]] = []
    skipped: list[Skipped] = []
    for item in read_images(folder):
        fault = _fault(item)
        if isinstance(item, Skipped) or fault is not None:
            skipped.append(item if isinstance(item, Skipped) else Skipped(item.name, str(fault)))
            continue
        names.append(item.name)
        rows.append(_row(item, seed))
    if not rows:
        raise ValueError(
            f"{folder} holds no picture known to be clear ({len(skipped)} left out); put clear "
            "ones into a folder 'sunny', or say so in frames.csv"
        )
    return contact_sheet(rows, ("clear", *VARIANTS), names), skipped


def _fault(item: Seen | Skipped) -> str | None:
    if isinstance(item, Skipped):
        return item.reason
    if item.facts.condition != "sunny":
        return f"its condition is {item.facts.condition or 'not known'}, not clear"
    if item.facts.dark:
        return "it is dark"
    return None


def _row(item: Seen, seed: int) -> list[Image]:
    frame = decode_frame(item.observation.frame, _ENOUGH_PX)
    if min(frame.shape[:2]) < MIN_SIDE:
        frame = _fit(frame, (16 * MIN_SIDE, 16 * MIN_SIDE))
    key = [seed, zlib.crc32(item.name.encode())]
    made = (
        vary_weather(frame, variant, np.random.default_rng([*key, i]))
        for i, variant in enumerate(VARIANTS)
    )
    return [_fit(picture, _TILE_PX) for picture in (frame, *made)]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; 0, or exit status 2 with a message for what the user can mend."""
    parser = argparse.ArgumentParser(prog="python -m data.contact_sheet", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="pictures, at any depth")
    parser.add_argument("out", type=Path, metavar="OUT.jpg", help="the sheet; .jpg or .png")
    parser.add_argument("seed", type=int, nargs="?", default=0, help="0 or more; default 0")
    given = parser.parse_args(arguments)
    try:
        _check(given.out, given.seed)
        sheet, skipped = sheet_of_folder(given.folder, given.seed)
        _save(sheet, given.out)
    except ValueError as error:
        parser.error(str(error))
    for item in skipped:
        print(f"left out {item.name}: {item.reason}")
    shown = (len(sheet) - CAPTION_PX) // (CAPTION_PX + _TILE_PX[1])
    print(f"{given.out}: {shown} pictures in {len(VARIANTS)} variants, {len(skipped)} left out")
    return 0


def _check(out: Path, seed: int) -> None:
    """ValueError, before any work, for what cannot go well."""
    if seed < 0:
        raise ValueError(f"the seed is {seed}; give 0 or more")
    if out.suffix.lower() not in _ENDINGS:
        raise ValueError(f"cannot write {out}; name a file that ends in {', '.join(_ENDINGS)}")
    if not out.parent.is_dir() or out.is_dir():
        where = f"{out} is a folder" if out.is_dir() else f"there is no folder {out.parent}"
        raise ValueError(f"cannot write {out}: {where}; name a file in a folder that exists")


def _save(sheet: Image, out: Path) -> None:
    done, coded = cv2.imencode(out.suffix, cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    assert done
    try:
        out.write_bytes(coded.tobytes())
    except OSError as error:
        raise ValueError(
            f"cannot write {out}: {error.strerror}; name a file in a writable folder"
        ) from error


if __name__ == "__main__":
    sys.exit(main())
