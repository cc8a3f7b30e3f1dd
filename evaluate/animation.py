"""What the page's player needs to show a manoeuvre from above, three styles side by side.

Signals in, one JSON-ready dict per manoeuvre out: poses of the car eight times a second, poses of
the others, the path, and which part of the world to show. The player is page_parts/player.js.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ridetune.control.tracker import PERIOD_S
from ridetune.control.vehicle import Vehicle
from ridetune.matrix import STYLES
from ridetune.sim.road import AT_X, AT_Y, lay_out
from ridetune.sim.scenarios import LANE_M, SCENARIOS

from .driving_score import Manoeuvre
from .style_drives import EVERY, FRAME_S, SHOWN, Signals

# Part of the world that is shown [m]: x and y from .. to, and lanes by their middle's y.
_VIEWS: dict[Manoeuvre, dict[str, Any]] = {
    "acceleration": {"x": [-8.0, 215.0], "y": [-4.4, 4.4], "lanes": [0.0], "follow": True},
    "lane_change": {"x": [10.0, 165.0], "y": [-3.4, 6.9], "lanes": [0.0, LANE_M], "follow": True},
    "left_turn": {"x": [6.0, 78.0], "y": [-8.0, 52.0], "lanes": [0.0], "follow": False},
}
# When nothing is left to see [s].
_UNTIL_S: dict[Manoeuvre, float] = {"acceleration": 18.0, "lane_change": 10.5, "left_turn": 13.0}


def animate(
    manoeuvre: Manoeuvre, drives: Mapping[str, Signals], vehicle: Vehicle
) -> dict[str, Any]:
    """One manoeuvre for the player: all lengths in metres, angles in radians, speeds in km/h."""
    scenario = SCENARIOS[manoeuvre]
    rows = round(min(_UNTIL_S[manoeuvre], scenario.duration_s) / FRAME_S)
    steps = EVERY * np.arange(rows)
    road = lay_out(scenario, "sunny", vehicle, PERIOD_S)
    body = vehicle.body
    return {
        "name": manoeuvre,
        "frame_s": FRAME_S,
        "view": _VIEWS[manoeuvre],
        "lane_m": LANE_M,
        "path": _rounded(scenario.waypoints()[::10]),
        "car": {
            "length": body.length_m,
            "width": body.width_m,
            "behind": round(body.length_m - body.nose_m, 3),
        },
        "others": [
            {
                "length": actor.length_m,
                "width": actor.width_m,
                "at": _rounded(track[np.minimum(steps, len(track) - 1)][:, [AT_X, AT_Y]]),
            }
            for actor, track in zip(scenario.actors, road.positions, strict=True)
        ],
        "cars": [_poses(style, drives[style], rows) for style in STYLES],
    }


def _poses(style: str, signals: Signals, rows: int) -> dict[str, Any]:
    """x, y of the rear axle, heading, speed [km/h] by frame; shorter where the drive ended."""
    columns = (*(signals[name] for name in SHOWN[:3]), 3.6 * signals["speed_mps"])
    poses = np.stack(columns, axis=1)[:rows]
    whole = np.isfinite(poses).all(axis=1)
    return {"style": style, "poses": _rounded(poses[whole], 3)}


def _rounded(values: Any, digits: int = 2) -> list[list[float]]:
    rounded: list[list[float]] = np.round(values, digits).tolist()
    return rounded
