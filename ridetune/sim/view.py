"""What the front camera sees at a moment of a simulated drive.

In: a `Moment`, its scenario, the condition, and the number of a street. Out: a `Scene` that says
it in words, an RGB picture, or the JPEG bytes that a policy reads. Lead car, lanes, curve, crossing
and obstacles stand where the simulation has them; the street's looks come from its number. The
camera is the synthetic one that the dataset's pictures come from: a cartoon of a road, not a road.
"""

import math
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np

from ridetune.camera.render import paint
from ridetune.camera.scene import Lead, Road, Scene
from ridetune.camera.situation import Situation, place
from ridetune.camera.street import PAINTS, VEHICLES, Lanes, Thing
from ridetune.camera.weather import Image
from ridetune.control.kernel import Numbers
from ridetune.control.path import CURVATURE, SPACING_M, Path, X, Y, locate, wrap
from ridetune.sample import Condition
from ridetune.sim.drive import Moment
from ridetune.sim.scenarios import LANE_M, Actor, Arc, Scenario, Shift, Straight

WIDTH, HEIGHT, JPEG_QUALITY = 448, 256, 88
# Behind the windscreen, ahead of the rear axle [m].
CAMERA_M = 1.9
# A turn this tight leads through an intersection: until it begins one sees the road that crosses.
_TIGHT_TURN_M = 30.0
# How far ahead a bend or a lead car is mentioned; a lead is close up to the second [m].
_MENTIONED_M, _CLOSE_M = 60.0, 20.0
_LEAST_CURVATURE = 1e-3
# From the line into which one turns left to the near and the far edge of the crossing road [m].
_CROSSING_NEAR_M, _CROSSING_FAR_M = 1.5 * LANE_M, 0.5 * LANE_M + 0.5
_KINDS: tuple[Literal["car", "suv"], ...] = ("car", "suv")


def photograph(moment: Moment, scenario: Scenario, condition: Condition, street: int = 0) -> bytes:
    """The frame as JPEG bytes, as the policy gets it; the same for the same arguments."""
    picture = cv2.cvtColor(look(moment, scenario, condition, street), cv2.COLOR_RGB2BGR)
    done, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert done
    return bytes(jpeg.tobytes())


def look(
    moment: Moment,
    scenario: Scenario,
    condition: Condition,
    street: int = 0,
    *,
    width: int = WIDTH,
    height: int = HEIGHT,
) -> Image:
    """The picture, RGB uint8 [height, width, 3]."""
    scene = scene_of(moment, scenario, condition, street)
    return paint(scene, place(scene, situate(moment, scenario, street), width, height))


def scene_of(moment: Moment, scenario: Scenario, condition: Condition, street: int = 0) -> Scene:
    """What `camera.scene.describe` says of the moment; the looks of a street never change."""
    seen = situate(moment, scenario, street)
    road: Road = "straight"
    if seen.bend and seen.bend_start_m < _MENTIONED_M:
        road = "left curve" if seen.bend < 0 else "right curve"
    elif seen.crossing:
        road = "intersection"
    ahead = [
        t.z
        for t in seen.things
        if t.kind in VEHICLES and t.z > 0.0 and abs(t.x + seen.offset_m) < 0.5 * LANE_M
    ]
    nearest = min(ahead, default=math.inf)
    lead: Lead = "none"
    if nearest < _MENTIONED_M:
        lead = "near" if nearest < _CLOSE_M else "far"
    return Scene(
        condition=condition,
        road=road,
        lead=lead,
        traffic="light",
        surroundings=("city", "country")[street % 2],
        seed=street,
    )


def situate(moment: Moment, scenario: Scenario, street: int = 0) -> Situation:
    """Where the lanes, the bend and everything on the road are, as the camera has them."""
    table = _road(scenario)
    heading = moment.heading_rad
    x, y = moment.x_m + CAMERA_M * math.cos(heading), moment.y_m + CAMERA_M * math.sin(heading)
    near = int(np.argmin((table[:, X] - x) ** 2 + (table[:, Y] - y) ** 2))
    _, at_m, left_m, along = locate(table, near, x, y)
    bend, start_m, end_m = _bend_ahead(table, at_m)
    crossing = None
    if abs(bend) > 1.0 / _TIGHT_TURN_M and start_m > 0.0:
        turn_m = start_m + 1.0 / abs(bend)
        crossing = (turn_m - _CROSSING_NEAR_M, turn_m + _CROSSING_FAR_M)
        bend = 0.0
    things = [
        _thing(actor, number, middle, at_m, street)
        for number, (actor, middle) in enumerate(zip(scenario.actors, moment.actors, strict=True))
    ]
    return Situation(
        lanes=_lanes(scenario),
        travelled_m=at_m,
        offset_m=left_m,
        slope=math.tan(float(np.clip(wrap(heading - along), -1.0, 1.0))),
        bend=bend,
        bend_start_m=start_m,
        bend_end_m=end_m,
        crossing=crossing,
        things=tuple(thing for thing in things if thing is not None),
    )


@lru_cache(maxsize=32)
def _road(scenario: Scenario) -> Numbers:
    """The road that the path lies on [point, column]: a change of lane bends the path alone."""
    straight = tuple(Straight(s.length_m) if isinstance(s, Shift) else s for s in scenario.path)
    points = Scenario(scenario.name, scenario.about, straight, 0.0, 0.0).waypoints()
    return Path.of(points, 0.0).table


def _bend_ahead(table: Numbers, at_m: float) -> tuple[float, float, float]:
    """Curvature [1/m, positive to the right], start and end [m] of the next bend; 0 if none."""
    here = min(max(round(at_m / SPACING_M), 0), len(table) - 1)
    bent = np.abs(table[here:, CURVATURE]) > _LEAST_CURVATURE
    if not bent.any():
        return 0.0, 0.0, math.inf
    first = int(np.argmax(bent))
    length = len(bent) - first if bent[first:].all() else int(np.argmin(bent[first:]))
    part = table[here + first : here + first + length, CURVATURE]
    curvature = float(part[np.argmax(np.abs(part))])
    return -curvature, first * SPACING_M, (first + length) * SPACING_M


def _lanes(scenario: Scenario) -> Lanes:
    """A lane to the left where the path or a car goes there, one to the right for parked cars."""
    cars = [actor.lateral_m for actor in scenario.actors if actor.kind == "car"]
    shifts = [s.offset_m for s in scenario.path if isinstance(s, Shift)]
    turns = any(isinstance(s, Arc) for s in scenario.path)
    left = max([0.0, *cars, *shifts]) > 0.5 * LANE_M and not turns
    return Lanes(int(left), int(min([0.0, *cars]) < -0.5 * LANE_M), LANE_M)


def _thing(
    actor: Actor, number: int, middle: tuple[float, float] | None, at_m: float, street: int
) -> Thing | None:
    """An actor as the camera draws it; a closed stop line is the red signal beside it."""
    if middle is None:
        return None
    rng = np.random.default_rng([street, 5, number])
    paint_of = PAINTS[int(rng.integers(len(PAINTS)))]
    z, x = middle[0] - 0.5 * actor.length_m - at_m, -middle[1]
    if actor.kind == "stop_line":
        return Thing("signal", LANE_M, z, (0.5, 3.8, 0.0), (40, 42, 44))
    if actor.kind == "car":
        kind = _KINDS[int(rng.integers(len(_KINDS)))]
        size = (actor.width_m, VEHICLES[kind][1], actor.length_m)
        # Brake lights belong to a variant below 0.3; these cars do not brake.
        return Thing(kind, x, z, size, paint_of, "rear", 0.3 + 0.7 * float(rng.random()))
    height = {"pedestrian": 1.75, "barrier": 1.1, "bag": 0.6}[actor.kind]
    return Thing(actor.kind, x, z, (actor.width_m, height, actor.length_m), paint_of)
