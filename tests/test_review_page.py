"""The review page over HTTP, and its command."""

import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from data.review.__main__ import ReviewConfig, review
from data.review.app import create_app
from data.review.desk import Desk
from data.review.index import ProposalIndex
from data.review.preview import Previewer
from data.review.queue import Queue
from data.review.store import REVIEWS_FILE, Store, read_reviews
from ridetune.matrix import STYLES
from ridetune.stage import run_stage
from tests.review_pairs import ROOT, picture, say, write_proposals
from tests.shipped_car import RANGES, VEHICLE

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
