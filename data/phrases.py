"""The instruction bank: what passengers say, by language, style, directness level and intent.

    data/bank/reasons.yaml                     why the car drives so, by intent and style
    data/bank/<language>/<style>_<voice>.yaml  sentences, templates with {slots}
                         slots.yaml            what the slots may hold
                         feedback.yaml         what is said after a drive
                         speech.yaml           words before and after a sentence; may be missing
                         grammar.yaml          a phrase grammar for training; may be missing

All written out by hand. Whole sentences and whole templates are held out for testing; a held-out
sentence that nearly repeats a training sentence goes to training, and so does held-out feedback.
A file that says `trains_only: true` came after the test split closed: none of it is held out, and
what nearly repeats a held-out sentence is left out.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from ridetune.matrix import STYLES, Style
from ridetune.sample import LEVELS, Level, Split

from .bank_files import BANK, LANGUAGES, Language, read_yaml
from .feedback import Feedback
from .held_out import WordIndex, digest, keep_apart, normal, share_of

HELD_OUT_SENTENCES = 0.15
HELD_OUT_TEMPLATES = 0.25

# What the grammar and one's own commands are roughly about where they do not say: a wish or a hint,
# and a mere remark (level III).
USUAL_INTENT: dict[Style, tuple[str, str]] = {
    "aggressive": ("speed", "urgency"),
    "moderate": ("speed", "status_quo"),
    "conservative": ("speed", "comfort"),
}

SLOT = re.compile(r"\{(\w+)\}")
SYMBOL = re.compile(r"\$(\w+)")


@dataclass(frozen=True)
class Phrase:
    """One sentence, or a template whose {slots} are still open."""

    text: str
    style: Style
    level: Level
    intent: str
    phrase_id: str
    held_out: bool
    language: Language = "en"


@dataclass(frozen=True)
class Bank:
    """All phrases of one language with the material that fills and varies them.

    openers and closers stand before and after what is said. grammar: empty where the language has
    none.
    """

    language: Language
    phrases: tuple[Phrase, ...]
    slots: dict[str, list[str]]
    grammar: dict[str, list[str]]
    feedback: Feedback
    reasons: dict[str, dict[Style, str]]
    openers: tuple[str, ...] = ()
    closers: tuple[str, ...] = ()

    def choose(self, style: Style, split: Split) -> tuple[Phrase, ...]:
        """The phrases of a style that a split may use."""
        return self._by_style[style, split == "test"]

    def repeats_held_out(self, text: str) -> bool:
        """Whether a text says nearly the same words as a held-out phrase."""
        return bool(self._held_out_words.repeats(text).any())

    @cached_property
    def _by_style(self) -> dict[tuple[Style, bool], tuple[Phrase, ...]]:
        return {
            (style, held_out): tuple(
                p for p in self.phrases if p.style == style and p.held_out == held_out
            )
            for style in STYLES
            for held_out in (False, True)
        }

    @cached_property
    def _held_out_words(self) -> WordIndex:
        return WordIndex([p.text for p in self.phrases if p.held_out])


@lru_cache(maxsize=len(LANGUAGES))
def load_bank(language: Language = "en", root: Path = BANK) -> Bank:
    """Read and check the bank of a language, once; ValueError names the file and wrong entry."""
    folder = root / language
    slots: dict[str, list[str]] = read_yaml(folder / "slots.yaml")
    grammar: dict[str, list[str]] = read_yaml(folder / "grammar.yaml", or_else={})
    _check_grammar(grammar)
    speech = read_yaml(folder / "speech.yaml", or_else={})
    return Bank(
        language=language,
        phrases=_read_phrases(folder, language, slots),
        slots=slots,
        grammar=grammar,
        feedback=Feedback(read_yaml(folder / "feedback.yaml")),
        reasons=load_reasons(root),
        openers=tuple(speech.get("openers", ())),
        closers=tuple(speech.get("closers", ())),
    )


@lru_cache(maxsize=1)
def load_reasons(root: Path = BANK) -> dict[str, dict[Style, str]]:
    """Why the car drives so, by intent and style."""
    reasons: dict[str, dict[Style, str]] = read_yaml(root / "reasons.yaml")
    return reasons


def check_slots(text: str, slots: dict[str, list[str]], where: str) -> None:
    """ValueError where a template uses a slot that is not there."""
    unknown = sorted(set(SLOT.findall(text)) - set(slots))
    if unknown:
        raise ValueError(
            f"{where}: {text!r} uses the slot {unknown[0]!r}; there are {', '.join(sorted(slots))}"
        )


def _read_phrases(
    folder: Path, language: Language, slots: dict[str, list[str]]
) -> tuple[Phrase, ...]:
    phrases: dict[str, Phrase] = {}
    late: dict[str, Phrase] = {}
    for path in sorted(folder.glob("*_*.yaml")):
        raw = read_yaml(path)
        into = late if raw.get("trains_only", False) else phrases
        for phrase in _phrases_of(path, raw, language, slots):
            into.setdefault(normal(phrase.text), phrase)
    if not phrases:
        raise ValueError(f"no sentences in {folder}; expected files such as moderate_families.yaml")
    more = [phrase for said, phrase in sorted(late.items()) if said not in phrases]
    return _add_late(_apart(phrases.values()), more)


def _phrases_of(
    path: Path, raw: dict[str, Any], language: Language, slots: dict[str, list[str]]
) -> Iterable[Phrase]:
    late = raw.get("trains_only", False)
    style = raw["style"]
    if style not in STYLES:
        raise ValueError(f"{path}: style {style!r} is none of {', '.join(STYLES)}")
    voice = path.stem if language == "en" else f"{language}/{path.stem}"
    for level in LEVELS:
        for intent, texts in raw["sentences"][level].items():
            for text in texts:
                held_out = not late and share_of(text) < HELD_OUT_SENTENCES
                name = f"{voice}/{level}/{digest(text)[:8]}"
                yield Phrase(text, style, level, intent, name, held_out, language)
        for template in raw["templates"][level]:
            text = template["text"]
            check_slots(text, slots, str(path))
            held_out = not late and share_of(text) < HELD_OUT_TEMPLATES
            name = f"{voice}/{level}/template-{digest(text)[:8]}"
            yield Phrase(text, style, level, template["intent"], name, held_out, language)


def _apart(phrases: Iterable[Phrase]) -> tuple[Phrase, ...]:
    """Phrases in the order of their names, as held out as `keep_apart` leaves them."""
    kept = sorted(phrases, key=lambda p: p.phrase_id)
    held_out = keep_apart([p.text for p in kept], [p.held_out for p in kept])
    return tuple(replace(p, held_out=bool(h)) for p, h in zip(kept, held_out, strict=True))


def _add_late(phrases: tuple[Phrase, ...], late: Iterable[Phrase]) -> tuple[Phrase, ...]:
    """The phrases with all late ones that repeat none of the held-out."""
    held_out = WordIndex([p.text for p in phrases if p.held_out])
    return (*phrases, *(p for p in late if not held_out.repeats(p.text).any()))


def _check_grammar(grammar: dict[str, list[str]]) -> None:
    for style in STYLES if grammar else ():
        for level in LEVELS:
            if f"{style}_{level}" not in grammar:
                raise ValueError(f"grammar.yaml lacks the root {style}_{level}")
    for symbol, expansions in grammar.items():
        for name in {n for text in expansions for n in SYMBOL.findall(text)} - set(grammar):
            raise ValueError(f"grammar.yaml: {symbol} uses ${name}, which is not defined")
