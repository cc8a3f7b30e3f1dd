"""What a photograph from a car shows: sky, horizon, road, and a guess of the depth.

In: an RGB frame. Out: a `View` on a canvas of at most 256 px. Depth is a guess: the ground is a
plane, what stands on it is as near as its height over the horizon says, the sky is infinitely far.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ridetune.camera.weather import Image

Plane = NDArray[np.floating[Any]]  # [rows, columns] of the canvas, or with 3 colours

_CANVAS = 256  # px, width
_FOCAL = 0.9  # focal length in widths of the frame
_CAMERA_M = 1.4  # height of the camera over the road
_STANDING_M = 9.0  # height of what stands beside a road: trees, houses
_FARTHEST_M = 150.0


@dataclass(frozen=True)
class View:
    """What a frame shows, on the canvas [rows, columns]; weights 0..1."""

    canvas: Image
    horizon: int  # row
    depth: Plane  # m; without the sky
    right: Plane  # m; to the right of the camera
    road: Plane  # weight of what looks like the road
    flat: Plane  # factor that takes most of the sun and its shadows away
    sky: Plane  # weight
    edge: Image  # weight of the sky, 0..255, on as many upper rows of the frame as hold sky


def read_view(frame: Image) -> View:
    """What an RGB frame [height, width, 3] shows."""
    columns = min(_CANVAS, frame.shape[1])
    rows = max(round(frame.shape[0] * columns / frame.shape[1]), 8)
    canvas = np.asarray(cv2.resize(frame, (columns, rows), interpolation=cv2.INTER_AREA), np.uint8)
    grey = np.asarray(cv2.cvtColor(canvas, cv2.COLOR_RGB2GRAY), np.uint8)
    sky = _find_sky(canvas, grey)
    horizon = _find_horizon(grey, sky)
    depth = _guess_depth(sky, horizon)
    right = (np.arange(columns, dtype=np.float32) / columns - 0.5) / _FOCAL * depth
    base = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 0.02 * columns) + 12
    flat = np.clip(np.sqrt(105 / base), 0.6, 1.7)
    road = _find_road(canvas, horizon)
    return View(canvas, horizon, depth, right, road, flat, sky, _follow_edges(sky, canvas, frame))


def _find_sky(canvas: Image, grey: Image) -> Plane:
    """Weight of the sky: smooth, bright or blue, and connected with the upper edge."""
    rows, columns = grey.shape
    r, g, b = (canvas[..., i].astype(np.int16) for i in range(3))
    small = np.ones((3, 3), np.uint8)
    rough = cv2.blur(cv2.morphologyEx(grey, cv2.MORPH_GRADIENT, small), (5, 5))
    blue = (b > r + 8) & (b >= g - 2) & (grey > 40)
    like = (rough < 22) & (blue | (grey > 150)) & (np.arange(rows) < 0.62 * rows)[:, None]
    _, labels = cv2.connectedComponents(like.astype(np.uint8), connectivity=4)
    upper = np.bincount(labels[:3][like[:3]], minlength=labels.max() + 1)
    sky = (upper > 0.02 * columns)[labels] & like
    return np.asarray(cv2.dilate(sky.astype(np.float32), small), np.float32)


def _find_horizon(grey: Image, sky: Plane) -> int:
    """Row where straight lines of the road meet; else the lower edge of the sky, or the middle."""
    rows, columns = grey.shape
    edges = cv2.Canny(grey, 60, 150)
    edges[: int(0.35 * rows)] = 0
    found = cv2.HoughLinesP(edges, 1, np.pi / 180, 18, None, columns // 12, 3)
    row = None if found is None else _meeting(np.asarray(found, np.float64).reshape(-1, 4), grey)
    if row is None:
        low = np.flatnonzero(sky.max(axis=1) > 0.5)
        row = float(low[-1]) if len(low) else 0.5 * rows
    return int(np.clip(row, 0.3 * rows, 0.6 * rows))


def _meeting(lines: NDArray[np.float64], grey: Image) -> float | None:
    """Median row where lines (u0, v0, u1, v1) leaning left cross such leaning right, by length."""
    rows, columns = grey.shape
    u0, v0, u1, v1 = lines.T
    slope = (u1 - u0) / np.where(v1 == v0, 1e-6, v1 - v0)  # columns per row
    start, length = u0 - slope * v0, np.hypot(u1 - u0, v1 - v0)
    left, right = (slope < -0.3) & (slope > -4), (slope > 0.3) & (slope < 4)
    row = (start[left][:, None] - start[right]) / (slope[right] - slope[left][:, None])
    off = np.abs(start[left][:, None] + slope[left][:, None] * row - columns / 2)
    good = (row > 0.25 * rows) & (row < 0.65 * rows) & (off < 0.25 * columns)
    weight = (length[left][:, None] * length[right] * good).ravel()
    if not weight.any():
        return None
    order = np.argsort(row, axis=None)
    total = np.cumsum(weight[order])
    return float(row.ravel()[order][np.searchsorted(total, total[-1] / 2)])


def _guess_depth(sky: Plane, horizon: int) -> Plane:
    rows, columns = sky.shape
    focal = _FOCAL * columns
    ground = (np.arange(rows) - horizon) / (focal * _CAMERA_M)
    skyline = np.argmax(sky < 0.5, axis=0).astype(np.float32)[None]
    standing = np.maximum(horizon - skyline, 0) / (focal * _STANDING_M)
    standing = np.maximum(cv2.GaussianBlur(standing, (0, 0), 0.08 * columns), 1 / _FARTHEST_M)
    return np.asarray(1 / np.maximum(ground[:, None], standing), np.float32)


def _find_road(canvas: Image, horizon: int) -> Plane:
    """Weight of what lies below the horizon and has the colour of the road ahead."""
    rows, columns = canvas.shape[:2]
    lab = cv2.cvtColor(canvas, cv2.COLOR_RGB2LAB).astype(np.float32)
    top, bottom = horizon + (rows - horizon) // 4, horizon + 3 * (rows - horizon) // 4
    ahead = np.median(lab[top:bottom, 2 * columns // 5 : 3 * columns // 5], axis=(0, 1))
    off = (lab - ahead.astype(np.float32)) / np.array((60, 8, 10), np.float32)
    like = np.exp(-np.sum(off * off, axis=2)) * rise(rows, horizon, 0.05)
    closed = cv2.morphologyEx(like, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    return np.asarray(cv2.GaussianBlur(closed, (0, 0), 0.008 * columns), np.float32)


def rise(rows: int, start: float, span: float) -> Plane:
    """Ramp [rows, 1] from 0 at the row `start` to 1 a share `span` of the rows further down."""
    share = (np.arange(rows, dtype=np.float32) - start) / (span * rows)
    return np.asarray(np.clip(share, 0, 1)[:, None])


def _follow_edges(weight: Plane, canvas: Image, frame: Image) -> Image:
    """A weight of the canvas at the size of the frame, following the edges of its blue channel.

    Fast guided filter, He and Sun 2015: weight = a * guide + b within each window. Rows below all
    weight are left out.
    """
    rows, columns = canvas.shape[:2]
    window = (max(columns // 20 | 1, 3),) * 2
    used = np.flatnonzero(weight.any(axis=1))
    last = min(int(used[-1]) + 2 * window[0], rows) if len(used) else 1
    guide, target = canvas[:last, :, 2].astype(np.float32) / 255, weight[:last]
    mean, low = cv2.blur(guide, window), cv2.blur(target, window)
    spread = cv2.blur(guide * guide, window) - mean * mean
    a = (cv2.blur(guide * target, window) - mean * low) / (spread + 2e-3)
    height, width = max(round(last * frame.shape[0] / rows), 1), frame.shape[1]
    half = (max(width // 2, columns), max(height // 2, last))  # enough, at a quarter of the work
    scale, shift = (cv2.resize(cv2.blur(x, window), half) for x in (a, low - a * mean))
    blue = cv2.resize(cv2.extractChannel(frame[:height], 2), half, interpolation=cv2.INTER_AREA)
    fine = np.clip(1.5 * (scale * (blue * np.float32(1 / 255)) + shift) - 0.25, 0, 1)
    return np.asarray(cv2.resize((255 * fine).astype(np.uint8), (width, height)), np.uint8)
