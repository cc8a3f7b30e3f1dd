"""Weather variants of a real photograph: a clear daylight frame in rain, fog, snow, night, low sun.

In: an RGB frame taken from a car in clear daylight, and a random stream. Out: the same frame in
another condition; the same frame, variant and stream give the same bytes. Lights and masks are
made on the small canvas of `frame_view` and enlarged; only the edge of the sky follows the frame.

    python -m data.contact_sheet FOLDER OUT.jpg    # any CPU: the variants of one's own pictures
"""

from dataclasses import dataclass, replace
from typing import Literal, get_args

import cv2
import numpy as np

from ridetune.camera.atmosphere import Atmosphere, Colour, draw_atmosphere
from ridetune.camera.weather import (
    Image,
    add_glow,
    add_precipitation,
    crop,
    paint_ground_texture,
    paint_sky,
)

from .frame_view import Plane, View, read_view, rise

Variant = Literal["rain", "fog", "snow", "night", "low_sun"]
VARIANTS: tuple[Variant, ...] = get_args(Variant)

MIN_SIDE = 64  # px


@dataclass(frozen=True)
class _Light:
    """Light between scene and camera on the canvas: seen = frame * gain + veil."""

    gain: Plane  # [rows, columns, 3]
    veil: Plane  # [rows, columns, 3], 0..255


def vary_weather(frame: Image, variant: Variant, rng: np.random.Generator) -> Image:
    """The frame in another condition; RGB [height, width, 3] in and out, the input stays as it is.

    ValueError where the frame is no RGB picture of 64 px or more, or the variant is unknown.
    """
    shape = frame.shape
    if frame.dtype != np.uint8 or len(shape) != 3 or shape[2] != 3 or min(shape[:2]) < MIN_SIDE:
        raise ValueError(
            f"the frame is {frame.dtype} {shape}; give uint8 RGB [height, width, 3] of "
            f"{MIN_SIDE} px or more"
        )
    if variant not in VARIANTS:
        raise ValueError(f"there is no variant {variant!r}; choose one of {', '.join(VARIANTS)}")
    view = read_view(frame)
    if variant == "low_sun":
        return _low_sun(frame, view, rng)
    draw = {"rain": _rain, "fog": _fog, "snow": _snow, "night": _night}
    return draw[variant](frame, view, draw_atmosphere(variant, rng), rng)


def _mute(frame: Image, saturation: float) -> Image:
    mix = np.eye(3) * saturation + (1 - saturation) * np.array((0.299, 0.587, 0.114))
    return np.asarray(cv2.transform(frame, mix.astype(np.float32)), np.uint8)


def _scaled(colour: Colour, factor: float) -> Colour:
    return (colour[0] * factor, colour[1] * factor, colour[2] * factor)


def _daylight(view: View, air: Atmosphere) -> _Light:
    """Flat light of a covered sky, and Koschmieder's haze by depth."""
    passed = np.exp(np.float32(-air.extinction) * view.depth)[..., None]
    gain = view.flat[..., None] * passed * np.array(air.light, np.float32)
    return _Light(gain, (1 - passed) * np.array(air.haze, np.float32))


def _sky(view: View, air: Atmosphere, rng: np.random.Generator) -> Image:
    """Sky of the atmosphere on the canvas; below the horizon it goes on as haze."""
    sky = np.empty_like(view.canvas)
    sky[:] = np.array(air.sky_low, np.uint8)
    paint_sky(sky, air, view.horizon, rng)
    return np.asarray(cv2.GaussianBlur(sky, (0, 0), 0.01 * sky.shape[1]), np.uint8)


def _compose(frame: Image, view: View, light: _Light, sky: Image | None) -> Image:
    """The frame under a light, with another sky where one is given."""
    size = (frame.shape[1], frame.shape[0])
    peak = float(light.gain.max())  # 8 bits are a third of the work, and no step shows
    gain = cv2.resize((255 / peak * light.gain).astype(np.uint8), size)
    veil = cv2.resize(np.clip(light.veil, 0, 255).astype(np.uint8), size)
    seen = np.asarray(cv2.add(cv2.multiply(frame, gain, scale=peak / 255), veil), np.uint8)
    if sky is not None:
        edge = cv2.cvtColor(view.edge, cv2.COLOR_GRAY2RGB)
        above = cv2.multiply(cv2.resize(sky, size)[: len(edge)], edge, scale=1 / 255)
        below = cv2.multiply(seen[: len(edge)], cv2.bitwise_not(edge), scale=1 / 255)
        seen[: len(edge)] = cv2.add(above, below)
    return seen


def _rain(frame: Image, view: View, air: Atmosphere, rng: np.random.Generator) -> Image:
    light, sky, rows = _daylight(view, air), _sky(view, air, rng), len(view.canvas)
    # A wet road mirrors more the flatter one looks at it.
    flatter = np.exp(-np.maximum(np.arange(rows) - view.horizon, 0) / (0.15 * rows))[:, None]
    wet = ((0.3 + 0.7 * air.wet) * view.road * (0.25 + 0.55 * flatter))[..., None]
    gain = light.gain * (1 - wet) * (1 - 0.35 * air.wet * view.road[..., None])
    veil = light.veil * (1 - wet) + _mirror(view, sky, light) * wet
    seen = _compose(_mute(frame, 0.6), view, _Light(gain, veil), sky)
    air = replace(air, drops=0.6 * air.drops, fall=0.3 + 0.7 * air.fall)
    return _fall_through(seen, air, rng)


def _mirror(view: View, sky: Image, light: _Light) -> Plane:
    """What a wet road shows: the picture above the horizon upside down, smeared downwards."""
    rows, above = len(view.canvas), view.sky[..., None]
    scene = (_mute(view.canvas, 0.3) * light.gain + light.veil) * (1 - above) + sky * above
    flipped = np.clip(2 * view.horizon - np.arange(rows), 0, rows - 1)
    return np.asarray(cv2.blur(scene[flipped], (3, max(rows // 8, 3))))


def _fall_through(image: Image, air: Atmosphere, rng: np.random.Generator) -> Image:
    """Streaks and clear drops, drawn at most 640 px wide: at full size streaks are too thin to see.

    Only what they add to the picture and take from it is enlarged; its own detail stays.
    """
    height, width = image.shape[:2]
    columns = min(width, 640)
    size = (columns, max(round(height * columns / width), 8))
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    wet = add_precipitation(small, air, rng)
    more, less = (
        cv2.resize(cv2.convertScaleAbs(cv2.subtract(x, y), alpha=0.9), (width, height))
        for x, y in ((wet, small), (small, wet))
    )
    return np.asarray(cv2.subtract(cv2.add(image, more), less), np.uint8)


def _fog(frame: Image, view: View, air: Atmosphere, rng: np.random.Generator) -> Image:
    air = replace(air, sky_top=air.haze)  # a darker sky would turn trees into bright ghosts
    return _compose(_mute(frame, 0.55), view, _daylight(view, air), _sky(view, air, rng))


def _snow(frame: Image, view: View, air: Atmosphere, rng: np.random.Generator) -> Image:
    # Lying snow lights the scene and the clouds: less would look like rain.
    lift = 235 / max(*air.haze, *air.sky_low, 160.0)
    air = replace(
        air,
        light=_scaled(air.light, 0.85 / max(air.light)),
        sky_top=_scaled(air.sky_top, lift),
        sky_low=_scaled(air.sky_low, lift),
        haze=_scaled(air.haze, lift),
        fall=0.4 + 0.6 * air.fall,
    )
    # Snow shows a third of the relief below it, and has no shade of its own to take away.
    cover, light = _snow_cover(view, air, rng)[..., None], _daylight(view, air)
    bright = light.gain / view.flat[..., None]
    gain = light.gain * (1 - cover) + 0.35 * bright * cover
    light = _Light(gain, light.veil + 180 * bright * cover)
    seen = _compose(_mute(frame, 0.5), view, light, _sky(view, air, rng))
    return add_precipitation(seen, air, rng)


def _snow_cover(view: View, air: Atmosphere, rng: np.random.Generator) -> Plane:
    """Weight of lying snow on the canvas: on all that grows, and on the road between the tracks."""
    rows, columns = view.canvas.shape[:2]
    noise = np.full_like(view.canvas, 128)
    paint_ground_texture(noise, view.horizon, 1.0, float(rng.random()))
    lane = (view.right + 1.75) % 3.5 - 1.75  # m from the middle of a lane
    tracks = np.exp(-(((np.abs(lane) - 0.8) / 0.4) ** 2))
    level = (noise[..., 0] - 128.0) / 60 + 0.5 + 0.7 * air.snow - 1.1 * tracks
    r, g, b = (view.canvas[..., i].astype(np.float32) for i in range(3))
    growth = np.clip((np.minimum(r, g) - b - 2) / 20, 0, 1) * np.clip((g - 25) / 60, 0, 1)
    growth *= 0.5 + 0.5 * rise(rows, view.horizon - 0.06 * rows, 0.06)
    cover = np.maximum(view.road * np.clip(level, 0.1, 0.9), growth)
    return np.asarray(cv2.GaussianBlur(cover, (0, 0), 0.004 * columns))


def _night(frame: Image, view: View, air: Atmosphere, rng: np.random.Generator) -> Image:
    dim = min(1.0, 26 / max(air.sky_top))  # no dusk: it is hard to tell from rain
    air = replace(air, sky_top=_scaled(air.sky_top, dim), sky_low=_scaled(air.sky_low, dim))
    moon = dim * (0.05 + 0.5 * np.array(air.light)) * (0.8, 0.95, 1.25)
    near = np.clip(view.depth / 5, 0.25, 1) * np.exp(-view.depth / 22)
    low = np.exp(-np.logaddexp(0, (view.horizon / len(near) - np.linspace(0, 1, len(near))) / 0.03))
    cone = np.exp(-((view.right / (2.2 + 0.2 * view.depth)) ** 2)) * near * low[:, None]
    # A sunlit concrete road is not to look floodlit.
    road = np.average(view.canvas[..., 1] * view.flat, weights=view.road + 1e-3)
    strength = 1.5 * air.headlamp * min(1.0, 80 / max(float(road), 1.0))
    beam = strength * cone[..., None] * (1.0, 0.95, 0.82)
    lamps, halo = _lamps(view)
    light = _Light(np.maximum(view.flat[..., None] * (moon + beam), lamps[..., None]), halo)
    seen = _compose(_mute(frame, 0.75), view, light, _sky(view, air, rng))
    return _grain(seen, 3 + 4 * rng.random(), rng)


def _lamps(view: View) -> tuple[Plane, Plane]:
    """Weight of small bright or red lights, and their halos [rows, columns, 3]."""
    rows, columns = view.canvas.shape[:2]
    r, g, b = (view.canvas[..., i] for i in range(3))
    size = np.ones((max(columns // 45, 3),) * 2, np.uint8)
    red = cv2.morphologyEx(cv2.subtract(r, cv2.max(g, b)), cv2.MORPH_TOPHAT, size)
    white = cv2.morphologyEx(cv2.min(r, cv2.min(g, b)), cv2.MORPH_TOPHAT, size)
    near_sky = cv2.blur(cv2.dilate(view.sky, np.ones((15, 15), np.uint8)), (9, 9))
    # Gaps in a tree show the sky, and on the road white is paint.
    lit = (white - 90.0) / 60 * (b <= r) * (1 - near_sky) * (1 - rise(rows, view.horizon, 0.06))
    weight = np.clip(np.maximum((red - 45.0) / 40, lit), 0, 1).astype(np.float32)
    shine = (view.canvas * weight[..., None]).astype(np.float32)
    wide = cv2.resize(shine, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    wide = cv2.resize(cv2.GaussianBlur(wide, (0, 0), 0.0075 * columns), (columns, rows))
    return weight, 0.6 * cv2.GaussianBlur(shine, (0, 0), 0.006 * columns) + 1.5 * wide


def _grain(image: Image, strength: float, rng: np.random.Generator) -> Image:
    """The picture with sensor noise of a deviation in grey levels, coarser in a wider frame."""
    height, width = image.shape[:2]
    columns = min(width, 1280)
    rows = round(height * columns / width)
    tile = 128 + 4 * strength * rng.standard_normal((192, 192, 3), np.float32)
    repeats = (rows // 192 + 2, columns // 192 + 2, 1)
    tiled = np.tile(np.clip(tile, 0, 255).astype(np.uint8), repeats)
    noise = cv2.resize(crop(tiled, rows, columns, rng), (width, height))
    return np.asarray(cv2.addWeighted(image, 1.0, noise, 0.25, -32), np.uint8)


def _low_sun(frame: Image, view: View, rng: np.random.Generator) -> Image:
    """Warm light and glare from the front; where no sky is free, the sun stands behind the car."""
    rows, columns = view.canvas.shape[:2]
    sun, power = _place_sun(view, rng), rng.uniform(0.75, 1.0)
    down = np.arange(rows)[:, None] - view.horizon
    band = np.exp(-np.abs(down) / (0.2 * rows))[..., None]
    veil = np.zeros((rows, columns, 3)) + (30, 17, 7) + 60 * power * band * (1.0, 0.6, 0.22)
    if sun is not None:
        reach = 0.05 * columns + 0.25 * np.maximum(down, 0)
        glitter = np.exp(-(((np.arange(columns) - sun[0]) / reach) ** 2)) * view.road
        veil += 100 * power * glitter[..., None] * (1.0, 0.74, 0.44)
    shine = np.clip(veil, 0, 255).astype(np.uint8)
    if sun is not None:
        add_glow(shine, sun, 0.6 * columns, (235, 150, 65), power)
        add_glow(shine, sun, 0.16 * columns, (255, 240, 200), power)
    warm = 1 - np.array((0.1, 0.27, 0.46)) * (0.7 + 0.3 * band)
    gain = view.flat[..., None] ** 0.3 * warm * (1 - 0.15 * band)
    return _compose(frame, view, _Light(gain, shine.astype(np.float32)), None)


def _place_sun(view: View, rng: np.random.Generator) -> tuple[float, float] | None:
    """Column and row of a sun close above what stands before the sky; None without a free sky."""
    rows, columns = view.sky.shape
    free = view.sky > 0.9
    lowest = np.where(free.any(axis=0), rows - 1 - np.argmax(free[::-1], axis=0), 0)
    fit = np.flatnonzero((lowest > 0.1 * rows) & (lowest > lowest.max() - 0.12 * rows))
    fit = fit[(fit > 0.08 * columns) & (fit < 0.92 * columns)]
    if not len(fit):
        return None
    column = int(fit[int(rng.integers(len(fit)))])
    return float(column), float(lowest[column] - rows * rng.uniform(0.01, 0.08))
