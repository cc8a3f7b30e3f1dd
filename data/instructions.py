"""The instruction bank: what passengers say, in three styles and three directness levels.

In: data/bank/*.yaml, written out by hand: sentences, templates with slots, a phrase grammar,
feedback phrases and reasons. Out: drawn instructions. Whole sentences and whole templates are held
out for testing; a held-out sentence that nearly repeats a training sentence goes to training, and
so does held-out feedback. A file that says `trains_only: true` came after the test split closed:
none of it is held out, and what nearly repeats a held-out sentence is left out.
"""

import hashlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from numpy.typing import NDArray

from ridetune.matrix import STYLES, Style
from ridetune.sample import LEVELS, FeedbackKind, Level, Split

BANK = Path(__file__).parent / "bank"
HELD_OUT_SENTENCES = 0.15
HELD_OUT_TEMPLATES = 0.25
HELD_OUT_FEEDBACK = 0.2
NEAR_REPEAT = 0.7  # Jaccard similarity of the word sets

T = TypeVar("T")

OPENERS = ("Um, ", "Hey car, ", "Listen, ", "Well, ", "So, ", "Okay, ")
CLOSERS = (", please.", ", thanks.", ", okay?", " now.")

# The C reader loads the bank in a second, the Python one in eight.
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_SLOT = re.compile(r"\{(\w+)\}")
_SYMBOL = re.compile(r"\$(\w+)")
# The grammar does not know intents; these say roughly what its sentences are about.
_GRAMMAR_INTENT: dict[Style, tuple[str, str]] = {
    "aggressive": ("speed", "urgency"),
    "moderate": ("speed", "status_quo"),
    "conservative": ("speed", "comfort"),
}


@dataclass(frozen=True)
class Phrase:
    """One sentence, or a template whose {slots} are still open."""

    text: str
    style: Style
    level: Level
    intent: str
    phrase_id: str
    held_out: bool


@dataclass(frozen=True)
class Bank:
    """All phrases with the material that fills and varies them."""

    phrases: tuple[Phrase, ...]
    slots: dict[str, list[str]]
    grammar: dict[str, list[str]]
    feedback: dict[FeedbackKind, list[str]]
    reasons: dict[str, dict[Style, str]]

    @cached_property
    def _by_style(self) -> dict[tuple[Style, bool], tuple[Phrase, ...]]:
        return {
            (style, held_out): tuple(
                p for p in self.phrases if p.style == style and p.held_out == held_out
            )
            for style in STYLES
            for held_out in (False, True)
        }

    def choose(self, style: Style, split: Split) -> tuple[Phrase, ...]:
        """The phrases of a style that a split may use."""
        return self._by_style[style, split == "test"]

    def fill(self, phrase: Phrase, rng: np.random.Generator) -> str:
        """The phrase with its slots filled."""
        return _SLOT.sub(lambda slot: pick(self.slots[slot[1]], rng), phrase.text)

    def grow(self, style: Style, level: Level, rng: np.random.Generator) -> str:
        """A sentence from the phrase grammar."""
        grown = f"${style}_{level}"
        while _SYMBOL.search(grown):
            grown = _SYMBOL.sub(lambda s: pick(self.grammar[s[1]], rng), grown)
        return _tidy(grown)

    def grown_phrase(self, style: Style, rng: np.random.Generator) -> Phrase:
        """A training phrase from the grammar, drawn anew while it nearly repeats a held-out one."""
        level = LEVELS[int(rng.integers(len(LEVELS)))]
        intent = _GRAMMAR_INTENT[style][level == "III"]
        text = self.grow(style, level, rng)
        while self.repeats_held_out(text):
            text = self.grow(style, level, rng)
        return Phrase(text, style, level, intent, f"grammar/{style}/{level}", held_out=False)

    def repeats_held_out(self, text: str) -> bool:
        """Whether a text says nearly the same words as a held-out phrase."""
        return bool(self._held_out_words.repeats(text).any())

    @cached_property
    def _held_out_words(self) -> "_WordIndex":
        return _WordIndex([p.text for p in self.phrases if p.held_out])

    @cached_property
    def _feedback(self) -> dict[tuple[FeedbackKind, bool], list[str]]:
        said = [(kind, text) for kind, texts in self.feedback.items() for text in texts]
        texts = [text for _, text in said]
        apart = _keep_apart(texts, [_share(text) < HELD_OUT_FEEDBACK for text in texts])
        found: dict[tuple[FeedbackKind, bool], list[str]] = {
            (kind, held_out): [] for kind in self.feedback for held_out in (False, True)
        }
        for (kind, text), held_out in zip(said, apart, strict=True):
            found[kind, bool(held_out)].append(text)
        return found

    def feedback_of(self, kind: FeedbackKind, split: Split) -> list[str]:
        """Feedback sentences of one kind that a split may use."""
        return self._feedback[kind, split == "test"]


@lru_cache(maxsize=1)
def load_bank(folder: Path = BANK) -> Bank:
    """Read and check the whole bank, once; ValueError names the file and the wrong entry."""
    slots: dict[str, list[str]] = _read(folder / "slots.yaml")
    grammar: dict[str, list[str]] = _read(folder / "grammar.yaml")
    _check_grammar(grammar)
    phrases: dict[str, Phrase] = {}
    late: dict[str, Phrase] = {}
    for path in sorted(folder.glob("*_*.yaml")):
        raw = _read(path)
        into = late if raw.get("trains_only", False) else phrases
        for phrase in _phrases_of(path, raw, slots):
            into.setdefault(_normal(phrase.text), phrase)
    if not phrases:
        raise ValueError(f"no sentences in {folder}; expected files such as moderate_families.yaml")
    more = [phrase for said, phrase in sorted(late.items()) if said not in phrases]
    return Bank(
        phrases=_add_late(_apart(phrases.values()), more),
        slots=slots,
        grammar=grammar,
        feedback=_read(folder / "feedback.yaml"),
        reasons=_read(folder / "reasons.yaml"),
    )


def pick(options: Sequence[T], rng: np.random.Generator) -> T:
    """One of the options, uniformly."""
    return options[int(rng.integers(len(options)))]


def vary(text: str, rng: np.random.Generator) -> str:
    """The sentence as speech recognition might hand it over: case, punctuation, filler words."""
    if rng.random() < 0.15:
        text = pick(OPENERS, rng) + text[0].lower() + text[1:]
    if rng.random() < 0.1:
        text = text.rstrip(".!?") + pick(CLOSERS, rng)
    if rng.random() < 0.3:
        text = text.rstrip(".!?")
    if rng.random() < 0.1:
        text = re.sub(r"[,;:]", "", text)
    return text


def _phrases_of(path: Path, raw: dict[str, Any], slots: dict[str, list[str]]) -> Iterable[Phrase]:
    late = raw.get("trains_only", False)
    style = raw["style"]
    if style not in STYLES:
        raise ValueError(f"{path}: style {style!r} is none of {', '.join(STYLES)}")
    for level in LEVELS:
        for intent, texts in raw["sentences"][level].items():
            for text in texts:
                held_out = not late and _share(text) < HELD_OUT_SENTENCES
                name = f"{path.stem}/{level}/{_digest(text)[:8]}"
                yield Phrase(text, style, level, intent, name, held_out)
        for template in raw["templates"][level]:
            text = template["text"]
            unknown = set(_SLOT.findall(text)) - set(slots)
            if unknown:
                raise ValueError(
                    f"{path}: {text!r} uses the slot {unknown.pop()!r}, see slots.yaml"
                )
            held_out = not late and _share(text) < HELD_OUT_TEMPLATES
            name = f"{path.stem}/{level}/template-{_digest(text)[:8]}"
            yield Phrase(text, style, level, template["intent"], name, held_out)


def _apart(phrases: Iterable[Phrase]) -> tuple[Phrase, ...]:
    """Phrases in the order of their names, as held out as `_keep_apart` leaves them."""
    kept = sorted(phrases, key=lambda p: p.phrase_id)
    held_out = _keep_apart([p.text for p in kept], [p.held_out for p in kept])
    return tuple(replace(p, held_out=bool(h)) for p, h in zip(kept, held_out, strict=True))


def _add_late(phrases: tuple[Phrase, ...], late: Iterable[Phrase]) -> tuple[Phrase, ...]:
    """The phrases with all late ones that repeat none of the held-out."""
    held_out = _WordIndex([p.text for p in phrases if p.held_out])
    return (*phrases, *(p for p in late if not held_out.repeats(p.text).any()))


def _keep_apart(texts: list[str], asked: list[bool]) -> NDArray[np.bool_]:
    """Which texts are held out: those asked for that do not nearly repeat a training text."""
    held_out = np.array(asked)
    index = _WordIndex(texts)
    near = {i: np.flatnonzero(index.repeats(texts[i])) for i in np.flatnonzero(held_out).tolist()}
    moved = ~held_out  # what the remaining held-out texts are still to be compared with
    while moved.any() and held_out.any():
        repeats = np.zeros(len(texts), bool)
        repeats[[i for i in near if held_out[i] and moved[near[i]].any()]] = True
        held_out &= ~repeats
        moved = repeats
    return held_out


class _WordIndex:
    """Finds which of many texts say nearly the same words as another one."""

    def __init__(self, texts: list[str]) -> None:
        words = [set(_normal(text).split()) for text in texts]
        self._sizes = np.array([len(own) for own in words], int)
        lists: dict[str, list[int]] = {}
        for number, own in enumerate(words):
            for word in own:
                lists.setdefault(word, []).append(number)
        self._texts_with = {word: np.array(numbers) for word, numbers in lists.items()}

    def repeats(self, text: str) -> NDArray[np.bool_]:
        """For each of the texts, whether it nearly repeats this one."""
        words = set(_normal(text).split())
        shared = np.zeros(len(self._sizes), int)
        for word in words & self._texts_with.keys():
            shared[self._texts_with[word]] += 1
        either = len(words) + self._sizes - shared
        return np.asarray((shared > 0) & (shared >= NEAR_REPEAT * either))


def _check_grammar(grammar: dict[str, list[str]]) -> None:
    for style in STYLES:
        for level in LEVELS:
            if f"{style}_{level}" not in grammar:
                raise ValueError(f"grammar.yaml lacks the root {style}_{level}")
    for symbol, expansions in grammar.items():
        for name in {n for text in expansions for n in _SYMBOL.findall(text)} - set(grammar):
            raise ValueError(f"grammar.yaml: {symbol} uses ${name}, which is not defined")


def _read(path: Path) -> Any:
    if not path.is_file():
        raise ValueError(f"the instruction bank lacks {path.name} in {path.parent}")
    return yaml.load(path.read_text(), Loader=_LOADER)


def _tidy(text: str) -> str:
    text = re.sub(r"\s+([,.!?])", r"\1", " ".join(text.split()))
    return text[:1].upper() + text[1:]


def _normal(text: str) -> str:
    return " ".join(re.findall(r"[a-z']+", text.lower()))


def _digest(text: str) -> str:
    return hashlib.blake2b(_normal(text).encode(), digest_size=8).hexdigest()


def _share(text: str) -> float:
    """A number in [0, 1) that depends on the wording alone."""
    return int(_digest(text), 16) / 2**64
