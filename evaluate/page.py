"""Builds the report: one self-contained HTML page and a JSON beside it.

What the other commands wrote + drives of the styles' middles -> report.html, report.json. Nothing
is asked of a model here; what is missing is left out with the command that makes it.

    python -m evaluate.page --config configs/page.yaml
"""

import json
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from ridetune.codec import MatrixCodec
from ridetune.config import load_config
from ridetune.control.vehicle import Vehicle
from ridetune.matrix import STYLES, Ranges
from ridetune.stage import hash_file, run_stage

from . import curves, sections
from .animation import animate
from .driving_score import DrivingScoreConfig, Manoeuvre
from .style_drives import StyleDrive, drive_styles, table_rows
from .tables import Numbers, paper_table, table_1

_PARTS = Path(__file__).with_name("page_parts")
# The results of other commands, by their keys in the config.
FILES = ("evaluation", "profile", "closed_loop", "sweep")
_CLOSED_LOOP = "python -m evaluate.closed_loop --config configs/closed_loop.yaml"
_Drives = Mapping[Manoeuvre, Mapping[str, StyleDrive]]


@dataclass(frozen=True)
class PageConfig:
    """What to read, and where the page goes; the JSON gets the same name."""

    vehicle: Path
    ranges: Path
    score: Path
    evaluation: Path
    profile: Path
    closed_loop: Path
    sweep: Path
    out: Path
    seed: int
    table_seeds: int

    def __post_init__(self) -> None:
        if self.out.suffix != ".html":
            raise ValueError(f"out must end in .html, got {self.out}")


def write_page(config: PageConfig) -> None:
    """Read, drive, write the page and its JSON, and print one JSON line."""
    vehicle = Vehicle.load(config.vehicle)
    codec = MatrixCodec(Ranges.load(config.ranges))
    score = load_config(DrivingScoreConfig, config.score)
    found = {name: read_result(getattr(config, name)) for name in FILES}
    drives = drive_styles(vehicle, codec, "sunny", config.seed)
    shown = curves.choose(drives, (found["closed_loop"] or {}).get("trajectories"))
    looped = sections.loop_rows(found["closed_loop"]) if found["closed_loop"] else {}
    rows = looped or table_rows(vehicle, codec, score, range(config.table_seeds))
    body = "\n".join(
        [
            _head(found, drives),
            curves.animations(shown),
            curves.curves(shown),
            _table_section(rows, bool(looped), found),
            *_measured(found),
            _foot(config, found),
        ]
    )
    page = Template((_PARTS / "frame.html").read_text()).substitute(
        style=(_PARTS / "style.css").read_text(),
        player=(_PARTS / "player.js").read_text(),
        drives=json.dumps(
            {name: animate(name, cars, vehicle) for name, cars in shown.signals.items()},
            separators=(",", ":"),
        ),
        body=body,
    )
    config.out.parent.mkdir(parents=True, exist_ok=True)
    config.out.write_text(page)
    result = {
        "about": "simulation; a number of the paper stands here only where it is named so",
        "table_1": {
            manoeuvre: {arm: _finite(row) for arm, row in arms.items()}
            for manoeuvre, arms in rows.items()
        },
        "styles": {m: {n: _plain(d) for n, d in cars.items()} for m, cars in drives.items()},
        "inputs": {
            name: hash_file(getattr(config, name)) if found[name] is not None else None
            for name in FILES
        },
        **found,
    }
    beside = config.out.with_suffix(".json")
    beside.write_text(json.dumps(result, indent=2, allow_nan=False) + "\n")
    missing = [name for name in FILES if found[name] is None]
    print(json.dumps({"page": str(config.out), "kb": len(page) // 1024, "missing": missing}))


def read_result(path: Path) -> dict[str, Any] | None:
    """A JSON file of another command, or None where it is not there; ValueError if it is broken."""
    if not path.is_file():
        return None
    try:
        read = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is no JSON ({error}); make it again") from error
    if not isinstance(read, dict):
        raise ValueError(f"{path} must hold one JSON object; make it again")
    return read


def _head(found: Mapping[str, Any], drives: _Drives) -> str:
    rise = {s: drives["acceleration"][s].metrics.t90_s or math.nan for s in STYLES}
    times = " ".join(f'<span class="text-{s}">{t:.1f}</span>' for s, t in rise.items())
    tiles = [
        (
            f'<span class="trio">{times} s</span>',
            "to 90 % of 50 km/h: conservative, moderate, aggressive, middles of the ranges",
        )
    ]
    if found["evaluation"] is not None:
        served = found["evaluation"]["served"]
        constant = found["evaluation"]["controls"]["constant"]
        tiles += [
            (
                f"{served['command_alignment']:.1f}",
                f"command alignment of the served bundle; constant matrix "
                f"{constant['command_alignment']:.1f}",
            ),
            (
                f"{100 * served['scenario_alignment']:.1f} %",
                "of clear/adverse pairs are answered more cautiously in bad weather",
            ),
        ]
    if found["profile"] is not None:
        warm = found["profile"]["warm_ms"]["p50"]
        tiles.append((f"{warm:.1f} ms", "from words to gated matrix, warm, median, one CPU core"))
    cards = "".join(
        f'<div class="tile"><b>{b}</b><span class="about">{escape(s)}</span></div>'
        for b, s in tiles
    )
    return (
        '<span class="tag">Simulation</span><h1>What six numbers do to a drive</h1>'
        "<p>A passenger's words and a camera image become the matrix [[K<sub>p</sub>, "
        "K<sub>i</sub>, K<sub>d</sub>], [W<sub>l</sub>, W<sub>h</sub>, W<sub>s</sub>]] of a "
        "speed and a steering controller. This page shows what such matrices do to a simulated "
        "car, and how well the served model picks them.</p>"
        f'<div class="tiles">{cards}</div>'
    )


def _table_section(
    rows: Mapping[Manoeuvre, Mapping[str, Numbers]], looped: bool, found: Mapping[str, Any]
) -> str:
    closed_loop, evaluation, profile = (found[n] for n in ("closed_loop", "evaluation", "profile"))
    caption = (
        "Our simulation, no reproduction of the paper's test track. Means over five conditions and "
        "three styles asked for; a drive that breaks off scores 0. SV: variance of speed, "
        "|a|, |J|: means of absolute acceleration and jerk; |a<sub>y</sub>| is the body's, as in "
        "the paper, felt |a<sub>y</sub>| is speed times yaw rate. The oracle is told the style"
        + ("." if looped else " and the condition. A dash: nothing closes in, or nothing is asked.")
    )
    parts = ["<h2>Table 1 in the simulation</h2>", table_1(rows, caption)]
    if evaluation is not None and profile is not None:
        parts.append(sections.text_way(evaluation, profile))
    parts.append(paper_table())
    if closed_loop is None:
        parts.append(sections.missing("The row of the served bundle is", _CLOSED_LOOP))
    else:
        parts.append(sections.closed_loop(closed_loop))
    return "".join(parts)


def _measured(found: Mapping[str, Any]) -> list[str]:
    """The sections that only show what other commands measured."""
    wanted = (
        ("closed_loop", "Takeovers of simulated passengers", sections.takeovers, _CLOSED_LOOP),
        ("evaluation", "Alignment beside its controls", sections.alignment, "make bench"),
        ("profile", "Latency", sections.latency, "make bench"),
        ("sweep", "Many drawn matrices", sections.sweep, "make sweep"),
    )
    return [
        f"<h2>{head}</h2>"
        + (show(found[name]) if found[name] is not None else sections.missing("This is", command))
        for name, head, show, command in wanted
    ]


def _foot(config: PageConfig, found: Mapping[str, Any]) -> str:
    used = ", ".join(str(getattr(config, name)) for name in found if found[name] is not None)
    return (
        "<footer><p>Cars, roads and passengers of this page are simulated; the camera of the "
        "decisions is mostly a synthetic one. Made by <code>python -m evaluate.page</code> from "
        f"<code>{escape(used or 'nothing measured')}</code>; every number of it stands in "
        f"<code>{escape(config.out.with_suffix('.json').name)}</code>.</p></footer>"
    )


def _finite(row: Numbers) -> dict[str, float | None]:
    """A row whose infinite values are null: JSON has none."""
    return {
        key: value if value is not None and math.isfinite(value) else None
        for key, value in row.items()
    }


def _plain(drive: StyleDrive) -> dict[str, Any]:
    return {
        "matrix": drive.matrix.rows,
        "status": drive.status,
        "metrics": drive.metrics.as_dict(),
    }


if __name__ == "__main__":
    sys.exit(run_stage(PageConfig, "configs/page.yaml", write_page, __doc__))
