"""Picture under construction: what every drawing function gets, and the shapes they share.

In: a `Layout`, an `Atmosphere` and an RGB image. Out: polygons, bands of ground and rectangles in
that image, in place, and a list of lamps that glow once everything is drawn.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from .atmosphere import Atmosphere, Colour
from .projection import Camera, Points
from .street import Layout
from .weather import Image


def _there_and_back(count: int) -> Points:
    steps = np.linspace(0, 1, count)
    return np.concatenate([steps, steps[::-1]])


LONG_STRIP, SHORT_STRIP = _there_and_back(26), _there_and_back(3)
WHITE: Colour = (225.0, 228.0, 235.0)


@dataclass(frozen=True)
class Canvas:
    """The picture under construction with all that a drawing function needs."""

    image: Image  # drawn in place
    layout: Layout
    air: Atmosphere
    lights: list[tuple[float, float, float, Colour, float]]  # u, v, radius, colour, gain

    @cached_property
    def camera(self) -> Camera:
        """Camera of the layout."""
        return self.layout.camera

    def fill(self, pixels: list[NDArray[np.int32]], colour: Colour) -> None:
        """Anti-aliased polygons from pixels in 1/16."""
        cv2.fillPoly(self.image, pixels, colour, cv2.LINE_AA, 4)

    def hull(self, pixels: NDArray[np.int32], colour: Colour) -> None:
        """Anti-aliased convex hull of pixels in 1/16."""
        cv2.fillConvexPoly(self.image, cv2.convexHull(pixels), colour, cv2.LINE_AA, 4)

    def band(self, left: float, right: float, low: float, high: float, colour: Colour) -> None:
        """Strip of ground between two offsets from the centre line, in albedo."""
        self.bands([(left, right)], low, high, colour)

    def bands(
        self, sides: list[tuple[float, float]], low: float, high: float, colour: Colour
    ) -> None:
        """Strips of ground with the same colour and depth range."""
        steps = LONG_STRIP if high - low > 20 else SHORT_STRIP
        half, edges = len(steps) // 2, np.asarray(sides)
        points = np.zeros((len(sides), len(steps), 3))
        points[:, :half, 0], points[:, half:, 0] = edges[:, :1], edges[:, 1:]
        low = max(low, 1.0)
        points[:, :, 2] = low * (high / low) ** steps
        self.fill(
            list(self.camera.project(points.reshape(-1, 3)).reshape(len(sides), -1, 2)), colour
        )

    def lamp(self, u: float, v: float, radius: float, colour: Colour, gain: float) -> None:
        """Remember a lamp whose halo is added once everything is drawn."""
        self.lights.append((u, v, radius, colour, gain))


def mix(a: Colour, b: Colour, t: float) -> Colour:
    """Colour a moved to b by t."""
    return (a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t, a[2] + (b[2] - a[2]) * t)


def scale(colour: Colour, factor: float) -> Colour:
    """Colour made brighter or darker by a factor."""
    return (colour[0] * factor, colour[1] * factor, colour[2] * factor)


def draw_rectangle(
    canvas: Canvas, centre: tuple[float, float], w: float, h: float, colour: Colour
) -> None:
    """Upright rectangle from its centre and size in pixels."""
    u, v = centre
    low = (int((u - w / 2) * 16), int((v - h / 2) * 16))
    cv2.rectangle(
        canvas.image, low, (int((u + w / 2) * 16), int((v + h / 2) * 16)), colour, -1, shift=4
    )
