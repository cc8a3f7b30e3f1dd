"""Videos as a source, and the picker of frames that changed."""

from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from data.sources.picking import Picker
from data.sources.seen import Facts, Seen, Skipped, fault_of_frame
from data.sources.video import read_videos
from ridetune.vision import decode_frame
from tests.source_files import SIZE_PX, pixels_of, real_samples, seen_in, write


def write_video(path: Path, shots: list[tuple[int, int]], rate: float = 10.0) -> Path:
    """A clip of pictures by seed, each standing still for a number of frames."""
    path.parent.mkdir(parents=True, exist_ok=True)
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate, SIZE_PX)
    assert film.isOpened()
    for seed, count in shots:
        for _ in range(count):
            film.write(pixels_of(seed))
    film.release()
    return path


def test_a_picture_that_stands_still_is_taken_once(tmp_path: Path) -> None:
    path = write_video(tmp_path / "drive.avi", [(1, 22), (2, 20), (1, 8)])
    frames = list(read_videos(path, condition="rain", every_s=0.5))
    assert [frame.name for frame in frames] == [
        "drive.avi/000000",
        "drive.avi/000025",
        "drive.avi/000045",
    ]
    for frame, seed in zip(seen_in(iter(frames)), (1, 2, 1), strict=True):
        assert frame.scene_id == "drive.avi" and frame.facts == Facts("rain")
        shown = decode_frame(frame.observation.frame)[..., ::-1].astype(int)
        assert np.abs(shown - pixels_of(seed)).mean() < 12


def test_frames_of_a_video_are_so_far_apart(tmp_path: Path) -> None:
    path = write_video(tmp_path / "drive.avi", [(seed, 1) for seed in range(30)])
    for every_s, count in ((0.5, 6), (1.0, 3), (0.0, 30), (9.0, 1)):
        assert len(list(read_videos(path, every_s=every_s))) == count


def test_an_unreadable_video_is_skipped_and_the_next_one_read(tmp_path: Path) -> None:
    write(tmp_path / "a.mp4", b"no video at all")
    write_video(tmp_path / "b.avi", [(1, 3)])
    frames = list(read_videos(tmp_path))
    assert [type(frame) for frame in frames] == [Skipped, Seen]
    assert frames[0].name == "a.mp4"


def test_videos_of_one_name_in_two_folders_are_two_scenes(tmp_path: Path) -> None:
    for seed, folder in enumerate(("monday", "tuesday")):
        write_video(tmp_path / folder / "front.avi", [(seed, 3)])
    frames = seen_in(read_videos(tmp_path))
    assert [frame.scene_id for frame in frames] == ["monday/front.avi", "tuesday/front.avi"]
    assert frames[0].name == "monday/front.avi/000000"


def test_a_folder_without_videos_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds no \.mp4"):
        next(read_videos(tmp_path))


def test_real_clips_give_frames(root: Path) -> None:
    paths = sorted((real_samples(root) / "clips").glob("*.mp4"))
    for path in paths:
        frames = seen_in(islice(read_videos(path, change=0.0), 3))
        assert len(frames) == 3 and {frame.scene_id for frame in frames} == {path.name}
        assert all(fault_of_frame(frame.observation.frame) is None for frame in frames)
    assert len(paths) == 2


def test_a_picker_compares_with_the_last_picture_it_took() -> None:
    picker = Picker(change=6.0)
    levels = [100, 104, 105, 107, 103, 113, 101]
    took = [picker.takes(np.full((18, 32, 3), level, np.uint8)) for level in levels]
    assert took == [True, False, False, True, False, True, True]
