"""The run over the parts of a folder: what is there already stays, a stopped run goes on."""

from dataclasses import fields
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ridetune.config import start_or_resume
from ridetune.matrix import Ranges
from ridetune.stage import Stopwatch, write_manifest

from ..proposals import Proposal, num_rows, part_paths, read_part, write_part
from .agreement import compare_folders
from .answers import Answer
from .config import AskConfig
from .endpoint import LimitReachedError, ModelAnnotator
from .label import Labeller
from .skips import Skip, read_skips, write_skips

# The other keys may change between the runs of one folder.
_SHAPING = ("proposals", "base_url", "model", "prompt", "options", "ranges", "seed")


def ask(config: AskConfig) -> None:
    """Write all parts that are not there yet, what was skipped, and the manifest."""
    watch = Stopwatch()
    paths = part_paths(config.proposals)
    ranges = Ranges.load(config.ranges)
    labeller = Labeller(ranges, annotator=f"model:{config.model}", seed=config.seed)
    with ModelAnnotator(config) as annotator:
        start_or_resume(config, config.out, begun=True, free=_free(config))
        skips = read_skips(config.out)
        with tqdm(total=num_rows(paths), desc="pairs", unit="pair") as bar:
            for path in paths:
                if not annotator.why_ended:
                    _ask_part(path, config.out, annotator, labeller, skips, bar)
        ended = annotator.why_ended
    counts = {**annotator.ledger.counts, "skipped": len(skips)}
    facts = {**counts, "cost": annotator.ledger.cost, "stopped": str(ended) if ended else None}
    write_manifest(config.out, seconds=watch.seconds, facts=facts)
    said = ", ".join(f"{count:,} {what}" for what, count in counts.items())
    cost = f"cost {annotator.ledger.cost:.4f}"
    print(f"asked {config.model}: {said}, {cost}, in {config.out}, {watch.seconds:.0f} s")
    for line in compare_folders(config.proposals, config.out):
        print(line)
    if isinstance(ended, LimitReachedError):
        print(f"stopped: {ended}; what was answered is kept, a larger max_cost goes on from here")
    elif ended:
        raise ended


def _ask_part(
    path: Path,
    out: Path,
    annotator: ModelAnnotator,
    labeller: Labeller,
    skips: list[Skip],
    bar: "tqdm[Any]",
) -> None:
    """Write a part if it is not there; one that the end of the run cuts off is `-unfinished`."""
    whole, unfinished = out / path.name, out / f"{path.stem}-unfinished.parquet"
    cut_off = False
    if whole.exists():
        bar.update(num_rows([path]))
    else:
        labelled, cut_off = _label_part(path, annotator, labeller, skips, bar)
        write_skips(skips, out)  # before the part: where a part is, its skips are
        if labelled:  # a part without any is tried again by the next run
            write_part(labelled, unfinished if cut_off else whole)
    if not cut_off:
        unfinished.unlink(missing_ok=True)


def _label_part(
    path: Path,
    annotator: ModelAnnotator,
    labeller: Labeller,
    skips: list[Skip],
    bar: "tqdm[Any]",
) -> tuple[list[Proposal], bool]:
    """The labelled proposals of a part, and whether the end of the run cut it off."""
    proposals = read_part(path)
    labelled: list[Proposal] = []
    cut_off = False
    outcomes = annotator.annotate_all([proposal.sample for proposal in proposals])
    for proposal, outcome in zip(proposals, outcomes, strict=True):
        if isinstance(outcome, Answer):
            labelled.append(labeller.label(proposal, outcome))
        elif outcome:
            skips.append(Skip.of(path, proposal, outcome))
        cut_off = cut_off or outcome is None
        bar.update(outcome is not None)
        bar.set_postfix(cost=f"{annotator.ledger.cost:.4f}")
    return labelled, cut_off


def _free(config: AskConfig) -> list[str]:
    return [key.name for key in fields(config) if key.name not in _SHAPING]
