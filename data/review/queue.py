"""Who looks at what next, and whether an answer may still be given.

First what nobody has answered, then what asks for a further opinion: a share of all pairs, chosen
by their ids, is answered twice, and where the two differ a third time; never twice by one
annotator. A pair that one annotator is looking at is kept from the others for a while.
"""

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from .settle import difference
from .store import Action, Ledger, Review

_DID: dict[Action, str] = {"accept": "accepted", "edit": "edited", "reject": "rejected"}


@dataclass(frozen=True)
class Progress:
    """How far the review is. done: has an opinion; second_*: further opinions; disputed: open."""

    all: int
    done: int
    mine: int
    skipped: int
    second_wanted: int
    second_done: int
    disputed: int


class Queue:
    """Hands out pairs to annotators over a ledger that grows meanwhile.

    claim_s: for how long [s] a pair that was handed out is kept from the others.
    """

    def __init__(
        self,
        ids: Sequence[str],
        ledger: Ledger,
        *,
        second_opinion_share: float,
        claim_s: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._ids = dict.fromkeys(ids)
        self._ledger = ledger
        self._twice = frozenset(i for i in ids if _share_of(i) < second_opinion_share)
        self._claim_s = claim_s
        self._clock = clock
        self._claims: dict[str, tuple[str, float]] = {}  # annotator: proposal, until

    def next_for(self, annotator: str, *, skipped: bool = False) -> str | None:
        """The pair for an annotator to look at, claimed for them; None if there is none.

        skipped: out of those that they have skipped, the one skipped first.
        """
        mine = self._ledger.standing_of(annotator)
        answered = {line.proposal_id for line in mine if line.action != "skip"}
        passes = {line.proposal_id: line.number for line in mine if line.action == "skip"}
        if skipped:
            candidates = [i for i in sorted(passes, key=passes.__getitem__) if i in self._ids]
        else:
            candidates = [i for i in self._ids if i not in passes]
        found = self._best([i for i in candidates if i not in answered], annotator)
        if found is not None:
            self.claim(found, annotator)
        return found

    def claim(self, proposal_id: str, annotator: str) -> None:
        """Keep a pair from the others for a while; an annotator holds one at a time."""
        self._claims[annotator] = proposal_id, self._clock() + self._claim_s

    def wanted(self, proposal_id: str) -> int:
        """How many opinions a pair needs as things stand."""
        if difference(self._ledger.opinions(proposal_id)) is not None:
            return 3
        return 2 if proposal_id in self._twice else 1

    def conflict(self, proposal_id: str, annotator: str, base: int) -> str | None:
        """Why an answer cannot be kept, in a sentence for the annotator; None if it can.

        base: how many actions on the pair the annotator's page knew of.
        """
        opinions, speakers = self._ledger.opinions(proposal_id), self._ledger.speakers(proposal_id)
        own = next((o for o in opinions if o.annotator == annotator), None)
        if own is not None:
            return f"you {_said(own)} already; take that back with U to answer anew"
        if len(opinions) >= self.wanted(proposal_id):
            last = opinions[-1]
            return (
                f"{last.annotator} {_said(last)}, and no further opinion is wanted; "
                "yours was not kept, go on with the next pair"
            )
        if base > len(speakers) or annotator in speakers[base:]:
            return "you acted on this pair in another window; load the page again to answer it"
        return None

    def progress(self, annotator: str) -> Progress:
        """How far all are, and one annotator."""
        said = {i: o for i, o in self._ledger.all_opinions.items() if i in self._ids}
        mine = [o for o in self._ledger.standing_of(annotator) if o.proposal_id in self._ids]
        answered = {o.proposal_id for o in mine if o.action != "skip"}
        return Progress(
            all=len(self._ids),
            done=len(said),
            mine=len(answered),
            skipped=len({o.proposal_id for o in mine} - answered),
            second_wanted=len(self._twice),
            second_done=sum(i in self._twice and len(o) > 1 for i, o in said.items()),
            disputed=sum(len(o) == 2 and difference(o) is not None for o in said.values()),
        )

    def _best(self, candidates: Sequence[str], annotator: str) -> str | None:
        """The first of: free and unanswered, free, unanswered, any that wants an opinion."""
        now = self._clock()
        others = (claim for name, claim in self._claims.items() if name != annotator)
        claimed = {i for i, until in others if until > now}
        best: dict[tuple[bool, bool], str] = {}
        for i in candidates:
            count = len(self._ledger.opinions(i))
            if count and count >= self.wanted(i):
                continue
            best.setdefault((i in claimed, count > 0), i)
            if (False, False) in best:
                break
        return best[min(best)] if best else None


def _said(opinion: Review) -> str:
    return f"{_DID[opinion.action]} this pair at {opinion.time:%H:%M:%S UTC on %d %B}"


def _share_of(proposal_id: str) -> float:
    """Where an id falls in [0, 1), the same on every machine."""
    digest = hashlib.blake2b(proposal_id.encode(), digest_size=4, person=b"second opinion").digest()
    return int.from_bytes(digest, "big") / 2**32
