"""Behaviour of the synthetic front camera; run with `PYTHONPATH=. python -m pytest`."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ridetune.camera.render import render
from ridetune.camera.scene import Scene, describe, sample_scene, with_condition
from ridetune.camera.street import draw_layout
from ridetune.sample import CONDITIONS, Condition

BASE = Scene("sunny", "left curve", "near", "dense", "city", seed=7)


def _scenes(count: int) -> list[Scene]:
    rng = np.random.default_rng(3)
    return [sample_scene(rng) for _ in range(count)]


def _luminance(scene: Scene, condition: Condition) -> NDArray[np.uint8]:
    picture = render(with_condition(scene, condition), 224, 128)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)


@pytest.mark.parametrize("condition", CONDITIONS)
def test_render_is_deterministic_and_rgb_uint8(condition: Condition) -> None:
    for scene in _scenes(4):
        first = render(with_condition(scene, condition))
        assert first.shape == (256, 448, 3)
        assert first.dtype == np.uint8
        assert np.array_equal(first, render(with_condition(scene, condition)))


@pytest.mark.parametrize(("width", "height"), [(224, 128), (448, 256), (640, 360)])
def test_render_follows_the_requested_size(width: int, height: int) -> None:
    assert render(BASE, width, height).shape == (height, width, 3)


def test_another_seed_gives_another_picture() -> None:
    assert not np.array_equal(render(BASE), render(replace(BASE, seed=8)))


@pytest.mark.parametrize("condition", CONDITIONS)
def test_condition_keeps_geometry_and_all_but_the_first_word(condition: Condition) -> None:
    for scene in _scenes(20):
        other = with_condition(scene, condition)
        assert draw_layout(other, 448, 256) == draw_layout(scene, 448, 256)
        assert describe(other).split(" ", 1)[1] == describe(scene).split(" ", 1)[1]


def test_night_is_darker_than_sunny() -> None:
    night = [_luminance(s, "night").mean() for s in _scenes(12)]
    sunny = [_luminance(s, "sunny").mean() for s in _scenes(12)]
    assert np.mean(night) < 0.6 * np.mean(sunny)


def test_fog_lowers_the_contrast_far_away() -> None:
    def far_contrast(condition: Condition) -> float:
        return float(np.mean([_luminance(s, condition)[50:66].std() for s in _scenes(12)]))

    assert far_contrast("fog") < 0.7 * far_contrast("sunny")


def test_lead_stands_in_the_own_lane_at_its_distance() -> None:
    for scene in _scenes(60):
        own = [
            t for t in draw_layout(scene, 448, 256).things if t.facing == "rear" and abs(t.x) < 1
        ]
        own = [t for t in own if t.kind in ("car", "suv", "van", "truck")]
        limits = {"none": None, "near": (8, 18), "far": (25, 55)}[scene.lead]
        assert len(own) == (limits is not None)
        assert limits is None or limits[0] <= own[0].z <= limits[1]


def test_description_names_condition_road_lead_and_traffic() -> None:
    words = {
        "none": ("no vehicle", "free lane"),
        "near": ("close", "near"),
        "far": ("far", "distant"),
    }
    for scene in _scenes(60):
        text = describe(scene)
        assert text == text.lower()
        assert any(word in text for word in words[scene.lead])
        assert "ahead" in text and scene.traffic in text
        assert scene.road in text and scene.surroundings in text


def test_sampling_is_roughly_uniform() -> None:
    scenes = _scenes(600)
    for condition in CONDITIONS:
        assert 80 < sum(s.condition == condition for s in scenes) < 160
