"""Content of a synthetic picture: its categories, how they are drawn, and their description.

In: a random stream. Out: a `Scene` (weather, road, lead vehicle, traffic, surroundings, seed)
and a one-line description of it. `render` draws a scene.

    python -c "from ridetune.camera.scene import *; import numpy as np; \
print(describe(sample_scene(np.random.default_rng(0))))"    # any CPU
"""

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from ridetune.sample import CONDITIONS, Condition

Road = Literal["straight", "left curve", "right curve", "intersection"]
Lead = Literal["none", "near", "far"]
Traffic = Literal["light", "dense"]
Surroundings = Literal["city", "highway", "country"]


@dataclass(frozen=True)
class Scene:
    """What a picture shows; `seed` fixes everything that the other fields leave open."""

    condition: Condition
    road: Road
    lead: Lead
    traffic: Traffic
    surroundings: Surroundings
    seed: int


def sample_scene(rng: np.random.Generator) -> Scene:
    """Scene with every category drawn uniformly."""

    def pick(options: tuple[str, ...]) -> str:
        return options[int(rng.integers(len(options)))]

    return Scene(
        condition=pick(CONDITIONS),  # type: ignore[arg-type]
        road=pick(get_args(Road)),  # type: ignore[arg-type]
        lead=pick(get_args(Lead)),  # type: ignore[arg-type]
        traffic=pick(get_args(Traffic)),  # type: ignore[arg-type]
        surroundings=pick(get_args(Surroundings)),  # type: ignore[arg-type]
        seed=int(rng.integers(2**31)),
    )


def with_condition(scene: Scene, condition: Condition) -> Scene:
    """The same road, traffic and colours in another weather."""
    return replace(scene, condition=condition)


def describe(scene: Scene) -> str:
    """One short lower-case description; the first word names the condition."""
    rng = np.random.default_rng([scene.seed, 3])
    lead = {
        "none": ("no vehicle ahead", "a free lane ahead"),
        "near": ("a vehicle close ahead", "a near vehicle ahead"),
        "far": ("a vehicle far ahead", "a distant vehicle ahead"),
    }[scene.lead][int(rng.integers(2))]
    adjective = {
        "sunny": "sunny",
        "rain": "rainy",
        "fog": "foggy",
        "snow": "snowy",
        "night": "night-time",
    }
    where = {"city": "in the city", "highway": "on the highway", "country": "in the country"}
    road = "straight road" if scene.road == "straight" else scene.road
    start = f"{adjective[scene.condition]} {road} {where[scene.surroundings]}"
    wordings = (
        f"{start}, {lead}, {scene.traffic} traffic",
        f"{start} with {scene.traffic} traffic, {lead}",
        f"{start}, {scene.traffic} traffic and {lead}",
    )
    return wordings[int(rng.integers(len(wordings)))]
