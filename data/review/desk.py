"""What the page asks for, without HTTP: the next pair, an answer, an undo, a preview, agreement.

One lock orders all answers: what is checked is still true when it is written.
"""

from threading import Lock

from ridetune.codec import MatrixCodec
from ridetune.matrix import STYLES, ControllerMatrix, Ranges, ki_limit
from ridetune.sample import Condition

from ..proposals import Proposal
from .agreement import measure
from .index import ProposalIndex
from .preview import Previewer
from .queue import Queue
from .settle import difference, explanation_for
from .sliders import limits_fault, matrix_fault, sliders_of, transpose
from .store import Review, Store
from .wire import (
    AgreementOut,
    ItemOut,
    LastOut,
    NextOut,
    PreviewIn,
    PreviewOut,
    ReviewIn,
    SlidersOut,
    UndoIn,
    WasOut,
)


class RefusalError(ValueError):
    """A request that is not done, with its HTTP status."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


class Desk:
    """The review of one folder of proposals."""

    def __init__(
        self,
        index: ProposalIndex,
        store: Store,
        queue: Queue,
        ranges: Ranges,
        previewer: Previewer,
    ) -> None:
        self._index = index
        self._store = store
        self._queue = queue
        self._ranges = ranges
        self._codec = MatrixCodec(ranges)
        self._previewer = previewer
        self._lock = Lock()
        self.sliders = SlidersOut(vehicle=ranges.vehicle, sliders=sliders_of(self._codec))

    def warm_up(self) -> None:
        """Compile the simulation before somebody waits for it."""
        self._previewer.drives(self._ranges.default, "sunny")

    def next_for(self, annotator: str, *, skipped: bool) -> NextOut:
        """The next pair for an annotator."""
        with self._lock:
            found = self._queue.next_for(annotator, skipped=skipped)
            return self._next(annotator, found, None)

    def review(self, said: ReviewIn) -> NextOut:
        """Keep an answer and hand out the next pair; RefusalError 404, 409 or 422."""
        proposal = self._proposal(said.proposal_id)
        style, values = proposal.sample.style, proposal.sample.matrix.values
        if said.action == "edit":
            self._check_edit(said, proposal)
            style, values = said.style or style, said.values or values
        elif said.style is not None or said.values is not None:
            raise RefusalError(422, "only an edit brings a style and values of its own")
        with self._lock:
            conflict = self._queue.conflict(said.proposal_id, said.annotator, said.base)
            if conflict is not None:
                raise RefusalError(409, conflict)
            self._store.append(
                proposal_id=said.proposal_id,
                annotator=said.annotator,
                action=said.action,
                style=style,
                values=values,
                seconds=said.seconds,
            )
            return self._next(said.annotator, self._queue.next_for(said.annotator), None)

    def undo(self, asked: UndoIn) -> NextOut:
        """Take back an annotator's last action and hand out its pair; RefusalError 409."""
        with self._lock:
            standing = self._store.ledger.standing_of(asked.annotator)
            if not standing:
                raise RefusalError(409, "there is nothing of yours to take back")
            last = standing[-1]
            if last.number != asked.number:
                raise RefusalError(
                    409, "you acted in another window meanwhile; load the page again to take back"
                )
            self._store.append(
                proposal_id=last.proposal_id,
                annotator=asked.annotator,
                action="undo",
                style=last.style,
                values=last.values,
                seconds=0.0,
            )
            if last.proposal_id not in self._index:  # of another folder of proposals
                return self._next(asked.annotator, self._queue.next_for(asked.annotator), None)
            self._queue.claim(last.proposal_id, asked.annotator)
            return self._next(asked.annotator, last.proposal_id, last)

    def preview(self, asked: PreviewIn) -> PreviewOut:
        """Drive with a matrix within the vehicle's limits; RefusalError 422."""
        fault = limits_fault(asked.values, self._ranges)
        if fault is not None:
            raise RefusalError(422, fault)
        return self._preview(ControllerMatrix.of(asked.values), asked.condition)

    def frame(self, proposal_id: str) -> bytes:
        """The encoded frame of a pair; RefusalError 404."""
        return self._proposal(proposal_id).sample.observation.frame

    def agreement(self) -> AgreementOut:
        """How first and second opinions on these proposals agree."""
        with self._lock:
            said = {i: o for i, o in self._store.ledger.all_opinions.items() if i in self._index}
        open_ones = (difference(o) for o in said.values() if len(o) == 2)
        return AgreementOut(
            agreement=measure(said.values()),
            disputes=tuple(words for words in open_ones if words is not None),
        )

    def _proposal(self, proposal_id: str) -> Proposal:
        if proposal_id not in self._index:
            raise RefusalError(
                404, f"there is no proposal {proposal_id} in this folder; load the page again"
            )
        return self._index.read(proposal_id)

    def _check_edit(self, said: ReviewIn, proposal: Proposal) -> None:
        if said.style is None or said.values is None:
            raise RefusalError(422, "an edit needs a style and six values")
        if (said.style, said.values) == (proposal.sample.style, proposal.sample.matrix.values):
            raise RefusalError(422, "nothing was changed; accept the pair instead")
        fault = matrix_fault(said.values, self._ranges)
        if fault is not None:
            raise RefusalError(422, fault)

    def _preview(self, matrix: ControllerMatrix, condition: Condition) -> PreviewOut:
        return PreviewOut(
            fault=matrix_fault(matrix.values, self._ranges),
            ki_limit=ki_limit(matrix.kp),
            drives=self._previewer.drives(matrix, condition),
        )

    def _next(self, annotator: str, proposal_id: str | None, was: Review | None) -> NextOut:
        standing = self._store.ledger.standing_of(annotator)
        last = LastOut(number=standing[-1].number, action=standing[-1].action) if standing else None
        item = None if proposal_id is None else self._item(proposal_id, was)
        progress = self._queue.progress(annotator)
        return NextOut(annotator=annotator, item=item, progress=progress, last=last)

    def _item(self, proposal_id: str, was: Review | None) -> ItemOut:
        proposal = self._index.read(proposal_id)
        sample = proposal.sample
        return ItemOut(
            proposal_id=proposal_id,
            base=len(self._store.ledger.speakers(proposal_id)),
            instruction=sample.instruction,
            level=sample.level,
            style=sample.style,
            values=sample.matrix.values,
            scene=sample.scene,
            condition=sample.condition,
            speed_mps=sample.observation.speed_mps,
            split=sample.split,
            source=proposal.source,
            licence=proposal.licence,
            frame_name=proposal.frame_name,
            proposed_by=proposal.annotator,
            confidence=proposal.confidence,
            starts={
                s: transpose(sample.matrix, sample.style, s, self._codec).values for s in STYLES
            },
            explanations={s: explanation_for(sample, s) for s in STYLES},
            preview=self._preview(sample.matrix, sample.condition),
            was=WasOut(action=was.action, style=was.style, values=was.values) if was else None,
        )
