"""One's own collected commands: a CSV file with a style and a level for each, beside the bank.

    text,style,level,intent,language
    "Could you go easy on the corners?",conservative,I,corners,en

`intent` and `language` may be missing (then en). Commas or semicolons part the columns, the file is
UTF-8, and a text may hold the bank's {slots}. Held out for testing is about a seventh, by the
wording alone, as in the bank.
"""

import csv
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ridetune.matrix import STYLES, Style
from ridetune.prompt import InstructionError, clean_instruction
from ridetune.sample import LEVELS, Split

from .bank_files import LANGUAGES
from .held_out import digest, keep_apart, share_of
from .phrases import HELD_OUT_SENTENCES, USUAL_INTENT, Bank, Phrase, check_slots

_NEEDED, _OPTIONAL = ("text", "style", "level"), ("intent", "language")
_NAMED = 5  # wrong rows in a message


@dataclass(frozen=True)
class OwnCommands:
    """Commands of one language, ready to be drawn.

    repeats: how many were left out because the file says them twice, or because the bank has held
    out nearly the same words.
    """

    phrases: tuple[Phrase, ...]
    repeats: int

    def choose(self, style: Style, split: Split) -> list[Phrase]:
        """The commands of a style that a split may use."""
        tested = split == "test"
        return [p for p in self.phrases if p.style == style and p.held_out == tested]


def read_own_commands(path: Path, bank: Bank) -> OwnCommands:
    """The commands of a file in the bank's language; ValueError names every wrong row.

    Also where the same words are given two styles.
    """
    distinct: dict[str, Phrase] = {}
    asked = 0
    for phrase in _read_rows(path, bank):
        asked += 1
        first = distinct.setdefault(_said(phrase.text), phrase)
        if first.style != phrase.style:
            raise ValueError(
                f"{path} has {phrase.text!r} twice, as {first.style} and as {phrase.style}; "
                "keep one"
            )
    phrases = [p for p in distinct.values() if not bank.repeats_held_out(p.text)]
    training = [p.text for p in bank.phrases if not p.held_out]
    held_out = keep_apart(
        [p.text for p in phrases] + training,
        [p.held_out for p in phrases] + [False] * len(training),
    )[: len(phrases)]
    kept = tuple(replace(p, held_out=bool(h)) for p, h in zip(phrases, held_out, strict=True))
    return OwnCommands(kept, asked - len(kept))


def _read_rows(path: Path, bank: Bank) -> Iterator[Phrase]:
    wrong = []
    for number, row in _rows_of(path):
        language = row["language"] or "en"
        try:
            if language not in LANGUAGES:
                raise ValueError(f"language {language!r} is none of {_named(LANGUAGES)}")
            if language == bank.language:
                yield _phrase_of(row, path, bank)
        except ValueError as error:
            wrong.append(f"line {number}: {error}")
    if wrong:
        more = f"; and {len(wrong) - _NAMED} more" if len(wrong) > _NAMED else ""
        raise ValueError(f"{path} has wrong rows: {'; '.join(wrong[:_NAMED])}{more}")


def _rows_of(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """The line where each row ends, and its columns without outer blanks."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise ValueError(f"no file of commands at {path}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not UTF-8 text; save it again as CSV UTF-8") from error
    lines = text.splitlines()
    head = lines[0] if lines else ""
    rows = csv.DictReader(lines, delimiter=";" if head.count(";") > head.count(",") else ",")
    columns = [name.strip().lower() for name in rows.fieldnames or ()]
    missing = [name for name in _NEEDED if name not in columns]
    if missing:
        raise ValueError(
            f"{path} lacks the column {missing[0]!r}; "
            f"the first line names the columns: {_named(_NEEDED + _OPTIONAL)}"
        )
    rows.fieldnames = columns
    for row in rows:
        yield rows.line_num, {n: (row.get(n) or "").strip() for n in _NEEDED + _OPTIONAL}


def _phrase_of(row: Mapping[str, str], path: Path, bank: Bank) -> Phrase:
    style: Any = row["style"].lower()
    level: Any = row["level"].upper()
    if style not in STYLES:
        raise ValueError(f"style {row['style']!r} is none of {_named(STYLES)}")
    if level not in LEVELS:
        raise ValueError(f"level {row['level']!r} is none of {_named(LEVELS)}")
    intent = row["intent"] or _usual_intent(style, level)
    if intent not in bank.reasons:
        raise ValueError(f"intent {intent!r} is none of {_named(sorted(bank.reasons))}")
    try:
        text = clean_instruction(row["text"])
    except InstructionError as error:
        raise ValueError(str(error)) from error
    check_slots(text, bank.slots, "the text")
    name = f"own_{path.stem}/{level}/{digest(text)[:8]}"
    voice = name if bank.language == "en" else f"{bank.language}/{name}"
    held_out = share_of(text) < HELD_OUT_SENTENCES
    return Phrase(text, style, level, intent, voice, held_out, bank.language)


def _said(text: str) -> str:
    """Words and numbers: 15 metres and 30 metres are two commands, on one side of the split."""
    return " ".join(re.findall(r"\w+", text.casefold()))


def _usual_intent(style: Style, level: str) -> str:
    return USUAL_INTENT[style][level == "III"]


def _named(names: Iterable[str]) -> str:
    return ", ".join(names)
