"""The policy: one pass to a matrix, the gate behind it, the explanation after it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tokenizers import Tokenizer, decoders

from ridetune.policy import Policy, parse_answer, read_text
from ridetune.prompt import InstructionError
from ridetune.sample import Memory
from ridetune.vision import FrameError
from tests.fake_policy import ANSWER, CONTRACT, GOAL, RANGES, TOKENIZER, FakeEngine, frame


class FakeClock:
    """Advances by one millisecond each time it is read."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        self.now_s += 0.001
        return self.now_s


def policy_of(engine: FakeEngine) -> Policy:
    return Policy(engine, CONTRACT, TOKENIZER, clock=FakeClock())


def test_decision_holds_the_matrix_that_the_model_is_sure_of() -> None:
    decision = policy_of(FakeEngine(GOAL, ANSWER)).decide(
        frame(), "I am late", last_safe=RANGES.default
    )
    assert decision.proposal.values == pytest.approx(GOAL.values, rel=0.02, abs=1e-3)
    assert decision.verdict.outcome == "accepted"
    assert decision.verdict.matrix == decision.proposal
    assert decision.confidence == pytest.approx([1.0] * 6)


def test_decision_names_every_stage_and_the_total_covers_them() -> None:
    decision = policy_of(FakeEngine(GOAL, ANSWER)).decide(
        frame(), "I am late", last_safe=RANGES.default
    )
    ms = dict(decision.timings_ms)
    total = ms.pop("total")
    assert list(ms) == ["image", "prefill", "prompt", "decide", "gate"]
    assert all(value == pytest.approx(1.0) for value in ms.values())
    assert total >= sum(ms.values())


def test_prepared_frame_serves_many_decisions_and_its_age_is_reported() -> None:
    policy = policy_of(FakeEngine(GOAL, ANSWER))
    prepared = policy.prepare(frame(), captured_s=99.0)
    first = policy.decide(prepared, "I am late", last_safe=RANGES.default)
    second = policy.decide(prepared, "hurry", last_safe=RANGES.default)
    assert first.frame_age_ms > 1000
    assert second.frame_age_ms > first.frame_age_ms
    assert first.timings_ms["total"] == pytest.approx(3.0)  # the frame was read before


def test_age_of_an_undated_frame_counts_from_its_arrival() -> None:
    decision = policy_of(FakeEngine(GOAL, ANSWER)).decide(
        frame(), "I am late", last_safe=RANGES.default
    )
    assert 0 < decision.frame_age_ms < decision.timings_ms["total"] + 0.1


def test_same_input_gives_the_same_decision() -> None:
    one, two = (
        policy_of(FakeEngine(GOAL, ANSWER)).decide(frame(), "hurry", last_safe=RANGES.default)
        for _ in range(2)
    )
    assert (one.proposal, one.verdict, one.timings_ms) == (
        two.proposal,
        two.verdict,
        two.timings_ms,
    )


def test_memories_reach_the_prompt() -> None:
    engine = FakeEngine(GOAL, ANSWER)
    policy = policy_of(engine)
    prepared = policy.prepare(frame())
    memory = Memory("hurry", "clear day", GOAL, "slow")
    policy.decide(prepared, "hurry", [memory], last_safe=RANGES.default)
    policy.decide(prepared, "hurry", last_safe=RANGES.default)
    assert len(engine.suffixes[0]) > len(engine.suffixes[1]) + 6


def test_gate_stands_between_the_model_and_the_car() -> None:
    goal = replace(RANGES.default, ws=6.0)
    last = replace(RANGES.default, ws=0.07)
    decision = policy_of(FakeEngine(goal, ANSWER)).decide(frame(), "hurry", last_safe=last)
    assert decision.verdict.outcome == "limited"
    assert decision.verdict.matrix.ws < decision.proposal.ws


def test_nan_from_the_model_keeps_the_last_matrix_and_explains_nothing() -> None:
    engine = FakeEngine(GOAL, ANSWER)
    engine.logits[2] = np.nan
    policy = policy_of(engine)
    decision = policy.decide(frame(), "hurry", last_safe=GOAL)
    assert (decision.verdict.outcome, decision.verdict.matrix) == ("refused", GOAL)
    said = policy.explain(decision)
    assert (said.scene, said.explanation) == ("", "")


def test_explanation_is_read_up_to_the_end_token_with_closed_gaps() -> None:
    engine = FakeEngine(GOAL, ANSWER)
    policy = policy_of(engine)
    decision = policy.decide(frame(), "I am late", last_safe=RANGES.default)
    said = policy.explain(decision)
    assert said.scene == "clear day, 40 m ahead"
    assert said.explanation == "because you are late, hurry."
    assert said.ms == pytest.approx(1.0)
    assert engine.bins == CONTRACT.codec.encode(decision.proposal)


def test_unusable_input_is_named() -> None:
    policy = policy_of(FakeEngine(GOAL, ANSWER))
    with pytest.raises(FrameError):
        policy.decide(b"no image", "hurry", last_safe=RANGES.default)
    with pytest.raises(InstructionError):
        policy.decide(frame(), "...", last_safe=RANGES.default)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("scene: fog, 3.5 m lane. because it is dim.", ("fog, 3.5 m lane", "because it is dim.")),
        ("scene : night", ("night", "")),
        ("scene: night.", ("night", "")),
        ("because you are late.", ("", "because you are late.")),
        ("", ("", "")),
    ],
)
def test_answer_is_parsed_tolerantly(text: str, parts: tuple[str, str]) -> None:
    assert parse_answer(text) == parts


@given(st.text(max_size=80))
def test_any_answer_parses(text: str) -> None:
    assert all(isinstance(part, str) for part in parse_answer(text))


def test_gaps_are_closed_for_word_pieces_only() -> None:
    ids = TOKENIZER.encode("40 m", add_special_tokens=False).ids
    assert read_text(TOKENIZER, ids) == "40 m"
    plain = Tokenizer.from_str(TOKENIZER.to_str())
    plain.decoder = decoders.Fuse()
    assert read_text(plain, ids) == "40m"
