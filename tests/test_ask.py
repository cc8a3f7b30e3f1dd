"""The model annotator against an endpoint of its own: answers, failures, money, and the key."""

import base64
import json
import logging
import re
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from data.ask.answers import MAX_WIDTH_PX, Answer, Refusal, parse_answer, shrink
from data.ask.config import AskConfig
from data.ask.endpoint import LimitReachedError, ModelAnnotator, StoppedError
from data.ask.replies import pause_asked
from data.ask.run import ask
from data.kappa import cohens_kappa
from data.proposals import Proposal, read_proposals, write_part
from ridetune.alignment import style_of
from ridetune.config import load_config
from ridetune.matrix import STYLES, ControllerMatrix, Ranges
from ridetune.sample import CONDITIONS, Observation, Sample
from ridetune.stage import run_stage
from ridetune.vision import decode_frame
from tests.stub_endpoint import GOOD, KEY, Said, Stub, good


@pytest.fixture
def stub() -> Iterator[Stub]:
    stub = Stub()
    yield stub
    stub.server.shutdown()
    stub.server.server_close()


@pytest.fixture
def config(stub: Stub, root: Path, tmp_path: Path) -> AskConfig:
    key = tmp_path / "key.txt"
    key.write_text(KEY + "\n")
    shipped = load_config(AskConfig, root / "configs/ask.yaml")
    return replace(
        shipped,
        proposals=tmp_path / "proposals",
        out=tmp_path / "out",
        base_url=stub.url,
        model="stub/vlm-1",
        api_key_file=key,
        timeout_s=60.0,
        backoff_s=0.01,
        max_concurrent=1,
        max_cost=None,
        cache=tmp_path / "cache",
        ranges=root / "configs/ranges.yaml",
    )


def _frame(number: int = 0, width: int = 96, ending: str = ".jpg") -> bytes:
    pixels = np.random.default_rng(number).integers(0, 255, (128, width, 3)).astype(np.uint8)
    done, encoded = cv2.imencode(ending, pixels)
    assert done
    return encoded.tobytes()


def _proposal(number: int, ranges: Ranges) -> Proposal:
    style = STYLES[number % 3]
    values = [(r.lower + r.upper) / 2 for r in ranges.styles[style]]
    sample = Sample(
        observation=Observation(_frame(number), 10.0),
        instruction=f"Please drive like number {number}.",
        memories=(),
        matrix=ControllerMatrix.of(values),
        scene="sunny road",
        explanation="because you are on schedule, i keep the usual balance.",
        style=style,
        level="II",
        intent="speed",
        condition="sunny",
        split="train",
        scene_id=f"images/{number}",
        phrase_id=f"p{number}",
    )
    return Proposal(sample, "images", "CC0", f"frame-{number}.jpg", "rules-1", 0.2)


@pytest.fixture
def proposals(config: AskConfig, ranges: Ranges) -> list[Proposal]:
    """Two parts of three pairs each."""
    config.proposals.mkdir()
    made = [_proposal(number, ranges) for number in range(6)]
    write_part(made[:3], config.proposals / "part-00000.parquet")
    write_part(made[3:], config.proposals / "part-00001.parquet")
    return made


def _annotate(config: AskConfig, words: str = "Slowly.") -> Answer | Refusal:
    with ModelAnnotator(config) as annotator:
        return annotator.annotate(_frame(), words)


def _refusal(outcome: Answer | Refusal) -> str:
    assert isinstance(outcome, Refusal)
    return outcome.reason


# What the model may say


@pytest.mark.parametrize("fence", ["{}", "```json\n{}\n```", "```\n{}\n```\n", " \n{} \n"])
def test_an_answer_may_stand_in_a_fence(fence: str) -> None:
    parsed = parse_answer(fence.replace("{}", json.dumps(GOOD)))
    assert parsed == Answer.model_validate(GOOD)


@pytest.mark.parametrize(
    ("changed", "fault"),
    [
        ({"mood": "fine"}, "mood: Extra inputs are not permitted"),
        ({"condition": "hail"}, "condition: .*'sunny'"),
        ({"style": "Conservative"}, "style: .*'conservative'"),
        ({"scene": "rainy road\nwith trees"}, "scene: must be one line"),
        ({"scene": "rainy " + "x" * 200}, "scene: must have 1 to 200 characters, not 206"),
        ({"scene": " "}, "scene: must have 1 to 200"),
        ({"scene": "rainy road. dense traffic"}, "scene: .* no full stop"),
        ({"scene": "foggy road"}, "must name the condition 'rain'"),
        ({"explanation": "because it rains. i slow down."}, "explanation: must be one sentence"),
        ({"explanation": "because it rains, i slow down"}, "explanation: must be one sentence"),
        ({"explanation": "it rains, so i slow down."}, "starts with 'because'"),
        ({"explanation": "because " + "x" * 240 + "."}, "not 249"),
        ({"confidence": "high"}, "confidence: "),
        ({"confidence": True}, "confidence: "),
        ({"confidence": float("nan")}, "confidence: "),
        ({"confidence": None}, "confidence: "),
    ],
)
def test_a_wrong_answer_says_what_is_wrong(changed: dict[str, object], fault: str) -> None:
    assert re.search(fault, _refusal(parse_answer(json.dumps({**GOOD, **changed}))))


@pytest.mark.parametrize("text", ["", "I cannot", "[]", "{", '{"scene": "\\ud800"}', "null"])
def test_text_that_is_no_answer_is_refused(text: str) -> None:
    assert _refusal(parse_answer(text))


def test_capitals_and_the_scenes_full_stop_are_taken_off_and_confidence_is_clipped() -> None:
    said = {
        **GOOD,
        "scene": "Rainy road.",
        "explanation": "Because I care, I brake at 3.5 m.",
        "confidence": 7,
    }
    parsed = parse_answer(json.dumps(said))
    assert isinstance(parsed, Answer)
    assert parsed.scene == "rainy road" and parsed.confidence == 1.0
    assert parsed.explanation == "because i care, i brake at 3.5 m."


def test_the_shipped_prompt_names_everything_that_an_answer_may_hold(config: AskConfig) -> None:
    for word in (*CONDITIONS, *STYLES, *Answer.model_fields):
        assert f'"{word}"' in config.prompt


@pytest.mark.parametrize(("width", "sent"), [(96, 96), (768, 768), (769, 768), (1920, 768)])
@pytest.mark.parametrize("ending", [".jpg", ".png"])
def test_a_frame_is_sent_as_a_jpeg_of_at_most_768_px(width: int, sent: int, ending: str) -> None:
    jpeg = shrink(_frame(width=width, ending=ending))
    assert jpeg.startswith(b"\xff\xd8") and decode_frame(jpeg).shape[1] == sent <= MAX_WIDTH_PX


def test_kappa_of_the_textbook_example() -> None:
    # Cohen's kappa of the 2 x 2 table 20, 5, 10, 15 is 0.4.
    pairs = [("a", "a")] * 20 + [("a", "b")] * 5 + [("b", "a")] * 10 + [("b", "b")] * 15
    assert cohens_kappa(pairs) == pytest.approx(0.4)
    assert cohens_kappa([("a", "a")]) is None and cohens_kappa([]) is None


# One pair


def test_a_good_answer_to_picture_and_words(stub: Stub, config: AskConfig) -> None:
    assert _annotate(config, 'Slow "down"') == Answer.model_validate(GOOD)
    assert stub.keys == [f"Bearer {KEY}"]
    (request,) = stub.got
    assert request["model"] == "stub/vlm-1" and request["temperature"] == 0
    system, user = request["messages"]
    picture, words = user["content"]
    assert system["content"] == config.prompt and '"Slow \\"down\\""' in words["text"]
    kind, data = picture["image_url"]["url"].split(",")
    assert kind == "data:image/jpeg;base64" and decode_frame(base64.b64decode(data)).any()


def test_broken_json_is_repaired_once_with_the_error(stub: Stub, config: AskConfig) -> None:
    stub.script = [good(style="fast"), good()]
    with ModelAnnotator(config) as annotator:
        assert isinstance(annotator.annotate(_frame(), "Slowly."), Answer)
        assert annotator.ledger.counts["repaired"] == 1
    *before, wrong, demand = stub.got[1]["messages"]
    assert before == stub.got[0]["messages"]
    assert wrong["role"] == "assistant" and '"fast"' in wrong["content"]
    assert demand["role"] == "user" and "style: Input should be" in demand["content"]


def test_an_answer_that_is_wrong_twice_is_refused(stub: Stub, config: AskConfig) -> None:
    stub.script = [Said("no"), Said("")]
    assert "unusable twice: Invalid JSON" in _refusal(_annotate(config))
    assert len(stub.got) == 2


def test_a_frame_that_is_no_picture_is_refused_unasked(stub: Stub, config: AskConfig) -> None:
    with ModelAnnotator(config) as annotator:
        assert "JPEG or PNG" in _refusal(annotator.annotate(b"GIF89a", "Slowly."))
    assert not stub.got


def test_retry_after_is_honoured(stub: Stub, config: AskConfig) -> None:
    stub.script = [Said(status=429, Retry_After="0.4"), good()]
    assert isinstance(_annotate(config), Answer)
    assert stub.times[1] - stub.times[0] >= 0.4


def test_a_server_error_and_a_timeout_are_tried_again(stub: Stub, config: AskConfig) -> None:
    stub.script = [Said(status=500), Said(status=503), Said(after_s=4.0)]
    assert isinstance(_annotate(replace(config, timeout_s=1.0, attempts=9)), Answer)
    assert len(stub.got) >= 4  # a busy machine may miss the second once more


def test_attempts_come_to_an_end(stub: Stub, config: AskConfig) -> None:
    stub.otherwise = lambda _: Said(status=502)
    reason = _refusal(_annotate(replace(config, attempts=3)))
    assert reason == "status 502, in each of 3 attempts" and len(stub.got) == 3


def test_another_4xx_is_not_tried_again(stub: Stub, config: AskConfig) -> None:
    stub.otherwise = lambda _: Said(status=422)
    assert _refusal(_annotate(config)) == "status 422: 'the key *** is not welcome'"
    assert len(stub.got) == 1


def test_a_body_that_is_no_completion_is_refused(stub: Stub, config: AskConfig) -> None:
    stub.body = b"<html>login</html>"
    assert "no chat completion came back: '<html>" in _refusal(_annotate(config))


@pytest.mark.parametrize(("status", "remedy"), [(401, "api_key_file="), (404, "base_url")])
def test_a_refused_key_or_address_ends_the_run_in_one_sentence(
    stub: Stub, config: AskConfig, status: int, remedy: str
) -> None:
    stub.otherwise = lambda _: Said(status=status)
    with ModelAnnotator(config) as annotator:
        for _ in range(2):
            with pytest.raises(StoppedError) as stopped:
                annotator.annotate(_frame(), "Slowly.")
            said = str(stopped.value)
            assert stub.url in said and remedy in said and KEY not in said
    assert len(stub.got) == 1


def test_nothing_listening_ends_the_run_in_one_sentence(stub: Stub, config: AskConfig) -> None:
    stub.server.shutdown()
    stub.server.server_close()
    with pytest.raises(StoppedError, match=f"cannot reach {stub.url} .*check that a server runs"):
        _annotate(config)


def test_a_wait_that_is_too_long_ends_the_run(stub: Stub, config: AskConfig) -> None:
    stub.otherwise = lambda _: Said(status=429, Retry_After="7200")
    with pytest.raises(StoppedError, match="asks to wait 7200 s"):
        _annotate(config)


def test_a_retry_date_is_a_wait() -> None:
    assert pause_asked({"retry-after": "Wed, 21 Oct 2015 07:28:00 GMT"}) == 0
    assert pause_asked({"retry-after": "Wed, 21 Oct 2065 07:28:00 GMT"}) > 1e6
    assert pause_asked({"retry-after": "soon"}) == pause_asked({}) == 0


def test_the_run_is_given_up_after_failures_in_a_row(stub: Stub, config: AskConfig) -> None:
    stub.script = [Said(status=400), good(), Said(status=400), Said(status=400)]
    with ModelAnnotator(replace(config, give_up_after=2)) as annotator:
        for words in "abcd":
            annotator.annotate(_frame(), words)
        with pytest.raises(StoppedError, match="gave up: 2 pairs in a row"):
            annotator.annotate(_frame(), "e")
    assert len(stub.got) == 4


def test_an_endpoint_that_counts_no_tokens_cannot_keep_a_cost_limit(
    stub: Stub, config: AskConfig
) -> None:
    stub.usage = None
    assert isinstance(_annotate(config), Answer)
    with pytest.raises(StoppedError, match="counts no tokens"):
        _annotate(replace(config, max_cost=1.0, input_price=1.0), "Faster.")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"base_url": "127.0.0.1:8000/v1"}, "must start with http"),
        ({"base_url": "ftp://x/v1"}, "must start with http"),
        ({"base_url": f"http://me:{KEY}@x/v1"}, "may hold no password"),
        ({"options": {"messages": []}}, "options may not set messages"),
        ({"api_key_file": Path("nowhere.txt")}, "no key at api_key_file=nowhere.txt"),
    ],
)
def test_a_wrong_config_says_what_is_wrong(
    config: AskConfig, changed: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message) as error:
        ModelAnnotator(replace(config, **changed))
    assert KEY not in str(error.value)


@pytest.mark.parametrize("text", ["", "two words", f"{KEY}\nmore", "schlüssel"])
def test_a_file_that_holds_no_key_is_refused_unquoted(config: AskConfig, text: str) -> None:
    assert config.api_key_file
    config.api_key_file.write_text(text)
    with pytest.raises(ValueError, match="must hold the key alone") as error:
        ModelAnnotator(config)
    assert KEY not in str(error.value) and "more" not in str(error.value)


# Folders


def test_the_models_words_stand_in_the_new_folder_in_order(
    stub: Stub, config: AskConfig, proposals: list[Proposal], ranges: Ranges, capsys: Any
) -> None:
    together = threading.Barrier(3)

    def first_ones_last(request: dict[str, Any]) -> Said:
        said = good()
        said.together = together
        said.after_s = 0.2 if re.search("number [03]", json.dumps(request)) else 0.0
        return said

    stub.otherwise = first_ones_last
    ask(replace(config, max_concurrent=3))
    made = list(read_proposals(config.out))
    assert [p.frame_name for p in made] == [p.frame_name for p in proposals]
    for before, now in zip(proposals, made, strict=True):
        assert now.annotator == "model:stub/vlm-1" and now.confidence == pytest.approx(0.8)
        assert {name: getattr(now.sample, name) for name in GOOD if name != "confidence"} == {
            name: value for name, value in GOOD.items() if name != "confidence"
        }
        assert style_of(now.sample.matrix, ranges) == "conservative"
        assert now.sample.observation == before.sample.observation
        assert now.sample.phrase_id == before.sample.phrase_id
    assert stub.most == 3
    said = capsys.readouterr().out
    assert "6,000 tokens in, 600 tokens out" in said
    assert "style: model and rules agree on 33.3% of 6, Cohen's kappa 0.000" in said


def test_the_same_answers_make_the_same_matrices(
    config: AskConfig, proposals: list[Proposal]
) -> None:
    ask(config)
    ask(replace(config, out=config.out.with_name("again")))
    ask(replace(config, out=config.out.with_name("other"), seed=8))
    made, again, other = (
        [p.sample.matrix for p in read_proposals(config.out.with_name(name))]
        for name in ("out", "again", "other")
    )
    assert made == again != other


def test_what_was_answered_is_never_asked_again(
    stub: Stub, config: AskConfig, proposals: list[Proposal], capsys: Any
) -> None:
    stub.script = [Said("no"), good(), Said("no"), Said("no")]
    ask(replace(config, input_price=10.0))
    assert len(stub.got) == 8 and "cost 0.0800" in capsys.readouterr().out
    ask(replace(config, out=config.out.with_name("again"), input_price=10.0))
    assert len(stub.got) == 8 and "cost 0.0000" in capsys.readouterr().out
    assert not list(config.cache.rglob("*.partial"))


def test_a_damaged_cache_file_is_asked_again(stub: Stub, config: AskConfig) -> None:
    first = _annotate(config)
    (kept,) = config.cache.rglob("*.json")
    kept.write_text("{")
    assert _annotate(config) == first and len(stub.got) == 2
    assert _annotate(config) == first and len(stub.got) == 2


def test_skipped_pairs_are_counted_and_listed_and_stay_so(
    stub: Stub, config: AskConfig, proposals: list[Proposal], capsys: Any
) -> None:
    stub.script = [good(), Said("no"), Said("{}")]
    ask(config)
    listed = (config.out / "skipped.csv").read_text()
    assert "part-00000.parquet,frame-1.jpg,Please drive like number 1.,unusable twice" in listed
    assert "1 skipped" in capsys.readouterr().out
    assert [p.frame_name for p in read_proposals(config.out)][:2] == ["frame-0.jpg", "frame-2.jpg"]
    ask(config)
    assert (config.out / "skipped.csv").read_text() == listed
    assert json.loads((config.out / "manifest.json").read_text())["skipped"] == 1


def test_the_cost_limit_stops_the_run_and_keeps_what_was_answered(
    stub: Stub, config: AskConfig, proposals: list[Proposal], capsys: Any
) -> None:
    # A request costs 1, and the first one is taken to cost 2.
    limited = replace(config, input_price=1000.0, max_cost=4.5)
    ask(limited)
    assert len(stub.got) == 4 and "stopped: max_cost=4.5 is reached" in capsys.readouterr().out
    assert [p.frame_name for p in read_proposals(config.out)] == [
        f"frame-{number}.jpg" for number in range(4)
    ]
    assert (config.out / "part-00001-unfinished.parquet").is_file()
    ask(replace(limited, max_cost=9.0))
    assert len(stub.got) == 6
    assert sorted(path.name for path in config.out.glob("part-*")) == [
        "part-00000.parquet",
        "part-00001.parquet",
    ]
    assert len(list(read_proposals(config.out))) == 6


def test_no_request_is_made_where_it_might_cost_too_much(stub: Stub, config: AskConfig) -> None:
    with pytest.raises(LimitReachedError):
        _annotate(replace(config, input_price=1.0, max_cost=0.0))
    assert not stub.got


def test_a_part_that_is_there_is_not_asked_again(
    stub: Stub, config: AskConfig, proposals: list[Proposal]
) -> None:
    stub.script = [good(), good(), good(), Said(status=401)]
    with pytest.raises(StoppedError, match="answers 401"):
        ask(config)
    first = (config.out / "part-00000.parquet").read_bytes()
    for kept in config.cache.rglob("*.json"):
        kept.unlink()
    ask(config)
    assert len(stub.got) == 4 + 3
    assert (config.out / "part-00000.parquet").read_bytes() == first


def test_a_folder_of_another_model_is_left_alone(
    config: AskConfig, proposals: list[Proposal]
) -> None:
    ask(config)
    with pytest.raises(ValueError, match="holds results of another model, seed"):
        ask(replace(config, model="other", seed=8))
    ask(replace(config, max_concurrent=2, max_cost=5.0))


def test_a_folder_without_proposals_is_refused(config: AskConfig) -> None:
    with pytest.raises(ValueError, match="holds no proposals"):
        ask(config)
    assert not config.out.exists()


def test_the_key_stands_nowhere(
    stub: Stub,
    config: AskConfig,
    proposals: list[Proposal],
    root: Path,
    caplog: Any,
    capsys: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    caplog.set_level(logging.DEBUG)
    stub.script = [Said(status=500), good(), Said(status=400), Said(f"the key is {KEY}"), good()]
    stub.otherwise = lambda _: Said(status=401)
    shown = ("proposals", "out", "base_url", "api_key_file", "cache", "ranges", "backoff_s")
    settings = [f"{name}={getattr(config, name)}" for name in shown]
    shipped = str(root / "configs/ask.yaml")
    monkeypatch.setattr("sys.argv", ["ask", "--config", shipped, "max_concurrent=1", *settings])
    assert run_stage(AskConfig, shipped, ask, "about") == 2
    printed = capsys.readouterr()
    assert f"error: {stub.url} answers 401" in printed.err
    written = b"".join(
        path.read_bytes() for place in (config.out, config.cache) for path in place.rglob("*.*")
    )
    assert b"***" in written and KEY.encode() not in written
    assert KEY not in printed.out + printed.err + caplog.text
