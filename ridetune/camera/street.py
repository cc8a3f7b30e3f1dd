"""Geometry of a scene: camera, lanes, and what stands where.

In: a `Scene` and a picture size. Out: a `Layout` with every `Thing` in metres, in the frames of
`data.camera`. It comes from a random stream of the scene's seed and never sees the weather.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from .atmosphere import Colour
from .projection import Camera
from .scene import Scene

Kind = Literal[
    "car", "suv", "van", "truck",
    "building", "tree", "lamp", "sign", "signal", "gantry",
    "pedestrian", "barrier", "bag",
]  # fmt: skip
VEHICLES: dict[str, tuple[float, float, float]] = {  # width, height, length in m
    "car": (1.8, 1.45, 4.4),
    "suv": (1.95, 1.75, 4.7),
    "van": (2.05, 2.3, 5.4),
    "truck": (2.5, 3.5, 9.0),
}
PAINTS: tuple[Colour, ...] = (
    (215, 215, 218), (150, 153, 158), (85, 88, 94), (28, 29, 32), (140, 22, 25), (30, 55, 120),
    (40, 80, 65), (180, 170, 145), (235, 236, 238), (55, 60, 75),
)  # fmt: skip
FOLIAGE: tuple[Colour, ...] = ((52, 72, 34), (70, 84, 42), (38, 56, 34), (96, 88, 46), (82, 96, 52))
WALLS: tuple[Colour, ...] = (
    (150, 138, 122),
    (172, 160, 145),
    (120, 78, 62),
    (130, 132, 136),
    (188, 182, 170),
)


@dataclass(frozen=True)
class Thing:
    """Something that stands on the ground; x, z is the near middle of its base, size w, h, l."""

    kind: Kind
    x: float
    z: float
    size: tuple[float, float, float]
    colour: Colour
    facing: Literal["rear", "front", "side"] = "rear"
    variant: float = 0.0  # 0..1, picks details


@dataclass(frozen=True)
class Lanes:
    """The own carriageway: how many lanes lie on each side of the own one, and their width."""

    to_the_left: int
    to_the_right: int
    width_m: float


@dataclass(frozen=True)
class Layout:
    """Geometry of a scene; independent of its weather."""

    camera: Camera
    lane_m: float
    left: float  # edges of the own carriageway, x in m
    right: float
    opposite_left: float  # edges of the oncoming one; equal when there is none
    opposite_right: float
    shoulder_m: float
    crossing: tuple[float, float] | None  # depth range of the crossing road
    things: tuple[Thing, ...]
    looks: tuple[float, ...]  # 16 random numbers for colours and textures


def _camera(scene: Scene, rng: np.random.Generator, width: int, height: int) -> Camera:
    u = rng.random(7)
    radius_range = {"city": (40, 110), "country": (55, 180), "highway": (110, 260)}[
        scene.surroundings
    ]
    radius = radius_range[0] + (radius_range[1] - radius_range[0]) * u[0]
    sign = {"left curve": -1.0, "right curve": 1.0}.get(scene.road, 0.0)
    bend = sign / radius if sign else (u[1] - 0.5) * 0.0005 * (scene.road == "straight")
    return Camera(
        width, height,
        focal=width * (0.72 + 0.45 * u[2]),
        u0=width * (0.5 + 0.1 * (u[3] - 0.5)),
        v0=height * (0.45 + 0.12 * (u[4] - 0.5)),
        mount_m=1.25 + 0.35 * u[5],
        bend=float(bend),
        bend_start_m=8 * u[6],
    )  # fmt: skip


def _vehicle(
    rng: np.random.Generator, x: float, z: float, facing: Literal["rear", "front", "side"]
) -> Thing:
    kind = ("car", "car", "suv", "van", "truck")[int(rng.integers(5))]
    paint = PAINTS[int(rng.integers(len(PAINTS)))]
    if kind == "truck":
        paint = tuple(0.5 * c + 100 for c in paint)  # type: ignore[assignment]
    w, h, length = VEHICLES[kind]
    scale = rng.uniform(0.93, 1.08, 3)
    size = (w * scale[0], h * scale[1], length * scale[2])
    return Thing(kind, x, z, size, paint, facing, float(rng.random()))  # type: ignore[arg-type]


def _traffic(scene: Scene, rng: np.random.Generator, layout: Layout) -> list[Thing]:
    """Lead and other vehicles; the own lane stays free unless the scene has a lead."""
    things: list[Thing] = []
    offset = 0.5 * (rng.random() - 0.5)
    if scene.lead != "none":
        low, high = (8.0, 18.0) if scene.lead == "near" else (25.0, 55.0)
        things.append(_vehicle(rng, offset, float(rng.uniform(low, high)), "rear"))
    own = np.arange(layout.left + layout.lane_m / 2, layout.right, layout.lane_m)
    lanes: list[tuple[float, Literal["rear", "front"]]] = [
        (float(x), "rear") for x in own if abs(x) > 1.6
    ]
    opposite = np.arange(
        layout.opposite_left + layout.lane_m / 2, layout.opposite_right, layout.lane_m
    )
    lanes += [(float(x), "front") for x in opposite]
    dense = scene.traffic == "dense"
    count = int(rng.integers(6, 11)) if dense else int(rng.integers(0, 3))
    taken: list[tuple[float, float]] = []
    for _ in range(count if lanes else 0):
        x, facing = lanes[int(rng.integers(len(lanes)))]
        z = float(rng.uniform(7, 45 if dense else 90))
        thing = _vehicle(rng, x + 0.4 * (rng.random() - 0.5), z, facing)
        if all(x != t[0] or abs(z - t[1]) > 10.5 for t in taken):
            taken.append((x, z))
            things.append(thing)
    if layout.crossing and (dense or rng.random() < 0.2):
        things.extend(
            _vehicle(rng, float(x), layout.crossing[0] + 3.0, "side")
            for x in rng.uniform(5, 9, 2) * (-1, 1) + rng.uniform(-2, 2)
        )
    return things


def _roadside(scene: Scene, rng: np.random.Generator, layout: Layout) -> list[Thing]:
    """Buildings, trees, lamps and signs on both sides, and the signals of an intersection."""
    city = scene.surroundings == "city"
    left = min(layout.left, layout.opposite_left) - layout.shoulder_m
    right = layout.right + layout.shoulder_m
    things: list[Thing] = []
    for side, edge in ((-1, left), (1, right)):
        z = float(rng.uniform(4, 16))
        setback = rng.uniform(3, 7) if city else rng.uniform(2.5, 9)
        while z < (90 if city else 105):
            u = rng.random(6)
            if city and u[0] < 0.75:
                length = 9 + 20 * u[1]
                size = (12.0, 5 + 18 * float(u[2]) ** 1.5, float(length))
                wall = WALLS[int(u[3] * len(WALLS))]
                things.append(
                    Thing("building", edge + side * setback, z, size, wall, "side", float(u[4]))
                )
                z += length + 8 * u[5] ** 3
            else:
                tree = (2.5 + 4.5 * float(u[1]), 3.0 + 9 * float(u[2]) ** 1.5, 1.0)
                leaf = FOLIAGE[int(u[3] * len(FOLIAGE))]
                x = edge + side * (setback + (1.0 if city else 14 * u[4]))
                things.append(Thing("tree", float(x), z, tree, leaf, "rear", float(u[0])))
                z += 4 + (18 if scene.surroundings == "highway" else 11) * u[5]
        if city or rng.random() < 0.4:
            things.extend(
                Thing(
                    "lamp",
                    edge + side * 0.8,
                    float(depth),
                    (1.8, 7.5, 0),
                    (95, 98, 100),
                    "rear",
                    0.5 + 0.5 * side,
                )
                for depth in np.arange(rng.uniform(6, 20), 110, 26.0)
            )
        if rng.random() < 0.6:
            sign = (0.8, 2.6, 0.0)
            things.append(
                Thing(
                    "sign",
                    edge + side * 1.0,
                    float(rng.uniform(9, 40)),
                    sign,
                    (200, 200, 200),
                    "rear",
                    float(rng.random()),
                )
            )
    if scene.surroundings == "highway" and rng.random() < 0.35 and not layout.crossing:
        board = (right - layout.left, 7.0, 0.0)
        things.append(
            Thing(
                "gantry",
                (layout.left + right) / 2,
                float(rng.uniform(30, 70)),
                board,
                (25, 85, 60) if rng.random() < 0.5 else (30, 70, 150),
            )
        )
    return open_crossing(things, layout, rng) if layout.crossing else things


def open_crossing(things: list[Thing], layout: Layout, rng: np.random.Generator) -> list[Thing]:
    """The things that leave the crossing road of a layout free, and the signals before it."""
    assert layout.crossing is not None
    low, high = layout.crossing
    left = min(layout.left, layout.opposite_left) - layout.shoulder_m
    right = layout.right + layout.shoulder_m
    free = [
        t
        for t in things
        if t.z + (t.size[2] if t.kind == "building" else 0) < low - 1 or t.z > high + 1
    ]
    state, near = float(rng.random()), max(low - 1.5, 9.0)
    grey = (40, 42, 44)
    tall = (0.5, 3.6 + rng.random(), 0)
    free.append(Thing("signal", right + 0.5, near, tall, grey, "rear", state))
    free.append(Thing("signal", left - 0.5, high + 1.0, (0.5, 4.2, 0), grey, "rear", state))
    if rng.random() < 0.6:
        arm = (0.6, 5.6, right - 0.8)
        free.append(Thing("signal", 0.8, high + 1.0, arm, grey, "rear", state))
    return free


def draw_layout(scene: Scene, width: int, height: int, lanes: Lanes | None = None) -> Layout:
    """Geometry of a scene for one picture size; uses the seed but never the condition.

    lanes: the own carriageway where it is known; the seed draws it otherwise.
    """
    rng = np.random.default_rng([scene.seed, 0])
    camera = _camera(scene, rng, width, height)
    lane = float(rng.uniform(3.0, 3.7))
    highway, country = scene.surroundings == "highway", scene.surroundings == "country"
    own = 1 if country else int(rng.integers(2, 4)) if highway else int(rng.integers(1, 3))
    left = -(int(rng.integers(own)) + 0.5) * lane + float(rng.uniform(-0.35, 0.35))
    if lanes is not None:
        lane, own = lanes.width_m, 1 + lanes.to_the_left + lanes.to_the_right
        left = -(lanes.to_the_left + 0.5) * lane
    median = float(rng.uniform(2.0, 7.0)) if highway else 0.0
    crossing = None
    if scene.road == "intersection":
        start = float(rng.uniform(13, 24))
        crossing = (start, start + float(rng.uniform(9, 15)))
    layout = Layout(
        camera, lane, left, left + own * lane,
        opposite_left=left - median - own * lane, opposite_right=left - median,
        shoulder_m=float(rng.uniform(1.5, 3.0)) if highway else float(rng.uniform(0.3, 0.9)),
        crossing=crossing, things=(), looks=tuple(float(u) for u in rng.random(16)),
    )  # fmt: skip
    things = _traffic(scene, rng, layout) + _roadside(scene, rng, layout)
    things.sort(key=lambda t: -(t.z + (t.size[2] if t.kind == "building" else 0.0)))
    return replace(layout, things=tuple(things))
