"""The camera in the simulation: what it shows is where the simulation has it."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from ridetune.camera.scene import describe
from ridetune.camera.situation import Situation, place
from ridetune.camera.street import Lanes, Thing
from ridetune.sample import CONDITIONS
from ridetune.scene import scene_answers
from ridetune.sim.drive import Moment
from ridetune.sim.scenarios import (
    ACCELERATION,
    LANE_CHANGE,
    LANE_M,
    LEFT_TURN,
    PEDESTRIAN,
    STATIC_OBSTACLE,
    TRAFFIC_LIGHT,
    Scenario,
)
from ridetune.sim.view import CAMERA_M, look, photograph, scene_of, situate
from tests.shipped_car import DEFAULT, VEHICLE

Spot = tuple[float, float] | None


def at(
    x_m: float, y_m: float = 0.0, heading_rad: float = 0.0, actors: tuple[Spot, ...] = ()
) -> Moment:
    return Moment(0.0, x_m, y_m, heading_rad, 10.0, actors, DEFAULT)


def behind_lead(gap_m: float, y_m: float = 0.0) -> tuple[Moment, Scenario]:
    """The car with its bumper this far behind the lead car's."""
    lead = ACCELERATION.actors[0]
    middle = VEHICLE.body.nose_m + gap_m + 0.5 * lead.length_m
    return at(0.0, y_m, actors=((middle, 0.0),)), ACCELERATION


@pytest.mark.parametrize("gap_m", [5.0, 30.0, 55.0])
def test_the_lead_car_stands_at_its_distance_in_its_lane(gap_m: float) -> None:
    (lead,) = situate(*behind_lead(gap_m)).things
    assert lead.z == pytest.approx(gap_m + VEHICLE.body.nose_m - CAMERA_M)
    assert lead.x == 0.0
    assert lead.size[2] == ACCELERATION.actors[0].length_m


def test_a_nearer_lead_car_is_larger_in_the_picture() -> None:
    def differing(gap_m: float) -> int:
        moment, scenario = behind_lead(gap_m)
        empty = replace(moment, actors=(None,))
        with_car, without = look(moment, scenario, "sunny"), look(empty, scenario, "sunny")
        return int((np.abs(with_car.astype(int) - without).max(axis=2) > 25).sum())

    assert differing(6.0) > 2 * differing(12.0) > 4 * differing(40.0) > 0


def test_the_lane_moves_to_the_other_side_as_the_car_leaves_it() -> None:
    seen = situate(at(50.0, 1.5, actors=((120.0, 0.0),)), LANE_CHANGE)
    assert seen.lanes == Lanes(1, 0, LANE_M)
    assert seen.offset_m == pytest.approx(1.5)
    # Turned to the left, the road runs away to the right.
    turned = situate(at(50.0, 1.5, 0.1, ((120.0, 0.0),)), LANE_CHANGE)
    assert turned.slope == pytest.approx(math.tan(0.1))
    assert turned.bend == 0.0  # a change of lane bends the path, not the road


def test_a_lane_change_sets_the_markings_and_the_car_aside() -> None:
    inside, beside = (
        place(scene_of(moment, LANE_CHANGE, "sunny"), situate(moment, LANE_CHANGE), 448, 256)
        for moment in (at(50.0, 0.0, actors=((90.0, 0.0),)), at(50.0, 3.5, actors=((90.0, 0.0),)))
    )
    lead = next(t for t in inside.things if t.kind in ("car", "suv"))
    column = [layout.camera.stand(lead.x, lead.z, 0.0)[0] for layout in (inside, beside)]
    metre = inside.camera.focal / lead.z
    assert column[1] - column[0] == pytest.approx(3.5 * metre)


def test_the_turn_is_a_crossing_before_a_left_bend_in_it_and_straight_behind() -> None:
    before, inside, behind = at(20.0), at(45.0, 0.6, 0.2), at(63.89, 60.0, math.pi / 2)
    seen = situate(before, LEFT_TURN)
    assert seen.bend == 0.0 and seen.crossing is not None
    middle = 40.0 + 23.89 - 20.0 - CAMERA_M
    assert seen.crossing[0] < middle < seen.crossing[1]
    seen = situate(inside, LEFT_TURN)
    assert seen.crossing is None
    assert seen.bend == pytest.approx(-1.0 / 23.89, rel=0.05)
    assert seen.bend_start_m == pytest.approx(0.0, abs=1.0)
    assert situate(behind, LEFT_TURN).bend == 0.0
    assert [scene_of(m, LEFT_TURN, "fog").road for m in (before, inside, behind)] == [
        "intersection",
        "left curve",
        "straight",
    ]


def test_a_left_bend_leads_to_the_left_and_ends_where_it_ends() -> None:
    scene = scene_of(at(0.0), LEFT_TURN, "sunny")
    bent, short, straight = (
        place(scene, Situation(Lanes(0, 0, 3.5), bend=bend, bend_end_m=end), 448, 256).camera
        for bend, end in ((-0.03, math.inf), (-0.03, 5.0), (0.0, math.inf))
    )
    left = [camera.stand(0.0, 20.0, 0.0)[0] for camera in (bent, short, straight)]
    assert left[0] < left[1] < left[2]
    # Behind the end of the bend the road runs straight on.
    steps = np.diff(short.centre(np.array([10.0, 15.0, 20.0])))
    assert steps[0] == pytest.approx(steps[1])


def test_what_is_gone_or_behind_is_not_in_the_picture() -> None:
    gone = at(0.0, actors=(None,))
    passed = at(60.0, actors=((40.0, 0.0),))
    for moment in (gone, passed):
        scene = scene_of(moment, ACCELERATION, "sunny")
        layout = place(scene, situate(moment, ACCELERATION), 448, 256)
        assert not [t for t in layout.things if t.kind in ("car", "suv")]
        assert scene.lead == "none"


def test_the_roadside_passes_by_as_the_car_drives() -> None:
    scene = scene_of(at(0.0), LEFT_TURN, "sunny")

    def trees(travelled_m: float) -> dict[float, float]:
        things = place(scene, Situation(Lanes(0, 0, 3.5), travelled_m), 448, 256).things
        return {t.variant: t.z for t in things if t.kind == "tree"}

    start, later = trees(0.0), trees(3.0)
    moved = [start[key] - later[key] for key in start if start[key] > 7.5]
    assert moved and moved == pytest.approx([3.0] * len(moved))


@pytest.mark.parametrize(
    "scenario", [PEDESTRIAN, STATIC_OBSTACLE, TRAFFIC_LIGHT], ids=lambda s: s.name
)
def test_whatever_stands_in_the_lane_is_drawn(scenario: Scenario) -> None:
    nose = VEHICLE.body.nose_m
    spots = tuple((nose + a.ahead_m + 0.5 * a.length_m, a.lateral_m) for a in scenario.actors)
    here = at(scenario.actors[0].ahead_m - 10.0, actors=spots)
    bare = replace(here, actors=(None,) * len(spots))
    shown = {t.kind for t in situate(here, scenario).things}
    kinds = {a.kind for a in scenario.actors}
    assert ("signal" in shown) == ("stop_line" in kinds)
    assert shown >= kinds & {"pedestrian", "bag"}
    assert not np.array_equal(look(here, scenario, "sunny"), look(bare, scenario, "sunny"))


@pytest.mark.parametrize("condition", CONDITIONS)
def test_the_frame_is_the_same_again_and_shows_the_condition(condition: str) -> None:
    weather = next(c for c in CONDITIONS if c == condition)
    moment, scenario = behind_lead(15.0)
    frame = photograph(moment, scenario, weather, 3)
    assert frame == photograph(moment, scenario, weather, 3)
    assert frame != photograph(moment, scenario, weather, 4)
    picture = cv2.imdecode(np.frombuffer(frame, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None and picture.shape == (256, 448, 3)
    clear = look(moment, scenario, "sunny", 3).mean()
    assert weather != "night" or picture.mean() < 0.5 * clear


def test_the_description_says_what_the_moment_is() -> None:
    for gap_m, lead in ((12.0, 1), (40.0, 2), (90.0, 0)):
        moment, scenario = behind_lead(gap_m)
        answers = scene_answers(describe(scene_of(moment, scenario, "rain", street=1)))
        assert answers == (1, 0, lead, 2, 0)


def test_what_is_beside_the_camera_is_out_of_the_picture() -> None:
    near = Thing("car", 0.0, 1.0, (1.8, 1.5, 4.4), (0, 0, 0))
    scene = scene_of(at(0.0), LEFT_TURN, "sunny")
    layout = place(scene, Situation(Lanes(0, 0, 3.5), things=(near,)), 448, 256)
    assert near not in layout.things
