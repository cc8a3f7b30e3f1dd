"""A folder of images: one's own photographs, with what one knows of them.

In: JPEG and PNG files at any depth. What is known of a picture comes from frames.csv in the folder
(a header, then one line per picture: `file`, and whatever else is known of condition, dark,
low_sun, road, lead, traffic, surroundings, speed_mps, scene), or, for the condition, from the name
of its folder (`rain/0001.jpg`). Pictures of one `scene` never stand on both sides of a split;
without a name each picture is a scene of its own. Out: a `Seen` for each picture, by name.
"""

import csv
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ridetune.camera.scene import Lead, Road, Surroundings, Traffic
from ridetune.sample import CONDITIONS, Condition, Observation

from .seen import Facts, Frames, Seen, Skipped, fault_of_frame

ENDINGS = (".jpg", ".jpeg", ".png")
LIST = "frames.csv"
# Names of folders; the last three are what people call clear daylight.
_NAMED: dict[str, Condition] = {
    **{condition: condition for condition in CONDITIONS},
    "overcast": "sunny",
    "clear": "sunny",
    "day": "sunny",
}


class Line(BaseModel):
    """One line of frames.csv; what is not known is left empty."""

    model_config = ConfigDict(extra="forbid")

    file: str
    condition: Condition | None = None
    dark: bool | None = None
    low_sun: bool | None = None
    road: Road | None = None
    lead: Lead | None = None
    traffic: Traffic | None = None
    surroundings: Surroundings | None = None
    speed_mps: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] | None = None
    scene: str | None = None


def read_images(root: Path) -> Frames:
    """Every picture below a folder; ValueError where there is none or the list is wrong."""
    if not root.is_dir():
        raise ValueError(f"{root} is no folder; name one that holds JPEG or PNG pictures")
    paths = sorted(p for p in root.rglob("*") if p.suffix.lower() in ENDINGS and p.is_file())
    lines = _lines(root / LIST)
    if not paths and not lines:
        raise ValueError(f"{root} holds no {', '.join(ENDINGS)}; name a folder with pictures")
    names = [path.relative_to(root).as_posix() for path in paths]
    for name in sorted(set(lines) - set(names)):
        yield Skipped(name, f"{LIST} names it, but it is not there")
    for name in names:
        yield _seen(root, name, lines.get(name))


def _seen(root: Path, name: str, line: Line | None) -> Seen | Skipped:
    picture = (root / name).read_bytes()
    fault = fault_of_frame(picture)
    if fault is not None:
        return Skipped(name, fault)
    known = line or Line(file=name)
    facts = Facts(
        condition=known.condition or _condition_of(name),
        dark=known.dark,
        low_sun=known.low_sun,
        road=known.road,
        lead=known.lead,
        traffic=known.traffic,
        surroundings=known.surroundings,
    )
    return Seen(name, known.scene or name, Observation(picture, known.speed_mps), facts)


def _condition_of(name: str) -> Condition | None:
    for folder in reversed(Path(name).parts[:-1]):
        if folder.lower() in _NAMED:
            return _NAMED[folder.lower()]
    return None


def _lines(path: Path) -> dict[str, Line]:
    if not path.is_file():
        return {}
    lines: dict[str, Line] = {}
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = csv.DictReader(file, restkey="beyond the last one")
        try:
            for row in rows:
                line = _line(path, rows.line_num, row)
                if line.file in lines:
                    raise ValueError(
                        f"{path}, line {rows.line_num}: {line.file} is listed twice; keep one line"
                    )
                lines[line.file] = line
        except UnicodeDecodeError as error:
            raise ValueError(f"{path} is not UTF-8; save it again as CSV UTF-8") from error
    return lines


def _line(path: Path, number: int, row: dict[str, Any]) -> Line:
    try:
        return Line.model_validate({key: text for key, text in row.items() if text != ""})
    except ValidationError as error:
        first = error.errors()[0]
        column = first["loc"][0] if first["loc"] else "?"
        known = ", ".join(Line.model_fields)
        raise ValueError(
            f"{path}, line {number}, column {column!r}: {first['msg']}; known columns: {known}"
        ) from error
