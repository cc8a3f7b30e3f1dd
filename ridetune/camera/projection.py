"""Pinhole camera of the synthetic pictures: from the road to pixels.

In: points on or over the road. Out: pixels. Frames: x to the right of the centre line of the own
path, y up from the ground, z along the road ahead of the camera, in metres; pixels (u, v) to the
right and down.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]


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
    bend_end_m: float = math.inf
    offset_m: float = 0.0  # of the road to the right, at the camera
    slope: float = 0.0  # of the road to the right, m per m: the car points to its left

    def centre(self, z: Points) -> Points:
        """Lateral shift of the centre line at depth z: a parabola, straight from slope 0.9 on."""
        away = self.offset_m + self.slope * z
        if self.bend == 0.0:
            return away
        d = np.maximum(z - self.bend_start_m, 0.0)
        near = np.minimum(d, self._longest_bend_m)
        return away + self.bend * near * (d - 0.5 * near)

    @property
    def _longest_bend_m(self) -> float:
        return min(0.9 / max(abs(self.bend), 1e-6), max(self.bend_end_m - self.bend_start_m, 0.0))

    def project(self, points: Points) -> NDArray[np.int32]:
        """Road points [n, 3] to pixels [n, 2] in 1/16, as the OpenCV drawing calls take them."""
        z = np.maximum(points[:, 2], 1.0)
        scale = 16.0 * self.focal / z
        pixels = np.empty((len(z), 2))
        x = points[:, 0] + self.centre(z)
        pixels[:, 0] = scale * x + 16 * self.u0
        pixels[:, 1] = scale * (self.mount_m - points[:, 1]) + 16 * self.v0
        return pixels.astype(np.int32)

    def stand(self, x: float, z: float, h: float) -> tuple[float, float, float]:
        """Pixel column, foot row and head row of an upright of height h at (x, z)."""
        scale = self.focal / z
        d = max(z - self.bend_start_m, 0.0)
        near = min(d, self._longest_bend_m)
        away = self.offset_m + self.slope * z
        u = self.u0 + scale * (x + (away + self.bend * near * (d - 0.5 * near)))
        foot = self.v0 + scale * self.mount_m
        return u, foot, foot - scale * h
