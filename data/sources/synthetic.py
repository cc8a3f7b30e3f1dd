"""The synthetic camera as a source: drawn scenes of which everything is known.

In: a number of frames and a seed. Out: a `Seen` for each, in a random condition.
"""

import numpy as np

from ridetune.camera.render import render
from ridetune.camera.scene import sample_scene
from ridetune.sample import Observation

from ..build import encode
from .seen import Facts, Frames, Seen


def draw_scenes(count: int, *, seed: int, width: int = 448, height: int = 256) -> Frames:
    """That many frames; the first ones are the same for any count."""
    for number in range(count):
        scene = sample_scene(np.random.default_rng([seed, number]))
        facts = Facts(
            condition=scene.condition,
            dark=scene.condition == "night",
            road=scene.road,
            lead=scene.lead,
            traffic=scene.traffic,
            surroundings=scene.surroundings,
        )
        name = f"synthetic-{number:06d}"
        yield Seen(name, name, Observation(encode(render(scene, width, height))), facts)
