"""Pinhole camera of the synthetic pictures: from the road to pixels.

In: points on or over the road. Out: pixels. Frames: x to the right of the centre line of the own
path, y up from the ground, z along the road ahead of the camera, in metres; pixels (u, v) to the
right and down.
"""

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
