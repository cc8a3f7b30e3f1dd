"""Synthetic front camera: scenes with known content, drawn fast enough to train on the fly.

In: a `Scene`. Out: an RGB picture. Geometry comes from a random stream of the seed alone, weather
from a second one, the camera from a third, so `with_condition` changes nothing but the weather.
"""

from dataclasses import replace

import cv2
import numpy as np

from ridetune.sample import CONDITIONS

from . import sensor, weather
from .atmosphere import draw_atmosphere
from .canvas import Canvas, mix, scale
from .ground import draw_ground, draw_shadows
from .obstacles import OBSTACLES, draw_obstacle
from .roadside import draw_building, draw_post, draw_rails, draw_tree
from .scene import Scene
from .skyline import draw_skyline
from .street import PAINTS, VEHICLES, Layout, Thing, draw_layout
from .vehicles import draw_vehicle
from .weather import Image


def render(scene: Scene, width: int = 448, height: int = 256) -> Image:
    """Picture of a scene: RGB uint8 [height, width, 3], the same for the same arguments."""
    return paint(scene, draw_layout(scene, width, height))


def paint(scene: Scene, layout: Layout) -> Image:
    """Picture of a layout under the sky, in the weather and through the lens of a scene."""
    width, height = layout.camera.width, layout.camera.height
    rng = np.random.default_rng([scene.seed, 1, CONDITIONS.index(scene.condition)])
    air = draw_atmosphere(scene.condition, rng)
    canvas = Canvas(np.empty((height, width, 3), np.uint8), layout, air, [])
    camera = layout.camera
    horizon = int(camera.v0)
    weather.paint_sky(canvas.image, air, horizon + 1, rng)
    draw_ground(canvas, scene)
    weather.paint_ground_texture(
        canvas.image, horizon, 0.25 + 0.4 * layout.looks[0], layout.looks[1]
    )
    draw_shadows(canvas)
    weather.light_ground(
        canvas.image, air, horizon=camera.v0, focal_height=camera.focal * camera.mount_m
    )
    draw_skyline(canvas, scene.surroundings)
    _draw_things(canvas, scene)
    for u, v, radius, colour, gain in canvas.lights:
        weather.add_glow(canvas.image, (u, v), radius, colour, gain)
    image = weather.add_precipitation(canvas.image, air, rng)
    if image is not canvas.image:
        canvas = replace(canvas, image=image)
    _bonnet(canvas)
    return sensor.expose(
        canvas.image, np.random.default_rng([scene.seed, 2]), dark=air.headlamp > 0
    )


def _draw_things(canvas: Canvas, scene: Scene) -> None:
    """All things from far to near, with their mirror images on wet road."""
    if scene.surroundings == "highway":
        draw_rails(canvas)
    for thing in canvas.layout.things:
        if thing.kind == "building":
            draw_building(canvas, thing)
        elif thing.kind == "tree":
            draw_tree(canvas, thing)
        elif thing.kind in VEHICLES:
            draw_vehicle(canvas, thing)
            if canvas.air.wet > 0.1 and thing.z < 45:
                _mirror(canvas, thing)
        elif thing.kind in OBSTACLES:
            draw_obstacle(canvas, thing)
        else:
            draw_post(canvas, thing)


def _mirror(canvas: Canvas, thing: Thing) -> None:
    w, h, _ = thing.size
    corners = np.array([[thing.x - w / 2, h, thing.z], [thing.x + w / 2, 0, thing.z]])
    (u0, v0), (u1, v1) = canvas.camera.project(corners) // 16
    weather.reflect(canvas.image, (int(u0), int(v0), int(u1), int(v1)), 0.5 * canvas.air.wet)
    if canvas.air.fall > 0.4 and thing.facing == "rear":  # spray behind the wheels
        metre = canvas.camera.focal / thing.z
        haze = scale(canvas.air.haze, 0.9)
        for u in (int(u0), int(u1)):
            weather.add_glow(canvas.image, (u, v1 - 0.2 * metre), 0.9 * metre, haze, 0.35)


def _bonnet(canvas: Canvas) -> None:
    """Sometimes the own bonnet or dashboard at the lower edge."""
    looks, (height, width) = canvas.layout.looks, canvas.image.shape[:2]
    if looks[4] > 0.45:
        return
    rise = height * (0.03 + 0.22 * looks[4])
    centre = (int(width * (0.5 + 0.1 * (looks[5] - 0.5)) * 16), int((height + 1.2 * rise) * 16))
    paint = mix((30, 30, 33), PAINTS[int(looks[6] * len(PAINTS))], 0.6 * looks[7])
    axes = (int(width * 0.75 * 16), int(2.2 * rise * 16))
    colour = scale(paint, canvas.air.light[1] * 0.8 + 0.02)
    cv2.ellipse(canvas.image, centre, axes, 0, 180, 360, colour, -1, cv2.LINE_AA, 4)
