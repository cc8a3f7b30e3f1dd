"""Pairs to review and answers to them, as the tests of the review share them."""

import io
from datetime import UTC, datetime
from pathlib import Path

from PIL import Image

from data.proposals import Proposal, read_proposals, write_part
from data.review.store import Action, Review, Store
from ridetune.codec import MatrixCodec
from ridetune.matrix import STYLES, Style
from ridetune.sample import Observation, Sample
from tests.shipped_car import RANGES, middle

ROOT = Path(__file__).parents[1]
CODEC = MatrixCodec(RANGES)
SIX = (0.3, 0.004, 0.1, 0.2, 1.0, 0.4)
CALMER = (0.25, 0.004, 0.1, 0.2, 1.0, 0.4)


def picture(shade: int) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (32, 18), (shade, 90, 120)).save(file, "JPEG")
    return file.getvalue()


def proposal(number: int, style: Style = "moderate") -> Proposal:
    sample = Sample(
        observation=Observation(picture(number), 12.5),
        instruction=f"Sentence number {number}.",
        memories=(),
        matrix=middle(style),
        scene="a road in the rain",
        explanation="because you are happy with this speed, i keep the usual balance.",
        style=style,
        level="II",
        intent="speed",
        condition="rain",
        split="train",
        scene_id=f"images/{number}",
        phrase_id="grammar/moderate/II",
    )
    return Proposal(sample, "images", "CC0", f"rain/{number}.jpg", "rules-1", 0.6)


def write_proposals(folder: Path, count: int = 6) -> list[Proposal]:
    """Two parts, of all styles."""
    folder.mkdir(parents=True, exist_ok=True)
    made = [proposal(i, STYLES[i % 3]) for i in range(count)]
    write_part(made[: count // 2], folder / "part-00000.parquet")
    write_part(made[count // 2 :], folder / "part-00001.parquet")
    return list(read_proposals(folder))  # float32, as the reviewers see them


def say(
    store: Store,
    action: Action = "accept",
    *,
    who: str = "ann",
    about: str = "p0",
    style: Style = "moderate",
    values: tuple[float, ...] = SIX,
) -> Review:
    return store.append(
        proposal_id=about, annotator=who, action=action, style=style, values=values, seconds=1.5
    )


def make_review(
    number: int,
    about: str,
    who: str,
    action: Action,
    style: Style = "moderate",
    values: tuple[float, ...] = SIX,
) -> Review:
    time = datetime(2026, 11, 23, 12, 0, number % 60, tzinfo=UTC)
    return Review(number, about, who, action, style, values, 1.0, time)
