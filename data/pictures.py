"""The pictures that are proposed from one frame: itself, and a clear one in other weathers."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ridetune.sample import Split
from ridetune.vision import decode_frame

from .build import encode
from .sources.seen import Facts, Seen
from .variants import VARIANTS, Variant, vary_weather

JPEG_QUALITY = 90


@dataclass(frozen=True)
class Picture:
    """A frame as it is proposed: itself, or one of its variants."""

    name: str
    frame: bytes
    facts: Facts


def pictures_of(
    seen: Seen, split: Split, rng: np.random.Generator, *, max_width: int, variants: int
) -> Iterator[Picture]:
    """The frame itself, and a clear one in other weathers too.

    A test frame is seen in all adverse conditions; another one in `variants` drawn ones. Wider
    frames than max_width [px] are made smaller.
    """
    pixels = decode_frame(seen.observation.frame)
    height, width = pixels.shape[:2]
    frame = seen.observation.frame
    if width > max_width:
        size = (max_width, round(height * max_width / width))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
        frame = encode(pixels, JPEG_QUALITY)
    yield Picture(seen.name, frame, seen.facts)
    if seen.facts.condition != "sunny" or seen.facts.low_sun:
        return
    chosen: list[Variant] = [v for v in VARIANTS if v != "low_sun"]
    if split != "test":
        count = min(variants, len(VARIANTS))
        chosen = [VARIANTS[i] for i in sorted(rng.permutation(len(VARIANTS))[:count])]
    for variant in chosen:
        varied = vary_weather(pixels, variant, rng)
        yield Picture(
            f"{seen.name}+{variant}", encode(varied, JPEG_QUALITY), _in_weather(seen.facts, variant)
        )


def _in_weather(facts: Facts, variant: Variant) -> Facts:
    if variant == "low_sun":
        return replace(facts, low_sun=True)
    return replace(facts, condition=variant, dark=variant == "night")
