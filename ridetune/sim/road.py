"""A scenario in one condition as the arrays that the compiled loop reads."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ridetune.control.headway import Headway
from ridetune.control.kernel import Numbers, kernel
from ridetune.control.path import Path, Y, read_path
from ridetune.control.vehicle import Vehicle
from ridetune.sample import Condition
from ridetune.sim.conditions import EFFECTS
from ridetune.sim.plant import HEADING, X
from ridetune.sim.plant import Y as PLANT_Y
from ridetune.sim.scenarios import Actor, Scenario

# The columns of an actor's positions: its middle [m], speed, acceleration, 1 while it is there.
AT_X, AT_Y, AT_SPEED, AT_ACCELERATION, PRESENT = range(5)
# The columns of an actor's body: half length and width [m], 1 if its clock waits, 1 if solid.
HALF_LENGTH, HALF_WIDTH, WAITS, SOLID = range(4)
# What reaches this near to the swept lane counts as in the way [m].
_MARGIN_M = 0.3


class Road(NamedTuple):
    """The path's table, positions [actor, step, column], bodies [actor, column], and the rest."""

    path: Numbers
    positions: Numbers
    bodies: Numbers
    nose_m: float
    length_m: float
    half_width_m: float
    visibility_m: float
    drive_off_s: float
    initial_mps: float
    headway: Headway


@lru_cache(maxsize=128)
def lay_out(scenario: Scenario, condition: Condition, vehicle: Vehicle, period_s: float) -> Road:
    """A scenario for one vehicle at a control period [s]; kept, for the runs after it."""
    steps = num_steps(scenario, period_s)
    tracks = [_track(a, steps, period_s, vehicle.body.nose_m) for a in scenario.actors]
    bodies = [
        [0.5 * a.length_m, 0.5 * a.width_m, a.trigger == "stopped", a.kind != "stop_line"]
        for a in scenario.actors
    ]
    effects = EFFECTS[condition]
    return Road(
        path=Path.of(scenario.waypoints(), scenario.target_mps).table,
        positions=np.array(tracks, float).reshape(len(tracks), steps, 5),
        bodies=np.array(bodies, float).reshape(len(tracks), 4),
        nose_m=vehicle.body.nose_m,
        length_m=vehicle.body.length_m,
        half_width_m=0.5 * vehicle.body.width_m,
        visibility_m=effects.visibility_m,
        drive_off_s=scenario.drive_off_s,
        initial_mps=scenario.initial_mps,
        headway=Headway().on_friction(effects.friction),
    )


def num_steps(scenario: Scenario, period_s: float) -> int:
    """Control steps of a whole drive."""
    return round(scenario.duration_s / period_s)


def _track(actor: Actor, steps: int, period_s: float, nose_m: float) -> Numbers:
    """Where an actor is at each step of its own clock [step, column]."""
    time = np.arange(steps) * period_s
    acceleration = np.zeros(steps)
    start = 0.0
    for phase in actor.phases:
        inside = (time >= start - 1e-9) & (time < start + phase.duration_s - 1e-9)
        acceleration[inside] = phase.acceleration_mps2
        start += phase.duration_s
    gained = np.concatenate([[0.0], np.cumsum(acceleration[:-1] * period_s)])
    speed = np.maximum(actor.speed_mps + gained, 0.0)
    moved = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * period_s)])
    x = nose_m + actor.ahead_m + 0.5 * actor.length_m + moved
    y = actor.lateral_m + actor.crossing_mps * time
    return np.stack([x, y, speed, acceleration, time <= actor.leaves_s], axis=1)


@kernel
def clock_step(road: Road, clock: float) -> int:
    """The step of its own clock at which an actor is; it stays at the last one."""
    last: int = road.positions.shape[1] - 1
    return min(int(clock), last)


@kernel
def in_the_way(road: Road, clocks: Numbers, x_m: float, at_m: float) -> tuple[float, float, float]:
    """The nearest visible thing on the planned path: gap [m], its speed and acceleration.

    clocks [actor]: steps of each actor's own clock. x_m, at_m: the car's place along the road and
    along its path. A free road gives an infinite gap. Actors stand on straight roads along
    x, where both run in step.
    """
    nearest, speed, acceleration = np.inf, 0.0, 0.0
    for actor in range(len(road.bodies)):
        step = clock_step(road, clocks[actor])
        x, y = road.positions[actor, step, AT_X], road.positions[actor, step, AT_Y]
        half_length = road.bodies[actor, HALF_LENGTH]
        gap = x - half_length - x_m - road.nose_m
        passed = gap + 2.0 * half_length < 0.0
        if passed or gap >= min(nearest, road.visibility_m):
            continue
        if road.positions[actor, step, PRESENT] == 0.0:
            continue
        near = y - read_path(road.path, Y, at_m + road.nose_m + max(gap, 0.0))
        far = y - read_path(road.path, Y, at_m + road.nose_m + gap + 2.0 * half_length)
        reach = road.bodies[actor, HALF_WIDTH] + road.half_width_m + _MARGIN_M
        if min(abs(near), abs(far)) < reach:
            nearest = gap
            speed = road.positions[actor, step, AT_SPEED]
            acceleration = road.positions[actor, step, AT_ACCELERATION]
    return nearest, speed, acceleration


@kernel
def bumper_gap(road: Road, clocks: Numbers, state: Numbers) -> tuple[float, float, bool]:
    """What is straight ahead of the body now: gap [m] and its speed; and whether the car hit.

    An infinite gap and a NaN speed say that nothing is ahead. Crossing a closed stop line is a
    hit; only what is solid counts for the gap.
    """
    nearest, speed, hit = np.inf, np.nan, False
    nose = state[X] + road.nose_m
    sine = math.sin(state[HEADING])
    middle = state[PLANT_Y] + (road.nose_m - 0.5 * road.length_m) * sine
    half_width = road.half_width_m + 0.5 * road.length_m * abs(sine)
    for actor in range(len(road.bodies)):
        step = clock_step(road, clocks[actor])
        half_length = road.bodies[actor, HALF_LENGTH]
        gap = road.positions[actor, step, AT_X] - half_length - nose
        aside = abs(road.positions[actor, step, AT_Y] - middle)
        if road.positions[actor, step, PRESENT] == 0.0:
            continue
        if road.bodies[actor, SOLID] == 0.0:
            hit = hit or gap < 0.0
            continue
        behind = gap + 2.0 * half_length <= -road.length_m
        if behind or aside >= half_width + road.bodies[actor, HALF_WIDTH]:
            continue
        hit = hit or gap <= 0.0
        if gap < nearest:
            nearest, speed = gap, road.positions[actor, step, AT_SPEED]
    return nearest, speed, hit
