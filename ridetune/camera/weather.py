"""Weather effects of the synthetic front camera: sky, ground light, glows, rain and snow.

In: an RGB image under construction, an `Atmosphere`, a random stream. Out: the effects, in place
where they say so. Noise is drawn once per image size and cropped at random, so a frame costs a
few milliseconds.
"""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from .atmosphere import Atmosphere, Colour

Image = NDArray[np.uint8]


@lru_cache(maxsize=4)
def _clouds(width: int, height: int) -> Image:
    """Smooth noise of several octaves, [2 * height, 2 * width, 3]."""
    rng = np.random.default_rng(0)
    total = np.zeros((2 * height, 2 * width), np.float32)
    for octave in range(5):
        cells = rng.random((4 << octave, 3 << octave), dtype=np.float32)
        smooth = cv2.resize(cells, (2 * width, 2 * height), interpolation=cv2.INTER_CUBIC)
        total += np.asarray(smooth, np.float32) / np.float32(1.7**octave)
    scaled = 127 + 115 * (total - total.mean()) / total.std()
    return np.asarray(np.repeat(np.clip(scaled, 0, 255)[..., None], 3, axis=2), np.uint8)


@lru_cache(maxsize=4)
def _ground_noise(width: int, height: int) -> Image:
    """Road and verge texture seen in perspective, mean 128, [height, 2 * width, 3]."""
    rng = np.random.default_rng(1)
    fine = rng.normal(0, 22, (512, 512)).astype(np.float32)
    coarse = cv2.resize(rng.normal(0, 1, (48, 48)).astype(np.float32), (512, 512))
    plane = 128 + cv2.GaussianBlur(fine, (0, 0), 0.8) + 26 * coarse
    rows, columns = np.mgrid[0:height, 0 : 2 * width].astype(np.float32)
    depth = 600.0 * width / 448 / (rows + 6)
    u = (columns - width) * depth / (0.9 * width) * 18
    grid = cv2.remap(plane, u, depth * 6, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    # Far rows would alias: fade them out.
    grid = 128 + (grid - 128) * np.clip(rows / (0.25 * height), 0.15, 1)
    return np.asarray(np.repeat(np.clip(grid, 0, 255)[..., None], 3, axis=2), np.uint8)


@lru_cache(maxsize=16)
def _falling(width: int, height: int, kind: str, level: int) -> Image:
    """Rain streaks or snow flakes as light to add, density level 0..3, with a margin of 64."""
    rng = np.random.default_rng(10 + level)
    layer = np.zeros((height + 64, width + 64, 3), np.uint8)
    scale = width / 448
    count = (60, 130, 240, 380)[level]
    for x, y, size in rng.random((count, 3)):
        at = (int(x * (width + 64)), int(y * (height + 64)))
        grey = int(12 + 38 * rng.random()) if kind == "rain" else int(90 + 130 * rng.random())
        if kind == "rain":
            end = (
                at[0] + int((2 + 4 * level) * scale * size),
                at[1] + int((8 + 24 * size) * scale),
            )
            cv2.line(layer, at, end, (grey, grey, grey), 1, cv2.LINE_AA)
        else:
            radius = int(16 * scale * (0.4 + 2.4 * size**8))
            cv2.circle(layer, (at[0] * 16, at[1] * 16), radius, (grey,) * 3, -1, cv2.LINE_AA, 4)
    return np.asarray(cv2.GaussianBlur(layer, (0, 0), 0.7 * scale), np.uint8)


@lru_cache(maxsize=8)
def _drop_mask(width: int, height: int, level: int) -> NDArray[np.float32]:
    """Opacity of drops on the windscreen, [height + 64, width + 64, 1]."""
    rng = np.random.default_rng(20 + level)
    mask = np.zeros((height + 64, width + 64), np.float32)
    for x, y, size in rng.random((50 + 70 * level, 3)):
        axes = (int((1.5 + 6 * size**4) * width / 448), int((2 + 8 * size**4) * width / 448))
        at = (int(x * (width + 64)), int(y * (height + 64)))
        cv2.ellipse(mask, at, axes, 0, 0, 360, 0.5 + 0.4 * rng.random(), -1, cv2.LINE_AA)
    return cv2.GaussianBlur(mask, (0, 0), 0.8).astype(np.float32)[..., None]


@lru_cache(maxsize=1)
def _halo() -> NDArray[np.float32]:
    """Unit glow sprite with a bright core and a wide skirt, [65, 65, 1]."""
    axis = np.linspace(-1, 1, 65, dtype=np.float32)
    r2 = axis[:, None] ** 2 + axis[None, :] ** 2
    sprite = 0.7 * np.exp(-40 * r2) + 0.3 * np.exp(-6 * r2) - 0.3 * np.exp(-6.0)
    return np.asarray(np.clip(sprite, 0, 1)[..., None], np.float32)


def crop(bank: NDArray[np.generic], height: int, width: int, rng: np.random.Generator) -> Image:
    """Random window [height, width, ...] of a noise bank."""
    y, x = (
        int(rng.integers(0, n - m + 1)) for n, m in zip(bank.shape, (height, width), strict=False)
    )
    return bank[y : y + height, x : x + width]  # type: ignore[return-value]


def _widen(column: NDArray[np.floating], width: int) -> Image:
    """Column [rows, 1, 3] of colours repeated over the width as uint8."""
    size = (width, len(column))
    wide = cv2.resize(column.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    return np.asarray(wide, np.uint8)


def paint_sky(image: Image, air: Atmosphere, horizon: int, rng: np.random.Generator) -> None:
    """Fill the rows above the horizon with gradient, clouds and sun, in place."""
    _, width = image.shape[:2]
    t = np.linspace(0, 1, horizon, dtype=np.float32)[:, None, None] ** 1.5
    column = np.clip(np.array(air.sky_top) * (1 - t) + np.array(air.sky_low) * t, 0, 255)
    sky = _widen(column, width)
    if air.cloud > 0.02:
        noise = crop(_clouds(width, image.shape[0]), horizon, width, rng)
        bright = 235 * min(1.0, air.light[1]) if air.condition == "sunny" else 0.6 * air.sky_low[1]
        opacity = cv2.convertScaleAbs(noise, alpha=air.cloud)
        blue = cv2.subtract(sky, cv2.multiply(sky, opacity, scale=1 / 255))
        sky = np.asarray(cv2.add(blue, cv2.convertScaleAbs(opacity, alpha=bright / 255)), np.uint8)
    image[:horizon] = sky
    if air.glare > 0:
        u, v = int(width * rng.uniform(0.15, 0.85)), int(horizon * rng.uniform(-0.1, 0.6))
        add_glow(image, (u, v), width * 0.45, (255, 245, 215), 1.0)


def paint_ground_texture(image: Image, horizon: int, strength: float, offset: float) -> None:
    """Add perspective noise below the horizon, in place; `offset` 0..1 picks the window."""
    height, width = image.shape[:2]
    start = int(offset * width)
    noise = _ground_noise(width, height)[: height - horizon, start : start + width]
    part = image[horizon:]
    cv2.addWeighted(part, 1.0, noise, strength, -128 * strength, dst=part)


def light_ground(image: Image, air: Atmosphere, *, horizon: float, focal_height: float) -> None:
    """Turn ground albedo into seen colour by true depth, in place.

    `focal_height` is focal length in pixels times camera height in metres: row v lies at
    depth focal_height / (v - horizon).
    """
    height, width = image.shape[:2]
    first = int(horizon)
    rows = np.arange(first, height, dtype=np.float32)
    depth = focal_height / np.maximum(rows - horizon + 0.5, 0.3)
    t = np.exp(-air.extinction * depth)[:, None, None]
    light = np.array(air.light)
    peak = float(light.max()) + air.headlamp  # uint8 gains are in units of the brightest light
    gain = _widen(255 / peak * light * t, width)
    if air.headlamp > 0:
        x = (np.linspace(-0.5, 0.5, width // 4) / 0.9)[None] * depth[:, None]
        near = np.clip(depth / 5.0, 0.25, 1) * np.exp(-depth / 20.0)
        beam = near[:, None] * np.exp(-((x / (2.2 + 0.2 * depth[:, None])) ** 2))
        cone = (255 / peak * air.headlamp * beam[..., None] * (1.0, 0.97, 0.85)).astype(np.uint8)
        gain = np.asarray(cv2.add(gain, cv2.resize(cone, (width, height - first))), np.uint8)
    seen = cv2.multiply(image[first:], gain, scale=peak / 255)
    image[first:] = cv2.add(seen, _widen(np.array(air.haze) * (1 - t), width))


def add_glow(
    image: Image, at: tuple[float, float], radius: float, colour: Colour, gain: float
) -> None:
    """Add a round halo at pixel `at` (u, v), in place."""
    height, width = image.shape[:2]
    r = max(2, int(radius))
    u, v = int(at[0]), int(at[1])
    u0, u1, v0, v1 = max(0, u - r), min(width, u + r + 1), max(0, v - r), min(height, v + r + 1)
    if u0 >= u1 or v0 >= v1:
        return
    sprite = cv2.resize(_halo(), (2 * r + 1, 2 * r + 1))[
        v0 - v + r : v1 - v + r, u0 - u + r : u1 - u + r
    ]
    light = (sprite[..., None] * (np.array(colour, np.float32) * np.float32(gain))).astype(np.uint8)
    image[v0:v1, u0:u1] = cv2.add(image[v0:v1, u0:u1], light)


def reflect(image: Image, box: tuple[int, int, int, int], strength: float) -> None:
    """Mirror the picture box (u0, v0, u1, v1) into the wet road below it, in place."""
    height, width = image.shape[:2]
    u0, v0, u1, v1 = max(0, box[0]), max(0, box[1]), min(width, box[2]), box[3]
    rows = min(v1 - v0, height - v1)
    if rows < 2 or u1 - u0 < 2 or v1 <= 0:
        return
    mirrored = image[v1 - rows : v1, u0:u1][::-1]
    blurred = cv2.blur(mirrored, (3, max(3, rows // 4)))
    part = image[v1 : v1 + rows, u0:u1]
    image[v1 : v1 + rows, u0:u1] = cv2.addWeighted(part, 1 - strength, blurred, strength, 0)


def add_precipitation(image: Image, air: Atmosphere, rng: np.random.Generator) -> Image:
    """Rain streaks, windscreen drops, mist and flakes over the finished picture."""
    height, width = image.shape[:2]
    if air.condition not in ("rain", "snow"):
        return image
    layer = crop(
        _falling(width, height, air.condition, min(3, int(4 * air.fall))), height, width, rng
    )
    image = np.asarray(cv2.add(image, layer), np.uint8)
    if air.drops > 0.05:
        # A drop is a tiny fish-eye: it shows the blurred picture upside down and brighter.
        small = cv2.resize(image, (width // 8, height // 8), interpolation=cv2.INTER_AREA)
        lens = cv2.resize(small[::-1], (width, height))
        mask = crop(_drop_mask(width, height, int(2.99 * air.drops)), height, width, rng)
        image = np.asarray(image + (lens.astype(np.float32) - image) * mask, np.uint8)
        if air.drops > 0.6:
            image = np.asarray(
                cv2.addWeighted(image, 0.8, cv2.resize(small, (width, height)), 0.2, 0), np.uint8
            )
    return image
