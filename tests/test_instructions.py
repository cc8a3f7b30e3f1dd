"""The instruction bank: size, balance, and words of the test split that training never sees."""

import hashlib
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from data.held_out import NEAR_REPEAT
from data.instructions import draw_instruction, fill, grow, grown_phrase, vary
from data.phrases import Bank, Phrase, load_bank
from ridetune.matrix import STYLES
from ridetune.prompt import MAX_INSTRUCTION_CHARACTERS, clean_instruction
from ridetune.sample import FEEDBACK_KINDS, LEVELS, FeedbackKind

LATE_VOICES = (
    "asides",
    "clocks",
    "company",
    "compare",
    "crafts",
    "days",
    "dialogue",
    "errands",
    "feelings",
    "grumbles",
    "reasons",
    "replies",
    "roads",
    "strangers",
    "turns",
    "twins",
)


def _voice(phrase: Phrase) -> str:
    return phrase.phrase_id.split("/")[0].split("_")[1]


def _words(text: str) -> frozenset[str]:
    return frozenset(re.findall(r"[a-z']+", text.lower()))


def _likeness(some: list[str], others: list[str]) -> NDArray[np.float64]:
    """Jaccard similarity of the word sets, [some, others]."""
    sets = [_words(text) for text in (*some, *others)]
    column = {word: i for i, word in enumerate(sorted(frozenset().union(*sets)))}
    there = np.zeros((len(sets), len(column)), np.float32)
    for row, words in enumerate(sets):
        there[row, [column[word] for word in words]] = 1
    a, b = there[: len(some)], there[len(some) :]
    shared = (a @ b.T).astype(np.float64)
    either = a.sum(1)[:, None] + b.sum(1)[None, :] - shared
    return np.asarray(shared / either, np.float64)


def _split(bank: Bank) -> tuple[list[Phrase], list[Phrase]]:
    held_out = [p for p in bank.phrases if p.held_out]
    return held_out, [p for p in bank.phrases if not p.held_out]


def test_bank_holds_over_1200_distinct_sentences(bank: Bank) -> None:
    assert len({" ".join(sorted(_words(p.text))) for p in bank.phrases}) >= 1200
    assert len({p.phrase_id for p in bank.phrases}) == len(bank.phrases)


def test_every_style_and_level_has_many_phrases_on_both_sides(bank: Bank) -> None:
    held_out, training = _split(bank)
    for side, least in ((held_out, 50), (training, 100)):
        counts = Counter((p.style, p.level) for p in side)
        assert set(counts) == {(style, level) for style in STYLES for level in LEVELS}
        assert min(counts.values()) >= least


def test_about_a_seventh_of_what_came_before_the_split_was_closed_is_held_out(bank: Bank) -> None:
    early = [p for p in bank.phrases if _voice(p) not in LATE_VOICES]
    assert 0.1 < sum(p.held_out for p in early) / len(early) < 0.2


def test_no_held_out_phrase_nearly_repeats_a_training_phrase(bank: Bank) -> None:
    held_out, training = _split(bank)
    likeness = _likeness([p.text for p in held_out], [p.text for p in training])
    at = np.unravel_index(likeness.argmax(), likeness.shape)
    assert likeness.max() < NEAR_REPEAT, (held_out[at[0]].text, training[at[1]].text)


def test_the_test_split_is_closed(bank: Bank) -> None:
    held_out = sorted(p.phrase_id for p in bank.phrases if p.held_out)
    digest = hashlib.sha256("\n".join(held_out).encode()).hexdigest()
    assert len(held_out) == 3991
    assert digest[:16] == "9bd2581195dc9789", "scores are comparable only on the same sentences"


def test_late_sentences_only_train(bank: Bank) -> None:
    late = [p for p in bank.phrases if _voice(p) in LATE_VOICES]
    assert len(late) > 20_000
    assert not any(p.held_out for p in late)


def test_training_draws_hold_no_held_out_phrase(bank: Bank) -> None:
    rng = np.random.default_rng(0)
    held_out, _ = _split(bank)
    ids = {p.phrase_id for p in held_out}
    drawn = [
        draw_instruction(STYLES[i % 3], "calibration" if i % 5 == 0 else "train", 0.4, bank, rng)
        for i in range(2000)
    ]
    assert not ids & {phrase.phrase_id for phrase, _ in drawn}
    likeness = _likeness([p.text for p in held_out], [text for _, text in drawn])
    assert likeness.max() < 1.0
    # A slot's value or a lost word may bring a training phrase near one, rarely.
    assert (likeness.max(axis=0) >= NEAR_REPEAT).mean() < 0.005


def test_test_draws_are_held_out_and_unvaried(bank: Bank) -> None:
    rng = np.random.default_rng(1)
    for i in range(300):
        phrase, text = draw_instruction(STYLES[i % 3], "test", 1.0, bank, rng)
        assert phrase.held_out and phrase.style == STYLES[i % 3]
        assert "{" in phrase.text or text == phrase.text


def test_no_grammar_sentence_nearly_repeats_a_held_out_one(bank: Bank) -> None:
    rng = np.random.default_rng(2)
    grown = [grown_phrase(bank, STYLES[i % 3], rng).text for i in range(2000)]
    assert _likeness([p.text for p in _split(bank)[0]], grown).max() < NEAR_REPEAT
    assert bank.repeats_held_out(f"uh, {_split(bank)[0][0].text}")
    assert not bank.repeats_held_out("entirely other words")


def test_slots_and_symbols_are_all_filled(bank: Bank) -> None:
    rng = np.random.default_rng(3)
    texts = [fill(p.text, bank, rng) for p in bank.phrases]
    texts += [grow(bank, style, level, rng) for style in STYLES for level in LEVELS] * 40
    assert not [t for t in texts if re.search(r"[{}$]", t)]


def test_every_wording_fits_the_prompt(bank: Bank) -> None:
    rng = np.random.default_rng(4)
    for phrase in bank.phrases:
        text = vary(fill(phrase.text, bank, rng), bank, rng)
        assert len(text) <= MAX_INSTRUCTION_CHARACTERS
        assert clean_instruction(text)


def test_every_intent_has_a_reason_for_its_style(bank: Bank) -> None:
    used = {(p.intent, p.style) for p in bank.phrases}
    rng = np.random.default_rng(5)
    used |= {(p.intent, p.style) for s in STYLES for p in [grown_phrase(bank, s, rng)] * 5}
    assert all(bank.reasons[intent][style] for intent, style in used)


@pytest.mark.parametrize("kind", FEEDBACK_KINDS)
def test_feedback_of_the_test_split_is_held_out(bank: Bank, kind: FeedbackKind) -> None:
    training = {t.lower() for t in bank.feedback.of(kind, "train")}
    held_out = {t.lower() for t in bank.feedback.of(kind, "test")}
    assert len(training) >= 50 and len(held_out) >= 10
    assert not training & held_out


def test_an_incomplete_bank_names_the_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"lacks slots\.yaml"):
        load_bank("en", tmp_path)
