"""The queue of the reviews: who is asked what, and nobody overwrites anybody."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from data.review.queue import Queue
from data.review.store import Action, Ledger, Store
from ridetune.matrix import Style
from tests.review_pairs import make_review, say


def queue_of(ids: list[str], store: Store, share: float = 0.0, **kind: Any) -> Queue:
    return Queue(ids, store.ledger, second_opinion_share=share, claim_s=60.0, **kind)


def test_unanswered_pairs_come_first_and_two_people_get_two(tmp_path: Path) -> None:
    now = [0.0]
    with Store(tmp_path) as store:
        queue = queue_of(["p0", "p1", "p2"], store, clock=lambda: now[0])
        assert queue.next_for("ann") == "p0"
        assert queue.next_for("ann") == "p0"  # a page that is loaded again
        assert queue.next_for("bob") == "p1"
        assert queue.next_for("cy") == "p2"
        assert queue.next_for("dee") == "p0"  # nothing is free: better twice than idle
        now[0] = 61.0
        say(store)
        assert queue.next_for("bob") == "p1"
        say(store, "skip", who="bob", about="p1")
        assert queue.next_for("bob") == "p2"
        say(store, "skip", who="bob", about="p2")
        assert queue.next_for("bob") is None
        assert queue.next_for("bob", skipped=True) == "p1"
        say(store, "skip", who="bob", about="p1")
        assert queue.next_for("bob", skipped=True) == "p2"  # round and round
        progress = queue.progress("bob")
        assert (progress.all, progress.done, progress.mine, progress.skipped) == (3, 1, 0, 2)


def test_second_opinions_go_to_another_and_never_back_to_the_first(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        queue = queue_of(["p0", "p1"], store, share=1.0)
        say(store)
        assert queue.next_for("ann") == "p1"
        say(store, about="p1")
        assert queue.next_for("ann") is None
        assert queue.next_for("bob") == "p0"
        say(store, who="bob")
        say(store, "edit", who="bob", about="p1", style="aggressive")  # differs: a third decides
        assert queue.next_for("ann") is None and queue.next_for("bob") is None
        assert queue.wanted("p1") == 3 and queue.next_for("cy") == "p1"
        assert queue.progress("cy").disputed == 1
        say(store, who="cy", about="p1")
        assert queue.next_for("dee") is None
        assert queue.progress("cy").second_done == 2 and queue.progress("cy").disputed == 0


def test_the_share_of_second_opinions_is_kept_and_the_same_everywhere(tmp_path: Path) -> None:
    ids = [f"{i:016x}" for i in range(4000)]
    with Store(tmp_path) as store:
        queue = queue_of(ids, store, share=0.25)
        twice = {i for i in ids if queue.wanted(i) == 2}
        assert len(twice) == pytest.approx(1000, abs=100)
        more = queue_of(ids[::-1], store, share=0.4)
        assert twice < {i for i in ids if more.wanted(i) == 2}


def test_a_conflict_says_who_and_when_and_what_to_do(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        queue = queue_of(["p0"], store)
        assert queue.conflict("p0", "bob", 0) is None
        time = say(store).time
        said = queue.conflict("p0", "bob", 0) or ""
        assert said.startswith(f"ann accepted this pair at {time:%H:%M:%S UTC}")
        assert "go on with the next pair" in said
        assert "take that back with U" in (queue.conflict("p0", "ann", 1) or "")
        say(store, "undo")
        assert queue.conflict("p0", "bob", 0) is None
        assert "another window" in (queue.conflict("p0", "ann", 0) or "")
        assert queue.conflict("p0", "ann", 2) is None


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["ann", "bob", "cy", "dee"]),
            st.sampled_from(["accept", "edit", "reject", "skip", "undo"]),
        ),
        max_size=40,
    )
)
def test_nobody_is_asked_twice_and_no_pair_too_often(turns: list[tuple[str, Action]]) -> None:
    ledger = Ledger()
    queue = Queue(["p0", "p1", "p2"], ledger, second_opinion_share=0.5, claim_s=1.0)
    number = 0
    for who, action in turns:
        if action == "undo":
            mine = ledger.standing_of(who)
            about = mine[-1].proposal_id if mine else None
        else:
            about = queue.next_for(who)
        if about is None:
            continue
        assert action == "undo" or queue.conflict(about, who, len(ledger.speakers(about))) is None
        number += 1
        style: Style = "aggressive" if action == "edit" else "moderate"
        ledger.add(make_review(number, about, who, action, style))
    for opinions in ledger.all_opinions.values():
        names = [o.annotator for o in opinions]
        assert len(set(names)) == len(names) <= 3
