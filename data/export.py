"""Export proposals as a dataset: checked, split, in the forms that training programs read.

    proposals -> reviews -> checks -> every form -> card

In: a folder of proposals and, where people looked at them, one of reviews. Out, in one folder:
{train,calibration,test}.parquet as `python -m train` reads them, the feedback sentences, jsonl/,
sharegpt/ (LLaMA-Factory), qwen/ and images/, a dataset card with plots and a contact sheet, and
skipped.csv: what was left out, and why. The proposals are read twice, part by part: first all are
checked, then those that stand are written. Deterministic.

    python -m data.export --config configs/data-export.yaml proposals=FOLDER out=FOLDER2
"""

import csv
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from tqdm import tqdm

from ridetune.codec import MatrixCodec
from ridetune.config import save_config
from ridetune.matrix import Ranges
from ridetune.sample import Split
from ridetune.stage import Stopwatch, new_folder, run_stage, write_manifest

from .card import Card, write_card
from .checks import SPLITS, Checker, Fault, Judged, Ledger
from .feedback import write_feedback
from .formats import SplitFiles, write_dataset_info
from .proposals import Proposal, read_proposals

SKIPPED_FILE = "skipped.csv"
CONFIG_FILE = "config.yaml"


@dataclass(frozen=True)
class DataExportConfig:
    """What to export, and the name of the dataset.

    reviews: the folder of `python -m data.review`, or None. keep_unreviewed: with reviews, keep
    also what nobody has looked at.
    """

    proposals: Path
    reviews: Path | None
    keep_unreviewed: bool
    out: Path
    ranges: Path
    name: str


def export(config: DataExportConfig) -> None:
    """Write the dataset folder; an interrupted export leaves nothing that looks whole."""
    watch = Stopwatch()
    _check_apart(config)
    codec = MatrixCodec(Ranges.load(config.ranges))
    with new_folder(config.out) as folder, closing(Ledger()) as ledger:
        with (folder / SKIPPED_FILE).open("w", newline="", encoding="utf-8") as file:
            skipped = SkippedList(file)
            _check(config, codec, ledger, skipped)
            card = _write(config, codec, ledger, skipped, folder)
        if not card.pairs("train"):
            raise ValueError(_why_empty(config, skipped))
        write_feedback(card.languages, folder)
        write_dataset_info(folder, config.name, card.splits)
        write_card(card, folder, name=config.name, skipped=skipped.counts)
        save_config(config, folder / CONFIG_FILE)
        counts = {split: card.pairs(split) for split in SPLITS}
        facts = {"samples": counts, "skipped": skipped.counts}
        write_manifest(folder, seconds=watch.seconds, facts=facts)
    left_out = f"{skipped.counts.total()} left out"
    print(f"dataset: {counts}, {left_out}, in {config.out}, {watch.seconds:.0f} s")
    for warning in card.warnings():
        print(f"note: {warning}")


class SkippedList:
    """skipped.csv: one line for each pair that is left out, counted by kind."""

    def __init__(self, file: TextIO) -> None:
        self.counts: Counter[str] = Counter()
        self._lines = csv.writer(file, lineterminator="\n")
        self._lines.writerow(["proposal_id", "source", "frame", "instruction", "kind", "reason"])

    def add(self, proposal: Proposal, fault: Fault) -> None:
        """List one pair."""
        self.counts[fault.kind] += 1
        names = (proposal.proposal_id, proposal.source, proposal.frame_name)
        said = proposal.sample.instruction
        self._lines.writerow([*names, said, fault.kind, fault.reason])


def judged(config: DataExportConfig) -> Iterator[Judged]:
    """The proposals, with the opinions of the reviewers applied where there are any."""
    judge = _reviewers(config.reviews, config.keep_unreviewed) if config.reviews else None
    for proposal in read_proposals(config.proposals):
        yield judge(proposal) if judge else Judged(proposal)


def _reviewers(folder: Path, keep_unreviewed: bool) -> Callable[[Proposal], Judged]:
    """What the opinions in a folder make of one proposal."""
    from .review.settle import Tally, apply_reviews
    from .review.store import read_reviews

    opinions = read_reviews(folder)

    def judge(proposal: Proposal) -> Judged:
        name = proposal.proposal_id
        tally = Tally()
        kept = next(
            apply_reviews([proposal], opinions, tally, keep_unreviewed=keep_unreviewed), None
        )
        fault = None
        if kept is None and name in tally.disputes:
            fault = Fault("reviewers differ", tally.disputes[name])
        elif kept is None and name in opinions:
            fault = Fault("rejected", "a reviewer rejected it")
        elif kept is None:
            fault = Fault("not reviewed", "nobody has reviewed it")
        return Judged(kept or proposal, fault, name in opinions)

    return judge


def _check(
    config: DataExportConfig, codec: MatrixCodec, ledger: Ledger, skipped: SkippedList
) -> None:
    """Look at every pair and note those that stand; ValueError where the split leaks."""
    checker = Checker(codec)
    for pair in tqdm(judged(config), desc="check", unit="pair"):
        proposal = pair.proposal
        fault = pair.fault or checker.fault_of(proposal) or ledger.add(proposal)
        if fault is not None:
            skipped.add(proposal, fault)
    ledger.refuse_leaks()


def _write(
    config: DataExportConfig,
    codec: MatrixCodec,
    ledger: Ledger,
    skipped: SkippedList,
    folder: Path,
) -> Card:
    """Write the pairs that stand, each in its split, and count them for the card."""
    card = Card(codec)
    files: dict[Split, SplitFiles] = {}
    with ExitStack() as opened:
        for pair in ledger.kept(tqdm(judged(config), desc="write", unit="pair")):
            if pair.fault is not None:
                skipped.add(pair.proposal, pair.fault)
                continue
            split = pair.proposal.sample.split
            if split not in files:
                files[split] = SplitFiles(folder, split, codec)
                opened.callback(files[split].close)
            image = files[split].add(pair.proposal, reviewed=pair.reviewed)
            card.add(pair.proposal, image, reviewed=pair.reviewed)
    return card


def _why_empty(config: DataExportConfig, skipped: SkippedList) -> str:
    common = skipped.counts.most_common(1)
    why = f"; {common[0][1]} were left out for {common[0][0]!r}" if common else ""
    return (
        f"{config.proposals} leaves no pair to train on{why}; "
        "propose from more frames, or review more of them"
    )


def _check_apart(config: DataExportConfig) -> None:
    """ValueError where replacing `out` would delete what is read."""
    out = config.out.resolve()
    for name, place in (("proposals", config.proposals), ("reviews", config.reviews)):
        if place is not None and place.resolve().is_relative_to(out):
            raise ValueError(
                f"out={config.out} would replace the {name} at {place}; name another `out` folder"
            )


if __name__ == "__main__":
    sys.exit(run_stage(DataExportConfig, "configs/data-export.yaml", export, __doc__))
