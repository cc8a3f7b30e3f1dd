"""Which opinion stands on a proposal, and what the build makes of it.

    proposals + opinions -> settled proposals, and a tally of what was left out and why

The first answer stands. Where the first two differ - in the style, or one rejects what the other
keeps - neither does until a third annotator has decided.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from data.annotate import explain
from data.phrases import load_reasons
from data.proposals import Proposal
from ridetune.matrix import ControllerMatrix, Style
from ridetune.sample import Sample

from .store import Review


@dataclass
class Tally:
    """How many proposals went which way.

    disputes: by proposal, what the first two say where no third has decided. unknown: reviewed
    proposals that are not among those given.
    """

    accepted: int = 0
    edited: int = 0
    rejected: int = 0
    unreviewed: int = 0
    unknown: int = 0
    disputes: dict[str, str] = field(default_factory=dict)


def difference(opinions: Sequence[Review]) -> str | None:
    """In what the first two opinions differ, in words; None if they agree or are not yet two."""
    if len(opinions) < 2:
        return None
    first, second = opinions[:2]
    says = [
        f"{o.annotator} {'rejects it' if o.action == 'reject' else f'calls it {o.style}'}"
        for o in (first, second)
    ]
    if "reject" in (first.action, second.action):
        same = first.action == second.action
    else:
        same = first.style == second.style
    return None if same else ", ".join(says)


def settle(opinions: Sequence[Review]) -> Review | None:
    """The opinion that stands; None if there is none, or two differ and no third decides."""
    if not opinions or difference(opinions) is None:
        return opinions[0] if opinions else None
    return opinions[2] if len(opinions) > 2 else None


def apply_reviews(
    proposals: Iterable[Proposal],
    opinions: Mapping[str, Sequence[Review]],
    tally: Tally,
    *,
    keep_unreviewed: bool = False,
) -> Iterator[Proposal]:
    """The proposals to learn from, in their order; `tally` is filled on the way.

    An edited one has the reviewer's matrix and style, and its explanation follows the style.
    """
    known = 0
    for proposal in proposals:
        said = opinions.get(proposal.proposal_id, ())
        known += bool(said)
        stands, differ = settle(said), difference(said)
        if stands is None and differ is not None:
            tally.disputes[proposal.proposal_id] = differ
        elif stands is None:
            tally.unreviewed += 1
            if keep_unreviewed:
                yield proposal
        elif stands.action == "reject":
            tally.rejected += 1
        elif stands.action == "edit":
            tally.edited += 1
            yield _edited(proposal, stands)
        else:
            tally.accepted += 1
            yield proposal
    tally.unknown = len(opinions) - known


def explanation_for(sample: Sample, style: Style) -> str:
    """The sample's explanation as it reads for a style: its own where that is the sample's.

    ValueError where the bank has no reason for the sample's intent.
    """
    if style == sample.style:
        return sample.explanation
    reasons = load_reasons()
    if sample.intent not in reasons:
        raise ValueError(f"the bank's reasons.yaml lacks the intent {sample.intent!r}; add it")
    return explain(style, reasons[sample.intent][style], sample.condition, None)


def _edited(proposal: Proposal, review: Review) -> Proposal:
    sample = replace(
        proposal.sample,
        matrix=ControllerMatrix.of(review.values),
        style=review.style,
        explanation=explanation_for(proposal.sample, review.style),
    )
    return replace(proposal, sample=sample)
