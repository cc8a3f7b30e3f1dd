"""Vehicles: cars, vans and trucks as boxes with glass, wheels and lamps.

In: a canvas and a `Thing` that is a vehicle. Out: the vehicle in the image, in place; lit lamps
go to the list of the canvas.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .atmosphere import Colour
from .canvas import WHITE, Canvas, mix, scale
from .projection import Points
from .street import Thing


def _box(
    x0: float, x1: float, y0: float, y1: float, z0: float, z1: float
) -> list[tuple[float, float, float]]:
    return [(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)]


def _quad(x0: float, x1: float, y0: float, y1: float, z: float) -> list[tuple[float, float, float]]:
    return [(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]


def _template(
    roof: float, rear: tuple[float, float], front: tuple[float, float], waist: float
) -> dict[str, NDArray[np.float64]]:
    """Vehicle parts in units of half width, height and length; rear at z = 0.

    `roof` is the half width of the roof, `rear` and `front` the depths of waist and roof edge.
    """
    glass = waist + 0.05
    ring = [(x, waist - 0.02, z) for x in (-0.96, 0.96) for z in (rear[0], front[0])]
    ring += [(x, 1.0, z) for x in (-roof, roof) for z in (rear[1], front[1])]
    dz = rear[1] - rear[0]
    window = [(-0.8, glass, rear[0] + 0.1 * dz), (0.8, glass, rear[0] + 0.1 * dz)]
    window += [(roof * 0.86, 0.94, rear[1] - 0.1 * dz), (-roof * 0.86, 0.94, rear[1] - 0.1 * dz)]
    turn = np.linspace(0, 2 * np.pi, 9)[:-1]
    parts: dict[str, list[tuple[float, float, float]]] = {
        "under": [(-1.1, 0, -0.02), (1.1, 0, -0.02), (1.04, 0.3, 0.02), (-1.04, 0.3, 0.02)],
        "body": _box(-1, 1, 0.15, waist, 0, 1),
        "cabin": ring,
        "rear face": _quad(-1, 1, 0.16, waist, 0),
        "rear window": window,
        "bumper": _quad(-1, 1, 0.16, 0.27, -0.002),
        "plate": _quad(-0.25, 0.25, 0.34, 0.42, -0.003),
        "lamp left": _quad(-0.98, -0.68, waist - 0.16, waist - 0.03, -0.003),
        "lamp right": _quad(0.68, 0.98, waist - 0.16, waist - 0.03, -0.003),
    }
    for name, s in (("left", -1.0), ("right", 1.0)):
        parts[f"glass {name}"] = [
            (s * 0.97, glass, rear[0] + 0.09), (s * 0.97, glass, front[0] - 0.06),
            (s * (roof + 0.02), 0.93, front[1] - 0.02), (s * (roof + 0.02), 0.93, rear[1] + 0.03),
        ]  # fmt: skip
        for end, z in (("a", 0.19), ("b", 0.8)):
            parts[f"wheel {name} {end}"] = [
                (s, 0.2 + 0.2 * np.sin(a), z + 0.07 * np.cos(a)) for a in turn
            ]
        parts[f"tyre {name}"] = _quad(s * 0.94, s * 0.66, 0.0, 0.2, 0.0)
    return {name: np.asarray(points) for name, points in parts.items()}


def _truck_template() -> dict[str, NDArray[np.float64]]:
    parts = _template(0.98, (0.0, 0.0), (1.0, 1.0), 0.32)
    parts["body"], parts["rear face"] = (
        np.asarray(_box(-1, 1, 0.12, 0.3, 0, 1)),
        np.asarray(_quad(-1, 1, 0.12, 0.3, 0)),
    )
    for name, x in (("lamp left", -0.98), ("lamp right", 0.74)):
        parts[name] = np.asarray(_quad(x, x + 0.24, 0.2, 0.26, -0.003))
    parts["windscreen"] = np.asarray(_quad(-0.9, 0.9, 0.48, 0.72, -0.003))
    return parts


def _packed(parts: dict[str, NDArray[np.float64]]) -> tuple[Points, dict[str, slice]]:
    """All points of a template in one array [n, 3], and where each part lies in it."""
    ends = np.cumsum([len(p) for p in parts.values()])
    slices = {
        n: slice(int(e) - len(p), int(e)) for (n, p), e in zip(parts.items(), ends, strict=True)
    }
    return np.concatenate(list(parts.values())), slices


TEMPLATES = {
    "car": _packed(_template(0.74, (0.05, 0.2), (0.74, 0.55), 0.6)),
    "suv": _packed(_template(0.84, (0.0, 0.07), (0.76, 0.62), 0.58)),
    "van": _packed(_template(0.9, (0.0, 0.03), (0.92, 0.76), 0.52)),
    "truck": _packed(_truck_template()),
}


def _vehicle_pixels(canvas: Canvas, thing: Thing) -> dict[str, NDArray[np.int32]]:
    """Every part of a vehicle in the picture, projected in one call."""
    points, slices = TEMPLATES[thing.kind]
    w, h, length = thing.size
    along, across = points[:, 2], points[:, 0]
    if thing.facing == "side":
        x, z = (along - 0.5) * length, (across + 1) * w / 2
    else:
        x, z = across * w / 2, along * length
    world = np.empty_like(points)
    world[:, 0], world[:, 1], world[:, 2] = thing.x + x, points[:, 1] * h, thing.z + z
    pixels = canvas.camera.project(world)
    return {name: pixels[part] for name, part in slices.items()}


def draw_vehicle(canvas: Canvas, thing: Thing) -> None:
    """Body, cabin, glass, wheels, lamps and contact shadow of one vehicle."""
    px = _vehicle_pixels(canvas, thing)
    air = canvas.air
    x = (
        (canvas.camera.stand(thing.x, thing.z, 0)[0] - canvas.camera.u0)
        * thing.z
        / canvas.camera.focal
    )

    def shade(colour: Colour) -> Colour:
        return air.shade(colour, x, thing.z)

    truck = thing.kind == "truck"
    paint = mix(thing.colour, WHITE, 0.35 if air.snow > 0.6 else 0.0)
    dark, glass = (
        shade((16, 16, 18)),
        shade(mix((22, 25, 30), (120, 135, 150), 0.4 * thing.variant)),
    )
    canvas.fill([px["under"]], shade((20, 20, 22)))
    side_on = thing.facing == "side"
    body = px["body"]
    left_seen = side_on or body[1, 0] < body[0, 0]
    right_seen = not side_on and body[5, 0] > body[4, 0]
    canvas.hull(body, shade(scale(paint, 0.9 if side_on else 0.62)))
    canvas.hull(px["cabin"], shade(scale(paint, 0.9 if side_on else 0.7)))
    for name, seen in (("left", left_seen), ("right", right_seen)):
        if thing.z > 40:
            continue
        if seen and not truck:
            canvas.fill([px[f"glass {name}"]], glass)
        if seen:
            canvas.fill([px[f"wheel {name} a"], px[f"wheel {name} b"]], dark)
    if side_on:
        return
    canvas.fill([px["tyre left"], px["tyre right"]], dark)
    canvas.fill([px["rear face"]], shade(paint if not truck else (50, 50, 52)))
    if truck:
        canvas.fill([px["cabin"][[0, 2, 6, 4]]], shade(paint))
        if thing.facing == "front":
            canvas.fill([px["windscreen"]], glass)
    if not truck:
        canvas.fill([px["rear window"]], glass)
    if thing.z > 40:
        _vehicle_lamps(canvas, thing, px, shade)
        return
    canvas.fill([px["bumper"]], shade(scale(paint, 0.55)))
    canvas.fill([px["plate"]], shade((190, 190, 180) if thing.facing == "rear" else (30, 30, 32)))
    _vehicle_lamps(canvas, thing, px, shade)


def _vehicle_lamps(
    canvas: Canvas,
    thing: Thing,
    px: dict[str, NDArray[np.int32]],
    shade: Callable[[Colour], Colour],
) -> None:
    """Tail or head lamps, lit when the weather asks for it or the vehicle brakes."""
    air, rear = canvas.air, thing.facing == "rear"
    braking = rear and thing.variant < 0.3
    on = max(air.lamps, 0.8 if braking else 0.0)
    seen = float(np.exp(-0.5 * air.extinction * thing.z))  # lamps carry further than surfaces
    lit: Colour = (255, 40, 25) if rear else (255, 250, 225)
    off = shade((120, 18, 18) if rear else (185, 188, 190))
    colour = mix(off, lit, on * seen)
    canvas.fill([px["lamp left"], px["lamp right"]], colour)
    if air.glow == 0 or on * seen < 0.1:
        return
    size = canvas.camera.focal / max(thing.z, 4.0)
    radius = air.glow * (0.55 if rear else 1.1) * size + (2 if rear else 4) * air.glow
    for name in ("lamp left", "lamp right"):
        u, v = px[name].mean(axis=0) / 16
        canvas.lamp(u, v, min(radius, 70), lit, on * seen * (0.8 if rear else 1.0))
