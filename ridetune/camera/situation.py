"""A street seen from a given state: the picture of what happens, not of what the seed draws.

In: a `Scene` for the looks of the street, and a `Situation` for what stands where. Out: a `Layout`.
The seed still picks the camera, colours and roadside; the roadside passes by as the car moves.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from .scene import Scene
from .street import VEHICLES, Lanes, Layout, Thing, draw_layout, open_crossing

# The roadside repeats after this distance, and begins this far ahead of the camera [m].
_ROADSIDE_M, _NEAREST_M = 110.0, 4.0
# What stands nearer than this to the camera's plane is out of the picture [m].
_OUT_OF_VIEW_M = 2.5


@dataclass(frozen=True)
class Situation:
    """What is where around the camera, in metres along and beside the own lane's middle line.

    offset_m, slope: that line at the camera, to the right, and its slope to the right [m/m].
    bend, bend_start_m, bend_end_m: curvature of the road [1/m], positive to the right, and where
        it begins and ends. crossing: depth range of a crossing road. travelled_m: how far the car
        has come. things: everything that is no roadside, z from the camera to its near end.
    """

    lanes: Lanes
    travelled_m: float = 0.0
    offset_m: float = 0.0
    slope: float = 0.0
    bend: float = 0.0
    bend_start_m: float = 0.0
    bend_end_m: float = math.inf
    crossing: tuple[float, float] | None = None
    things: tuple[Thing, ...] = ()


def place(scene: Scene, situation: Situation, width: int, height: int) -> Layout:
    """The layout of a situation on the street of a scene, for one picture size."""
    plain = replace(scene, road="straight", lead="none", traffic="light")
    layout = draw_layout(plain, width, height, situation.lanes)
    camera = replace(
        layout.camera,
        bend=situation.bend,
        bend_start_m=situation.bend_start_m,
        bend_end_m=situation.bend_end_m,
        offset_m=situation.offset_m,
        slope=situation.slope,
    )
    layout = replace(layout, camera=camera, crossing=situation.crossing)
    roadside = [
        _pass_by(thing, situation.travelled_m)
        for thing in layout.things
        if thing.kind not in VEHICLES and thing.kind != "gantry"
    ]
    if layout.crossing:
        roadside = open_crossing(roadside, layout, np.random.default_rng([scene.seed, 4]))
    things = [*roadside, *(thing for thing in situation.things if thing.z > _OUT_OF_VIEW_M)]
    things.sort(key=lambda t: -(t.z + (t.size[2] if t.kind == "building" else 0.0)))
    return replace(layout, things=tuple(things))


def _pass_by(thing: Thing, travelled_m: float) -> Thing:
    """A thing of the roadside after the car has moved; behind the camera it comes round again."""
    first = 1.0 - thing.size[2] if thing.kind == "building" else _NEAREST_M
    return replace(thing, z=first + (thing.z - first - travelled_m) % _ROADSIDE_M)
