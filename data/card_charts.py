"""The charts of a dataset card: the six values by style, and pairs by condition and level.

In: counts. Out: the text of SVG files that stand alone, in light and dark.
"""

import math
from collections.abc import Mapping
from html import escape

import numpy as np
from numpy.typing import NDArray

from ridetune.codec import MatrixCodec
from ridetune.matrix import PARAMETERS, STYLES
from ridetune.sample import CONDITIONS, LEVELS

NUM_BARS = 48

_STYLE_SHEET = """
.paper{fill:#fff}text{fill:#626973;font:11px system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif}
.name{fill:#1f2328;font-size:13px;font-weight:600}.strong{fill:#1f2328}.grid{stroke:#e4e2dd}
.conservative{--c:#2577b8}.moderate{--c:#b7790a}.aggressive{--c:#c23b63}
.I{--c:#274c77}.II{--c:#5288ad}.III{--c:#c3d5e4}.on-I,.on-II{fill:#fff}.on-III{fill:#1f2328}
.area{fill:var(--c);fill-opacity:.22;stroke:var(--c);stroke-width:1.4}
.band{stroke:var(--c);stroke-width:3}.box{fill:var(--c)}
@media (prefers-color-scheme:dark){.paper{fill:#1b1f24}text{fill:#9ba3ae}.name,.strong{fill:#e7e9ec}
.grid{stroke:#2d333a}.conservative{--c:#62b0ea}.moderate{--c:#e3b04b}.aggressive{--c:#f27d9d}}
"""
_ABOUT = ("proportional", "integral", "derivative", "lateral error", "heading error", "steering")
_LEVELS = {"I": "I says it outright", "II": "II hints strongly", "III": "III hints mildly"}

# Panels of the histograms, in the drawing's own units.
_WIDTH, _TOP = 940, 44
_PANEL, _PANEL_HEIGHT = 300, 214
_LEFT, _PLOT_WIDTH, _PLOT_TOP, _PLOT_HEIGHT = 40, 246, 30, 126
_TICK_GAP = 0.15  # of the width between two ticks, at least


def draw_values(bars: NDArray[np.int64], codec: MatrixCodec) -> str:
    """Six histograms by style on the codec's scale; bars: [parameter, style, bar] pairs."""
    legend, x = [], 16.0
    for i, style in enumerate(STYLES):
        count = int(bars[0, i].sum())
        legend.append(
            f'<g class="{style}"><rect class="box" x="{x}" y="15" width="12" height="12" rx="2"/>'
            f'<text class="strong" x="{x + 18}" y="25">{style}, {count:,} pairs</text></g>'
        )
        x += 186
    note = "up: pairs; across: value; lines below: the range of each style"
    legend.append(f'<text x="924" y="25" text-anchor="end">{note}</text>')
    panels = []
    for i in range(len(PARAMETERS)):
        row, column = divmod(i, 3)
        at = f"translate({14 + column * (_PANEL + 6)} {_TOP + row * _PANEL_HEIGHT})"
        panels.append(f'<g transform="{at}">{_histogram(bars[i], codec, i)}</g>')
    height = _TOP + 2 * _PANEL_HEIGHT + 6
    about = "Histograms of the six matrix values by style"
    return _svg(_WIDTH, height, about, "".join([*legend, *panels]))


def _histogram(bars: NDArray[np.int64], codec: MatrixCodec, parameter: int) -> str:
    """One panel: filled steps, one over the other, and below them each style's range."""
    bottom = _PLOT_TOP + _PLOT_HEIGHT
    top = max(int(bars.max()), 1)
    letter, index = PARAMETERS[parameter].split("_")
    parts = [
        f'<text class="name" x="{_LEFT}" y="18">{letter}<tspan dy="3" font-size="10">{index}'
        f'</tspan><tspan dy="-3" font-weight="400" font-size="12">  {_ABOUT[parameter]}</tspan>'
        "</text>"
    ]
    for count in _counts(top):
        y = bottom - count / top * _PLOT_HEIGHT
        parts.append(
            f'<path class="grid" d="M{_LEFT} {y:.1f}h{_PLOT_WIDTH}"/>'
            f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{count:,}</text>'
        )
    for i, style in enumerate(STYLES):
        outline = _outline(bars[i] / top)
        limits = codec.ranges.styles[style][parameter]
        low, high = (_across(codec.share(v, parameter)) for v in (limits.lower, limits.upper))
        y = bottom + 7 + 5 * i
        parts.append(
            f'<g class="{style}"><path class="area" d="{outline}"/>'
            f'<path class="band" d="M{low:.1f} {y}H{high:.1f}"/></g>'
        )
    parts += [
        f'<text x="{_across(share):.1f}" y="{bottom + 34}" text-anchor="middle">{value:g}</text>'
        for value, share in _ticks(codec, parameter)
    ]
    return "".join(parts)


def _outline(heights: NDArray[np.float64]) -> str:
    """Steps over the bars; what is empty has no line."""
    bottom, step = _PLOT_TOP + _PLOT_HEIGHT, _PLOT_WIDTH / NUM_BARS
    parts, drawing = [], False
    for bar, height in enumerate(heights.tolist()):
        if height and not drawing:
            parts.append(f"M{_LEFT + bar * step:.2f} {bottom}")
        if height:
            parts.append(f"V{bottom - height * _PLOT_HEIGHT:.1f}H{_LEFT + (bar + 1) * step:.2f}")
        elif drawing:
            parts.append(f"V{bottom}")
        drawing = height > 0
    return "".join(parts) + (f"V{bottom}" if drawing else "")


def _counts(top: int) -> range:
    """Zero and up to three round counts."""
    power = 10 ** max(len(str(top)) - 2, 0)
    step = next(m * power for m in (1, 2, 5, 10, 20, 50) if top < 4 * m * power)
    return range(0, top + 1, step)


def _across(share: float) -> float:
    return _LEFT + share * _PLOT_WIDTH


def _ticks(codec: MatrixCodec, parameter: int) -> list[tuple[float, float]]:
    """Round values with their share of the axis, its ends among them, none too close."""
    low, high = codec.ranges.lowest[parameter], codec.ranges.highest[parameter]
    decades = range(math.floor(math.log10(max(low, 1e-4))), math.ceil(math.log10(high)) + 1)
    between = [m * 10.0**d for m in (1, 5, 2) for d in decades if low < m * 10.0**d < high]
    chosen: list[tuple[float, float]] = []
    for value in [low, high, *between]:
        share = codec.share(value, parameter)
        if all(abs(share - other) >= _TICK_GAP for _, other in chosen):
            chosen.append((value, share))
    return sorted(chosen)


def draw_conditions(levels: Mapping[tuple[str, str], int]) -> str:
    """Pairs by condition, each bar parted by the level; levels: by condition and level."""
    totals = {c: sum(levels.get((c, level), 0) for level in LEVELS) for c in CONDITIONS}
    scale = 560 / max(*totals.values(), 1)
    parts, x = [], 110.0
    for level in LEVELS:
        parts.append(
            f'<rect class="box {level}" x="{x}" y="15" width="12" height="12" rx="2"/>'
            f'<text class="strong" x="{x + 18}" y="25">{_LEVELS[level]}</text>'
        )
        x += 160
    y = 48
    for condition in CONDITIONS:
        parts.append(
            f'<text class="strong" x="96" y="{y + 18}" text-anchor="end">{condition}</text>'
        )
        left = 110.0
        for level in LEVELS:
            count = levels.get((condition, level), 0)
            width = count * scale
            label = f"{count:,}" if width > 34 else ""
            parts.append(
                f'<rect class="box {level}" x="{left:.1f}" y="{y}" width="{width:.1f}" '
                f'height="26"/><text class="on-{level}" x="{left + width / 2:.1f}" y="{y + 17}" '
                f'text-anchor="middle">{label}</text>'
            )
            left += width
        total = totals[condition]
        parts.append(f'<text class="strong" x="{left + 8:.1f}" y="{y + 17}">{total:,}</text>')
        y += 36
    return _svg(760, y + 4, "Pairs by condition and level", "".join(parts))


def _svg(width: int, height: int, about: str, inside: str) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}" role="img" aria-label="{escape(about, quote=True)}">'
        f"<style>{_STYLE_SHEET}</style>"
        f'<rect class="paper" width="{width}" height="{height}" rx="8"/>{inside}</svg>\n'
    )
