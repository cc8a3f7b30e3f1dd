"""What is said in a sample: drawn from the bank, from one's own commands, or grown, and varied.

Speech (config) -> Speakers -> one bank of the languages asked for -> phrase -> wording
"""

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ridetune.config import Share
from ridetune.matrix import Style
from ridetune.sample import LEVELS, Level, Split

from .bank_files import LANGUAGES, Language
from .own_commands import OwnCommands, read_own_commands
from .phrases import SLOT, SYMBOL, USUAL_INTENT, Bank, Phrase, load_bank

T = TypeVar("T")

# Also as Chinese and Spanish write them.
_ENDINGS = ".!?\u3002\uff01\uff1f"
_COMMAS = re.compile("[,;:\uff0c\uff1b\uff1a\u3001\u00bf\u00a1]")


@dataclass(frozen=True)
class Speech:
    """Who speaks: languages in equal shares, the phrase grammar, one's own collected commands.

    grammar: share of what is learned from that the phrase grammar grows, where a language has one.
    own: a CSV file of commands, or None; own_share: how much of what is drawn comes from it.
    """

    languages: tuple[Language, ...]
    grammar: Share
    own: Path | None
    own_share: Share


class Speakers:
    """Draws instructions as a `Speech` asks for them."""

    def __init__(self, speech: Speech, own: Mapping[Language, OwnCommands]) -> None:
        self._speech, self._own = speech, own
        self.banks = [load_bank(language) for language in own]

    def bank(self, rng: np.random.Generator) -> Bank:
        """The bank of one of the languages."""
        return self.banks[0] if len(self.banks) == 1 else pick(self.banks, rng)

    @cached_property
    def phrases(self) -> tuple[Phrase, ...]:
        """All that they may say."""
        own = (phrase for bank in self.banks for phrase in self._own[bank.language].phrases)
        return (*(phrase for bank in self.banks for phrase in bank.phrases), *own)

    def about(self) -> dict[str, Any]:
        """How many phrases there are, how many are held out, and a digest of them all."""
        texts = sorted(f"{p.phrase_id}\t{p.text}\t{p.held_out}" for p in self.phrases)
        return {
            "languages": [bank.language for bank in self.banks],
            "phrases": len(self.phrases),
            "held_out": sum(p.held_out for p in self.phrases),
            "digest": hashlib.sha256("\n".join(texts).encode()).hexdigest()[:16],
        }

    def draw(
        self, bank: Bank, style: Style, split: Split, rng: np.random.Generator
    ) -> tuple[Phrase, str]:
        """A phrase of the style with its wording, from a bank or one's own in its language."""
        own = self._own[bank.language].choose(style, split)
        if own and rng.random() < self._speech.own_share:
            return _worded(pick(own, rng), split, bank, rng)
        return draw_instruction(style, split, self._speech.grammar, bank, rng)


def draw_instruction(
    style: Style, split: Split, grammar_share: float, bank: Bank, rng: np.random.Generator
) -> tuple[Phrase, str]:
    """A phrase of the style with its final wording; test wordings are held out and unvaried."""
    if split != "test" and bank.grammar and rng.random() < grammar_share:
        return _worded(grown_phrase(bank, style, rng), split, bank, rng)
    return _worded(pick(bank.choose(style, split), rng), split, bank, rng)


def _worded(
    phrase: Phrase, split: Split, bank: Bank, rng: np.random.Generator
) -> tuple[Phrase, str]:
    text = fill(phrase.text, bank, rng)
    return phrase, text if split == "test" else vary(text, bank, rng)


def read_own(speech: Speech) -> dict[Language, OwnCommands]:
    """One's own commands in each language that is asked for, with a line on what becomes of them.

    ValueError where no language is named, or the file or a row of it is wrong.
    """
    if not speech.languages:
        raise ValueError(f"speech.languages is empty; name some of {', '.join(LANGUAGES)}")
    found: dict[Language, OwnCommands] = {}
    for language in speech.languages:
        found[language] = OwnCommands((), 0)
        if speech.own is not None:
            found[language] = own = read_own_commands(speech.own, load_bank(language))
            if own.phrases or own.repeats:
                held_out = sum(phrase.held_out for phrase in own.phrases)
                print(
                    f"{speech.own} [{language}]: {len(own.phrases)} commands, {held_out} of them "
                    f"held out for testing; {own.repeats} left out, said before or held out by the "
                    "bank"
                )
    if speech.own is not None and not any(own.phrases for own in found.values()):
        raise ValueError(
            f"{speech.own} holds no commands in {', '.join(found)}; name their language in "
            "a column `language`, and in speech.languages"
        )
    return found


def fill(text: str, bank: Bank, rng: np.random.Generator) -> str:
    """A text with its slots filled."""
    return SLOT.sub(lambda slot: pick(bank.slots[slot[1]], rng), text)


def vary(text: str, bank: Bank, rng: np.random.Generator) -> str:
    """The sentence as speech recognition might hand it over: case, punctuation, filler words."""
    if rng.random() < 0.15 and bank.openers:
        opener = pick(bank.openers, rng)
        goes_on = opener.rstrip().endswith(",")
        text = opener + (text[0].lower() + text[1:] if goes_on else text)
    if rng.random() < 0.1 and bank.closers:
        text = _unmarked(text) + pick(bank.closers, rng)
    if rng.random() < 0.3:
        text = _unmarked(text)
    if rng.random() < 0.1:
        text = _COMMAS.sub("", text)
    return text


def _unmarked(text: str) -> str:
    return text.rstrip(_ENDINGS).replace("\u00bf", "").replace("\u00a1", "")


def grown_phrase(bank: Bank, style: Style, rng: np.random.Generator) -> Phrase:
    """A training phrase from the grammar, drawn anew while it nearly repeats a held-out one."""
    level = LEVELS[int(rng.integers(len(LEVELS)))]
    intent = USUAL_INTENT[style][level == "III"]
    text = grow(bank, style, level, rng)
    while bank.repeats_held_out(text):
        text = grow(bank, style, level, rng)
    return Phrase(text, style, level, intent, f"grammar/{style}/{level}", held_out=False)


def grow(bank: Bank, style: Style, level: Level, rng: np.random.Generator) -> str:
    """A sentence from the phrase grammar."""
    grown = f"${style}_{level}"
    while SYMBOL.search(grown):
        grown = SYMBOL.sub(lambda s: pick(bank.grammar[s[1]], rng), grown)
    return _tidy(grown)


def pick(options: Sequence[T], rng: np.random.Generator) -> T:
    """One of the options, uniformly."""
    return options[int(rng.integers(len(options)))]


def _tidy(text: str) -> str:
    text = re.sub(r"\s+([,.!?])", r"\1", " ".join(text.split()))
    return text[:1].upper() + text[1:]
