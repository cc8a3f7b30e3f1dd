"""What reviews come to, and what reviewers see: agreement, sliders, previews, the index."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from data.kappa import cohens_kappa
from data.proposals import write_part
from data.review.agreement import icc_2_1, measure
from data.review.index import ProposalIndex
from data.review.preview import Previewer
from data.review.settle import Tally, apply_reviews, explanation_for, settle
from data.review.sliders import matrix_fault, sliders_of, transpose
from ridetune.matrix import STYLES, ControllerMatrix, ParameterRange, Style, ki_limit
from ridetune.sample import Sample
from tests.review_pairs import CALMER, CODEC, make_review, proposal, write_proposals
from tests.shipped_car import RANGES, VEHICLE, middle

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
    with pytest.raises(ValueError, match="lacks the intent 'unheard'"):
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
