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
import logging
import sys
from collections import Counter
from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path

from tqdm import tqdm

from ridetune.config import start_or_resume
from ridetune.sample import CONDITIONS
from ridetune.stage import Stopwatch, run_stage, write_manifest
from ridetune.workers import run_tasks

from .instructions import Speakers
from .lookalikes import Lookalikes, difference_hash
from .proposals import part_path, write_whole
from .proposer import Kit, PartTask, ProposeConfig, licence_of, make_part
from .sources.images import read_images
from .sources.mcap_log import read_mcap
from .sources.nuscenes import read_nuscenes
from .sources.seen import Frames, Seen, Skipped
from .sources.synthetic import draw_scenes
from .sources.video import read_videos

UNSTATED = "not stated"
SKIPPED_FILE = "skipped.csv"

log = logging.getLogger(__name__)


def propose(config: ProposeConfig) -> None:
    """Write all parts that are not there yet, what was skipped, and the manifest."""
    watch = Stopwatch()
    begun = any(config.out.glob("part-*.parquet"))
    start_or_resume(config, config.out, begun=begun, free=("backend", "workers", "address"))
    skipped: list[Skipped] = []
    frames = iter(tqdm(_kept(config, skipped), desc="frames", unit="frame"))
    parts = iter(lambda: list(islice(frames, config.frames_per_part)), [])
    first = next(parts, None)
    if first is None:
        reasons = Counter(skip.reason for skip in skipped).most_common(1)
        why = f"; most often: {reasons[0][0]}" if reasons else ""
        raise ValueError(f"{config.source} at {config.root} gave no usable frame{why}")
    kit = Kit.of(config)
    read = Counter[str]()

    def tasks() -> Iterator[PartTask]:
        for number, part in enumerate(chain([first], parts)):
            read["frames"] += len(part)
            read["parts"] += 1
            if not part_path(config.out, number).exists():
                yield PartTask(kit, number, part)

    made = run_tasks(
        make_part,
        tasks(),
        backend=config.backend,
        workers=config.workers,
        address=config.address,
    )
    for number, content in made:
        write_whole(content, part_path(config.out, number))
    _write_skipped(skipped, config.out)
    facts = {"frames": read["frames"], "skipped": len(skipped), "parts": read["parts"]}
    bank = Speakers(config.speech, kit.own).about()
    write_manifest(config.out, seconds=watch.seconds, facts={**facts, "bank": bank})
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


def _write_skipped(skipped: list[Skipped], folder: Path) -> None:
    with (folder / SKIPPED_FILE).open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow(["frame", "reason"])
        lines.writerows((skip.name, skip.reason) for skip in skipped)


if __name__ == "__main__":
    sys.exit(run_stage(ProposeConfig, "configs/propose.yaml", propose, __doc__))
