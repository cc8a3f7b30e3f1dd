"""What may stand in the lane besides vehicles: people, bags and the barriers of a work zone.

In: a canvas and a `Thing` of these kinds. Out: the thing in the image, in place.
"""

import numpy as np

from .atmosphere import Colour
from .canvas import Canvas, draw_rectangle
from .street import Thing

OBSTACLES = ("pedestrian", "barrier", "bag")
_RED, _WHITE, _SKIN, _TROUSERS = (200, 40, 35), (228, 228, 224), (196, 150, 122), (45, 50, 66)


def draw_obstacle(canvas: Canvas, thing: Thing) -> None:
    """A person, a bag, or a striped barrier across the width of the thing."""
    u, foot, top = canvas.camera.stand(thing.x, thing.z, thing.size[1])
    wide, tall = thing.size[0] * canvas.camera.focal / thing.z, foot - top

    def part(x: float, y: float, w: float, h: float, colour: Colour) -> None:
        """A rectangle in shares of the thing's width and height; y counts from the ground."""
        centre = (u + x * wide, foot - y * tall)
        draw_rectangle(canvas, centre, w * wide, h * tall, canvas.air.shade(colour, 0.0, thing.z))

    if thing.kind == "barrier":
        for number, x in enumerate(np.linspace(-0.5, 0.5, 9)[:-1] + 1 / 16):
            part(float(x), 0.75, 0.125, 0.5, (_RED, _WHITE)[number % 2])
        for x in (-0.45, 0.45):
            part(x, 0.3, 0.03, 0.6, _TROUSERS)
    elif thing.kind == "bag":
        part(0.0, 0.4, 1.0, 0.8, thing.colour)
        part(0.0, 0.9, 0.4, 0.2, thing.colour)
    else:
        part(-0.2, 0.24, 0.3, 0.48, _TROUSERS)
        part(0.2, 0.24, 0.3, 0.48, _TROUSERS)
        part(0.0, 0.66, 0.9, 0.38, thing.colour)
        part(0.0, 0.93, 0.36, 0.14, _SKIN)
