"""The bank in every language: whole, fillable, and its test wordings apart from the others."""

import re
from collections import Counter

import numpy as np
import pytest

from data.bank_files import LANGUAGES, Language
from data.held_out import WordIndex, digest, normal
from data.instructions import draw_instruction, fill, vary
from data.phrases import Bank, load_bank
from ridetune.matrix import STYLES
from ridetune.prompt import MAX_INSTRUCTION_CHARACTERS, clean_instruction
from ridetune.sample import FEEDBACK_KINDS, LEVELS

OTHERS = [language for language in LANGUAGES if language != "en"]


@pytest.fixture(scope="module", params=OTHERS)
def foreign(request: pytest.FixtureRequest) -> Bank:
    language: Language = request.param
    return load_bank(language)


def test_all_languages_together_have_600_templates() -> None:
    banks = [load_bank(language) for language in LANGUAGES]
    counts = {b.language: sum("{" in p.text for p in b.phrases) for b in banks}
    assert sum(counts.values()) >= 600
    assert min(counts.values()) >= 200


def test_every_style_and_level_has_phrases_on_both_sides(foreign: Bank) -> None:
    for held_out, least in ((True, 3), (False, 30)):
        side = [p for p in foreign.phrases if p.held_out == held_out]
        counts = Counter((p.style, p.level) for p in side)
        assert set(counts) == {(style, level) for style in STYLES for level in LEVELS}
        assert min(counts.values()) >= least
    assert any("{" in p.text for p in foreign.phrases if p.held_out)
    assert {p.language for p in foreign.phrases} == {foreign.language}
    assert all(p.phrase_id.startswith(f"{foreign.language}/") for p in foreign.phrases)


def test_every_wording_is_filled_has_a_reason_and_fits_the_prompt(foreign: Bank) -> None:
    rng = np.random.default_rng(1)
    for phrase in foreign.phrases:
        text = vary(fill(phrase.text, foreign, rng), foreign, rng)
        assert not re.search(r"[{}$]", text), text
        assert len(text) <= MAX_INSTRUCTION_CHARACTERS
        assert clean_instruction(text)
        assert foreign.reasons[phrase.intent][phrase.style]


def test_no_held_out_phrase_nearly_repeats_a_training_phrase(foreign: Bank) -> None:
    training = WordIndex([p.text for p in foreign.phrases if not p.held_out])
    held_out = [p.text for p in foreign.phrases if p.held_out]
    assert not [text for text in held_out if training.repeats(text).any()]


def test_both_sides_can_be_drawn_without_a_grammar(foreign: Bank) -> None:
    rng = np.random.default_rng(2)
    assert not foreign.grammar
    for style in STYLES:
        for split in ("train", "test"):
            phrase, _ = draw_instruction(style, split, 1.0, foreign, rng)
            assert phrase.style == style and phrase.held_out == (split == "test")


def test_feedback_is_there_on_both_sides(foreign: Bank) -> None:
    for kind in FEEDBACK_KINDS:
        training = foreign.feedback.of(kind, "train")
        held_out = foreign.feedback.of(kind, "test")
        assert len(training) >= 30 and len(held_out) >= 3
        assert not set(map(normal, training)) & set(map(normal, held_out))


def test_openers_lower_the_next_letter_only_behind_a_comma() -> None:
    bank = Bank("de", (), {}, {}, load_bank("de").feedback, {}, openers=("Also. ", "Du, "))
    said = {vary("Fahr bitte", bank, np.random.default_rng(seed)) for seed in range(200)}
    assert {"Also. Fahr bitte", "Du, fahr bitte"} <= said
    assert not any("Du, F" in text or "Also. f" in text for text in said)


def test_a_lost_question_mark_takes_its_opening_along() -> None:
    bank = Bank("es", (), {}, {}, load_bank("es").feedback, {}, closers=(", gracias.",))
    said = {vary("¿Puedes ir más lento?", bank, np.random.default_rng(s)) for s in range(200)}
    assert {"¿Puedes ir más lento?", "Puedes ir más lento, gracias.", "Puedes ir más lento"} <= said
    assert not any("¿" in text and "?" not in text for text in said)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("Don't rush, OK?", "don't rush ok"),
        ("Größer, öfter!", "größer öfter"),
        ("¿Por qué así?", "por qué así"),
        ("开快点儿，go!", "开 快 点 儿 go"),
        ("In 5 minutes", "in minutes"),
    ],
)
def test_words_of_every_script_count(text: str, words: str) -> None:
    assert normal(text) == words
    assert digest(text) == digest(words.title())
