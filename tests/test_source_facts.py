"""What is known of a frame of the synthetic camera, and the words for what is known."""

import pytest

from data.sources.seen import Facts, describe_facts
from data.sources.synthetic import draw_scenes
from ridetune.vision import decode_frame
from tests.source_files import seen_in


def test_everything_is_known_of_a_synthetic_frame_and_more_frames_change_none() -> None:
    few, more = seen_in(draw_scenes(2, seed=3)), seen_in(draw_scenes(4, seed=3))
    assert more[:2] == few and more[0] != seen_in(draw_scenes(1, seed=4))[0]
    facts = more[0].facts
    assert None not in (facts.condition, facts.dark, facts.road, facts.lead, facts.traffic)
    assert decode_frame(more[0].observation.frame).shape == (256, 448, 3)


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        (Facts(), "road"),
        (Facts("rain"), "rainy road"),
        (Facts("rain", dark=True, road="straight"), "rainy straight road at night"),
        (Facts("night", dark=True, lead="far"), "night-time road, a vehicle far ahead"),
        (
            Facts("sunny", low_sun=True, road="left curve", surroundings="country"),
            "sunny left curve in the country against a low sun",
        ),
        (
            Facts("snow", False, False, "intersection", "near", "dense", "city"),
            "snowy intersection in the city, a vehicle close ahead, dense traffic",
        ),
        (Facts(road="straight", lead="none"), "straight road, no vehicle ahead"),
    ],
)
def test_facts_become_words_and_the_unknown_is_left_out(facts: Facts, words: str) -> None:
    assert describe_facts(facts) == words
