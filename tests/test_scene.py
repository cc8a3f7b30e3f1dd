"""Every description that the synthetic scenes can get is read back as what the scene holds."""

from dataclasses import replace
from typing import get_args

import numpy as np

from ridetune.camera.scene import Lead, Road, Scene, Surroundings, Traffic, describe, sample_scene
from ridetune.sample import CONDITIONS
from ridetune.scene import SCENE_QUESTIONS, scene_answers


def _truth(scene: Scene) -> tuple[int, ...]:
    """The numbers of the scene's categories in the order of SCENE_QUESTIONS."""
    leads: tuple[Lead, ...] = ("none", "near", "far")
    return (
        CONDITIONS.index(scene.condition),
        get_args(Road).index(scene.road),
        leads.index(scene.lead),
        get_args(Surroundings).index(scene.surroundings),
        get_args(Traffic).index(scene.traffic),
    )


def test_answers_are_those_of_the_scene_in_every_wording() -> None:
    rng = np.random.default_rng(5)
    scenes = [sample_scene(rng) for _ in range(200)]
    for scene in scenes:
        assert scene_answers(describe(scene)) == _truth(scene), describe(scene)
    wordings = {describe(replace(scenes[0], seed=seed)) for seed in range(60)}
    assert len(wordings) == 6  # two leads times three orders
    assert {scene_answers(wording) for wording in wordings} == {_truth(scenes[0])}


def test_every_answer_occurs_in_the_scenes() -> None:
    rng = np.random.default_rng(6)
    seen = [scene_answers(describe(sample_scene(rng))) for _ in range(200)]
    for question, answers in enumerate(SCENE_QUESTIONS.values()):
        assert {found[question] for found in seen} == set(range(len(answers)))


def test_text_without_an_answer_gives_minus_one() -> None:
    assert scene_answers("") == (-1,) * len(SCENE_QUESTIONS)
    assert scene_answers("foggy and dense") == (2, -1, -1, -1, 1)
