"""Charts as inline SVG, drawn by hand: numbers in, text for an HTML page out.

Colours come from the page's style sheet by class (`style-conservative`, ..., `style-default`): a
style looks alike everywhere and in both colour schemes. Every axis has a label with its unit.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

# The drawing's own units; the page scales it to its column.
WIDTH, HEIGHT = 360.0, 226.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 10.0, 10.0, 40.0
# Line charts need no more points than this per line.
_POINTS = 260
_BAR, _BAR_GAP, _GROUP_GAP = 15.0, 5.0, 20.0
_NAMES_WIDTH = 128.0


@dataclass(frozen=True)
class Line:
    """One line: a class of the style sheet, a name, and points x, y [point] in order."""

    kind: str
    name: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]


@dataclass(frozen=True)
class Bar:
    """One bar in [0, limit] with an interval, or None where there is none."""

    kind: str
    name: str
    value: float
    interval: tuple[float, float] | None
    note: str


def line_chart(
    lines: Sequence[Line], x_label: str, y_label: str, about: str, *, least: float = 0.0
) -> str:
    """Lines over common axes, with gaps at what is not finite.

    least: the y axis spans no less, so that noise does not fill a chart.
    """
    xs, ys = (_limits([getattr(line, axis) for line in lines]) for axis in ("x", "y"))
    width, height = WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM
    if ys[1] - ys[0] < least:
        middle = (ys[0] + ys[1]) / 2.0
        ys = middle - least / 2.0, middle + least / 2.0
    x_ticks, y_ticks = ticks(*xs), ticks(*ys)

    def place(x: float, y: float) -> tuple[float, float]:
        across = _LEFT + (x - xs[0]) / (xs[1] - xs[0]) * width
        return across, _TOP + (ys[1] - y) / (ys[1] - ys[0]) * height

    grid = []
    for tick in y_ticks:
        _, y = place(xs[0], tick)
        grid.append(
            f'<line class="grid" x1="{_LEFT:.0f}" x2="{WIDTH - _RIGHT:.0f}" y1="{y:.1f}" '
            f'y2="{y:.1f}"/><text class="tick" x="{_LEFT - 6:.0f}" y="{y + 3.5:.1f}" '
            f'text-anchor="end">{_say(tick)}</text>'
        )
    for tick in x_ticks:
        x, _ = place(tick, ys[0])
        grid.append(
            f'<text class="tick" x="{x:.1f}" y="{HEIGHT - _BOTTOM + 15:.0f}" '
            f'text-anchor="middle">{_say(tick)}</text>'
        )
    paths = [
        f'<path class="line style-{line.kind}" d="{_path(line, place)}">'
        f"<title>{escape(line.name)}</title></path>"
        for line in lines
    ]
    middle = _TOP + height / 2
    labels = (
        f'<text class="axis" x="{_LEFT + width / 2:.0f}" y="{HEIGHT - 6:.0f}" '
        f'text-anchor="middle">{escape(x_label)}</text>'
        f'<text class="axis" transform="translate(11 {middle:.0f}) rotate(-90)" '
        f'text-anchor="middle">{escape(y_label)}</text>'
    )
    return _svg(WIDTH, HEIGHT, about, "".join(grid + paths) + labels)


def interval_bars(
    groups: Sequence[tuple[str, Sequence[Bar]]], limit: float, unit: str, about: str
) -> str:
    """Horizontal bars in named groups over one axis from 0 to `limit`."""
    width = WIDTH - _NAMES_WIDTH - 44.0
    parts, y = [], 4.0
    for name, bars in groups:
        if name:
            parts.append(f'<text class="group" x="0" y="{y + 11:.0f}">{escape(name)}</text>')
            y += 20.0
        for bar in bars:
            parts.append(_bar(bar, y, width / limit, limit))
            y += _BAR + _BAR_GAP
        y += _GROUP_GAP - _BAR_GAP
    bottom = y - _GROUP_GAP + 10.0
    axis = [
        f'<line class="grid" x1="{_NAMES_WIDTH + t * width / limit:.1f}" '
        f'x2="{_NAMES_WIDTH + t * width / limit:.1f}" y1="0" y2="{bottom:.0f}"/>'
        f'<text class="tick" x="{_NAMES_WIDTH + t * width / limit:.1f}" y="{bottom + 13:.0f}" '
        f'text-anchor="middle">{_say(t)}</text>'
        for t in ticks(0.0, limit)
    ]
    label = (
        f'<text class="axis" x="{_NAMES_WIDTH + width / 2:.0f}" y="{bottom + 30:.0f}" '
        f'text-anchor="middle">{escape(unit)}</text>'
    )
    return _svg(WIDTH, bottom + 36.0, about, "".join(axis + parts) + label)


def ticks(low: float, high: float) -> list[float]:
    """Three to six round numbers within [low, high]."""
    rough = (high - low) / 4.0
    power = 10.0 ** math.floor(math.log10(rough))
    step = min((m * power for m in (1.0, 2.0, 2.5, 5.0, 10.0)), key=lambda s: abs(s - rough))
    first = math.ceil(low / step - 1e-9)
    return [i * step for i in range(first, math.floor(high / step + 1e-9) + 1)]


def _bar(bar: Bar, y: float, scale: float, limit: float) -> str:
    end = min(bar.value, limit) * scale
    middle = y + _BAR / 2
    parts = [
        f'<text class="name" x="{_NAMES_WIDTH - 8:.0f}" y="{middle + 4:.1f}" '
        f'text-anchor="end">{escape(bar.name)}</text>'
        f'<rect class="bar style-{bar.kind}" x="{_NAMES_WIDTH:.0f}" y="{y:.1f}" rx="2" '
        f'width="{max(end, 0.8):.1f}" height="{_BAR:.0f}"><title>{escape(bar.note)}</title></rect>'
    ]
    if bar.interval is not None:
        low, high = (_NAMES_WIDTH + min(v, limit) * scale for v in bar.interval)
        end = max(end, high - _NAMES_WIDTH)
        parts.append(
            f'<path class="whisker" d="M{low:.1f} {middle:.1f}H{high:.1f}M{low:.1f} '
            f'{middle - 4:.1f}v8M{high:.1f} {middle - 4:.1f}v8"/>'
        )
    parts.append(
        f'<text class="value" x="{_NAMES_WIDTH + end + 6:.1f}" y="{middle + 4:.1f}">'
        f"{_say(round(bar.value, 1 if bar.value >= 1.0 else 2))}</text>"
    )
    return "".join(parts)


def _limits(values: Sequence[NDArray[np.float64]]) -> tuple[float, float]:
    """Lowest and highest finite value with a little air; never an empty span."""
    finite = np.concatenate([v[np.isfinite(v)] for v in values])
    low, high = float(finite.min()), float(finite.max())
    air = 0.05 * (high - low) or 0.5
    return (0.0 if low == 0.0 else low - air), high + air


def _path(line: Line, place: Callable[[float, float], tuple[float, float]]) -> str:
    step = max(len(line.x) // _POINTS, 1)
    parts, pen = [], "M"
    for x, y in zip(line.x[::step].tolist(), line.y[::step].tolist(), strict=True):
        if not (math.isfinite(x) and math.isfinite(y)):
            pen = "M"
            continue
        across, down = place(x, y)
        parts.append(f"{pen}{across:.1f} {down:.1f}")
        pen = "L"
    return "".join(parts)


def _say(value: float) -> str:
    return f"{value:.4g}".replace("-", "\u2212")


def _svg(width: float, height: float, about: str, inside: str) -> str:
    return (
        f'<svg class="chart" viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
        f'aria-label="{escape(about, quote=True)}">{inside}</svg>'
    )
