"""Pictures that no two seeds share, and what the sources of frames made of them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from data.sources.seen import Frames, Seen, Skipped

SIZE_PX = (160, 96)


def pixels_of(seed: int) -> NDArray[np.uint8]:
    """A picture [height, width, 3] of coarse patches; two seeds never look alike."""
    patches = np.random.default_rng(seed).integers(0, 256, (6, 10, 3), np.uint8)
    return np.asarray(cv2.resize(patches, SIZE_PX, interpolation=cv2.INTER_CUBIC), np.uint8)


def encoded(pixels: NDArray[np.uint8], ending: str = ".jpg", quality: int = 90) -> bytes:
    done, picture = cv2.imencode(ending, pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return bytes(picture)


def jpeg(seed: int) -> bytes:
    return encoded(pixels_of(seed))


def seen_in(frames: Frames) -> list[Seen]:
    return [frame for frame in frames if isinstance(frame, Seen)]


def skipped_in(frames: Frames) -> list[Skipped]:
    return [frame for frame in frames if isinstance(frame, Skipped)]


def write(path: Path, content: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def real_samples(root: Path) -> Path:
    """The folder of real samples; the test is skipped on machines that have none."""
    folder = root.parent / "shared/real"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    return folder
