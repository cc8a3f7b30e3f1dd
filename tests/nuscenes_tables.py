"""Drives as nuScenes tables: cars on known ways, with known boxes around them."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.source_files import SIZE_PX, jpeg, write

Rows = dict[str, list[dict[str, Any]]]


@dataclass(frozen=True)
class Box:
    """What stands in one frame, seen from the car [m, rad]; a car is 4.5 m long, 1.9 m wide."""

    ahead_m: float
    left_m: float = 0.0
    turned: float = 0.0
    category: str = "vehicle.car"
    attribute: str = "vehicle.moving"
    frame: int = 0


@dataclass(frozen=True)
class Way:
    """One scene: a car that drives at one speed and turns at one rate."""

    description: str = "Parked truck, construction"
    speed_mps: float = 10.0
    turn_rad_s: float = 0.0
    frames: int = 9
    step_s: float = 0.5
    boxes: tuple[Box, ...] = ()


def quaternion(heading: float) -> list[float]:
    return [math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2)]


def poses_of(way: Way) -> Iterator[tuple[float, float, float]]:
    """x, y [m] and heading [rad] of each frame; not along an axis, so that mixed ones show."""
    x, y, heading = 100.0, -40.0, 0.7
    fine = 50
    for _ in range(way.frames):
        yield x, y, heading
        for _ in range(fine):
            heading += way.turn_rad_s * way.step_s / fine
            x += way.speed_mps * way.step_s / fine * math.cos(heading)
            y += way.speed_mps * way.step_s / fine * math.sin(heading)


def nuscenes_tables(*ways: Way) -> Rows:
    """All tables that the source reads, in the layout of nuScenes."""
    names = ("vehicle.car", "vehicle.bicycle", "human.pedestrian.adult")
    attributes = ("vehicle.moving", "vehicle.parked")
    rows: Rows = {
        "sensor": [{"token": f"s-{c}", "channel": c} for c in ("CAM_FRONT", "CAM_BACK")],
        "calibrated_sensor": [
            {
                "token": f"c-{channel}",
                "sensor_token": f"s-{channel}",
                "translation": [1.7, 0.0, 1.5],
                "rotation": [0.5, -0.5, 0.5, -0.5],  # x right, y down, z ahead
                "camera_intrinsic": [[100.0, 0.0, 80.0], [0.0, 100.0, 48.0], [0.0, 0.0, 1.0]],
            }
            for channel in ("CAM_FRONT", "CAM_BACK")
        ],
        "category": [{"token": f"k-{name}", "name": name} for name in names],
        "attribute": [{"token": f"a-{name}", "name": name} for name in attributes],
        "instance": [{"token": f"i-{name}", "category_token": f"k-{name}"} for name in names],
        "scene": [],
        "sample": [],
        "sample_data": [],
        "ego_pose": [],
        "sample_annotation": [],
    }
    for number, way in enumerate(ways, 1):
        add_way(rows, f"scene-{number:04d}", way)
    return rows


def add_way(rows: Rows, scene: str, way: Way) -> None:
    rows["scene"].append({"token": scene, "name": scene, "description": way.description})
    for number, (x, y, heading) in enumerate(poses_of(way)):
        sample = f"{scene}-{number}"
        rows["sample"].append({"token": sample, "scene_token": scene})
        rows["ego_pose"].append(
            {"token": sample, "rotation": quaternion(heading), "translation": [x, y, 0.0]}
        )
        time_us = 1_532_402_927_000_000 + round(number * way.step_s * 1e6)
        for channel, is_key in (("CAM_FRONT", True), ("CAM_FRONT", False), ("CAM_BACK", True)):
            rows["sample_data"].append(
                {
                    "sample_token": sample,
                    "ego_pose_token": sample,
                    "calibrated_sensor_token": f"c-{channel}",
                    "timestamp": time_us,
                    "is_key_frame": is_key,
                    "filename": f"samples/{channel}/{sample}.jpg",
                    "width": SIZE_PX[0],
                    "height": SIZE_PX[1],
                }
            )
        for box in way.boxes:
            if box.frame == number:
                rows["sample_annotation"].append(annotation(sample, box, x, y, heading))
    rows["sample_data"].reverse()  # the order of the table is not that of time


def annotation(sample: str, box: Box, x: float, y: float, heading: float) -> dict[str, Any]:
    ahead, left = box.ahead_m, box.left_m
    return {
        "sample_token": sample,
        "instance_token": f"i-{box.category}",
        "attribute_tokens": [f"a-{box.attribute}"],
        "translation": [
            x + ahead * math.cos(heading) - left * math.sin(heading),
            y + ahead * math.sin(heading) + left * math.cos(heading),
            0.8,
        ],
        "size": [1.9, 4.5, 1.6],
        "rotation": quaternion(heading + box.turned),
    }


def unpack(root: Path, rows: Rows, version: str = "v1.0-mini") -> Path:
    for name, table in rows.items():
        write(root / version / f"{name}.json", json.dumps(table, indent=0).encode())
    for number, row in enumerate(rows["sample_data"]):
        if "CAM_FRONT" in row["filename"]:
            write(root / row["filename"], jpeg(number % 5))
    return root
