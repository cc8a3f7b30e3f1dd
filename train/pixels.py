"""Fitted frames -> patches for training, with the spread of real cameras added."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ridetune.vision import VisionSpec, patchify


@dataclass(frozen=True)
class Augment:
    """Random exposure, colour, blur and shift; never a flip, which would swap the curves."""

    gain: float = 0.2  # standard deviation of the log gain
    colour: float = 0.05  # the same per channel
    offset: float = 10.0  # standard deviation of the black level, of 255
    shift_px: int = 8  # largest shift in either direction
    blur: float = 0.2  # share of frames that are blurred

    def __call__(self, frame: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
        """One frame [height, width, 3], changed."""
        gain = np.exp(rng.normal(0, self.gain) + rng.normal(0, self.colour, 3))
        exposed = np.clip(frame * gain + rng.normal(0, self.offset), 0, 255).astype(np.uint8)
        dx, dy = (int(v) for v in rng.integers(-self.shift_px, self.shift_px + 1, 2))
        shift = np.array([[1, 0, dx], [0, 1, dy // 2]], np.float32)
        moved = cv2.warpAffine(
            exposed,
            shift,
            (frame.shape[1], frame.shape[0]),
            flags=cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_REPLICATE,
        )
        blurred = cv2.blur(moved, (3, 3)) if rng.random() < self.blur else moved
        return np.asarray(blurred, np.uint8)


def patches_of(
    pixels: NDArray[np.uint8],
    spec: VisionSpec,
    augment: Augment | None = None,
    rng: np.random.Generator | None = None,
) -> Tensor:
    """Fitted frames [frame, height, width, 3] -> patches [frame, patch, values]."""
    if augment is not None and rng is not None:
        pixels = np.stack([augment(frame, rng) for frame in pixels])
    return torch.from_numpy(np.stack([patchify(frame, spec) for frame in pixels]))
