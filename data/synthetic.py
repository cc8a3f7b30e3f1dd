"""Synthetic front camera: scenes with known content, drawn fast enough to train on the fly.

In: a `Scene` (weather, road, lead vehicle, traffic, surroundings, seed). Out: an RGB picture and a
one-line description. Geometry comes from a random stream of the seed alone, weather from a
second one, the camera from a third, so `with_condition` changes nothing but the weather.

    PYTHONPATH=. python -c "from data.synthetic import *; import numpy as np; \
print(describe(sample_scene(np.random.default_rng(0))))"    # any CPU

Frames: x to the right of the centre line of the own path, y up from the ground, z along the road
ahead of the camera, in metres; pixels (u, v) to the right and down.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from data import weather
from data.weather import Atmosphere, Colour, Image
from ridetune.sample import CONDITIONS, Condition

Road = Literal["straight", "left curve", "right curve", "intersection"]
Lead = Literal["none", "near", "far"]
Traffic = Literal["light", "dense"]
Surroundings = Literal["city", "highway", "country"]
Points = NDArray[np.float64]
Kind = Literal["car", "suv", "van", "truck", "building", "tree", "lamp", "sign", "signal", "gantry"]

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
class Scene:
    """What a picture shows; `seed` fixes everything that the other fields leave open."""

    condition: Condition
    road: Road
    lead: Lead
    traffic: Traffic
    surroundings: Surroundings
    seed: int


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
class Camera:
    """Pinhole camera over a flat ground with a bent road."""

    width: int
    height: int
    focal: float  # pixels
    u0: float
    v0: float  # horizon row
    mount_m: float
    bend: float  # curvature of the road, 1/m, positive to the right
    bend_start_m: float

    def centre(self, z: Points) -> Points:
        """Lateral shift of the centre line at depth z: a parabola, straight from slope 0.9 on."""
        if self.bend == 0.0:
            return np.zeros_like(z)
        d = np.maximum(z - self.bend_start_m, 0.0)
        near = np.minimum(d, 0.9 / max(abs(self.bend), 1e-6))
        return self.bend * near * (d - 0.5 * near)

    def project(self, points: Points) -> NDArray[np.int32]:
        """Road points [n, 3] to pixels [n, 2] in 1/16, as the OpenCV drawing calls take them."""
        z = np.maximum(points[:, 2], 1.0)
        scale = 16.0 * self.focal / z
        pixels = np.empty((len(z), 2))
        x = points[:, 0] + self.centre(z) if self.bend else points[:, 0]
        pixels[:, 0] = scale * x + 16 * self.u0
        pixels[:, 1] = scale * (self.mount_m - points[:, 1]) + 16 * self.v0
        return pixels.astype(np.int32)

    def stand(self, x: float, z: float, h: float) -> tuple[float, float, float]:
        """Pixel column, foot row and head row of an upright of height h at (x, z)."""
        scale = self.focal / z
        d = max(z - self.bend_start_m, 0.0)
        near = min(d, 0.9 / max(abs(self.bend), 1e-6))
        u = self.u0 + scale * (x + self.bend * near * (d - 0.5 * near))
        foot = self.v0 + scale * self.mount_m
        return u, foot, foot - scale * h


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


def sample_scene(rng: np.random.Generator) -> Scene:
    """Scene with every category drawn uniformly."""

    def pick(options: tuple[str, ...]) -> str:
        return options[int(rng.integers(len(options)))]

    return Scene(
        condition=pick(CONDITIONS),  # type: ignore[arg-type]
        road=pick(get_args(Road)),  # type: ignore[arg-type]
        lead=pick(get_args(Lead)),  # type: ignore[arg-type]
        traffic=pick(get_args(Traffic)),  # type: ignore[arg-type]
        surroundings=pick(get_args(Surroundings)),  # type: ignore[arg-type]
        seed=int(rng.integers(2**31)),
    )


def with_condition(scene: Scene, condition: Condition) -> Scene:
    """The same road, traffic and colours in another weather."""
    return replace(scene, condition=condition)


def describe(scene: Scene) -> str:
    """One short lower-case description; the first word names the condition."""
    rng = np.random.default_rng([scene.seed, 3])
    lead = {
        "none": ("no vehicle ahead", "a free lane ahead"),
        "near": ("a vehicle close ahead", "a near vehicle ahead"),
        "far": ("a vehicle far ahead", "a distant vehicle ahead"),
    }[scene.lead][int(rng.integers(2))]
    adjective = {
        "sunny": "sunny",
        "rain": "rainy",
        "fog": "foggy",
        "snow": "snowy",
        "night": "night-time",
    }
    where = {"city": "in the city", "highway": "on the highway", "country": "in the country"}
    road = "straight road" if scene.road == "straight" else scene.road
    start = f"{adjective[scene.condition]} {road} {where[scene.surroundings]}"
    wordings = (
        f"{start}, {lead}, {scene.traffic} traffic",
        f"{start} with {scene.traffic} traffic, {lead}",
        f"{start}, {scene.traffic} traffic and {lead}",
    )
    return wordings[int(rng.integers(len(wordings)))]


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
        for x in rng.uniform(5, 9, 2) * (-1, 1) + rng.uniform(-2, 2):
            things.append(_vehicle(rng, float(x), layout.crossing[0] + 3.0, "side"))
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
            for depth in np.arange(rng.uniform(6, 20), 110, 26.0):
                things.append(
                    Thing(
                        "lamp",
                        edge + side * 0.8,
                        float(depth),
                        (1.8, 7.5, 0),
                        (95, 98, 100),
                        "rear",
                        0.5 + 0.5 * side,
                    )
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
    if layout.crossing:
        low, high = layout.crossing
        things = [
            t
            for t in things
            if t.z + (t.size[2] if t.kind == "building" else 0) < low - 1 or t.z > high + 1
        ]
        state = float(rng.random())
        things.append(
            Thing(
                "signal",
                right + 0.5,
                max(low - 1.5, 9.0),
                (0.5, 3.6 + rng.random(), 0),
                (40, 42, 44),
                "rear",
                state,
            )
        )
        things.append(
            Thing("signal", left - 0.5, high + 1.0, (0.5, 4.2, 0), (40, 42, 44), "rear", state)
        )
        if rng.random() < 0.6:
            things.append(
                Thing(
                    "signal", 0.8, high + 1.0, (0.6, 5.6, right - 0.8), (40, 42, 44), "rear", state
                )
            )
    return things


def draw_layout(scene: Scene, width: int, height: int) -> Layout:
    """Geometry of a scene for one picture size; uses the seed but never the condition."""
    rng = np.random.default_rng([scene.seed, 0])
    camera = _camera(scene, rng, width, height)
    lane = float(rng.uniform(3.0, 3.7))
    highway, country = scene.surroundings == "highway", scene.surroundings == "country"
    own = 1 if country else int(rng.integers(2, 4)) if highway else int(rng.integers(1, 3))
    left = -(int(rng.integers(own)) + 0.5) * lane + float(rng.uniform(-0.35, 0.35))
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


# --- Drawing -------------------------------------------------------------------------------


def _there_and_back(count: int) -> Points:
    steps = np.linspace(0, 1, count)
    return np.concatenate([steps, steps[::-1]])


LONG_STRIP, SHORT_STRIP = _there_and_back(26), _there_and_back(3)


@dataclass(frozen=True)
class _Canvas:
    """The picture under construction with all that a drawing function needs."""

    image: Image  # drawn in place
    layout: Layout
    air: Atmosphere
    lights: list[tuple[float, float, float, Colour, float]]  # u, v, radius, colour, gain

    @cached_property
    def camera(self) -> Camera:
        return self.layout.camera

    def fill(self, pixels: list[NDArray[np.int32]], colour: Colour) -> None:
        """Anti-aliased polygons from pixels in 1/16."""
        cv2.fillPoly(self.image, pixels, colour, cv2.LINE_AA, 4)

    def hull(self, pixels: NDArray[np.int32], colour: Colour) -> None:
        cv2.fillConvexPoly(self.image, cv2.convexHull(pixels), colour, cv2.LINE_AA, 4)

    def band(self, left: float, right: float, low: float, high: float, colour: Colour) -> None:
        """Strip of ground between two offsets from the centre line, in albedo."""
        self.bands([(left, right)], low, high, colour)

    def bands(
        self, sides: list[tuple[float, float]], low: float, high: float, colour: Colour
    ) -> None:
        """Strips of ground with the same colour and depth range."""
        steps = LONG_STRIP if high - low > 20 else SHORT_STRIP
        half, edges = len(steps) // 2, np.asarray(sides)
        points = np.zeros((len(sides), len(steps), 3))
        points[:, :half, 0], points[:, half:, 0] = edges[:, :1], edges[:, 1:]
        low = max(low, 1.0)
        points[:, :, 2] = low * (high / low) ** steps
        self.fill(
            list(self.camera.project(points.reshape(-1, 3)).reshape(len(sides), -1, 2)), colour
        )

    def lamp(self, u: float, v: float, radius: float, colour: Colour, gain: float) -> None:
        self.lights.append((u, v, radius, colour, gain))


def _mix(a: Colour, b: Colour, t: float) -> Colour:
    """Colour a moved to b by t."""
    return (a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t, a[2] + (b[2] - a[2]) * t)


def _scale(colour: Colour, factor: float) -> Colour:
    return (colour[0] * factor, colour[1] * factor, colour[2] * factor)


WHITE: Colour = (225.0, 228.0, 235.0)
FAR_M = 400.0


def _skyline(canvas: _Canvas, surroundings: Surroundings) -> None:
    """Hills, far trees or far buildings that close the view at the horizon."""
    camera, looks, air = canvas.camera, canvas.layout.looks, canvas.air
    rng = np.random.default_rng(int(looks[0] * 2**31))
    u = np.linspace(-10, camera.width + 10, 56)
    x = u / camera.width
    hills = (
        camera.height
        * (0.02 + 0.09 * looks[1])
        * (1 + np.sin(3 + 9 * looks[2] + (3 + 4 * looks[3]) * x))
        / 2
    )
    if surroundings != "city" and looks[4] < 0.6:
        colour = _mix((96, 104, 92), (88, 100, 120), looks[5])
        if air.snow:
            colour = _mix(colour, WHITE, 0.5)
        _silhouette(canvas, u, hills, air.shade(colour, 90.0, 500.0))
    rough = np.repeat(rng.random(14), 4) if surroundings == "city" else rng.random(56)
    height = camera.height * (0.015 + (0.1 if surroundings == "city" else 0.045) * rough * looks[6])
    colour = (105, 104, 104) if surroundings == "city" else FOLIAGE[int(looks[7] * len(FOLIAGE))]
    if air.snow:
        colour = _mix(colour, WHITE, 0.3)
    _silhouette(canvas, u, height, air.shade(colour, 60.0, 160.0))


def _silhouette(canvas: _Canvas, u: Points, height: Points, colour: Colour) -> None:
    v = canvas.camera.v0 - height
    points = np.stack([u, v], axis=1)
    base = np.array([[u[-1], canvas.camera.v0 + 3], [u[0], canvas.camera.v0 + 3]])
    canvas.fill([np.rint(np.concatenate([points, base]) * 16).astype(np.int32)], colour)


def _ground(canvas: _Canvas, scene: Scene) -> None:
    """Verges, road, markings and crossing in albedo; light and haze follow in one step."""
    layout, air, looks = canvas.layout, canvas.air, canvas.layout.looks
    verge = _mix((84, 98, 48), (165, 142, 92), looks[8])
    if scene.surroundings == "city":
        verge = _mix((120, 116, 112), (160, 155, 148), looks[8])
    asphalt = _mix((72, 72, 77), (150, 145, 138), looks[9] ** 1.4)
    asphalt = _scale(asphalt, 1 - 0.5 * air.wet)
    if air.snow:
        verge = _mix(verge, WHITE, 0.93)
        asphalt = _mix(asphalt, WHITE, 0.15 + 0.75 * air.snow)
    elif air.wet:
        verge = _scale(verge, 0.8)
    corner = (canvas.camera.width, canvas.camera.height)
    cv2.rectangle(canvas.image, (0, int(canvas.camera.v0)), corner, verge, -1)
    left, right = layout.left - layout.shoulder_m, layout.right + layout.shoulder_m
    if scene.surroundings == "city":
        kerb = _mix(_scale(verge, 0.75), WHITE, 0.4 * bool(air.snow))
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


def _tracks(canvas: _Canvas, asphalt: Colour) -> None:
    """Tyre tracks: dark and wet in snow, faint otherwise."""
    layout, snow = canvas.layout, canvas.air.snow
    strength = 0.25 + 0.4 * layout.looks[10] if snow else 0.1 * layout.looks[10]
    colour = _mix(asphalt, (70, 72, 80) if snow else (40, 40, 42), strength)
    lanes = np.arange(layout.left + layout.lane_m / 2, layout.right, layout.lane_m)
    sides = [(x + side - 0.25, x + side + 0.25) for x in lanes for side in (-0.75, 0.75)]
    canvas.bands(sides, 1, 90, colour)


def _markings(canvas: _Canvas, scene: Scene, asphalt: Colour) -> None:
    """Solid edges, dashed lane limits, and a white or yellow centre."""
    layout, looks = canvas.layout, canvas.layout.looks
    worn = 0.1 + 0.3 * looks[11] + 0.65 * canvas.air.snow
    white, yellow = _mix((235, 235, 232), asphalt, worn), _mix((225, 170, 45), asphalt, worn)
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
    _dashes(canvas, dashed, half, white if highway else _mix(white, centre, 0.5))


def _dashes(canvas: _Canvas, offsets: list[float], half: float, colour: Colour) -> None:
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


def _crossing(canvas: _Canvas, asphalt: Colour) -> None:
    """Crossing road with its edge lines, and a zebra or a stop line on the own side."""
    layout = canvas.layout
    assert layout.crossing is not None
    low, high = layout.crossing
    paint = _mix((232, 232, 230), asphalt, 0.15 + 0.55 * canvas.air.snow)
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


def _shadows(canvas: _Canvas) -> None:
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


def _box(
    x0: float, x1: float, y0: float, y1: float, z0: float, z1: float
) -> list[tuple[float, float, float]]:
    return [(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)]


def _quad(x0: float, x1: float, y0: float, y1: float, z: float) -> list[tuple[float, float, float]]:
    return [(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]


def _template(
    roof: float, rear: tuple[float, float], front: tuple[float, float], waist: float
) -> dict[str, NDArray[np.float64]]:
    """Vehicle parts in units of half width, height and length; rear at z = 0.

    `roof` is the half width of the roof, `rear` and `front` the depths of waist and roof edge.
    """
    glass = waist + 0.05
    ring = [(x, waist - 0.02, z) for x in (-0.96, 0.96) for z in (rear[0], front[0])]
    ring += [(x, 1.0, z) for x in (-roof, roof) for z in (rear[1], front[1])]
    dz = rear[1] - rear[0]
    window = [(-0.8, glass, rear[0] + 0.1 * dz), (0.8, glass, rear[0] + 0.1 * dz)]
    window += [(roof * 0.86, 0.94, rear[1] - 0.1 * dz), (-roof * 0.86, 0.94, rear[1] - 0.1 * dz)]
    turn = np.linspace(0, 2 * np.pi, 9)[:-1]
    parts: dict[str, list[tuple[float, float, float]]] = {
        "under": [(-1.1, 0, -0.02), (1.1, 0, -0.02), (1.04, 0.3, 0.02), (-1.04, 0.3, 0.02)],
        "body": _box(-1, 1, 0.15, waist, 0, 1),
        "cabin": ring,
        "rear face": _quad(-1, 1, 0.16, waist, 0),
        "rear window": window,
        "bumper": _quad(-1, 1, 0.16, 0.27, -0.002),
        "plate": _quad(-0.25, 0.25, 0.34, 0.42, -0.003),
        "lamp left": _quad(-0.98, -0.68, waist - 0.16, waist - 0.03, -0.003),
        "lamp right": _quad(0.68, 0.98, waist - 0.16, waist - 0.03, -0.003),
    }
    for name, s in (("left", -1.0), ("right", 1.0)):
        parts[f"glass {name}"] = [
            (s * 0.97, glass, rear[0] + 0.09), (s * 0.97, glass, front[0] - 0.06),
            (s * (roof + 0.02), 0.93, front[1] - 0.02), (s * (roof + 0.02), 0.93, rear[1] + 0.03),
        ]  # fmt: skip
        for end, z in (("a", 0.19), ("b", 0.8)):
            parts[f"wheel {name} {end}"] = [
                (s, 0.2 + 0.2 * np.sin(a), z + 0.07 * np.cos(a)) for a in turn
            ]
        parts[f"tyre {name}"] = _quad(s * 0.94, s * 0.66, 0.0, 0.2, 0.0)
    return {name: np.asarray(points) for name, points in parts.items()}


def _truck_template() -> dict[str, NDArray[np.float64]]:
    parts = _template(0.98, (0.0, 0.0), (1.0, 1.0), 0.32)
    parts["body"], parts["rear face"] = (
        np.asarray(_box(-1, 1, 0.12, 0.3, 0, 1)),
        np.asarray(_quad(-1, 1, 0.12, 0.3, 0)),
    )
    for name, x in (("lamp left", -0.98), ("lamp right", 0.74)):
        parts[name] = np.asarray(_quad(x, x + 0.24, 0.2, 0.26, -0.003))
    parts["windscreen"] = np.asarray(_quad(-0.9, 0.9, 0.48, 0.72, -0.003))
    return parts


def _packed(parts: dict[str, NDArray[np.float64]]) -> tuple[Points, dict[str, slice]]:
    """All points of a template in one array [n, 3], and where each part lies in it."""
    ends = np.cumsum([len(p) for p in parts.values()])
    slices = {
        n: slice(int(e) - len(p), int(e)) for (n, p), e in zip(parts.items(), ends, strict=True)
    }
    return np.concatenate(list(parts.values())), slices


TEMPLATES = {
    "car": _packed(_template(0.74, (0.05, 0.2), (0.74, 0.55), 0.6)),
    "suv": _packed(_template(0.84, (0.0, 0.07), (0.76, 0.62), 0.58)),
    "van": _packed(_template(0.9, (0.0, 0.03), (0.92, 0.76), 0.52)),
    "truck": _packed(_truck_template()),
}


def _vehicle_pixels(canvas: _Canvas, thing: Thing) -> dict[str, NDArray[np.int32]]:
    """Every part of a vehicle in the picture, projected in one call."""
    points, slices = TEMPLATES[thing.kind]
    w, h, length = thing.size
    along, across = points[:, 2], points[:, 0]
    if thing.facing == "side":
        x, z = (along - 0.5) * length, (across + 1) * w / 2
    else:
        x, z = across * w / 2, along * length
    world = np.empty_like(points)
    world[:, 0], world[:, 1], world[:, 2] = thing.x + x, points[:, 1] * h, thing.z + z
    pixels = canvas.camera.project(world)
    return {name: pixels[part] for name, part in slices.items()}


def _draw_vehicle(canvas: _Canvas, thing: Thing) -> None:
    """Body, cabin, glass, wheels, lamps and contact shadow of one vehicle."""
    px = _vehicle_pixels(canvas, thing)
    air = canvas.air
    x = (
        (canvas.camera.stand(thing.x, thing.z, 0)[0] - canvas.camera.u0)
        * thing.z
        / canvas.camera.focal
    )

    def shade(colour: Colour) -> Colour:
        return air.shade(colour, x, thing.z)

    truck = thing.kind == "truck"
    paint = _mix(thing.colour, WHITE, 0.35 if air.snow > 0.6 else 0.0)
    dark, glass = (
        shade((16, 16, 18)),
        shade(_mix((22, 25, 30), (120, 135, 150), 0.4 * thing.variant)),
    )
    canvas.fill([px["under"]], shade((20, 20, 22)))
    side_on = thing.facing == "side"
    body = px["body"]
    left_seen = side_on or body[1, 0] < body[0, 0]
    right_seen = not side_on and body[5, 0] > body[4, 0]
    canvas.hull(body, shade(_scale(paint, 0.9 if side_on else 0.62)))
    canvas.hull(px["cabin"], shade(_scale(paint, 0.9 if side_on else 0.7)))
    for name, seen in (("left", left_seen), ("right", right_seen)):
        if thing.z > 40:
            continue
        if seen and not truck:
            canvas.fill([px[f"glass {name}"]], glass)
        if seen:
            canvas.fill([px[f"wheel {name} a"], px[f"wheel {name} b"]], dark)
    if side_on:
        return
    canvas.fill([px["tyre left"], px["tyre right"]], dark)
    canvas.fill([px["rear face"]], shade(paint if not truck else (50, 50, 52)))
    if truck:
        canvas.fill([px["cabin"][[0, 2, 6, 4]]], shade(paint))
        if thing.facing == "front":
            canvas.fill([px["windscreen"]], glass)
    if not truck:
        canvas.fill([px["rear window"]], glass)
    if thing.z > 40:
        _vehicle_lamps(canvas, thing, px, shade)
        return
    canvas.fill([px["bumper"]], shade(_scale(paint, 0.55)))
    canvas.fill([px["plate"]], shade((190, 190, 180) if thing.facing == "rear" else (30, 30, 32)))
    _vehicle_lamps(canvas, thing, px, shade)


def _vehicle_lamps(
    canvas: _Canvas,
    thing: Thing,
    px: dict[str, NDArray[np.int32]],
    shade: Callable[[Colour], Colour],
) -> None:
    """Tail or head lamps, lit when the weather asks for it or the vehicle brakes."""
    air, rear = canvas.air, thing.facing == "rear"
    braking = rear and thing.variant < 0.3
    on = max(air.lamps, 0.8 if braking else 0.0)
    seen = float(np.exp(-0.5 * air.extinction * thing.z))  # lamps carry further than surfaces
    lit: Colour = (255, 40, 25) if rear else (255, 250, 225)
    off = shade((120, 18, 18) if rear else (185, 188, 190))
    colour = _mix(off, lit, on * seen)
    canvas.fill([px["lamp left"], px["lamp right"]], colour)
    if air.glow == 0 or on * seen < 0.1:
        return
    size = canvas.camera.focal / max(thing.z, 4.0)
    radius = air.glow * (0.55 if rear else 1.1) * size + (2 if rear else 4) * air.glow
    for name in ("lamp left", "lamp right"):
        u, v = px[name].mean(axis=0) / 16
        canvas.lamp(u, v, min(radius, 70), lit, on * seen * (0.8 if rear else 1.0))


WINDOW_Y, WINDOW_Z = np.array([0.32, 0.32, 0.82, 0.82]), np.array([-0.5, 0.5, 0.5, -0.5])
LOTS = np.random.default_rng(3).random(4096)


def _lots(variant: float, count: int) -> Points:
    """Numbers 0..1 that a thing always draws again."""
    start = int(variant * 2048)
    return LOTS[start : start + count]


def _draw_building(canvas: _Canvas, thing: Thing) -> None:
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
    canvas.fill([front], air.shade(_scale(thing.colour, 0.7), 30.0, z0))
    canvas.fill([face], air.shade(_scale(thing.colour, shade), 25.0, middle))
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


def _draw_tree(canvas: _Canvas, thing: Thing) -> None:
    """Trunk and a ragged crown with lit tufts and dark gaps."""
    air, camera = canvas.air, canvas.camera
    w, h, _ = thing.size
    u, foot, top = camera.stand(thing.x, thing.z, h)
    half, tall = 0.5 * w * camera.focal / thing.z, 0.85 * (foot - top)
    if u + half < 0 or u - half > camera.width:
        return
    _rectangle(
        canvas,
        (u, foot - 0.2 * tall),
        max(1.0, 0.12 * half),
        0.4 * tall,
        air.shade((62, 50, 40), thing.x, thing.z),
    )
    size, base = np.array([half, -tall]) * 16, np.array([u, top + tall]) * 16
    crown = CROWNS[int(thing.variant * 24)]
    leaf = _mix(thing.colour, WHITE, 0.45) if air.snow else thing.colour
    canvas.fill(
        [(crown * size + base).astype(np.int32)], air.shade(_scale(leaf, 0.85), thing.x, thing.z)
    )
    if half < 7:  # too small for tufts
        return
    count = 6 if half < 25 else 14
    tufts = (TUFTS[int(thing.variant * 24), :count] * size + base).astype(np.int32)
    bright = 1.35 if air.shadow else 1.12
    canvas.fill(list(tufts[count // 2 :]), air.shade(_scale(leaf, 0.55), thing.x, thing.z))
    canvas.fill(list(tufts[: count // 2]), air.shade(_scale(leaf, bright), thing.x, thing.z))


def _draw_post(canvas: _Canvas, thing: Thing) -> None:
    """Lamps, signs, signals and gantries: a post with something at its head."""
    air, camera = canvas.air, canvas.camera
    w, h, _ = thing.size
    u, foot, top = camera.stand(thing.x, thing.z, h)
    metre = camera.focal / thing.z
    grey = air.shade((92, 95, 98), thing.x, thing.z)
    if thing.kind == "gantry":
        _rectangle(canvas, (u, top), w * metre, 0.25 * metre, grey)
        for edge in (-0.52, 0.52):
            _rectangle(
                canvas, (u + edge * w * metre, (top + foot) / 2), 0.3 * metre, foot - top, grey
            )
        board = air.shade(thing.colour, 0.0, thing.z)
        for at in (-0.25, 0.22):
            _rectangle(canvas, (u + at * w * metre, top), 0.36 * w * metre, 2.2 * metre, board)
        return
    _rectangle(canvas, (u, (top + foot) / 2), max(1.0, 0.14 * metre), foot - top, grey)
    if thing.kind == "lamp":
        end = u + (0.5 - thing.variant) * 2 * w * metre
        _rectangle(canvas, ((u + end) / 2, top), abs(end - u), max(1.0, 0.12 * metre), grey)
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


def _signal_head(canvas: _Canvas, thing: Thing, at: tuple[float, float], metre: float) -> None:
    """Three lamps in a dark case; on an arm that reaches over the road when the size says so."""
    air = canvas.air
    u, v = at
    if thing.size[2] > 0:  # post stands on the right, the head hangs over the lane
        right = u + thing.size[2] * metre
        _rectangle(
            canvas,
            ((u + right) / 2, v),
            right - u,
            max(1.0, 0.14 * metre),
            air.shade((92, 95, 98), 3.0, thing.z),
        )
    size = metre * 1.25
    _rectangle(canvas, (u, v), 0.5 * size, 1.15 * size, air.shade((22, 22, 24), 3.0, thing.z))
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


def _rectangle(
    canvas: _Canvas, centre: tuple[float, float], w: float, h: float, colour: Colour
) -> None:
    u, v = centre
    low = (int((u - w / 2) * 16), int((v - h / 2) * 16))
    cv2.rectangle(
        canvas.image, low, (int((u + w / 2) * 16), int((v + h / 2) * 16)), colour, -1, shift=4
    )


def _rails(canvas: _Canvas) -> None:
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


def _draw_things(canvas: _Canvas, scene: Scene) -> None:
    """All things from far to near, with their mirror images on wet road."""
    if scene.surroundings == "highway":
        _rails(canvas)
    for thing in canvas.layout.things:
        if thing.kind == "building":
            _draw_building(canvas, thing)
        elif thing.kind == "tree":
            _draw_tree(canvas, thing)
        elif thing.kind in VEHICLES:
            _draw_vehicle(canvas, thing)
            if canvas.air.wet > 0.1 and thing.z < 45:
                _mirror(canvas, thing)
        else:
            _draw_post(canvas, thing)


def _mirror(canvas: _Canvas, thing: Thing) -> None:
    w, h, _ = thing.size
    corners = np.array([[thing.x - w / 2, h, thing.z], [thing.x + w / 2, 0, thing.z]])
    (u0, v0), (u1, v1) = canvas.camera.project(corners) // 16
    weather.reflect(canvas.image, (int(u0), int(v0), int(u1), int(v1)), 0.5 * canvas.air.wet)
    if canvas.air.fall > 0.4 and thing.facing == "rear":  # spray behind the wheels
        metre = canvas.camera.focal / thing.z
        haze = _scale(canvas.air.haze, 0.9)
        for u in (int(u0), int(u1)):
            weather.add_glow(canvas.image, (u, v1 - 0.2 * metre), 0.9 * metre, haze, 0.35)


def _bonnet(canvas: _Canvas) -> None:
    """Sometimes the own bonnet or dashboard at the lower edge."""
    looks, (height, width) = canvas.layout.looks, canvas.image.shape[:2]
    if looks[4] > 0.45:
        return
    rise = height * (0.03 + 0.22 * looks[4])
    centre = (int(width * (0.5 + 0.1 * (looks[5] - 0.5)) * 16), int((height + 1.2 * rise) * 16))
    paint = _mix((30, 30, 33), PAINTS[int(looks[6] * len(PAINTS))], 0.6 * looks[7])
    axes = (int(width * 0.75 * 16), int(2.2 * rise * 16))
    colour = _scale(paint, canvas.air.light[1] * 0.8 + 0.02)
    cv2.ellipse(canvas.image, centre, axes, 0, 180, 360, colour, -1, cv2.LINE_AA, 4)


def render(scene: Scene, width: int = 448, height: int = 256) -> Image:
    """Picture of a scene: RGB uint8 [height, width, 3], the same for the same arguments."""
    layout = draw_layout(scene, width, height)
    rng = np.random.default_rng([scene.seed, 1, CONDITIONS.index(scene.condition)])
    air = weather.draw_atmosphere(scene.condition, rng)
    canvas = _Canvas(np.empty((height, width, 3), np.uint8), layout, air, [])
    camera = layout.camera
    horizon = int(camera.v0)
    weather.paint_sky(canvas.image, air, horizon + 1, rng)
    _ground(canvas, scene)
    weather.paint_ground_texture(
        canvas.image, horizon, 0.25 + 0.4 * layout.looks[0], layout.looks[1]
    )
    _shadows(canvas)
    weather.light_ground(
        canvas.image, air, horizon=camera.v0, focal_height=camera.focal * camera.mount_m
    )
    _skyline(canvas, scene.surroundings)
    _draw_things(canvas, scene)
    for u, v, radius, colour, gain in canvas.lights:
        weather.add_glow(canvas.image, (u, v), radius, colour, gain)
    image = weather.add_precipitation(canvas.image, air, rng)
    if image is not canvas.image:
        canvas = replace(canvas, image=image)
    _bonnet(canvas)
    return weather.expose(
        canvas.image, np.random.default_rng([scene.seed, 2]), dark=air.headlamp > 0
    )
