"""nuScenes as a source: what its tables tell of a frame, on drives that the tests write."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from data.sources import tables
from data.sources.nuscenes import Pose, read_nuscenes
from data.sources.seen import Facts, Seen, Skipped
from data.sources.tables import read_table
from ridetune.camera.scene import Road
from ridetune.vision import decode_frame
from tests.nuscenes_tables import Box, Way, nuscenes_tables, unpack
from tests.source_files import real_samples, seen_in, skipped_in, write


def facts_of(folder: Path, way: Way) -> Facts:
    """What is known of the first frame of a way."""
    return seen_in(read_nuscenes(unpack(folder, nuscenes_tables(way))))[0].facts


def ahead_of_bumper(gap_m: float, half_m: float = 2.25) -> float:
    """Where the centre of a box stands whose near end is so far from the bumper [m]."""
    return gap_m + 3.4 + half_m


def test_key_frames_come_in_the_order_of_scene_and_time(tmp_path: Path) -> None:
    root = unpack(tmp_path, nuscenes_tables(Way(frames=3), Way(frames=2)))
    frames = seen_in(read_nuscenes(root))
    names = [f"scene-0001/{n:03d}" for n in range(3)] + [f"scene-0002/{n:03d}" for n in range(2)]
    assert [frame.name for frame in frames] == names
    assert [frame.scene_id for frame in frames] == ["scene-0001"] * 3 + ["scene-0002"] * 2
    picture = tmp_path / "samples/CAM_FRONT/scene-0001-1.jpg"
    assert frames[1].observation.frame == picture.read_bytes()
    assert all(frame.facts.surroundings == "city" for frame in frames)


def test_a_stride_takes_every_so_many_key_frames(tmp_path: Path) -> None:
    root = unpack(tmp_path, nuscenes_tables(Way(frames=7)))
    names = [frame.name[-3:] for frame in seen_in(read_nuscenes(root, stride=3))]
    assert names == ["000", "003", "006"]


def test_speed_is_that_of_the_poses_at_both_ends_and_between(tmp_path: Path) -> None:
    root = unpack(tmp_path, nuscenes_tables(Way(speed_mps=13.5, frames=4)))
    speeds = [frame.observation.speed_mps for frame in seen_in(read_nuscenes(root))]
    assert speeds == pytest.approx([13.5] * 4, abs=1e-3)


@pytest.mark.parametrize("way", [Way(frames=1), Way(frames=3, step_s=8.0)])
def test_speed_is_unknown_without_a_neighbour_in_time(tmp_path: Path, way: Way) -> None:
    frames = seen_in(read_nuscenes(unpack(tmp_path, nuscenes_tables(way))))
    assert [frame.observation.speed_mps for frame in frames] == [None] * way.frames


@pytest.mark.parametrize(
    ("description", "condition", "dark"),
    [
        ("Parked truck, construction, turn left", "sunny", False),
        ("Night, big street, bus stop", "night", True),
        ("Rain, many peds", "rain", False),
        ("Wet road, raining, scooter", "rain", False),
        ("Night, after rain, jaywalker", "rain", True),
        ("Training ground, knight statue", "sunny", False),
    ],
)
def test_weather_comes_from_the_words_of_the_scene(
    tmp_path: Path, description: str, condition: str, dark: bool
) -> None:
    facts = facts_of(tmp_path, Way(description))
    assert (facts.condition, facts.dark) == (condition, dark)


@pytest.mark.parametrize(
    ("box", "lead"),
    [
        (Box(ahead_of_bumper(19.9)), "near"),
        (Box(ahead_of_bumper(20.1)), "far"),
        (Box(ahead_of_bumper(59.9)), "far"),
        (Box(ahead_of_bumper(60.1)), "none"),
        (Box(ahead_of_bumper(19.9, 0.95), turned=math.pi / 2), "near"),
        (Box(ahead_of_bumper(20.1, 0.95), turned=math.pi / 2), "far"),
        (Box(ahead_of_bumper(10.0), left_m=1.7), "near"),
        (Box(ahead_of_bumper(10.0), left_m=-1.9), "none"),
        (Box(-10.0), "none"),
        (Box(ahead_of_bumper(10.0), attribute="vehicle.parked"), "none"),
        (Box(ahead_of_bumper(10.0), category="vehicle.bicycle"), "none"),
        (Box(ahead_of_bumper(10.0), category="human.pedestrian.adult"), "none"),
    ],
)
def test_lead_is_the_nearest_driving_vehicle_of_the_own_lane(
    tmp_path: Path, box: Box, lead: str
) -> None:
    # Annotations of another frame: without any the lead would be unknown.
    assert facts_of(tmp_path, Way(boxes=(box, Box(50.0, frame=1)))).lead == lead


@pytest.mark.parametrize(
    ("driving", "parked", "traffic"), [(6, 0, "dense"), (5, 0, "light"), (5, 3, "light")]
)
def test_traffic_counts_the_vehicles_that_do_not_park(
    tmp_path: Path, driving: int, parked: int, traffic: str
) -> None:
    boxes = [Box(40.0, left_m=4.0 * n - 10.0) for n in range(driving)]
    boxes += [Box(40.0, attribute="vehicle.parked") for _ in range(parked)]
    assert facts_of(tmp_path, Way(boxes=tuple(boxes))).traffic == traffic


@pytest.mark.parametrize(
    ("turn_rad_s", "speed_mps", "road"),
    [
        (0.0, 10.0, "straight"),
        (0.1, 10.0, "left curve"),
        (-0.1, 10.0, "right curve"),
        (0.5, 6.0, "intersection"),
        (-0.5, 6.0, "intersection"),
        (0.0, 0.5, None),  # it stands, more or less
    ],
)
def test_road_is_how_the_car_turns_next(
    tmp_path: Path, turn_rad_s: float, speed_mps: float, road: Road | None
) -> None:
    assert facts_of(tmp_path, Way(turn_rad_s=turn_rad_s, speed_mps=speed_mps)).road == road


def test_road_is_unknown_where_the_scene_ends(tmp_path: Path) -> None:
    frames = seen_in(read_nuscenes(unpack(tmp_path, nuscenes_tables(Way(frames=9)))))
    assert [frame.facts.road for frame in frames] == ["straight"] * 3 + [None] * 6


def test_a_missing_image_and_a_broken_one_are_skipped_and_named(tmp_path: Path) -> None:
    root = unpack(tmp_path, nuscenes_tables(Way(frames=4)))
    (root / "samples/CAM_FRONT/scene-0001-1.jpg").unlink()
    broken = root / "samples/CAM_FRONT/scene-0001-2.jpg"
    broken.write_bytes(broken.read_bytes()[:-200])
    assert [frame.name for frame in seen_in(read_nuscenes(root))] == [
        "scene-0001/000",
        "scene-0001/003",
    ]
    missing, damaged = skipped_in(read_nuscenes(root))
    assert missing.name == "scene-0001/001" and "is not there" in missing.reason
    assert damaged.name == "scene-0001/002" and "damaged" in damaged.reason


def test_a_scene_without_a_picture_of_the_front_camera_is_skipped(tmp_path: Path) -> None:
    rows = nuscenes_tables(Way(frames=2), Way(frames=2))
    rows["sample_data"] = [r for r in rows["sample_data"] if "scene-0002" in r["filename"]]
    frames = list(read_nuscenes(unpack(tmp_path, rows)))
    assert frames[0] == Skipped("scene-0001", "it has no key frame of CAM_FRONT")
    assert len(frames) == 3


@pytest.mark.parametrize("table", ["sensor", "scene", "sample_data", "ego_pose", "instance"])
def test_a_missing_table_is_named(tmp_path: Path, table: str) -> None:
    root = unpack(tmp_path, nuscenes_tables(Way(boxes=(Box(20.0),))))
    (root / f"v1.0-mini/{table}.json").unlink()
    with pytest.raises(ValueError, match=rf"lacks {table}\.json"):
        next(read_nuscenes(root))


@pytest.mark.parametrize(
    ("table", "field"), [("sample_data", "is_key_frame"), ("sample_annotation", "size")]
)
def test_a_row_without_a_field_is_named(tmp_path: Path, table: str, field: str) -> None:
    rows = nuscenes_tables(Way(boxes=(Box(20.0), Box(30.0))))
    del rows[table][1][field]
    with pytest.raises(ValueError, match=rf"{table}\.json: row 1 lacks '{field}'"):
        next(read_nuscenes(unpack(tmp_path, rows)))


@pytest.mark.parametrize("kept", [0, 1, 400, -2])
def test_a_truncated_table_is_named(tmp_path: Path, kept: int) -> None:
    root = unpack(tmp_path, nuscenes_tables(Way()))
    path = root / "v1.0-mini/ego_pose.json"
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ValueError, match=r"ego_pose\.json is (damaged|no JSON array)"):
        next(read_nuscenes(root))


@pytest.mark.parametrize(
    ("table", "key"), [("ego_pose", "ego_pose lacks 1 of the key frames"), ("sample", "names the")]
)
def test_a_row_that_another_table_names_must_be_there(tmp_path: Path, table: str, key: str) -> None:
    rows = nuscenes_tables(Way())
    del rows[table][4]
    with pytest.raises(ValueError, match=key):
        next(read_nuscenes(unpack(tmp_path, rows)))


@pytest.mark.parametrize("written", [True, False])
def test_without_annotations_lead_and_traffic_are_unknown(tmp_path: Path, written: bool) -> None:
    root = unpack(tmp_path, nuscenes_tables(Way()), "v1.0-test")
    if not written:
        (root / "v1.0-test/sample_annotation.json").unlink()
    frames = seen_in(read_nuscenes(root))
    assert len(frames) == 9
    assert all(frame.facts.lead is None and frame.facts.traffic is None for frame in frames)
    assert frames[0].facts.road == "straight"


def test_two_versions_in_one_root_are_refused(tmp_path: Path) -> None:
    rows = nuscenes_tables(Way())
    unpack(unpack(tmp_path, rows), rows, "v1.0-trainval")
    with pytest.raises(ValueError, match=r"holds v1\.0-mini, v1\.0-trainval; keep one"):
        next(read_nuscenes(tmp_path))


def test_a_root_without_tables_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds no v1\.0-mini"):
        next(read_nuscenes(tmp_path))


def test_a_table_is_read_the_same_in_small_pieces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [{"name": f'"brackets ]}}" {n} ä', "at": [n, {"x": -n / 7}]} for n in range(40)]
    for text in (
        json.dumps(rows),
        json.dumps(rows, indent=1),
        json.dumps(rows, ensure_ascii=False),
    ):
        write(tmp_path / "rows.json", text.encode())
        monkeypatch.setattr(tables, "_CHUNK", 11)
        found = [
            {"name": name, "at": at} for name, at in read_table(tmp_path, "rows", "name", "at")
        ]
        assert found == rows


def test_the_real_annotation_lies_where_the_devkit_puts_it(root: Path) -> None:
    folder = real_samples(root) / "nuscenes/one_sample/v1.0-mini"
    ((centre, _),) = read_table(folder, "sample_annotation", "translation", "token")
    point = np.array(centre)
    for table in ("ego_pose", "calibrated_sensor"):
        ((rotation, translation),) = read_table(folder, table, "rotation", "translation")
        point = Pose.of(rotation, translation).inside(point)
    # Annotation ef63a697930c4b20a6b9791f423351da, nuscenes-devkit 1.2.0.
    assert point == pytest.approx([18.64, 0.19, 59.02], abs=0.005)


def test_the_real_sample_is_read(root: Path) -> None:
    (frame,) = read_nuscenes(real_samples(root) / "nuscenes/one_sample")
    assert isinstance(frame, Seen) and frame.name == "scene-0061/000"
    assert frame.facts == Facts(
        "sunny", dark=False, lead="none", traffic="light", surroundings="city"
    )
    assert decode_frame(frame.observation.frame).shape == (900, 1600, 3)
