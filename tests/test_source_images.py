"""A folder of images as a source: frames.csv, the names of folders, and broken files."""

from pathlib import Path

import pytest

from data.sources.images import read_images
from data.sources.seen import Facts
from ridetune.sample import CONDITIONS
from tests.source_files import (
    encoded,
    jpeg,
    pixels_of,
    real_samples,
    seen_in,
    skipped_in,
    write,
)


def list_frames(root: Path, *lines: str) -> None:
    write(root / "frames.csv", "\n".join(lines).encode())


def test_what_frames_csv_says_is_known(tmp_path: Path) -> None:
    write(tmp_path / "a.jpg", jpeg(1))
    write(tmp_path / "b.png", encoded(pixels_of(2), ".png"))
    list_frames(
        tmp_path,
        "file,condition,dark,low_sun,road,lead,traffic,surroundings,speed_mps,scene",
        "a.jpg,rain,true,,left curve,near,dense,highway,12.5,drive",
        "b.png,fog,,,,,,,,",
    )
    first, second = seen_in(read_images(tmp_path))
    assert first.facts == Facts(
        "rain", dark=True, road="left curve", lead="near", traffic="dense", surroundings="highway"
    )
    assert (first.scene_id, first.observation.speed_mps) == ("drive", 12.5)
    assert second.facts == Facts("fog") and second.scene_id == "b.png"
    assert second.observation.speed_mps is None


def test_frames_csv_may_start_with_a_byte_order_mark_and_quote(tmp_path: Path) -> None:
    write(tmp_path / "rain, hard/a.jpg", jpeg(1))
    write(tmp_path / "frames.csv", '\ufefffile,condition\r\n"rain, hard/a.jpg",rain\r\n'.encode())
    assert [frame.facts.condition for frame in seen_in(read_images(tmp_path))] == ["rain"]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (("file,weather", "a.jpg,rain"), "line 2, column 'weather'.*known columns: file, cond"),
        (("file,condition", "a.jpg,hail"), "line 2, column 'condition'"),
        (("file,road", "a.jpg,straight", "b.jpg,bumpy"), "line 3, column 'road'"),
        (("condition", "rain"), "line 2, column 'file'"),
        (("file,speed_mps", "a.jpg,fast"), "line 2, column 'speed_mps'"),
        (("file,speed_mps", "a.jpg,nan"), "line 2, column 'speed_mps'"),
        (("file,speed_mps", "a.jpg,-3"), "line 2, column 'speed_mps'"),
        (("file,condition", "a.jpg,rain,wet"), "line 2.*beyond the last"),
        (("file,condition", "a.jpg,rain", "a.jpg,fog"), "line 3.*a.jpg.*twice"),
    ],
)
def test_a_wrong_line_of_frames_csv_is_named(
    tmp_path: Path, lines: tuple[str, ...], message: str
) -> None:
    write(tmp_path / "a.jpg", jpeg(1))
    list_frames(tmp_path, *lines)
    with pytest.raises(ValueError, match=message):
        next(read_images(tmp_path))


def test_frames_csv_in_another_encoding_is_refused_by_name(tmp_path: Path) -> None:
    write(tmp_path / "a.jpg", jpeg(1))
    write(tmp_path / "frames.csv", "file,scene\na.jpg,Düne\n".encode("latin-1"))
    with pytest.raises(ValueError, match=r"frames\.csv is not UTF-8"):
        next(read_images(tmp_path))


@pytest.mark.parametrize(
    ("name", "condition"),
    [
        ("rain/a.jpg", "rain"),
        ("Night/clip-3/a.JPG", "night"),
        ("rain/snow/a.jpeg", "snow"),
        ("overcast/a.jpg", "sunny"),
        ("mine/a.jpg", None),
        ("rain.jpg", None),
    ],
)
def test_the_folder_tells_the_condition(tmp_path: Path, name: str, condition: str | None) -> None:
    write(tmp_path / name, jpeg(1))
    (frame,) = seen_in(read_images(tmp_path))
    assert (frame.name, frame.facts.condition) == (name, condition)


def test_the_list_weighs_more_than_the_folder(tmp_path: Path) -> None:
    write(tmp_path / "rain/a.jpg", jpeg(1))
    list_frames(tmp_path, "file,condition", "rain/a.jpg,night")
    assert seen_in(read_images(tmp_path))[0].facts.condition == "night"


def test_a_listed_file_that_is_missing_and_a_broken_one_are_skipped(tmp_path: Path) -> None:
    write(tmp_path / "a.jpg", jpeg(1))
    write(tmp_path / "b.jpg", jpeg(2)[:-300])
    write(tmp_path / "c.png", b"no picture")
    list_frames(tmp_path, "file,condition", "gone.jpg,rain", "a.jpg,rain")
    frames = list(read_images(tmp_path))
    assert [frame.name for frame in seen_in(iter(frames))] == ["a.jpg"]
    gone, broken, text = skipped_in(iter(frames))
    assert gone.name == "gone.jpg" and "is not there" in gone.reason
    assert broken.name == "b.jpg" and "damaged" in broken.reason
    assert text.name == "c.png" and "not a readable JPEG" in text.reason


def test_a_folder_with_the_name_of_a_picture_is_none(tmp_path: Path) -> None:
    write(tmp_path / "drive.jpg/a.jpg", jpeg(1))
    (tmp_path / "gone.jpg").symlink_to(tmp_path / "nothing.jpg")
    assert [frame.name for frame in read_images(tmp_path)] == ["drive.jpg/a.jpg"]


def test_a_folder_without_pictures_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "readme.txt", b"none")
    with pytest.raises(ValueError, match=r"holds no \.jpg"):
        next(read_images(tmp_path))
    with pytest.raises(ValueError, match="is no folder"):
        next(read_images(tmp_path / "readme.txt"))


def test_the_real_pictures_are_all_of_a_known_condition(root: Path) -> None:
    frames = list(read_images(real_samples(root) / "images"))
    assert len(frames) == 23 and not skipped_in(iter(frames))
    counted = {c: sum(f.facts.condition == c for f in seen_in(iter(frames))) for c in CONDITIONS}
    assert counted == {"sunny": 17, "rain": 2, "fog": 0, "snow": 1, "night": 3}
