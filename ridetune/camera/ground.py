"""The ground: verges, road, markings, crossing, and the shadows that fall on it.

In: a canvas. Out: the albedo of the ground in its image, in place; `weather.light_ground` adds
light and haze afterwards.
"""

import cv2
import numpy as np

from .atmosphere import Colour
from .canvas import WHITE, Canvas, mix, scale
from .scene import Scene

FAR_M = 400.0


def draw_ground(canvas: Canvas, scene: Scene) -> None:
    """Verges, road, markings and crossing in albedo; light and haze follow in one step."""
    layout, air, looks = canvas.layout, canvas.air, canvas.layout.looks
    verge = mix((84, 98, 48), (165, 142, 92), looks[8])
    if scene.surroundings == "city":
        verge = mix((120, 116, 112), (160, 155, 148), looks[8])
    asphalt = mix((72, 72, 77), (150, 145, 138), looks[9] ** 1.4)
    asphalt = scale(asphalt, 1 - 0.5 * air.wet)
    if air.snow:
        verge = mix(verge, WHITE, 0.93)
        asphalt = mix(asphalt, WHITE, 0.15 + 0.75 * air.snow)
    elif air.wet:
        verge = scale(verge, 0.8)
    corner = (canvas.camera.width, canvas.camera.height)
    cv2.rectangle(canvas.image, (0, int(canvas.camera.v0)), corner, verge, -1)
    left, right = layout.left - layout.shoulder_m, layout.right + layout.shoulder_m
    if scene.surroundings == "city":
        kerb = mix(scale(verge, 0.75), WHITE, 0.4 * bool(air.snow))
        canvas.band(layout.opposite_left - layout.shoulder_m - 0.3, right + 0.3, 1, FAR_M, kerb)
    canvas.band(
        layout.opposite_left - layout.shoulder_m,
        layout.opposite_right + layout.shoulder_m,
        1,
        FAR_M,
        asphalt,
    )
    canvas.band(left, right, 1, FAR_M, asphalt)
    _tracks(canvas, asphalt)
    _markings(canvas, scene, asphalt)
    if layout.crossing:
        _crossing(canvas, asphalt)


def _tracks(canvas: Canvas, asphalt: Colour) -> None:
    """Tyre tracks: dark and wet in snow, faint otherwise."""
    layout, snow = canvas.layout, canvas.air.snow
    strength = 0.25 + 0.4 * layout.looks[10] if snow else 0.1 * layout.looks[10]
    colour = mix(asphalt, (70, 72, 80) if snow else (40, 40, 42), strength)
    lanes = np.arange(layout.left + layout.lane_m / 2, layout.right, layout.lane_m)
    sides = [(x + side - 0.25, x + side + 0.25) for x in lanes for side in (-0.75, 0.75)]
    canvas.bands(sides, 1, 90, colour)


def _markings(canvas: Canvas, scene: Scene, asphalt: Colour) -> None:
    """Solid edges, dashed lane limits, and a white or yellow centre."""
    layout, looks = canvas.layout, canvas.layout.looks
    worn = 0.1 + 0.3 * looks[11] + 0.65 * canvas.air.snow
    white, yellow = mix((235, 235, 232), asphalt, worn), mix((225, 170, 45), asphalt, worn)
    centre = yellow if looks[12] < 0.45 else white
    half, far = 0.07 + 0.05 * looks[13], 160.0
    highway = scene.surroundings == "highway"
    edges = [layout.right, layout.opposite_right if highway else layout.opposite_left]
    canvas.bands([(x - half, x + half) for x in edges], 1, far, white)
    if highway or looks[14] < 0.6:  # solid, doubled when very solid
        gap = 0.14 if looks[14] < 0.3 and not highway else 0.0
        middle = [layout.left - gap, layout.left + gap]
        canvas.bands([(x - half, x + half) for x in middle], 1, far, centre)
    dashed = list(np.arange(layout.left + layout.lane_m, layout.right - 1, layout.lane_m))
    dashed += list(
        np.arange(layout.opposite_left + layout.lane_m, layout.opposite_right - 1, layout.lane_m)
    )
    if not highway and looks[14] >= 0.6:
        dashed.append(layout.left)
    _dashes(canvas, dashed, half, white if highway else mix(white, centre, 0.5))


def _dashes(canvas: Canvas, offsets: list[float], half: float, colour: Colour) -> None:
    """Dashed lines of 3-4 m with gaps, all in one drawing call."""
    if not offsets:
        return
    dash, period = 3.0 + canvas.layout.looks[15], 7.0 + 6.0 * canvas.layout.looks[13]
    z = np.maximum(1.2, np.arange(-period * canvas.layout.looks[15], 100, period))
    x = np.asarray(offsets)[:, None, None] + np.array([-half, half, half, -half])
    depth = z[None, :, None] + np.array([0, 0, dash, dash])
    x, depth = np.broadcast_arrays(x, depth)
    points = np.stack([x.ravel(), np.zeros(x.size), depth.ravel()], axis=1)
    canvas.fill(list(canvas.camera.project(points).reshape(-1, 4, 2)), colour)


def _crossing(canvas: Canvas, asphalt: Colour) -> None:
    """Crossing road with its edge lines, and a zebra or a stop line on the own side."""
    layout = canvas.layout
    assert layout.crossing is not None
    low, high = layout.crossing
    paint = mix((232, 232, 230), asphalt, 0.15 + 0.55 * canvas.air.snow)
    left, right = layout.opposite_left, layout.right
    canvas.band(-90, 90, low, high, asphalt)
    middle, far = (low + high) / 2, high - 0.3
    for start, end in ((-90.0, left - 1), (right + 1, 90.0)):
        canvas.band(start, end, middle - 0.1, middle + 0.1, paint)
        canvas.band(start, end, far - 0.08, far + 0.08, paint)
    if layout.looks[10] < 0.75:
        for zebra in (low - 4.2, high + 0.8):
            x = np.arange(left + 0.3, right - 0.4, 1.0)[:, None] + np.array([0, 0.5, 0.5, 0])
            z = np.broadcast_to(zebra + np.array([0, 0, 3.2, 3.2]), x.shape)
            points = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
            canvas.fill(list(canvas.camera.project(points).reshape(-1, 4, 2)), paint)
    canvas.band(layout.left + 0.2, right - 0.2, low - 5.6, low - 5.1, paint)


def draw_shadows(canvas: Canvas) -> None:
    """Hard shadows of everything that stands on the ground, towards the far side of the sun."""
    camera, air = canvas.camera, canvas.air
    if air.shadow == 0:
        return
    first = int(camera.v0)
    mask = np.zeros(canvas.image.shape[:2], np.uint8)
    for thing in canvas.layout.things:
        if thing.z > 70 or thing.kind in ("gantry", "sign"):
            continue
        w, h, length = thing.size
        tree = thing.kind == "tree"
        w, length = (
            (w, w) if tree else (w, max(length, 0.3)) if thing.facing != "side" else (length, w)
        )
        if thing.kind in ("lamp", "signal"):
            w, length = 0.15, 0.15
        corners = np.array([[-w / 2, 0, 0], [w / 2, 0, 0], [w / 2, 0, length], [-w / 2, 0, length]])
        corners += (thing.x, 0, thing.z)
        shift = np.array([air.sun[0] * min(h, 9), 0, air.sun[1] * min(h, 9)])
        ends = corners + shift
        base = corners + shift * 0.4 if tree else corners
        cv2.fillConvexPoly(
            mask, cv2.convexHull(camera.project(np.concatenate([base, ends]))), 255, 0, 4
        )
    factor = cv2.LUT(mask[first:], np.linspace(255, 255 * (1 - air.shadow), 256).astype(np.uint8))
    part = canvas.image[first:]
    cv2.multiply(part, cv2.merge([factor, factor, factor]), dst=part, scale=1 / 255)
