"""nuScenes: the front camera's key frames with speed, weather, lead vehicle and traffic.

In: <root>/v1.0-{mini,trainval,test} with its tables, and <root>/samples/CAM_FRONT (Caesar et al.,
"nuScenes", CVPR 2020; schema of the official devkit). Out: a `Seen` for each key frame.

    speed          from the poses of the neighbouring key frames
    condition      from the words of the scene; there is neither fog nor snow in nuScenes
    lead, traffic  from the boxes of vehicles that the front camera sees; v1.0-test has none
    road           from how the car turns in the next three seconds

Frames: global [m], ego (x ahead, y left, at the rear axle on the ground), camera (x right, y down,
z ahead). The licence of nuScenes forbids commercial use: CC BY-NC-SA 4.0 and its terms.
"""

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ridetune.camera.scene import Lead, Road
from ridetune.sample import Observation

from .seen import Facts, Frames, Seen, Skipped, fault_of_frame
from .tables import read_table

LICENCE = "CC BY-NC-SA 4.0 and the nuScenes terms of use"
CHANNEL = "CAM_FRONT"

# The Renault Zoe of nuScenes, rear axle to front bumper, and half a lane [m].
_BUMPER_M, _HALF_LANE_M = 3.4, 1.8
# As in the simulation's own descriptions (ridetune/sim/view.py) [m].
_CLOSE_M, _MENTIONED_M = 20.0, 60.0
# Moving or waiting vehicles that the front camera sees within _MENTIONED_M.
_DENSE = 6
# How far the heading changes in the time that a look at the road takes [s, rad].
_LOOK_S, _CURVE_RAD, _TURN_RAD, _MOVED_M = 3.0, 0.08, 0.7, 5.0
# A pause between key frames beyond which they say nothing of the speed [s].
_LONGEST_GAP_S = 1.5

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Pose:
    """A frame in its parent: rotation [3, 3] and translation [3] in metres."""

    rotation: Vector
    translation: Vector

    @staticmethod
    def of(quaternion: Iterable[float], translation: Iterable[float]) -> "Pose":
        """From [w, x, y, z] and [x, y, z]."""
        w, x, y, z = np.asarray(quaternion, float) / np.linalg.norm(np.asarray(quaternion, float))
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        return Pose(rotation, np.asarray(translation, float))

    def inside(self, point: Vector) -> Vector:
        """A point [3] of the parent as this frame has it."""
        return self.rotation.T @ (point - self.translation)

    @property
    def heading(self) -> float:
        """Angle of the x axis in the parent's plane [rad]."""
        return math.atan2(self.rotation[1, 0], self.rotation[0, 0])


@dataclass(frozen=True)
class Camera:
    """Where the camera sits in the ego frame, and its intrinsic matrix [3, 3] in pixels."""

    pose: Pose
    intrinsic: Vector
    width_px: int
    height_px: int

    def sees(self, point: Vector) -> bool:
        """Whether a point [3] of the camera's own frame lies in the picture."""
        if point[2] <= 0.0:
            return False
        u, v = (self.intrinsic @ point)[:2] / point[2]
        return bool(0.0 <= u < self.width_px and 0.0 <= v < self.height_px)


@dataclass
class _Ahead:
    """What the boxes of one key frame say."""

    gap_m: float = math.inf
    vehicles: int = 0


@dataclass(frozen=True)
class KeyFrame:
    """One picture of the front camera; time in microseconds."""

    sample: str
    time_us: int
    filename: str
    pose: str
    camera: Camera


@dataclass(frozen=True)
class _Tables:
    """All that is read once."""

    scenes: dict[str, tuple[str, str]]  # token -> name, description
    frames: dict[str, list[KeyFrame]]  # scene token -> in order of time
    poses: dict[str, Pose]
    ahead: dict[str, _Ahead] | None = field(default=None)  # by sample; None without annotations


def read_nuscenes(root: Path, *, stride: int = 1) -> Frames:
    """Every stride-th key frame of every scene, in order of scene and time.

    ValueError where the tables are missing, damaged or of another layout.
    """
    folder = _version(root)
    tables = _read(folder)
    for scene in sorted(tables.scenes, key=lambda token: tables.scenes[token]):
        name, description = tables.scenes[scene]
        frames = tables.frames.get(scene, [])
        if not frames:
            yield Skipped(name, f"it has no key frame of {CHANNEL}")
        for number in range(0, len(frames), stride):
            yield _seen(root, name, description, frames, number, tables)


def _seen(
    root: Path, scene: str, description: str, frames: list[KeyFrame], number: int, tables: _Tables
) -> Seen | Skipped:
    frame = frames[number]
    name = f"{scene}/{number:03d}"
    path = root / frame.filename
    if not path.is_file():
        return Skipped(name, f"{frame.filename} is not there")
    picture = path.read_bytes()
    fault = fault_of_frame(picture)
    if fault is not None:
        return Skipped(name, f"{frame.filename}: {fault}")
    night, rain = (
        re.search(rf"\b{word}", description, re.IGNORECASE) is not None
        for word in ("night", "rain")
    )
    ahead = None if tables.ahead is None else tables.ahead[frame.sample]
    facts = Facts(
        condition="rain" if rain else "night" if night else "sunny",
        dark=night,
        road=_road(frames, number, tables.poses),
        lead=None if ahead is None else _lead(ahead.gap_m),
        traffic=None if ahead is None else "dense" if ahead.vehicles >= _DENSE else "light",
        surroundings="city",
    )
    speed = _speed(frames, number, tables.poses)
    return Seen(name, scene, Observation(picture, speed), facts)


def _version(root: Path) -> Path:
    found = sorted(path for path in root.glob("v1.0-*") if path.is_dir())
    if not found:
        raise ValueError(
            f"{root} holds no v1.0-mini, v1.0-trainval or v1.0-test; "
            "name the folder into which nuScenes was unpacked"
        )
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise ValueError(f"{root} holds {names}; keep one, or link the one you mean elsewhere")
    return found[0]


def _read(folder: Path) -> _Tables:
    front = {
        token
        for token, channel in read_table(folder, "sensor", "token", "channel")
        if channel == CHANNEL
    }
    mounted = {
        token: (Pose.of(rotation, translation), np.array(intrinsic, float))
        for token, sensor, rotation, translation, intrinsic in read_table(
            folder,
            "calibrated_sensor",
            "token",
            "sensor_token",
            "rotation",
            "translation",
            "camera_intrinsic",
        )
        if sensor in front
    }
    scenes = {
        token: (name, description)
        for token, name, description in read_table(folder, "scene", "token", "name", "description")
    }
    scene_of = dict(read_table(folder, "sample", "token", "scene_token"))
    frames: dict[str, list[KeyFrame]] = defaultdict(list)
    for sample, pose, mount, time_us, is_key, filename, width, height in read_table(
        folder,
        "sample_data",
        "sample_token",
        "ego_pose_token",
        "calibrated_sensor_token",
        "timestamp",
        "is_key_frame",
        "filename",
        "width",
        "height",
    ):
        if is_key and mount in mounted:
            if sample not in scene_of:
                raise ValueError(
                    f"{folder}: sample_data names the sample {sample}, which is not there"
                )
            camera = Camera(*mounted[mount], width, height)
            frames[scene_of[sample]].append(KeyFrame(sample, time_us, filename, pose, camera))
    for several in frames.values():
        several.sort(key=lambda frame: frame.time_us)
    wanted = {frame.pose for several in frames.values() for frame in several}
    poses = {
        token: Pose.of(rotation, translation)
        for token, rotation, translation in read_table(
            folder, "ego_pose", "token", "rotation", "translation"
        )
        if token in wanted
    }
    if wanted - poses.keys():
        raise ValueError(f"{folder}: ego_pose lacks {len(wanted - poses.keys())} of the key frames")
    every = [frame for several in frames.values() for frame in several]
    return _Tables(scenes, dict(frames), poses, _look_ahead(folder, every, poses))


def _look_ahead(
    folder: Path, frames: list[KeyFrame], poses: dict[str, Pose]
) -> dict[str, _Ahead] | None:
    """Gap to the lead vehicle and vehicles in view, by sample; None without annotations."""
    if not (folder / "sample_annotation.json").is_file():
        return None
    vehicles = {
        token
        for token, name in read_table(folder, "category", "token", "name")
        if name.startswith("vehicle.") and "bicycle" not in name
    }
    parked = {
        token
        for token, name in read_table(folder, "attribute", "token", "name")
        if name == "vehicle.parked"
    }
    driving = {
        token
        for token, category in read_table(folder, "instance", "token", "category_token")
        if category in vehicles
    }
    frame_of = {frame.sample: frame for frame in frames}
    ahead = {sample: _Ahead() for sample in frame_of}
    empty = True
    for sample, instance, attributes, translation, size, rotation in read_table(
        folder,
        "sample_annotation",
        "sample_token",
        "instance_token",
        "attribute_tokens",
        "translation",
        "size",
        "rotation",
    ):
        empty = False
        frame = frame_of.get(sample)
        if frame is None or instance not in driving or parked.intersection(attributes):
            continue
        ego = poses[frame.pose]
        at = ego.inside(np.asarray(translation, float))
        if not frame.camera.sees(frame.camera.pose.inside(at)):
            continue
        turned = Pose.of(rotation, translation).heading - ego.heading
        gap = _gap(at, size, turned)
        found = ahead[sample]
        found.vehicles += gap < _MENTIONED_M
        if abs(at[1]) < _HALF_LANE_M:
            found.gap_m = min(found.gap_m, gap)
    return None if empty else ahead


def _gap(at: Vector, size: Iterable[float], turned: float) -> float:
    """Front bumper to the near end of a box [w, l, h] that is turned by an angle [m]."""
    width, length, _ = size
    half = 0.5 * (length * abs(math.cos(turned)) + width * abs(math.sin(turned)))
    return float(at[0]) - half - _BUMPER_M


def _lead(gap_m: float) -> Lead:
    if gap_m >= _MENTIONED_M:
        return "none"
    return "near" if gap_m < _CLOSE_M else "far"


def _speed(frames: list[KeyFrame], number: int, poses: dict[str, Pose]) -> float | None:
    """Way between the neighbours over the time between them [m/s]; None without a neighbour."""
    first, last = frames[max(number - 1, 0)], frames[min(number + 1, len(frames) - 1)]
    seconds = (last.time_us - first.time_us) * 1e-6
    if not 0.0 < seconds <= 2.0 * _LONGEST_GAP_S:
        return None
    way = poses[last.pose].translation - poses[first.pose].translation
    return float(np.linalg.norm(way)) / seconds


def _road(frames: list[KeyFrame], number: int, poses: dict[str, Pose]) -> Road | None:
    """Where the car goes next; None where the scene ends or the car stands."""
    start = frames[number]
    later = next(_after(frames, number, start.time_us + int(_LOOK_S * 1e6)), None)
    if later is None:
        return None
    here, there = poses[start.pose], poses[later.pose]
    if np.linalg.norm(there.translation - here.translation) < _MOVED_M:
        return None
    turned = math.remainder(there.heading - here.heading, math.tau)
    if abs(turned) > _TURN_RAD:
        return "intersection"
    if abs(turned) > _CURVE_RAD:
        return "left curve" if turned > 0 else "right curve"
    return "straight"


def _after(frames: list[KeyFrame], number: int, time_us: int) -> Iterator[KeyFrame]:
    return (frame for frame in frames[number + 1 :] if frame.time_us >= time_us)
