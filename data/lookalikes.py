"""Pictures that look alike: a 64-bit difference hash, and a search among all seen so far.

dHash: the picture as 9x8 grey cells; each bit says whether a cell is brighter than its right
neighbour, by more than an even surface varies when it is compressed again. It survives scaling,
recompression and small changes of light.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from ridetune.vision import decode_frame

# Two frames of one clip, half a second apart, differ by about this many bits.
NEAR_BITS = 4
_GLANCE_PX = (72, 64)
# Of 255. Without it an even sky gives random bits: a real picture that was compressed again was up
# to 11 bits away from itself, now 3.
_BRIGHTER = 2.0
_WEIGHTS = (1 << np.arange(63, -1, -1, dtype=np.uint64)).astype(np.uint64)


def difference_hash(frame: bytes) -> np.uint64:
    """Hash of an encoded frame; FrameError if it cannot be decoded."""
    pixels = decode_frame(frame, _GLANCE_PX)
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
    cells = cv2.resize(grey, (9, 8), interpolation=cv2.INTER_AREA)
    bits = (cells[:, :-1] - cells[:, 1:] > _BRIGHTER).reshape(-1)
    return np.uint64(_WEIGHTS[bits].sum(dtype=np.uint64))


class Lookalikes:
    """Remembers hashes with names and finds the nearest one."""

    def __init__(self, near_bits: int = NEAR_BITS) -> None:
        self._near_bits = near_bits
        self._names: list[str] = []
        self._hashes: NDArray[np.uint64] = np.zeros(1024, np.uint64)

    def find_or_add(self, name: str, own: np.uint64) -> str | None:
        """The name of the first picture that looks alike; else None, and this one is kept."""
        count = len(self._names)
        apart = np.bitwise_count(self._hashes[:count] ^ own)
        near = np.flatnonzero(apart <= self._near_bits)
        if len(near):
            return self._names[int(near[0])]
        if count == len(self._hashes):
            self._hashes = np.concatenate([self._hashes, np.zeros_like(self._hashes)])
        self._hashes[count] = own
        self._names.append(name)
        return None
