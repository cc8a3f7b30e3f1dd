"""Video files: a frame wherever the picture has changed enough since the last one taken.

In: a video, or a folder of them (anything that OpenCV's FFmpeg reads). Out: a `Seen` for each frame
taken, as JPEG; all frames of one file are one scene. Nothing is known of them but the condition
where it is given.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ridetune.sample import Condition, Observation

from .picking import Picker
from .seen import Facts, Frames, Seen, Skipped

ENDINGS = (".mp4", ".mkv", ".avi", ".mov", ".webm")
JPEG_QUALITY = 92


def read_videos(
    root: Path, *, condition: Condition | None = None, every_s: float = 0.5, change: float = 6.0
) -> Frames:
    """Frames at least every_s [s] apart, whose thumbnails differ by `change` of 255 on average.

    ValueError where there is no video; one that cannot be read is skipped.
    """
    paths = (
        [root]
        if root.is_file()
        else sorted(path for path in root.rglob("*") if path.suffix.lower() in ENDINGS)
    )
    if not paths:
        raise ValueError(f"{root} holds no {', '.join(ENDINGS)}; name a video or a folder of them")
    for path in paths:
        scene = path.name if root.is_file() else path.relative_to(root).as_posix()
        yield from _frames_of(path, scene, condition, every_s, change)


def _frames_of(
    path: Path, scene: str, condition: Condition | None, every_s: float, change: float
) -> Frames:
    film = cv2.VideoCapture(str(path))
    try:
        rate = film.get(cv2.CAP_PROP_FPS)
        if not film.isOpened() or not rate > 0:
            yield Skipped(scene, "OpenCV cannot read this video; convert it to H.264 in MP4")
            return
        picker = Picker(change)
        taken = 0
        for number, picture in _every(film, max(round(every_s * rate), 1)):
            if not picker.takes(picture):
                continue
            taken += 1
            done, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            assert done
            name = f"{scene}/{number:06d}"
            yield Seen(name, scene, Observation(jpeg.tobytes()), Facts(condition=condition))
        if not taken:
            yield Skipped(scene, "no frame of this video could be decoded")
    finally:
        film.release()


def _every(film: Any, step: int) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Every step-th frame with its number; the frames between are passed over undecoded."""
    number = 0
    while film.grab():
        if number % step == 0:
            done, picture = film.retrieve()
            if done:
                yield number, picture
        number += 1
