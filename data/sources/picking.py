"""Which pictures of a drive are worth a frame: those that changed enough since the last one.

In: the pictures of one drive, in order. Out: whether to take each of them. Change is measured on
grey thumbnails, so that neither noise nor a wiper blade counts.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

THUMBNAIL_PX = (32, 18)


class Picker:
    """Remembers the last picture taken; `change` of 255 on average makes the next one new."""

    def __init__(self, change: float) -> None:
        self._change = change
        self._last: NDArray[np.int16] | None = None

    def takes(self, picture: NDArray[np.uint8]) -> bool:
        """Whether to take this picture [height, width, 3], blue first as OpenCV has it."""
        small = cv2.resize(picture, THUMBNAIL_PX, interpolation=cv2.INTER_AREA)
        grey = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY).astype(np.int16)
        if self._last is not None and np.abs(grey - self._last).mean() < self._change:
            return False
        self._last = grey
        return True
