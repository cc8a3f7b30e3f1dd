"""The review: nothing acknowledged is lost, nobody overwrites anybody, agreement is measured."""

import io
import json
import logging
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from data.kappa import cohens_kappa
from data.proposals import Proposal, read_proposals, write_part
from data.review.__main__ import ReviewConfig, review
from data.review.agreement import icc_2_1, measure
from data.review.app import create_app
from data.review.desk import Desk
from data.review.index import ProposalIndex
from data.review.preview import Previewer
from data.review.queue import Queue
from data.review.settle import Tally, apply_reviews, explanation_for, settle
from data.review.sliders import matrix_fault, sliders_of, transpose
from data.review.store import REVIEWS_FILE, Action, Ledger, Review, Store, read_reviews
from ridetune.codec import MatrixCodec
from ridetune.matrix import STYLES, ControllerMatrix, ParameterRange, Style, ki_limit
from ridetune.sample import Observation, Sample
from ridetune.stage import run_stage
from tests.shipped_car import RANGES, VEHICLE, middle

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


# --- the log ---


def test_an_action_is_on_disk_before_it_is_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Store(tmp_path) as store:
        synced: list[bytes] = []

        def watched(descriptor: int) -> None:
            synced.append(store.path.read_bytes())

        monkeypatch.setattr(os, "fsync", watched)
        assert not store.ledger.all_opinions
        say(store)
        assert len(synced) == 1 and synced[0].endswith(b"}\n")
        raw = json.loads(store.path.read_text())
    assert raw["number"] == 1 and raw["proposal_id"] == "p0" and raw["annotator"] == "ann"
    assert raw["values"] == list(SIX) and raw["seconds"] == 1.5 and raw["time"].endswith("Z")


def test_the_log_is_replayed_without_what_was_taken_back(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        say(store)
        say(store, "reject", about="p1")
        say(store, "undo", about="p1")
        say(store, "edit", who="bob", values=CALMER)
        say(store, "skip", about="p2")
        before = store.ledger.all_opinions
    with Store(tmp_path) as store:
        assert store.ledger.all_opinions == before == read_reviews(tmp_path)
        assert [o.annotator for o in before["p0"]] == ["ann", "bob"]
        assert set(before) == {"p0"}
        assert say(store, about="p3").number == 6


def test_an_undo_takes_back_only_the_last_of_ones_own(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        say(store)
        say(store, about="p1")
        say(store, who="bob", about="p0")
    line = json.loads((tmp_path / REVIEWS_FILE).read_text().splitlines()[0])
    wrong = {**line, "number": 4, "action": "undo"}  # p0, but p1 was last
    with (tmp_path / REVIEWS_FILE).open("a") as file:
        file.write(json.dumps(wrong) + "\n")
    with pytest.raises(ValueError, match=r"line 4 is damaged .*not the last"):
        read_reviews(tmp_path)


def test_a_line_torn_anywhere_is_cut_off_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Store(tmp_path) as store:
        say(store)
        whole = store.path.stat().st_size
        say(store, about="p1")
    content = (tmp_path / REVIEWS_FILE).read_bytes()
    for end in range(whole + 1, len(content)):
        (tmp_path / REVIEWS_FILE).write_bytes(content[:end])
        assert set(read_reviews(tmp_path)) == {"p0"}  # reading changes nothing
        assert (tmp_path / REVIEWS_FILE).stat().st_size == end
        caplog.clear()
        with caplog.at_level(logging.WARNING), Store(tmp_path) as store:
            assert "cut_torn_line" in caplog.text
            assert set(store.ledger.all_opinions) == {"p0"}
            assert say(store, about="p2").number == 2
        assert set(read_reviews(tmp_path)) == {"p0", "p2"}


@pytest.mark.parametrize(
    "damage",
    [b"", b"{}", b'{"number": 2', b"\xff\x00", b'{"number": 7}', b"null"],
)
def test_a_damaged_line_in_the_middle_names_file_and_line(tmp_path: Path, damage: bytes) -> None:
    with Store(tmp_path) as store:
        for name in ("p0", "p1", "p2"):
            say(store, about=name)
    lines = (tmp_path / REVIEWS_FILE).read_bytes().split(b"\n")
    lines[1] = damage
    (tmp_path / REVIEWS_FILE).write_bytes(b"\n".join(lines))
    for read in (read_reviews, Store):
        with pytest.raises(ValueError, match=r"reviews\.jsonl, line 2 is damaged"):
            read(tmp_path)
    assert (tmp_path / REVIEWS_FILE).read_bytes() == b"\n".join(lines)


def test_a_missing_line_is_noticed(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        for name in ("p0", "p1", "p2"):
            say(store, about=name)
    lines = (tmp_path / REVIEWS_FILE).read_bytes().splitlines(keepends=True)
    (tmp_path / REVIEWS_FILE).write_bytes(lines[0] + lines[2])
    with pytest.raises(ValueError, match=r"line 2 .*number 3"):
        read_reviews(tmp_path)


def test_a_second_server_on_the_same_reviews_is_refused(tmp_path: Path) -> None:
    with Store(tmp_path), pytest.raises(ValueError, match="another review server"):
        Store(tmp_path)
    Store(tmp_path).close()


def test_what_a_full_disk_half_wrote_is_taken_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.write
    with Store(tmp_path) as store:
        say(store)
        monkeypatch.setattr(os, "write", lambda to, data: real(to, data[:20]))
        with pytest.raises(OSError, match="disk full"):
            say(store, about="p1")
        monkeypatch.setattr(os, "write", real)
        assert say(store, about="p2").number == 2
    assert set(read_reviews(tmp_path)) == {"p0", "p2"}


def test_a_log_that_somebody_else_changed_is_not_written_on(tmp_path: Path) -> None:
    with Store(tmp_path) as store:
        say(store)
        with store.path.open("a") as file:
            file.write("hello")
        with pytest.raises(OSError, match="changed by someone else"):
            say(store, about="p1")


_WRITER = """
import sys
from pathlib import Path
from data.review.store import Store
with Store(Path(sys.argv[1])) as store:
    print("ready", flush=True)
    while True:
        line = store.append(
            proposal_id=f"p{len(store.ledger.all_opinions)}", annotator="ann", action="accept",
            style="moderate", values=(0.3, 0.004, 0.1, 0.2, 1.0, 0.4), seconds=1.0,
        )
        print(line.number, flush=True)
"""


@pytest.mark.slow
def test_nothing_acknowledged_is_lost_when_the_writer_is_killed(tmp_path: Path) -> None:
    acknowledged = 0
    for kill_after in (1, 7, 20, 3, 40):
        command = [sys.executable, "-c", _WRITER, str(tmp_path)]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as writer:
            assert writer.stdout is not None
            assert writer.stdout.readline() == "ready\n"
            for _ in range(kill_after):
                acknowledged = int(writer.stdout.readline())
            writer.send_signal(signal.SIGKILL)
            said = writer.stdout.read().splitlines()
        # Also what it said between the last look and its end; a torn number is no number.
        acknowledged = max([acknowledged, *(int(n) for n in said[:-1])])
        opinions = read_reviews(tmp_path)
        numbers = sorted(o.number for found in opinions.values() for o in found)
        assert numbers == list(range(1, len(numbers) + 1))
        assert len(numbers) >= acknowledged


# --- the queue ---


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


# --- what the build reads ---


def test_settled_proposals_carry_the_reviewers_matrix_style_and_a_fitting_reason(
    tmp_path: Path,
) -> None:
    made = write_proposals(tmp_path)
    a, b, c, d, e, f = (p.proposal_id for p in made)
    said = {
        a: (make_review(1, a, "ann", "accept"),),
        b: (make_review(2, b, "ann", "edit", "aggressive", CALMER),),
        c: (make_review(3, c, "ann", "reject"), make_review(4, c, "bob", "reject")),
        d: (make_review(5, d, "ann", "edit", "moderate"), make_review(6, d, "bob", "accept")),
        e: (make_review(7, e, "ann", "reject"), make_review(8, e, "bob", "accept")),
        "elsewhere": (make_review(9, "elsewhere", "ann", "accept"),),
    }
    said[d] = (said[d][0], make_review(6, d, "bob", "edit", "conservative"))
    tally = Tally()
    kept = list(apply_reviews(iter(made), said, tally))
    assert [p.proposal_id for p in kept] == [a, b]
    assert kept[0] == made[0]
    assert kept[1].sample.matrix.values == CALMER and kept[1].sample.style == "aggressive"
    assert "i react faster" in kept[1].sample.explanation
    assert (tally.accepted, tally.edited, tally.rejected) == (1, 1, 1)
    assert (tally.unreviewed, tally.unknown) == (1, 1)
    assert tally.disputes == {
        d: "ann calls it moderate, bob calls it conservative",
        e: f"ann rejects it, bob calls it {said[e][1].style}",
    }
    # A third decides; and what nobody reviewed is kept where that is asked for.
    said[d] = (*said[d], make_review(10, d, "cy", "edit", "conservative", CALMER))
    kept = list(apply_reviews(made, said, Tally(), keep_unreviewed=True))
    assert [p.proposal_id for p in kept] == [a, b, d, f]
    assert kept[2].sample.style == "conservative"


def test_the_first_answer_stands_where_two_agree_on_the_style() -> None:
    first = make_review(1, "p", "ann", "edit", values=CALMER)
    assert settle(()) is None
    assert settle((first, make_review(2, "p", "bob", "accept"))) == first


def test_an_explanation_follows_the_style_or_says_what_it_lacks() -> None:
    sample = proposal(0).sample
    assert explanation_for(sample, "moderate") == sample.explanation
    assert explanation_for(sample, "conservative").startswith("because you want to go slower")
    with pytest.raises(ValueError, match="no reason for the intent 'unheard'"):
        explanation_for(Sample(**{**vars(sample), "intent": "unheard"}), "aggressive")


# --- agreement ---


def test_icc_2_1_is_the_one_that_shrout_and_fleiss_print() -> None:
    # Psychological Bulletin 86 (1979), Table 2: six targets, four judges; ICC(2,1) = .29.
    ratings = [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]]
    assert icc_2_1(np.array(ratings, float)) == pytest.approx(0.29, abs=0.005)


def counted(table: list[list[int]]) -> list[tuple[str, str]]:
    """Pairs of labels as often as a table [first, second] counts them."""
    return [
        (str(first), str(second))
        for first, row in enumerate(table)
        for second, count in enumerate(row)
        for _ in range(count)
    ]


def test_kappa_is_the_one_that_the_books_print() -> None:
    # Cohen, Psychological Bulletin 70 (1968), Table 1, as counts of 200: kappa = .492.
    table = [[88, 14, 18], [10, 40, 10], [2, 6, 12]]
    assert cohens_kappa(counted(table)) == pytest.approx(0.492, abs=0.0005)
    assert cohens_kappa(counted([[20, 5], [10, 15]])) == pytest.approx(0.4)
    assert cohens_kappa(counted([[0, 5], [5, 0]])) == pytest.approx(-1.0)


def test_scores_that_are_not_defined_are_none() -> None:
    assert cohens_kappa([]) is None
    assert cohens_kappa(counted([[7, 0], [0, 0]])) is None
    assert icc_2_1(np.empty((0, 2))) is None
    assert icc_2_1(np.array([[1.0, 2.0]])) is None
    assert icc_2_1(np.full((5, 2), 0.1)) is None
    nothing = measure([])
    assert nothing.pairs == 0 and nothing.kappa is None and set(nothing.icc) == {None}


def test_icc_is_one_for_equal_ratings_and_sees_a_shift_between_judges() -> None:
    values = np.linspace(0.0, 1.0, 9)
    assert icc_2_1(np.stack([values, values], axis=1)) == pytest.approx(1.0)
    shifted = icc_2_1(np.stack([values, values + 0.5], axis=1))
    assert shifted is not None and 0.2 < shifted < 0.8


def test_agreement_counts_what_neither_rejects() -> None:
    pairs = [
        (make_review(1, "a", "ann", "accept"), make_review(2, "a", "bob", "accept")),
        (
            make_review(3, "b", "ann", "accept", values=CALMER),
            make_review(4, "b", "bob", "edit", "aggressive", CALMER),
        ),
        (make_review(5, "c", "ann", "reject"), make_review(6, "c", "bob", "reject")),
        (make_review(7, "d", "ann", "accept"), make_review(8, "d", "bob", "reject")),
        (make_review(9, "e", "ann", "accept"),),
    ]
    found = measure(pairs)
    assert (found.pairs, found.kept, found.both_rejected, found.one_rejected) == (4, 2, 1, 1)
    assert found.disputed == 2
    assert found.styles == ((0, 0, 0), (0, 1, 1), (0, 0, 0))
    assert found.icc[0] == pytest.approx(1.0) and found.icc[1] is None


# --- sliders, previews, the index ---


def test_slider_stops_rise_from_limit_to_limit_and_bands_lie_on_them() -> None:
    for i, slider in enumerate(sliders_of(CODEC)):
        assert list(slider.stops) == sorted(set(slider.stops)) and len(slider.stops) == 256
        assert slider.stops[0] == pytest.approx(RANGES.lowest[i])
        assert slider.stops[-1] == pytest.approx(RANGES.highest[i])
        for band in slider.bands.values():
            assert -1e-9 <= band[0] <= band[1] <= band[2] <= band[3] <= 1 + 1e-9


def test_a_corrected_style_starts_at_the_same_place_of_its_range() -> None:
    def centre(style: Style) -> ControllerMatrix:
        """Halfway from lower to upper, on the codec's scale."""
        ends = [(CODEC.share(r.lower, i), CODEC.share(r.upper, i)) for i, r in limits(style)]
        return ControllerMatrix.of([CODEC.value(sum(e) / 2, i) for i, e in enumerate(ends)])

    def limits(style: Style) -> Iterator[tuple[int, ParameterRange]]:
        return iter(enumerate(RANGES.styles[style]))

    for style in STYLES:
        for other in STYLES:
            moved = transpose(centre(style), style, other, CODEC)
            assert moved.values == pytest.approx(centre(other).values)
    # The conservative end of K_i with the lowest K_p would overshoot as it is.
    low = ControllerMatrix.of([0.5, 0.03, 0.1, 0.2, 1.0, 0.1])
    assert transpose(low, "aggressive", "moderate", CODEC).ki == pytest.approx(ki_limit(0.25))


def test_a_matrix_that_breaks_a_limit_is_named_and_float32_is_forgiven() -> None:
    kp = float(np.float32(0.3))
    assert matrix_fault((kp, ki_limit(kp) * (1 + 1e-8), 0.1, 0.2, 1.0, 0.4), RANGES) is None
    assert "K_p²/8" in (matrix_fault((0.3, 0.02, 0.1, 0.2, 1.0, 0.4), RANGES) or "")
    assert "W_s = 9" in (matrix_fault((0.3, 0.004, 0.1, 0.2, 1.0, 9.0), RANGES) or "")
    assert "finite" in (matrix_fault((float("nan"), 0.004, 0.1, 0.2, 1.0, 0.4), RANGES) or "")
    highest = [float(np.float32(x)) for x in RANGES.highest]
    assert matrix_fault(highest, RANGES) is None


def test_a_preview_shows_that_a_bolder_matrix_drives_bolder() -> None:
    previewer = Previewer(VEHICLE)
    calm, bold = (previewer.drives(middle(s), "sunny") for s in ("conservative", "aggressive"))
    for drive in (*calm, *bold):
        assert drive.fault is None
        assert {len(chart.values) for chart in drive.charts} == {len(drive.time_s)}
    assert max(filter(None, bold[0].charts[1].values)) > max(filter(None, calm[0].charts[1].values))
    assert previewer.drives(middle("aggressive"), "snow") != bold
    assert previewer.drives(middle("aggressive"), "sunny") == bold  # no noise


def test_the_index_reads_the_row_that_is_asked_for(tmp_path: Path) -> None:
    made = write_proposals(tmp_path, 9)
    index = ProposalIndex(tmp_path)
    assert index.ids == tuple(p.proposal_id for p in made) and len(index) == 9
    for p in (made[8], made[0], made[5], made[0]):
        assert index.read(p.proposal_id) == p
    write_part(made[:2][::-1], tmp_path / "part-00000.parquet")
    fresh = ProposalIndex(tmp_path)
    assert fresh.read(made[0].proposal_id) == made[0]


def test_an_index_over_nothing_or_over_damage_says_so(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no proposals at .*data\.propose"):
        ProposalIndex(tmp_path / "none")
    with pytest.raises(ValueError, match="holds no proposals"):
        ProposalIndex(tmp_path)
    made = write_proposals(tmp_path)
    part = tmp_path / "part-00001.parquet"
    whole = part.read_bytes()
    for damaged in (whole[:100], b"", whole[:-20]):
        part.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"part-00001\.parquet is damaged"):
            ProposalIndex(tmp_path)
    write_part(made[:1], part)
    with pytest.raises(ValueError, match=r"stands in .* and again in"):
        ProposalIndex(tmp_path)


# --- over HTTP ---


class Page:
    """What the page does, without a browser."""

    def __init__(self, client: TestClient) -> None:
        self.client = client

    def next(self, who: str) -> dict[str, Any]:
        answer = self.client.get("/api/next", params={"annotator": who})
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    def answer(self, who: str, item: dict[str, Any], action: str, **own: Any) -> Any:
        body = {"proposal_id": item["proposal_id"], "annotator": who, "action": action}
        return self.client.post(
            "/api/reviews", json={**body, "base": item["base"], "seconds": 2.0, **own}
        )

    def undo(self, who: str, number: int) -> Any:
        return self.client.post("/api/undo", json={"annotator": who, "number": number})


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    write_proposals(tmp_path / "proposals")
    index = ProposalIndex(tmp_path / "proposals")
    with Store(tmp_path / "reviews") as store:
        queue = Queue(index.ids, store.ledger, second_opinion_share=0.0, claim_s=60.0)
        app = create_app(Desk(index, store, queue, RANGES, Previewer(VEHICLE)))
        with TestClient(app, base_url="http://127.0.0.1") as client:
            yield Page(client)


def test_a_pair_is_shown_with_all_that_a_reviewer_needs(page: Page) -> None:
    item = page.next("ann")["item"]
    assert item["instruction"] == "Sentence number 0." and item["style"] == "conservative"
    assert item["starts"]["conservative"] == item["values"] and item["base"] == 0
    assert set(item["explanations"]) == set(STYLES)
    assert [len(d["charts"]) for d in item["preview"]["drives"]] == [2, 2]
    frame = page.client.get(f"/api/frame/{item['proposal_id']}")
    assert frame.content == picture(0) and frame.headers["content-type"] == "image/jpeg"
    sliders = page.client.get("/api/sliders").json()["sliders"]
    assert [s["name"] for s in sliders] == ["K_p", "K_i", "K_d", "W_l", "W_h", "W_s"]


def test_answers_move_on_and_an_undo_brings_the_edit_back(page: Page, tmp_path: Path) -> None:
    first = page.next("ann")["item"]
    second = page.answer("ann", first, "accept").json()["item"]
    assert second["proposal_id"] != first["proposal_id"]
    values = [*second["values"][:5], second["values"][5] * 1.1]
    after = page.answer("ann", second, "edit", style="moderate", values=values).json()
    assert after["progress"]["done"] == after["progress"]["mine"] == 2
    assert after["last"] == {"number": 2, "action": "edit"}
    assert page.undo("ann", 1).status_code == 409  # not the last
    assert page.undo("bob", 2).status_code == 409  # not one's own
    back = page.undo("ann", 2).json()
    assert back["item"]["proposal_id"] == second["proposal_id"]
    assert back["item"]["was"] == {"action": "edit", "style": "moderate", "values": values}
    assert back["progress"]["done"] == 1
    assert page.answer("ann", second, "reject").status_code == 409  # of before the undo
    assert page.answer("ann", back["item"], "reject").status_code == 200
    said = read_reviews(tmp_path / "reviews")
    assert [o.action for opinions in said.values() for o in opinions] == ["accept", "reject"]


def test_the_first_answer_stands_and_the_second_is_told(page: Page, tmp_path: Path) -> None:
    item = page.next("ann")["item"]
    assert page.answer("bob", item, "reject").status_code == 200
    refused = page.answer("ann", item, "accept")
    assert refused.status_code == 409
    assert refused.json()["error"].startswith("bob rejected this pair at ")
    assert page.next("ann")["item"]["proposal_id"] != item["proposal_id"]
    (opinions,) = read_reviews(tmp_path / "reviews").values()
    assert [o.annotator for o in opinions] == ["bob"]


def test_names_are_one_spelling_for_one_person(page: Page) -> None:
    item = page.next("  Ann   Lee ")["item"]
    assert page.answer("ANN LEE", item, "accept").json()["annotator"] == "ann lee"
    for name in ("", "   ", "a\nb;", "<b>", "x" * 41):
        answer = page.client.get("/api/next", params={"annotator": name})
        assert answer.status_code == 422, name
        assert isinstance(answer.json()["error"], str)


def test_what_cannot_be_kept_is_refused_in_a_sentence(page: Page, tmp_path: Path) -> None:
    item = page.next("ann")["item"]
    good = item["values"]
    for own, words in (
        ({"style": item["style"], "values": good}, "nothing was changed"),
        ({"style": item["style"], "values": [0.1, 0.09, *good[2:]]}, "K_p²/8"),
        ({"style": item["style"], "values": [99.0, *good[1:]]}, "outside the vehicle's"),
        ({"style": item["style"], "values": good[:5]}, "values"),
        ({"style": "brutal", "values": good}, "style"),
        ({"style": "moderate"}, "six values"),
        ({"style": "moderate", "values": good, "extra": 1}, "extra"),
    ):
        answer = page.answer("ann", item, "edit", **own)
        assert answer.status_code == 422 and words in answer.json()["error"], answer.text
    raw = json.dumps({"annotator": "ann", "action": "edit", "base": 0, "seconds": 1.0})[:-1]
    for number in ("NaN", "Infinity", "1e999"):
        body = f'{raw}, "proposal_id": "{item["proposal_id"]}", "style": "moderate", '
        body += f'"values": [{number}, 0, 0, 0, 0, 0]}}'
        headers = {"Content-Type": "application/json"}
        answer = page.client.post("/api/reviews", content=body, headers=headers)
        assert answer.status_code == 422, number
    assert page.answer("ann", item, "accept", values=good).status_code == 422
    assert page.answer("ann", {**item, "base": 5}, "accept").status_code == 409
    assert page.answer("ann", {**item, "proposal_id": "0" * 16}, "accept").status_code == 404
    assert page.client.get("/api/frame/../../etc/passwd").status_code == 404
    assert page.client.get("/page/..%2Fapp.py").status_code == 404
    assert (tmp_path / "reviews" / REVIEWS_FILE).read_bytes() == b""


def test_a_preview_of_a_coupled_fault_is_driven_and_named(page: Page) -> None:
    item = page.next("ann")["item"]
    body = {"values": [0.1, 0.09, *item["values"][2:]], "condition": "snow"}
    answer = page.client.post("/api/preview", json=body).json()
    assert "K_p²/8" in answer["fault"] and answer["ki_limit"] == pytest.approx(0.00125)
    assert len(answer["drives"]) == 2
    body["values"] = [50.0, *item["values"][1:]]
    assert page.client.post("/api/preview", json=body).status_code == 422


def test_pages_of_other_sites_are_kept_out(page: Page) -> None:
    item = page.next("ann")["item"]
    body = json.dumps(
        {
            "proposal_id": item["proposal_id"],
            "annotator": "eve",
            "action": "reject",
            "base": 0,
            "seconds": 1.0,
        }
    )
    plain = {"Content-Type": "text/plain"}  # what a page elsewhere may send without asking
    assert page.client.post("/api/reviews", content=body, headers=plain).status_code == 422
    assert page.client.get("/", headers={"Host": "evil.example"}).status_code == 400
    assert "default-src 'self'" in page.client.get("/").headers["content-security-policy"]


def test_agreement_is_told_for_the_pairs_of_this_folder(tmp_path: Path) -> None:
    made = write_proposals(tmp_path / "proposals")
    index = ProposalIndex(tmp_path / "proposals")
    with Store(tmp_path / "reviews") as store:
        for p in made:
            for who in ("ann", "bob"):
                values = p.sample.matrix.values
                say(store, who=who, about=p.proposal_id, style=p.sample.style, values=values)
            say(store, who="ann", about="of another folder")
        queue = Queue(index.ids, store.ledger, second_opinion_share=1.0, claim_s=60.0)
        told = Desk(index, store, queue, RANGES, Previewer(VEHICLE)).agreement()
    assert told.agreement.pairs == 6 and told.agreement.kappa == 1.0 and not told.disputes
    assert told.agreement.icc[0] == pytest.approx(1.0)


def test_the_page_needs_nothing_from_elsewhere() -> None:
    for path in sorted((ROOT / "data/review/page").iterdir()):
        text = path.read_text().replace("http://www.w3.org/2000/svg", "")
        assert "http:" not in text and "https:" not in text and "@import" not in text
        assert "innerHTML" not in text  # words of others are text, never markup


# --- the command ---


def run_command(folder: Path, monkeypatch: pytest.MonkeyPatch, *overrides: str) -> int:
    yaml = str(ROOT / "configs/review.yaml")
    arguments = [f"proposals={folder / 'proposals'}", f"reviews={folder / 'reviews'}"]
    monkeypatch.setattr("sys.argv", ["review", "--config", yaml, *arguments, *overrides])
    return run_stage(ReviewConfig, yaml, review, None)


def test_mistakes_end_the_command_with_one_sentence_and_code_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*overrides: str) -> str:
        capsys.readouterr()
        assert run_command(tmp_path, monkeypatch, *overrides) == 2
        return capsys.readouterr().err

    assert "no proposals at" in fails()
    write_proposals(tmp_path / "proposals")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        said = fails(f"port={taken.getsockname()[1]}")
    assert "is in use; stop the other program or set port=<another>" in said
    with Store(tmp_path / "reviews"):
        assert "another review server" in fails("port=0")
    (tmp_path / "reviews" / REVIEWS_FILE).write_text("{}\n{}\n")
    assert "line 1 is damaged" in fails("port=0")
    (tmp_path / "proposals/part-00000.parquet").write_bytes(b"PAR1 nothing")
    assert "part-00000.parquet is damaged" in fails("port=0")
