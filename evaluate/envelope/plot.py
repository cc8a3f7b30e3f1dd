"""The verified envelope as one SVG: steering weights per condition, speed gains beside them."""

import math
from collections.abc import Mapping
from html import escape

import numpy as np
from numpy.typing import NDArray

from ridetune.codec import MatrixCodec
from ridetune.envelope import Envelope
from ridetune.matrix import STYLES, Style, ki_limit
from ridetune.sample import CONDITIONS, Condition

_PANEL, _GAP, _LEFT, _TOP = 220, 78, 66, 74
_COLOURS: dict[Style, str] = {
    "conservative": "#2a7f9e",
    "moderate": "#8a6d1f",
    "aggressive": "#a8452f",
}
_WL, _WS, _KP, _KI = 3, 5, 0, 1
_TICKS = {
    _WL: (0.02, 0.05, 0.1, 0.2, 0.5, 1.0),
    _WS: (0.1, 0.2, 0.5, 1.0, 2.0, 5.0),
    _KP: (0.1, 0.2, 0.4, 0.8),
    _KI: (0.0, 0.003, 0.01, 0.03, 0.1),
}
# Matrices of a condition by place [matrix, parameter], and which leave the turn.
Points = Mapping[Condition, tuple[NDArray[np.float64], NDArray[np.bool_]]]


class _Panel:
    """One pair of axes on the codec's scale."""

    def __init__(self, codec: MatrixCodec, number: int, x: int, y: int, title: str) -> None:
        self._codec, self._x, self._y = codec, x, y
        self.left = _LEFT + (number % 3) * (_PANEL + _GAP)
        self.top = _TOP + (number // 3) * (_PANEL + _GAP + 14)
        self.parts = [
            f'<rect x="{self.left}" y="{self.top}" width="{_PANEL}" height="{_PANEL}" '
            'class="frame"/>',
            f'<text x="{self.left}" y="{self.top - 8}" class="title">{escape(title)}</text>',
        ]

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Pixels of shares in [0, 1]."""
        return self.left + _PANEL * x, self.top + _PANEL * (1.0 - y)

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Pixels of two values."""
        return self.at(self._codec.share(x, self._x), self._codec.share(y, self._y))

    def axes(self, x_name: str, y_name: str) -> None:
        """Ticks and names."""
        for value in _TICKS[self._x]:
            x, _ = self.at(self._codec.share(value, self._x), 0.0)
            self._text(x, self.top + _PANEL + 14, f"{value:g}", "middle")
        for value in _TICKS[self._y]:
            _, y = self.at(0.0, self._codec.share(value, self._y))
            self._text(self.left - 6, y + 4, f"{value:g}", "end")
        self._text(self.left + _PANEL / 2, self.top + _PANEL + 30, x_name, "middle")
        x, y = self.left - 50, self.top + _PANEL / 2
        self.parts.append(
            f'<text x="{x}" y="{y}" transform="rotate(-90 {x} {y})" text-anchor="middle">'
            f"{escape(y_name)}</text>"
        )

    def box(self, x: tuple[float, float], y: tuple[float, float], style: str) -> None:
        """A rectangle between two values on each axis."""
        left, bottom = self.place(x[0], y[0])
        right, top = self.place(x[1], y[1])
        self.parts.append(
            f'<rect x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" '
            f'height="{bottom - top:.1f}" {style}/>'
        )

    def styles(self) -> None:
        """Where each style scores 100, dashed."""
        for style in STYLES:
            core = self._codec.ranges.styles[style]
            self.box(
                (core[self._x].lower, core[self._x].upper),
                (core[self._y].lower, core[self._y].upper),
                f'fill="none" stroke="{_COLOURS[style]}" stroke-width="1.6" stroke-dasharray="4 3"',
            )

    def _text(self, x: float, y: float, text: str, anchor: str) -> None:
        self.parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'
        )


def plot_envelope(codec: MatrixCodec, envelope: Envelope, points: Points) -> str:
    """The picture; crosses left their lane in the turn, dots did not."""
    panels = []
    for number, condition in enumerate(CONDITIONS):
        panel = _Panel(codec, number, _WL, _WS, condition)
        for share, broken in zip(*points[condition], strict=True):
            x, y = panel.at(float(share[_WL]), float(share[_WS]))
            mark = f'd="M{x - 2:.1f} {y - 2:.1f}l4 4m0-4l-4 4"'
            panel.parts.append(
                f'<path {mark} class="broken"/>'
                if broken
                else f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.3" class="kept"/>'
            )
        panel.styles()
        box = envelope.box(condition)
        panel.box(box[_WL], box[_WS], 'class="verified"')
        panel.axes("W_l, lateral error", "W_s, steering input")
        panels.append(panel)
    panels.append(_gains(codec, envelope, len(CONDITIONS)))
    return _page(panels)


def _gains(codec: MatrixCodec, envelope: Envelope, number: int) -> _Panel:
    panel = _Panel(codec, number, _KP, _KI, "speed gains, every condition")
    box = envelope.box(None)
    curve = []
    for kp in np.geomspace(box[_KP][0], box[_KP][1], 60):
        x, y = panel.place(float(kp), min(ki_limit(float(kp)), box[_KI][1]))
        curve.append(f"{x:.1f} {y:.1f}")
    right, bottom = panel.place(box[_KP][1], box[_KI][0])
    left, _ = panel.place(box[_KP][0], box[_KI][0])
    outline = f"M{left:.1f} {bottom:.1f}L" + "L".join(curve) + f"L{right:.1f} {bottom:.1f}Z"
    panel.parts.append(f'<path d="{outline}" class="verified"/>')
    panel.styles()
    panel.axes("K_p, proportional gain", "K_i, integral gain")
    return panel


def _page(panels: list[_Panel]) -> str:
    rows = math.ceil(len(panels) / 3)
    width = _LEFT + 3 * _PANEL + 2 * _GAP + 24
    height = _TOP + rows * (_PANEL + _GAP + 14)
    legend = "".join(
        f'<text x="{_LEFT + 330 + 120 * i}" y="24" style="fill: {_COLOURS[s]}">- - {s}</text>'
        for i, s in enumerate(STYLES)
    )
    body = "\n".join(part for panel in panels for part in panel.parts)
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">
<style>
text {{ font: 12px system-ui, sans-serif; fill: #333; }}
.title {{ font-weight: 600; }}
.frame {{ fill: #fff; stroke: #bbb; }}
.verified {{ fill: #3a8f5c; fill-opacity: 0.14; stroke: #2c7047; stroke-width: 1.6; }}
.kept {{ fill: #9a9a9a; }}
.broken {{ stroke: #c23b22; fill: none; }}
</style>
<rect width="{width}" height="{height}" fill="#fbfaf8"/>
<text x="{_LEFT}" y="24" class="title">Verified envelope (green), simulation</text>
{legend}
<text x="{_LEFT}" y="42">Cross: the matrix breaks a limit in the left turn with a hard car; dot: it
 does not. Dashed: where a style scores 100.</text>
{body}
</svg>
"""
