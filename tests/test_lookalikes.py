"""Pictures that look alike are found again; others are not taken for them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from data.lookalikes import Lookalikes, difference_hash
from data.sources.images import read_images
from data.sources.synthetic import draw_scenes
from ridetune.vision import decode_frame
from tests.source_files import encoded, jpeg, real_samples, seen_in


def rescaled(picture: bytes, factor: float, quality: int) -> bytes:
    pixels = np.ascontiguousarray(decode_frame(picture, (640, 360))[..., ::-1])
    small = cv2.resize(pixels, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return encoded(np.asarray(small, np.uint8), quality=quality)


@pytest.mark.parametrize(("factor", "quality"), [(1.0, 40), (0.5, 80), (0.37, 70), (1.6, 60)])
def test_the_same_picture_rescaled_and_recompressed_looks_alike(
    factor: float, quality: int
) -> None:
    lookalikes = Lookalikes()
    for frame in seen_in(draw_scenes(8, seed=5)):
        picture = frame.observation.frame
        lookalikes.find_or_add(frame.name, difference_hash(picture))
        again = difference_hash(rescaled(picture, factor, quality))
        assert lookalikes.find_or_add("again", again) is not None


def test_other_pictures_do_not_look_alike_however_many_there_are() -> None:
    lookalikes = Lookalikes()
    hashes = np.random.default_rng(0).integers(
        0, 2**64, 2500, np.uint64
    )  # more than it starts with
    assert all(lookalikes.find_or_add(str(n), own) is None for n, own in enumerate(hashes))
    for seed in range(20):
        assert lookalikes.find_or_add(f"picture-{seed}", difference_hash(jpeg(seed))) is None
    assert lookalikes.find_or_add("twin", hashes[2100]) == "2100"
    assert lookalikes.find_or_add("twin", difference_hash(jpeg(7))) == "picture-7"


def test_a_look_alike_is_one_of_few_other_bits() -> None:
    lookalikes = Lookalikes(near_bits=3)
    own = np.uint64(0x123456789ABCDEF0)
    assert lookalikes.find_or_add("first", own) is None
    assert lookalikes.find_or_add("near", own ^ np.uint64(0x8001_0000_0000_0010)) == "first"
    assert lookalikes.find_or_add("far", own ^ np.uint64(0x8001_0000_0000_0011)) is None


@pytest.mark.slow
def test_real_pictures_are_told_apart_and_found_again(root: Path) -> None:
    lookalikes = Lookalikes()
    for frame in seen_in(read_images(real_samples(root) / "images")):
        picture = frame.observation.frame
        assert lookalikes.find_or_add(frame.name, difference_hash(picture)) is None
        again = difference_hash(rescaled(picture, 0.5, 75))
        assert lookalikes.find_or_add("again", again) == frame.name
