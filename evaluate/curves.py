"""What the page draws of drives: animations from above, and their signals as curves.

The three styles are the served bundle's drives where `evaluate.closed_loop` left some, else the
middles of the styles' ranges; the default matrix is always driven here.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ridetune.matrix import STYLES
from ridetune.sim.scenarios import SCENARIOS

from .driving_score import MANOEUVRES, Manoeuvre
from .plots import Line, line_chart
from .style_drives import DEFAULT, FRAME_S, NAMES, Signals, StyleDrive
from .tables import title

# Shape of each view, and the least height at which a car can be told from a dot.
_SHAPES: dict[Manoeuvre, str] = {
    "acceleration": "aspect-ratio:223/8.8;min-height:38px",
    "lane_change": "aspect-ratio:155/10.3;min-height:52px",
    "left_turn": "aspect-ratio:72/60",
}


@dataclass(frozen=True)
class Shown:
    """Signals by manoeuvre and name; words: what was said, None where no model took part."""

    signals: Mapping[Manoeuvre, Mapping[str, Signals]]
    words: Mapping[Manoeuvre, Mapping[str, str]] | None


def choose(
    middles: Mapping[Manoeuvre, Mapping[str, StyleDrive]], served: list[dict[str, Any]] | None
) -> Shown:
    """The served bundle's trajectories if all nine are there, else the styles' middles."""
    ours = {m: {n: drive.signals for n, drive in cars.items()} for m, cars in middles.items()}
    given = {(drive["manoeuvre"], drive["style"]): drive for drive in served or ()}
    if any((manoeuvre, style) not in given for manoeuvre in MANOEUVRES for style in STYLES):
        return Shown(ours, None)
    for (manoeuvre, style), drive in given.items():
        if abs(drive["period_s"] - FRAME_S) > 1e-9:
            raise ValueError(
                f"a served trajectory has a row every {drive['period_s']} s, the page shows one "
                f"every {FRAME_S} s; run python -m evaluate.closed_loop of the same version again"
            )
        ours[manoeuvre][style] = {
            name: np.array(values, float) for name, values in drive["signals"].items()
        }
    words: dict[Manoeuvre, dict[str, str]] = {
        m: {s: str(given[m, s]["instruction"]) for s in STYLES} for m in MANOEUVRES
    }
    return Shown(ours, words)


def animations(shown: Shown) -> str:
    """The figures that the player fills."""
    about = (
        "The same road, the same noise; only the matrix differs. Each car drives with the middle "
        "of its style's ranges: no model takes part here."
        if shown.words is None
        else "The served bundle looks through the simulated car's camera, hears the words and "
        "proposes; the gate lets through what is safe. Clear day; of each style the middle one of "
        "its drives, for some words are misunderstood."
    )
    figures = "".join(_figure(manoeuvre, shown) for manoeuvre in MANOEUVRES)
    return f"<h2>Three manoeuvres from above</h2><p>{about}</p>{figures}"


def curves(shown: Shown) -> str:
    """Path, speed, acceleration and steering of each manoeuvre."""
    legend = "".join(
        f'<li><i class="{"dashed" if name == DEFAULT else ""} text-{name}"></i>{name}'
        f"{' matrix' if name == DEFAULT else ''}</li>"
        for name in NAMES
    )
    parts = [f'<h2>The same drives as curves</h2><ul class="legend">{legend}</ul>']
    for manoeuvre in MANOEUVRES:
        charts = "".join(
            f"<div><h4>{name}</h4>{chart}</div>" for name, chart in _charts(manoeuvre, shown)
        )
        parts.append(f'<h3>{title(manoeuvre)}</h3><div class="charts">{charts}</div>')
    return "".join(parts)


def _figure(manoeuvre: Manoeuvre, shown: Shown) -> str:
    panels = "".join(
        f'<div><div class="panel-name"><span class="text-{style}">{style}'
        f"{_said(shown, manoeuvre, style)}</span>"
        '<span class="speed"></span></div>'
        f'<canvas style="{_SHAPES[manoeuvre]}" role="img" '
        f'aria-label="{style} car seen from above"></canvas></div>'
        for style in STYLES
    )
    columns = " columns" if manoeuvre == "left_turn" else ""
    return (
        f'<figure data-manoeuvre="{manoeuvre}"><figcaption><b>{title(manoeuvre)}.</b> '
        f"{escape(SCENARIOS[manoeuvre].about.replace('m/s2', 'm/s²'))}</figcaption>"
        f'<div class="panels{columns}">{panels}</div>'
        '<div class="controls"><button type="button" aria-pressed="false">Play</button>'
        '<input type="range" min="0" max="1" step="0.01" value="0" aria-label="Time">'
        '<span class="clock"></span></div></figure>'
    )


def _said(shown: Shown, manoeuvre: Manoeuvre, style: str) -> str:
    if shown.words is None:
        return ""
    return f' <q class="said">{escape(shown.words[manoeuvre][style])}</q>'


def _charts(manoeuvre: Manoeuvre, shown: Shown) -> list[tuple[str, str]]:
    cars, path = shown.signals[manoeuvre], SCENARIOS[manoeuvre].waypoints()

    def chart(
        name: str, y: str, y_label: str, least: float = 0.0, x: str = "time"
    ) -> tuple[str, str]:
        # The default first: the styles are drawn over it.
        order = (DEFAULT, *STYLES)
        lines = [Line(n, n, _signal(cars[n], x, path), _signal(cars[n], y, path)) for n in order]
        about = f"{name} in the {title(manoeuvre).lower()}: three styles and the default matrix"
        x_label = "time [s]" if x == "time" else "x, ahead [m]"
        return name, line_chart(lines, x_label, y_label, about, least=least)

    place = {
        "acceleration": chart("Distance", "x_m", "x, ahead [m]"),
        "lane_change": chart("Path", "y_m", "y, to the left [m]", x="x_m"),
        "left_turn": chart("Distance from the path", "beside_m", "to the left of it [m]"),
    }
    felt = chart("Felt lateral acceleration", "felt_lateral_mps2", "lateral [m/s²]", 1.0)
    pull = chart("Acceleration", "acceleration_mps2", "longitudinal [m/s²]", 1.0)
    return [
        place[manoeuvre],
        chart("Speed", "speed_kmh", "speed [km/h]", 10.0),
        pull if manoeuvre == "acceleration" else felt,
        chart("Steering", "steer_deg", "front wheels [°]", 4.0),
    ]


def _signal(signals: Signals, name: str, path: NDArray[np.float64]) -> NDArray[np.float64]:
    if name == "time":
        return np.arange(len(signals["x_m"]), dtype=np.float64) * FRAME_S
    if name == "beside_m":
        return _beside(signals["x_m"], signals["y_m"], path)
    if name == "speed_kmh":
        return 3.6 * signals["speed_mps"]
    return np.rad2deg(signals["steer_rad"]) if name == "steer_deg" else signals[name]


def _beside(
    x: NDArray[np.float64], y: NDArray[np.float64], path: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far left of the path's nearest waypoint each place [row] lies [m]; NaN stays NaN."""
    places = np.stack([x, y], axis=1)
    far = ((places[:, None] - path[None]) ** 2).sum(axis=2)  # [row, waypoint]
    nearest = np.minimum(np.where(np.isnan(far), np.inf, far).argmin(axis=1), len(path) - 2)
    along, away = path[nearest + 1] - path[nearest], places - path[nearest]
    across = along[:, 0] * away[:, 1] - along[:, 1] * away[:, 0]
    beside: NDArray[np.float64] = across / np.hypot(along[:, 0], along[:, 1])
    return beside
