"""Light and air of a synthetic picture, drawn at random for each condition.

In: a condition and a random stream. Out: an `Atmosphere` (light, haze, sky, wetness, snow) for
the street drawing and the effects of `data.weather`.
"""

from dataclasses import dataclass
from math import exp

import numpy as np

from ridetune.sample import Condition

Colour = tuple[float, float, float]  # RGB, 0..255 for colours, about 0..1 for light


@dataclass(frozen=True)
class Atmosphere:
    """Light and air of one frame; distances in metres, x to the right, z forward."""

    condition: Condition
    light: Colour = (1.0, 1.0, 1.0)  # factor on every albedo
    sky_top: Colour = (90.0, 140.0, 195.0)
    sky_low: Colour = (175.0, 195.0, 215.0)
    cloud: float = 0.0  # opacity of the clouds, 0..1
    haze: Colour = (180.0, 190.0, 205.0)  # colour of infinitely distant things
    extinction: float = 0.001  # Koschmieder: transmission exp(-extinction * z), 1/m
    shadow: float = 0.0  # darkness of cast shadows, 0..1
    sun: tuple[float, float] = (0.0, 0.0)  # shadow (right, forward) in m per m of height
    glare: float = 0.0  # strength of the sun in the picture
    headlamp: float = 0.0  # own headlamps at 0 m, in units of light
    lamps: float = 0.0  # brightness of all vehicle and street lamps, 0..1
    glow: float = 0.0  # size of halos round lamps
    wet: float = 0.0
    snow: float = 0.0  # cover of the road; verges are covered whenever positive
    fall: float = 0.0  # density of rain streaks or flakes, 0..1
    drops: float = 0.0  # drops on the windscreen, 0..1

    def beam(self, x: float, z: float) -> float:
        """Own headlamp light at ground point (x, z)."""
        if self.headlamp == 0.0:
            return 0.0
        return self.headlamp * exp(-z / 24.0 - (x / (2.2 + 0.2 * z)) ** 2)

    def shade(self, colour: Colour, x: float, z: float) -> Colour:
        """Colour 0..255 of a surface at (x, z) as the camera sees it: light, then haze."""
        t, e = exp(-self.extinction * z), self.beam(x, z)
        return (
            min(255.0, colour[0] * (self.light[0] + e)) * t + self.haze[0] * (1 - t),
            min(255.0, colour[1] * (self.light[1] + e)) * t + self.haze[1] * (1 - t),
            min(255.0, colour[2] * (self.light[2] + 0.9 * e)) * t + self.haze[2] * (1 - t),
        )


def _grey(level: float, tint: float) -> Colour:
    """Grey of about `level`; a positive tint is bluish, a negative one warm."""
    return (level * (1 - tint), level, level * (1 + tint))


def draw_atmosphere(condition: Condition, rng: np.random.Generator) -> Atmosphere:
    """Random severity of one condition; `rng` must be the weather stream of the scene."""
    draw = {"sunny": _sunny, "rain": _rain, "fog": _fog, "snow": _snow, "night": _night}
    return draw[condition](rng)


def _sunny(rng: np.random.Generator) -> Atmosphere:
    u = rng.random(10)
    blue, low_sun = u[0], u[1] < 0.25
    level = 0.85 + 0.5 * u[2]
    top = (40 + 75 * blue, 70 + 90 * blue, 105 + 105 * blue)
    pale = 0.35 + 0.5 * u[3]
    low: Colour = (
        top[0] + (225 - top[0]) * pale,
        top[1] + (228 - top[1]) * pale,
        top[2] + (230 - top[2]) * pale,
    )
    warm = 0.12 * u[4] if low_sun else 0.04 * u[4]
    length = 1.5 + 2.0 * u[5] if low_sun else 0.3 + 0.9 * u[5]
    angle = 2 * np.pi * u[6]
    return Atmosphere(
        "sunny",
        light=(level * (1 + warm), level, level * (1 - warm)),
        sky_top=top,
        sky_low=low,
        cloud=max(0.0, 1.6 * u[7] - 0.6),
        haze=low,
        extinction=0.0006 + 0.002 * u[8] ** 2,
        shadow=0.35 + 0.35 * u[9],
        sun=(float(length * np.cos(angle)), float(length * np.sin(angle))),
        glare=1.0 if (low_sun and np.sin(angle) < 0) or u[4] > 0.9 else 0.0,
    )


def _rain(rng: np.random.Generator) -> Atmosphere:
    u = rng.random(8)
    level, tint = 100 + 90 * u[0], 0.07 * u[1] - 0.02
    light = 0.42 + 0.42 * u[0]
    low = _grey(level * (0.95 + 0.2 * u[2]), tint)
    return Atmosphere(
        "rain",
        light=(light * (1 - tint), light, light * (1 + tint)),
        sky_top=_grey(level * (0.7 + 0.3 * u[2]), tint),
        sky_low=low,
        cloud=0.25 * u[3],
        haze=low,
        extinction=0.004 + 0.012 * u[4],
        lamps=0.9,
        glow=0.6,
        wet=0.5 + 0.5 * u[5],
        fall=0.25 + 0.75 * u[6],
        drops=max(0.0, 1.5 * u[7] - 0.5),
    )


def _fog(rng: np.random.Generator) -> Atmosphere:
    u = rng.random(5)
    level, tint = 125 + 95 * u[0], 0.06 * u[1] - 0.02
    light = 0.4 + 0.4 * u[0]
    haze = _grey(level, tint)
    return Atmosphere(
        "fog",
        light=(light, light, light),
        sky_top=_grey(level * (0.88 + 0.14 * u[2]), tint),
        sky_low=haze,
        haze=haze,
        extinction=0.018 + 0.075 * u[3] ** 1.5,
        lamps=0.75,
        glow=0.8,
        wet=0.25 * u[4],
    )


def _snow(rng: np.random.Generator) -> Atmosphere:
    u = rng.random(6)
    level, tint = 125 + 85 * u[0], 0.14 * u[1] - 0.01
    light = 0.5 + 0.35 * u[0]
    low = _grey(level * 1.06, tint)
    return Atmosphere(
        "snow",
        light=(light * (1 - tint), light, light * (1 + tint)),
        sky_top=_grey(level * (0.8 + 0.2 * u[2]), tint),
        sky_low=low,
        cloud=0.2 * u[2],
        haze=low,
        extinction=0.004 + 0.014 * u[3],
        lamps=0.6,
        glow=0.4,
        snow=0.25 + 0.75 * u[4],
        fall=0.2 + 0.8 * u[5],
    )


def _night(rng: np.random.Generator) -> Atmosphere:
    u = rng.random(6)
    dusk = u[0] < 0.15
    level = 60 + 60 * u[1] if dusk else 3 + 22 * u[1] ** 2
    light = 0.12 + 0.15 * u[1] if dusk else 0.02 + 0.07 * u[1] ** 2
    tint = 0.18 * u[2] if dusk else 0.7 * u[2] - 0.4
    low: Colour = _grey(level * 1.3, -0.1 if dusk else tint)
    return Atmosphere(
        "night",
        light=(light * (1 - 0.3 * tint), light, light * (1 + 0.3 * tint)),
        sky_top=_grey(level * 0.75, tint),
        sky_low=low,
        cloud=0.5 * u[3] if dusk else 0.0,
        haze=low,
        extinction=0.002,
        headlamp=0.45 + 0.75 * u[4],
        lamps=1.0,
        glow=0.7 + 0.6 * u[5],
        wet=0.7 * max(0.0, u[3] * 2 - 1),
    )
