"""Makes the proposals of a part: a few frames, each asked in every style, with rule labels.

A part depends on its frames and the config alone, so parts may be made on any worker.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ridetune.config import Count, Share
from ridetune.matrix import STYLES, Ranges
from ridetune.sample import Condition, Observation, Sample, Split
from ridetune.workers import Backend

from .annotate import Rules, explain
from .bank_files import Language
from .instructions import Speakers, Speech, read_own
from .own_commands import OwnCommands
from .phrases import Phrase, load_reasons
from .pictures import Picture, pictures_of
from .proposals import Proposal, part_bytes
from .sources.nuscenes import LICENCE as NUSCENES_LICENCE
from .sources.seen import Facts, Seen, describe_facts

ANNOTATOR = "rules-1"


@dataclass(frozen=True)
class ProposeConfig:
    """What to propose from. Shares of scenes; limit: pictures at most, or None."""

    source: Literal["nuscenes", "images", "video", "mcap", "synthetic"]
    root: Path | None  # not for the synthetic camera
    licence: str  # of the frames; nuScenes has its own
    out: Path
    ranges: Path
    seed: int
    limit: Count | None
    stride: int  # nuscenes: every so many key frames
    every_s: float  # video, mcap: frames are at least so far apart [s]
    change: float  # video, mcap: and differ by this on average, of 255
    condition: Condition | None  # video, mcap: where it is known
    camera: str | None  # mcap: topic; None for the only one of a fitting schema
    speed: str | None
    near_bits: Count  # pictures whose hashes differ by no more are look-alikes
    max_width: int  # larger pictures are made smaller [px]
    variants_per_frame: Count  # other weathers of a clear picture that trains
    speech: Speech
    test_share: Share
    calibration_share: Share
    frames_per_part: int
    backend: Backend  # where parts are made: serial, joblib (cores) or ray (machines)
    workers: int
    address: str | None  # of a Ray cluster, or None for this machine


@dataclass(frozen=True)
class Kit:
    """A config with the content of the files that it names, which other machines do not have."""

    config: ProposeConfig
    ranges: Ranges
    own: dict[Language, OwnCommands]

    @staticmethod
    def of(config: ProposeConfig) -> "Kit":
        """Read the files; ValueError where one is missing or wrong."""
        return Kit(config, Ranges.load(config.ranges), read_own(config.speech))


@dataclass(frozen=True)
class PartTask:
    """The frames of one part."""

    kit: Kit
    number: int
    frames: list[Seen]


def make_part(task: PartTask) -> tuple[int, bytes]:
    """The number of a part and the content of its file."""
    config = task.kit.config
    if config not in _proposers:  # the bank is read once in each worker
        _proposers[config] = Proposer(task.kit)
    of_frame = _proposers[config].of_frame
    return task.number, part_bytes(p for seen in task.frames for p in of_frame(seen))


class Proposer:
    """Makes the proposals of one frame; what it draws depends on the frame's name alone."""

    def __init__(self, kit: Kit) -> None:
        self._config = kit.config
        self._rules = Rules(kit.ranges)
        self._speakers = Speakers(kit.config.speech, kit.own)

    def of_frame(self, seen: Seen) -> Iterator[Proposal]:
        """One proposal of each style for the picture and for each of its variants."""
        config = self._config
        split = split_of(seen.scene_id, config.test_share, config.calibration_share)
        rng = np.random.default_rng([config.seed, _number_of(seen.name)])
        pictures = pictures_of(
            seen, split, rng, max_width=config.max_width, variants=config.variants_per_frame
        )
        for number, picture in enumerate(pictures):
            # All weathers of a test scene are asked the same: only the frame differs.
            if number == 0 or split != "test":
                asked = [
                    self._speakers.draw(self._speakers.bank(rng), style, split, rng)
                    for style in STYLES
                ]
            for phrase, text in asked:
                yield self._proposal(seen, picture, split, phrase, text, rng)

    def _proposal(
        self,
        seen: Seen,
        picture: Picture,
        split: Split,
        phrase: Phrase,
        text: str,
        rng: np.random.Generator,
    ) -> Proposal:
        facts, speed = picture.facts, seen.observation.speed_mps
        assert facts.condition is not None, "frames of unknown condition are skipped"
        reason = load_reasons()[phrase.intent][phrase.style]
        sample = Sample(
            observation=Observation(picture.frame, speed),
            instruction=text,
            memories=(),
            matrix=self._rules.label(phrase.style, facts, speed, rng),
            scene=describe_facts(facts),
            explanation=explain(phrase.style, reason, facts.condition, None),
            style=phrase.style,
            level=phrase.level,
            intent=phrase.intent,
            condition=facts.condition,
            split=split,
            scene_id=f"{self._config.source}/{seen.scene_id}",
            phrase_id=phrase.phrase_id,
            language=phrase.language,
        )
        return Proposal(
            sample,
            self._config.source,
            licence_of(self._config),
            picture.name,
            ANNOTATOR,
            _known_share(facts),
        )


def licence_of(config: ProposeConfig) -> str:
    """What may be done with the frames: what nuScenes and the synthetic camera say, or the user."""
    own = {"nuscenes": NUSCENES_LICENCE, "synthetic": "Apache-2.0, drawn by ridetune"}
    return own.get(config.source, config.licence)


def split_of(scene_id: str, test_share: float, calibration_share: float) -> Split:
    """The split of a scene, by its name alone: no frame of it ever stands on another side."""
    share = _number_of(scene_id) / 2**32
    if share < test_share:
        return "test"
    return "calibration" if share < test_share + calibration_share else "train"


def _known_share(facts: Facts) -> float:
    known = (facts.condition, facts.road, facts.lead, facts.traffic, facts.surroundings)
    return sum(fact is not None for fact in known) / len(known)


def _number_of(name: str) -> int:
    """32 bits of a name."""
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=4).digest(), "big")


_proposers: dict[ProposeConfig, Proposer] = {}
