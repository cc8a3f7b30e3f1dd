"""MCAP drive logs as a source: topics, layouts, and logs that are damaged."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType

from data.sources.mcap_log import read_mcap
from data.sources.seen import Facts, Frames, Seen, Skipped, fault_of_frame
from tests.mcap_logs import (
    CAMERA,
    SPEED,
    Said,
    image,
    json_image,
    speed,
    write_json,
    write_ros,
)
from tests.source_files import jpeg, seen_in, skipped_in, write


def read(root: Path, camera: str | None = None, speed: str | None = None, **options: Any) -> Frames:
    return read_mcap(root, camera=camera, speed=speed, **options)


def test_a_log_gives_frames_apart_and_changed_with_their_speed(tmp_path: Path) -> None:
    shown = [1, 2, 3, 3, 3, 3, 4, 4]  # every 0.25 s
    said = [image(n / 4, jpeg(seed)) for n, seed in enumerate(shown)]
    said += [speed(0.4, 5.0), speed(0.5, 6.0), speed(0.55, 7.0)]
    path = write_ros(tmp_path / "drive.mcap", *said)
    frames = seen_in(read(path, condition="fog"))
    assert [f.name for f in frames] == [f"drive.mcap/{n:06d}" for n in (0, 2, 6)]
    assert [f.observation.frame for f in frames] == [jpeg(1), jpeg(3), jpeg(4)]
    assert [f.observation.speed_mps for f in frames] == [None, 6.0, 7.0]
    assert all(f.scene_id == "drive.mcap" and f.facts == Facts("fog") for f in frames)
    assert not skipped_in(read(path))


def test_a_speed_counts_for_a_second(tmp_path: Path) -> None:
    said = [speed(1.0, 5.0)] + [image(time, jpeg(n)) for n, time in enumerate((0.9, 2.0, 2.5))]
    frames = seen_in(read(write_ros(tmp_path / "drive.mcap", *said)))
    assert [frame.observation.speed_mps for frame in frames] == [None, 5.0, None]


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        ("nav_msgs/msg/Odometry", {"twist": {"twist": {"linear": {"x": -7.5, "y": 1.0}}}}),
        ("geometry_msgs/msg/TwistStamped", {"twist": {"linear": {"x": 7.5}}}),
        ("geometry_msgs/msg/Twist", {"linear": {"x": 7.5}, "angular": {"x": 1.0}}),
        ("std_msgs/msg/Float32", {"data": 7.5}),
        ("std_msgs/msg/Float64", {"data": -7.5}),
    ],
)
def test_every_ros_message_of_a_speed_is_read_as_its_magnitude(
    tmp_path: Path, kind: str, content: dict[str, Any]
) -> None:
    said = (Said(0.0, "/motion", kind, content), image(0.1, jpeg(1)))
    (frame,) = seen_in(read(write_ros(tmp_path / "drive.mcap", *said)))
    assert frame.observation.speed_mps == 7.5


@pytest.mark.parametrize(
    "content",
    [
        {"speed_mps": 7.5},
        {"data": 7.5, "unit": "m/s"},
        {"twist": {"linear": {"x": 7.5}}},
        {"twist": {"twist": {"linear": {"x": -7.5}}}},
    ],
)
def test_every_json_message_of_a_speed_is_read(tmp_path: Path, content: dict[str, Any]) -> None:
    said = (Said(0.0, "/motion", "Motion", content), json_image(0.1, jpeg(1)))
    (frame,) = seen_in(read(write_json(tmp_path / "drive.mcap", *said)))
    assert (frame.observation.frame, frame.observation.speed_mps) == (jpeg(1), 7.5)


def test_json_of_another_schema_is_read_where_it_is_named(tmp_path: Path) -> None:
    picture = json_image(0.1, jpeg(1)).content
    said = (Said(0.0, "/v", "Unknown", {"linear": {"x": 3.0}}), Said(0.1, "/c", "Picture", picture))
    path = write_json(tmp_path / "drive.mcap", *said)
    (frame,) = seen_in(read(path, "/c", "/v"))
    assert (frame.observation.frame, frame.observation.speed_mps) == (jpeg(1), 3.0)
    with pytest.raises(ValueError, match=r"has no camera topic .*/c \(Picture, json\)"):
        next(read(path))


def test_which_of_several_topics_is_meant_must_be_said(tmp_path: Path) -> None:
    said = (
        image(0.0, jpeg(1)),
        image(0.0, jpeg(2), "/rear"),
        speed(0.0, 1.0),
        speed(0.0, 2.0, "/v"),
    )
    path = write_ros(tmp_path / "drive.mcap", *said)
    with pytest.raises(ValueError, match="several camera topics: /front, /rear; set camera="):
        next(read(path))
    with pytest.raises(ValueError, match="several speed topics: /speed, /v; set speed="):
        next(read(path, "/rear"))
    (frame,) = seen_in(read(path, "/rear", "/v"))
    assert (frame.observation.frame, frame.observation.speed_mps) == (jpeg(2), 2.0)


@pytest.mark.parametrize(("camera", "speed"), [("/side", None), ("/speed", None), (None, "/front")])
def test_a_topic_that_does_not_fit_is_refused_with_those_there_are(
    tmp_path: Path, camera: str | None, speed: str | None
) -> None:
    said = (image(0.0, jpeg(1)), Said(0.0, "/speed", SPEED, {"data": 1.0}))
    path = write_ros(tmp_path / "drive.mcap", *said)
    listed = rf"has no topic .*/front \({CAMERA}, cdr\), /speed \({SPEED}, cdr\); set "
    with pytest.raises(ValueError, match=listed):
        next(read(path, camera, speed))


def test_a_log_without_a_camera_is_refused_before_the_first_frame(tmp_path: Path) -> None:
    write_ros(tmp_path / "a.mcap", image(0.0, jpeg(1)))
    write_ros(tmp_path / "b.mcap", speed(0.0, 1.0), Said(0.0, "/log", "std_msgs/msg/String", {}))
    listed = r"b\.mcap has no camera topic .*it has /log .*, /speed .*; set camera="
    with pytest.raises(ValueError, match=listed):
        next(read(tmp_path))


def test_without_a_speed_topic_the_speed_is_unknown(tmp_path: Path) -> None:
    (frame,) = seen_in(read(write_ros(tmp_path / "drive.mcap", image(0.0, jpeg(1)))))
    assert frame.observation.speed_mps is None


def test_a_speed_that_is_no_number_is_passed_over_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    said = (speed(0.0, 4.0), speed(0.1, math.nan), speed(0.2, math.inf), image(0.3, jpeg(1)))
    (frame,) = seen_in(read(write_ros(tmp_path / "drive.mcap", *said)))
    assert frame.observation.speed_mps == 4.0
    assert "topic=/speed unread=2" in caplog.text


def test_each_log_of_a_folder_is_a_scene(tmp_path: Path) -> None:
    for number, name in enumerate(("a/front.mcap", "b/front.mcap")):
        write_ros(tmp_path / name, image(0.0, jpeg(1)), speed(0.0, float(number)))
    frames = seen_in(read(tmp_path))
    assert [frame.scene_id for frame in frames] == ["a/front.mcap", "b/front.mcap"]
    assert [frame.observation.speed_mps for frame in frames] == [0.0, 1.0]


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.LZ4},
        {"use_chunking": False},
        {"repeat_channels": False, "repeat_schemas": False, "use_summary_offsets": False},
        {"index_types": IndexType.NONE, "use_statistics": False},
    ],
)
def test_every_layout_of_the_format_gives_the_same(tmp_path: Path, options: dict[str, Any]) -> None:
    said = [json_image(n, jpeg(n)) for n in range(3)]
    said += [Said(n, "/v", "Speed", {"speed_mps": float(n)}) for n in range(3)]
    frames = seen_in(read(write_json(tmp_path / "drive.mcap", *said, **options)))
    assert [frame.observation.frame for frame in frames] == [jpeg(n) for n in range(3)]
    assert [frame.observation.speed_mps for frame in frames] == [0.0, 1.0, 2.0]


def test_a_log_that_breaks_off_gives_what_it_holds_and_says_so(tmp_path: Path) -> None:
    said = [s for n in range(6) for s in (speed(n, float(n)), image(n, jpeg(n)))]
    path = write_ros(tmp_path / "drive.mcap", *said)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    frames = list(read(path))
    kept = seen_in(iter(frames))
    assert 2 <= len(kept) < 6 and isinstance(frames[-1], Skipped)
    assert [f.observation.speed_mps for f in kept] == [float(n) for n in range(len(kept))]
    (skipped,) = skipped_in(iter(frames))
    assert skipped.name == "drive.mcap" and f"; {len(kept)} frames were kept" in skipped.reason


def test_a_damaged_chunk_costs_no_other(tmp_path: Path) -> None:
    said = [image(n, jpeg(n)) for n in range(5)]
    path = write_ros(tmp_path / "drive.mcap", *said, compression=CompressionType.NONE)
    whole = bytearray(path.read_bytes())
    whole[whole.index(jpeg(2)) + 100] ^= 0xFF
    path.write_bytes(whole)
    frames = list(read(path))
    kept = [frame.observation.frame for frame in seen_in(iter(frames))]
    assert kept == [jpeg(n) for n in (0, 1, 3, 4)]
    assert len(frames) == 5 and "crc" in skipped_in(iter(frames))[0].reason


@pytest.mark.parametrize("content", [b"", b"no log at all", b"\x89MCAP0\r\n"])
def test_a_file_that_is_no_log_is_skipped_and_the_next_one_read(
    tmp_path: Path, content: bytes
) -> None:
    write(tmp_path / "a.mcap", content)
    write_ros(tmp_path / "b.mcap", image(0.0, jpeg(1)), speed(0.0, 1.0))
    for camera, motion in ((None, None), ("/front", "/speed")):
        frames = list(read(tmp_path, camera, motion))
        assert [type(frame) for frame in frames] == [Skipped, Seen]
        assert frames[0].name == "a.mcap"


@pytest.mark.parametrize("encoding", ["ros", "json"])
def test_a_broken_picture_is_skipped_and_named(tmp_path: Path, encoding: str) -> None:
    make, log = (image, write_ros) if encoding == "ros" else (json_image, write_json)
    pictures = (jpeg(0), jpeg(1)[:-200], b"", b"text", jpeg(4))
    path = log(tmp_path / "drive.mcap", *[make(n, p) for n, p in enumerate(pictures)])
    frames = list(read(path))
    assert [type(frame) for frame in frames] == [Seen, Skipped, Skipped, Skipped, Seen]
    assert [frame.name for frame in frames] == [f"drive.mcap/{n:06d}" for n in range(5)]
    assert "damaged" in skipped_in(iter(frames))[0].reason


def test_a_message_that_holds_no_picture_is_skipped(tmp_path: Path) -> None:
    contents: list[dict[str, Any]] = [{"data": "%"}, {"data": 1}, {}]
    said = [Said(n, "/c", "Picture", content) for n, content in enumerate(contents)]
    frames = skipped_in(read(write_json(tmp_path / "drive.mcap", *said), "/c"))
    names = [f"drive.mcap/{n:06d}" for n in range(3)]
    assert [frame.name for frame in frames] == [*names, "drive.mcap"]


def test_a_clock_that_is_set_back_does_not_end_the_drive(tmp_path: Path) -> None:
    said = [image(time, jpeg(n)) for n, time in enumerate((100.0, 101.0, 3.0, 4.0))]
    assert len(seen_in(read(write_ros(tmp_path / "drive.mcap", *said)))) == 4


def test_a_folder_without_logs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds no \.mcap"):
        next(read(tmp_path))


@dataclass(frozen=True)
class Logs:
    """Whole logs, to be damaged."""

    contents: tuple[bytes, ...] = field(repr=False)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Logs:
    folder = tmp_path_factory.mktemp("logs")
    said = [s for n in range(2) for s in (speed(n, float(n)), image(n, jpeg(n)))]
    unchecked: dict[str, Any] = {"compression": CompressionType.NONE, "enable_crcs": False}
    paths = (
        write_ros(folder / "chunks.mcap", *said),
        write_ros(folder / "unchecked.mcap", *said, **unchecked),
    )
    return Logs(tuple(path.read_bytes() for path in paths))


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(which=st.integers(0, 1), at=st.floats(0, 1), bits=st.integers(1, 255), cut=st.booleans())
def test_no_damage_to_a_log_escapes(
    logs: Logs, tmp_path: Path, which: int, at: float, bits: int, cut: bool
) -> None:
    content = bytearray(logs.contents[which])
    place = int(at * (len(content) - 1))
    content[place] ^= bits
    path = write(tmp_path / "drive.mcap", bytes(content[:place] if cut else content))
    try:
        frames = list(read(path))
    except ValueError as error:
        # The damage makes another topic of one, and nothing shows that it is damage.
        frames = []
        told = str(error)
    else:
        told = "topic"
    assert "topic" in told
    assert all(fault_of_frame(f.observation.frame) is None for f in seen_in(iter(frames)))
