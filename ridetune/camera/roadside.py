"""Roadside: buildings, trees, lamps, signs, signals, gantries and guard rails.

In: a canvas and a `Thing` that is no vehicle. Out: the thing in the image, in place; lit lamps go
to the list of the canvas.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from .atmosphere import Colour
from .canvas import WHITE, Canvas, draw_rectangle, mix, scale
from .projection import Points
from .street import Thing

WINDOW_Y, WINDOW_Z = np.array([0.32, 0.32, 0.82, 0.82]), np.array([-0.5, 0.5, 0.5, -0.5])
LOTS = np.random.default_rng(3).random(4096)


def _lots(variant: float, count: int) -> Points:
    """Numbers 0..1 that a thing always draws again."""
    start = int(variant * 2048)
    return LOTS[start : start + count]


def draw_building(canvas: Canvas, thing: Thing) -> None:
    """Wall along the road with a window grid, and the wall that faces the camera."""
    air, camera = canvas.air, canvas.camera
    depth, h, length = thing.size
    side = 1.0 if thing.x > 0 else -1.0
    z0, z1 = max(thing.z, 2.0), max(thing.z, 2.0) + length
    face = camera.project(
        np.array([[thing.x, 0, z0], [thing.x, 0, z1], [thing.x, h, z1], [thing.x, h, z0]])
    )
    out = thing.x + side * depth
    front = camera.project(
        np.array([[thing.x, 0, z0], [out, 0, z0], [out, h, z0], [thing.x, h, z0]])
    )
    seen = np.concatenate([face, front])[:, 0]
    if seen.max() < 0 or seen.min() > 16 * camera.width:
        return
    middle = (z0 + z1) / 2
    shade = 0.78 if air.sun[0] * side > 0 else 1.0
    canvas.fill([front], air.shade(scale(thing.colour, 0.7), 30.0, z0))
    canvas.fill([face], air.shade(scale(thing.colour, shade), 25.0, middle))
    floors, columns = max(1, int(h / 3.2)), max(2, int(length / 3.0))
    wide = 0.45 + 0.3 * thing.variant
    points = np.empty((floors, columns, 4, 3))
    points[..., 0] = thing.x
    points[..., 1] = (np.arange(floors)[:, None, None] + WINDOW_Y) * h / floors
    points[..., 2] = z0 + (np.arange(columns)[:, None] + 0.5 + wide * WINDOW_Z) * length / columns
    windows = camera.project(points.reshape(-1, 3)).reshape(-1, 4, 2)
    lit = _lots(thing.variant, len(windows)) < (0.3 if air.condition == "night" else 0.0)
    canvas.fill(list(windows[~lit]), air.shade((48, 54, 64), 25.0, middle))
    if lit.any():
        canvas.fill(
            list(windows[lit]),
            air.shade((255, 220, 150), 0.0, 1.0) if air.headlamp == 0 else (190, 150, 90),
        )
    if air.snow:
        roof = camera.project(
            np.array(
                [[thing.x, h - 0.4, z0], [thing.x, h - 0.4, z1], [thing.x, h, z1], [thing.x, h, z0]]
            )
        )
        canvas.fill([roof], air.shade(WHITE, 25.0, middle))


def _crowns() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ragged outlines [24, 22, 2] and tufts inside them [24, 14, 9, 2].

    x is -1..1, y 0 (foot of the crown) .. 1 (top); every third crown is a conifer.
    """
    rng = np.random.default_rng(4)
    angle = np.linspace(0, 2 * np.pi, 22, endpoint=False)
    shapes, tufts = np.empty((24, 22, 2)), np.empty((24, 14, 9, 2))
    for i in range(24):
        ragged = 0.75 + 0.25 * rng.random(22)
        taper = 1 - 0.62 * np.clip(np.sin(angle), 0, 1) if i % 3 == 0 else 1.0
        shapes[i, :, 0] = np.cos(angle) * ragged * taper
        shapes[i, :, 1] = 0.5 + 0.5 * np.sin(angle) * (ragged if i % 3 else 0.95)
        for j in range(14):
            middle = (0, 0.5) + 0.8 * (shapes[i, rng.integers(22)] - (0, 0.5)) * rng.random()
            turn = np.linspace(0, 2 * np.pi, 9, endpoint=False)
            blob = np.stack([np.cos(turn), 0.5 * np.sin(turn)], axis=1) * rng.uniform(
                0.5, 1, (9, 1)
            )
            tufts[i, j] = middle + (0, 0.05) + blob * rng.uniform(0.1, 0.3)
    return shapes, tufts


CROWNS, TUFTS = _crowns()


def draw_tree(canvas: Canvas, thing: Thing) -> None:
    """Trunk and a ragged crown with lit tufts and dark gaps."""
    air, camera = canvas.air, canvas.camera
    w, h, _ = thing.size
    u, foot, top = camera.stand(thing.x, thing.z, h)
    half, tall = 0.5 * w * camera.focal / thing.z, 0.85 * (foot - top)
    if u + half < 0 or u - half > camera.width:
        return
    draw_rectangle(
        canvas,
        (u, foot - 0.2 * tall),
        max(1.0, 0.12 * half),
        0.4 * tall,
        air.shade((62, 50, 40), thing.x, thing.z),
    )
    size, base = np.array([half, -tall]) * 16, np.array([u, top + tall]) * 16
    crown = CROWNS[int(thing.variant * 24)]
    leaf = mix(thing.colour, WHITE, 0.45) if air.snow else thing.colour
    canvas.fill(
        [(crown * size + base).astype(np.int32)], air.shade(scale(leaf, 0.85), thing.x, thing.z)
    )
    if half < 7:  # too small for tufts
        return
    count = 6 if half < 25 else 14
    tufts = (TUFTS[int(thing.variant * 24), :count] * size + base).astype(np.int32)
    bright = 1.35 if air.shadow else 1.12
    canvas.fill(list(tufts[count // 2 :]), air.shade(scale(leaf, 0.55), thing.x, thing.z))
    canvas.fill(list(tufts[: count // 2]), air.shade(scale(leaf, bright), thing.x, thing.z))


def draw_post(canvas: Canvas, thing: Thing) -> None:
    """Lamps, signs, signals and gantries: a post with something at its head."""
    air, camera = canvas.air, canvas.camera
    w, h, _ = thing.size
    u, foot, top = camera.stand(thing.x, thing.z, h)
    metre = camera.focal / thing.z
    grey = air.shade((92, 95, 98), thing.x, thing.z)
    if thing.kind == "gantry":
        draw_rectangle(canvas, (u, top), w * metre, 0.25 * metre, grey)
        for edge in (-0.52, 0.52):
            draw_rectangle(
                canvas, (u + edge * w * metre, (top + foot) / 2), 0.3 * metre, foot - top, grey
            )
        board = air.shade(thing.colour, 0.0, thing.z)
        for at in (-0.25, 0.22):
            draw_rectangle(canvas, (u + at * w * metre, top), 0.36 * w * metre, 2.2 * metre, board)
        return
    draw_rectangle(canvas, (u, (top + foot) / 2), max(1.0, 0.14 * metre), foot - top, grey)
    if thing.kind == "lamp":
        end = u + (0.5 - thing.variant) * 2 * w * metre
        draw_rectangle(canvas, ((u + end) / 2, top), abs(end - u), max(1.0, 0.12 * metre), grey)
        if air.headlamp:
            canvas.lamp(end, top, min(60.0, air.glow * (0.8 * metre + 5)), (255, 205, 130), 0.9)
    elif thing.kind == "sign":
        face: Colour = (
            (205, 60, 50)
            if thing.variant < 0.4
            else (60, 90, 170)
            if thing.variant < 0.6
            else (225, 200, 60)
        )
        radius = int(max(1.0, 0.42 * metre) * 16)
        middle = (int(u * 16), int(top * 16))
        cv2.circle(
            canvas.image, middle, radius, air.shade(face, thing.x, thing.z), -1, cv2.LINE_AA, 4
        )
        cv2.circle(
            canvas.image,
            middle,
            int(0.6 * radius),
            air.shade((225, 225, 225), thing.x, thing.z),
            -1,
            cv2.LINE_AA,
            4,
        )
    else:
        _signal_head(canvas, thing, (u, top), metre)


def _signal_head(canvas: Canvas, thing: Thing, at: tuple[float, float], metre: float) -> None:
    """Three lamps in a dark case; on an arm that reaches over the road when the size says so."""
    air = canvas.air
    u, v = at
    if thing.size[2] > 0:  # post stands on the right, the head hangs over the lane
        right = u + thing.size[2] * metre
        draw_rectangle(
            canvas,
            ((u + right) / 2, v),
            right - u,
            max(1.0, 0.14 * metre),
            air.shade((92, 95, 98), 3.0, thing.z),
        )
    size = metre * 1.25
    draw_rectangle(canvas, (u, v), 0.5 * size, 1.15 * size, air.shade((22, 22, 24), 3.0, thing.z))
    state = int(thing.variant * 2.999)
    lamp: Colour = ((255, 50, 35), (255, 190, 50), (60, 255, 150))[state]
    where = v + (state - 1) * 0.34 * size
    cv2.circle(
        canvas.image,
        (int(u * 16), int(where * 16)),
        int(max(1.2, 0.17 * size) * 16),
        lamp,
        -1,
        cv2.LINE_AA,
        4,
    )
    canvas.lamp(u, where, (0.5 + air.glow) * 0.6 * size + 3, lamp, 0.5 + 0.4 * air.lamps)


def draw_rails(canvas: Canvas) -> None:
    """Guard rails on both sides of a highway carriageway, drawn from far to near."""
    layout, air = canvas.layout, canvas.air
    edges = np.array([1.5, 4, 8, 14, 25, 45, 80, 150])
    for x in (layout.right + layout.shoulder_m + 0.4, layout.left - layout.shoulder_m * 0.5 - 0.3):
        points = np.empty((2, 36, 3))
        points[..., 0], points[0, :, 1], points[1, :, 1] = x, 0.45, 0.78
        points[..., 2] = np.geomspace(1.5, 150, 36)
        low, high = canvas.camera.project(points.reshape(-1, 3)).reshape(2, 36, 2)
        for i in range(6, -1, -1):
            part = slice(i * 5, i * 5 + 6)
            colour = air.shade((150, 153, 155), 0.3 * x, float(edges[i]))
            canvas.fill([np.concatenate([low[part], high[part][::-1]])], colour)
