"""Propose pairs from real frames: each picture with one instruction of every style and a label.

    source -> frames, without look-alikes -> weather variants -> instructions -> labels -> proposals

In: nuScenes, a folder of images, videos, a drive log or the synthetic camera. Out: a folder of
proposals for `python -m data.review` and the export, and what was skipped and why (skipped.csv).
A run that was stopped goes on where it was: finished parts are kept.

A picture's condition is the name of its folder (sunny, rain, fog, snow, night), or stands in a
frames.csv beside the folders: file, condition, dark, low_sun, road, lead, traffic, surroundings,
speed_mps, scene. Give pictures of one drive the same `scene` there, so that the split keeps them
together: without it each picture is a scene of its own.

    python -m data.propose --config configs/propose.yaml source=images root=../my-photographs
"""

import csv
import hashlib
import logging
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Literal

import numpy as np
import yaml
from tqdm import tqdm

from ridetune.codec import MatrixCodec
from ridetune.config import Count, Share, save_config
from ridetune.gate import SafetyGate
from ridetune.matrix import STYLES, Ranges
from ridetune.sample import CONDITIONS, Condition, Observation, Sample, Split
from ridetune.stage import Stopwatch, run_stage, write_manifest

from .annotate import draw_matrix, explain, shift_for_care
from .build import draw_instruction
from .instructions import Bank, Phrase, load_bank
from .lookalikes import Lookalikes, difference_hash
from .pictures import Picture, pictures_of
from .proposals import Proposal, write_part
from .sources.images import read_images
from .sources.mcap_log import read_mcap
from .sources.nuscenes import LICENCE as NUSCENES_LICENCE
from .sources.nuscenes import read_nuscenes
from .sources.seen import Facts, Frames, Seen, Skipped, describe_facts
from .sources.synthetic import draw_scenes
from .sources.video import read_videos

ANNOTATOR = "rules-1"
UNSTATED = "not stated"
SKIPPED_FILE = "skipped.csv"
CONFIG_FILE = "config.yaml"

log = logging.getLogger(__name__)


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
    grammar_share: Share
    test_share: Share
    calibration_share: Share
    frames_per_part: int


def propose(config: ProposeConfig) -> None:
    """Write all parts that are not there yet, what was skipped, and the manifest."""
    watch = Stopwatch()
    _start_or_resume(config)
    skipped: list[Skipped] = []
    frames = iter(tqdm(_kept(config, skipped), desc="frames", unit="frame"))
    parts = iter(lambda: list(islice(frames, config.frames_per_part)), [])
    first = next(parts, None)
    if first is None:
        reasons = Counter(skip.reason for skip in skipped).most_common(1)
        why = f"; most often: {reasons[0][0]}" if reasons else ""
        raise ValueError(f"{config.source} at {config.root} gave no usable frame{why}")
    proposer = Proposer(config)
    num_frames = num_parts = 0
    for part in chain([first], parts):
        path = config.out / f"part-{num_parts:05d}.parquet"
        if not path.exists():
            write_part((p for seen in part for p in proposer.of_frame(seen)), path)
        num_frames += len(part)
        num_parts += 1
    _write_skipped(skipped, config.out)
    facts = {"frames": num_frames, "skipped": len(skipped), "parts": num_parts}
    write_manifest(config.out, seconds=watch.seconds, facts=facts)
    print(f"proposals: {facts} in {config.out}, {watch.seconds:.0f} s")
    if licence_of(config) == UNSTATED:
        print("note: their licence is not stated; licence=... puts it into the dataset's card")


def open_source(config: ProposeConfig) -> Frames:
    """The frames of the source that the config names; ValueError without its root."""
    if config.source == "synthetic":
        if config.limit is None:
            raise ValueError("the synthetic camera never ends; set limit=... to a number of frames")
        return draw_scenes(config.limit, seed=config.seed)
    if config.root is None:
        raise ValueError(f"the source {config.source!r} needs root=..., the folder to read from")
    if config.source == "nuscenes":
        return read_nuscenes(config.root, stride=config.stride)
    if config.source in ("video", "mcap") and config.condition is None:
        raise ValueError(
            f"a {config.source} does not say what the weather was; "
            f"set condition= to one of {', '.join(CONDITIONS)}, and propose other weathers apart"
        )
    if config.source == "video":
        return read_videos(
            config.root, condition=config.condition, every_s=config.every_s, change=config.change
        )
    if config.source == "mcap":
        return read_mcap(
            config.root,
            camera=config.camera,
            speed=config.speed,
            every_s=config.every_s,
            change=config.change,
            condition=config.condition,
        )
    return read_images(config.root)


class Proposer:
    """Makes the proposals of one frame; what it draws depends on the frame's name alone."""

    def __init__(self, config: ProposeConfig) -> None:
        ranges = Ranges.load(config.ranges)
        self._config = config
        self._codec = MatrixCodec(ranges)
        self._gate = SafetyGate(ranges, self._codec)
        self._bank: Bank = load_bank()

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
                    draw_instruction(style, split, config.grammar_share, self._bank, rng)
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
        care = shift_for_care(facts, speed)
        matrix = draw_matrix(phrase.style, facts.condition, None, self._codec, rng, care=care)
        verdict = self._gate.judge(matrix, matrix)
        assert verdict.outcome == "accepted", verdict.reasons
        reason = self._bank.reasons[phrase.intent][phrase.style]
        sample = Sample(
            observation=Observation(picture.frame, speed),
            instruction=text,
            memories=(),
            matrix=matrix,
            scene=describe_facts(facts),
            explanation=explain(phrase.style, reason, facts.condition, None),
            style=phrase.style,
            level=phrase.level,
            intent=phrase.intent,
            condition=facts.condition,
            split=split,
            scene_id=f"{self._config.source}/{seen.scene_id}",
            phrase_id=phrase.phrase_id,
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


def _kept(config: ProposeConfig, skipped: list[Skipped]) -> Iterator[Seen]:
    """Frames of known condition that look like none before; the others are noted."""
    lookalikes = Lookalikes(config.near_bits)
    kept = 0
    for seen in open_source(config):
        if kept == config.limit:
            return
        fault = seen if isinstance(seen, Skipped) else _fault_of(seen, lookalikes)
        if isinstance(fault, Skipped):
            log.info("skipped frame=%s reason=%s", fault.name, fault.reason)
            skipped.append(fault)
        elif isinstance(seen, Seen):
            kept += 1
            yield seen


def _fault_of(seen: Seen, lookalikes: Lookalikes) -> Skipped | None:
    if seen.facts.condition is None:
        return Skipped(
            seen.name,
            "its condition is not known: name its folder sunny, rain, fog, snow or night, "
            "or list it in frames.csv",
        )
    twin = lookalikes.find_or_add(seen.name, difference_hash(seen.observation.frame))
    return None if twin is None else Skipped(seen.name, f"it looks like {twin}")


def _known_share(facts: Facts) -> float:
    known = (facts.condition, facts.road, facts.lead, facts.traffic, facts.surroundings)
    return sum(fact is not None for fact in known) / len(known)


def _number_of(name: str) -> int:
    """32 bits of a name."""
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=4).digest(), "big")


def _start_or_resume(config: ProposeConfig) -> None:
    """Make the folder; ValueError where it holds what another config has begun."""
    config.out.mkdir(parents=True, exist_ok=True)
    path = config.out / CONFIG_FILE
    partial = config.out / f".{CONFIG_FILE}"
    save_config(config, partial)
    begun = path.exists() and any(config.out.glob("part-*.parquet"))
    if begun and yaml.safe_load(path.read_text()) != yaml.safe_load(partial.read_text()):
        partial.unlink()
        raise ValueError(
            f"{config.out} holds proposals of another config; delete it, or name a new `out`"
        )
    partial.rename(path)


def _write_skipped(skipped: list[Skipped], folder: Path) -> None:
    with (folder / SKIPPED_FILE).open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow(["frame", "reason"])
        lines.writerows((skip.name, skip.reason) for skip in skipped)


if __name__ == "__main__":
    sys.exit(run_stage(ProposeConfig, "configs/propose.yaml", propose, __doc__))
