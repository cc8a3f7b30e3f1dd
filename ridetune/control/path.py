"""A path: waypoints with speeds, resampled evenly, with heading and curvature at each point.

In: waypoints [n, 2] and speeds. Out: a table that the compiled controllers read, and the car's
place on it. x forward, y left, headings and curvatures counter-clockwise, SI units.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ridetune.control.kernel import Numbers, kernel

SPACING_M = 0.5
# The columns of a path's table.
X, Y, HEADING, CURVATURE, SMOOTH_CURVATURE, SPEED = range(6)
# Half the baseline over which headings and curvatures are taken: waypoints are no smooth curve.
_BASELINE_M = 1.0
# The steering feed-forward sees the curvature averaged over this distance to each side: a turn
# is steered ahead, while how a lane change is followed is left to the weights.
FEED_FORWARD_M = 20.0
_SEARCH = 200


@dataclass(frozen=True)
class Path:
    """Points every SPACING_M metres: `table` [point, column]; see the columns above."""

    table: Numbers = field(repr=False)

    @staticmethod
    def of(waypoints: ArrayLike, speeds_mps: ArrayLike) -> "Path":
        """From waypoints [n, 2] in driving order and a speed [m/s] for each, or for all.

        ValueError for fewer than two points, points that repeat, or numbers that are not finite.
        """
        points = np.asarray(waypoints, float)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
            raise ValueError(f"a path needs waypoints [n, 2], n >= 2, got shape {points.shape}")
        speeds = np.broadcast_to(np.asarray(speeds_mps, float), len(points))
        if not (np.isfinite(points).all() and np.isfinite(speeds).all()):
            raise ValueError("a path's waypoints and speeds must be finite")
        steps = np.hypot(*np.diff(points, axis=0).T)
        if steps.min() <= 0.0:
            raise ValueError(f"waypoint {int(np.argmin(steps)) + 1} repeats the one before it")
        at = np.concatenate([[0.0], np.cumsum(steps)])
        even = np.arange(0.0, at[-1] + SPACING_M, SPACING_M).clip(max=at[-1])
        if even[-1] - even[-2] < 0.5 * SPACING_M:
            even = even[:-1]
        x, y = np.interp(even, at, points[:, 0]), np.interp(even, at, points[:, 1])
        heading = _heading(x, y)
        curvature = _slope(heading)
        smooth = _moving_mean(curvature, round(FEED_FORWARD_M / SPACING_M))
        speed = np.interp(even, at, speeds)
        return Path(np.stack([x, y, heading, curvature, smooth, speed], axis=1))


@kernel
def locate(table: Numbers, index: int, x_m: float, y_m: float) -> tuple[int, float, float, float]:
    """The car's place on a path: nearest point, arc length [m], lateral error [m], heading [rad].

    index: the nearest point of the step before; the search walks on from there. The lateral
    error is positive left of the path; the heading is the path's own.
    """
    last = len(table) - 1
    best = (x_m - table[index, X]) ** 2 + (y_m - table[index, Y]) ** 2
    for direction in (1, -1):
        for _ in range(_SEARCH):
            other = index + direction
            if other < 0 or other > last:
                break
            distance = (x_m - table[other, X]) ** 2 + (y_m - table[other, Y]) ** 2
            if distance >= best:
                break
            index, best = other, distance
    heading = table[index, HEADING]
    along_x, along_y = np.cos(heading), np.sin(heading)
    dx, dy = x_m - table[index, X], y_m - table[index, Y]
    along = dx * along_x + dy * along_y
    # Across a bent path the tangent errs by curvature / 2 * along^2.
    curvature = table[index, CURVATURE]
    lateral = dy * along_x - dx * along_y - 0.5 * curvature * along * along
    return index, index * SPACING_M + along, lateral, heading + curvature * along


@kernel
def _between(table: Numbers, at_m: float) -> tuple[int, float]:
    """The point before an arc length [m], and the share of the way to the next one."""
    place = min(max(at_m / SPACING_M, 0.0), len(table) - 1.0)
    low = min(int(place), len(table) - 2)
    return low, place - low


@kernel
def read_path(table: Numbers, column: int, at_m: float) -> float:
    """A column's value at an arc length [m], interpolated; the ends go on for ever."""
    low, share = _between(table, at_m)
    value: float = (1.0 - share) * table[low, column] + share * table[low + 1, column]
    return value


@kernel
def read_curvatures(table: Numbers, at_m: float) -> tuple[float, float]:
    """The curvature and the smoothed curvature at an arc length [m], interpolated."""
    low, share = _between(table, at_m)
    return (
        (1.0 - share) * table[low, CURVATURE] + share * table[low + 1, CURVATURE],
        (1.0 - share) * table[low, SMOOTH_CURVATURE] + share * table[low + 1, SMOOTH_CURVATURE],
    )


@kernel
def wrap(angle_rad: float) -> float:
    """An angle in [-pi, pi)."""
    return (angle_rad + np.pi) % (2.0 * np.pi) - np.pi


def _around(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The points half a baseline ahead of and behind each; the ends repeat."""
    at, reach = np.arange(count), round(_BASELINE_M / SPACING_M)
    return np.minimum(at + reach, count - 1), np.maximum(at - reach, 0)


def _heading(x: Numbers, y: Numbers) -> Numbers:
    ahead, behind = _around(len(x))
    return np.unwrap(np.arctan2(y[ahead] - y[behind], x[ahead] - x[behind]))


def _slope(heading: Numbers) -> Numbers:
    ahead, behind = _around(len(heading))
    slope: Numbers = (heading[ahead] - heading[behind]) / ((ahead - behind) * SPACING_M)
    return slope


def _moving_mean(values: Numbers, reach: int) -> Numbers:
    """The mean of the 2 * reach + 1 values around each; the ends repeat."""
    padded = np.pad(values, reach, mode="edge")
    sums = np.concatenate([[0.0], np.cumsum(padded)])
    width = 2 * reach + 1
    mean: Numbers = (sums[width:] - sums[:-width]) / width
    return mean
