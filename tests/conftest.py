"""What many tests start from: the shipped ranges, their codec and the instruction bank."""

from pathlib import Path

import pytest

from data.phrases import Bank, load_bank
from ridetune.codec import MatrixCodec
from ridetune.matrix import Ranges

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def root() -> Path:
    return ROOT


@pytest.fixture(scope="session")
def ranges() -> Ranges:
    return Ranges.load(ROOT / "configs/ranges.yaml")


@pytest.fixture(scope="session")
def codec(ranges: Ranges) -> MatrixCodec:
    return MatrixCodec(ranges)


@pytest.fixture(scope="session")
def bank() -> Bank:
    return load_bank()
