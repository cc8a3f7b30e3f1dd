"""Hills, far trees and far buildings at the horizon.

In: a canvas and the surroundings. Out: silhouettes in its image, in place, seen through the haze.
"""

import numpy as np

from .atmosphere import Colour
from .canvas import WHITE, Canvas, mix
from .projection import Points
from .scene import Surroundings
from .street import FOLIAGE


def draw_skyline(canvas: Canvas, surroundings: Surroundings) -> None:
    """Hills, far trees or far buildings that close the view at the horizon."""
    camera, looks, air = canvas.camera, canvas.layout.looks, canvas.air
    rng = np.random.default_rng(int(looks[0] * 2**31))
    u = np.linspace(-10, camera.width + 10, 56)
    x = u / camera.width
    hills = (
        camera.height
        * (0.02 + 0.09 * looks[1])
        * (1 + np.sin(3 + 9 * looks[2] + (3 + 4 * looks[3]) * x))
        / 2
    )
    if surroundings != "city" and looks[4] < 0.6:
        colour = mix((96, 104, 92), (88, 100, 120), looks[5])
        if air.snow:
            colour = mix(colour, WHITE, 0.5)
        _silhouette(canvas, u, hills, air.shade(colour, 90.0, 500.0))
    rough = np.repeat(rng.random(14), 4) if surroundings == "city" else rng.random(56)
    height = camera.height * (0.015 + (0.1 if surroundings == "city" else 0.045) * rough * looks[6])
    colour = (105, 104, 104) if surroundings == "city" else FOLIAGE[int(looks[7] * len(FOLIAGE))]
    if air.snow:
        colour = mix(colour, WHITE, 0.3)
    _silhouette(canvas, u, height, air.shade(colour, 60.0, 160.0))


def _silhouette(canvas: Canvas, u: Points, height: Points, colour: Colour) -> None:
    v = canvas.camera.v0 - height
    points = np.stack([u, v], axis=1)
    base = np.array([[u[-1], canvas.camera.v0 + 3], [u[0], canvas.camera.v0 + 3]])
    canvas.fill([np.rint(np.concatenate([points, base]) * 16).astype(np.int32)], colour)
