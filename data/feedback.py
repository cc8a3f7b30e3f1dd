"""What passengers say after a drive, by kind; a fifth of it is held out for testing."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from ridetune.sample import FEEDBACK_KINDS, FeedbackKind, Split

from .bank_files import BANK, Language, read_yaml
from .held_out import keep_apart, share_of

HELD_OUT_FEEDBACK = 0.2
_SPLITS: tuple[Split, ...] = ("train", "test")


@dataclass(frozen=True)
class Feedback:
    """The sentences of one language by kind."""

    sayings: dict[FeedbackKind, list[str]]

    def of(self, kind: FeedbackKind, split: Split) -> list[str]:
        """The sentences of one kind that a split may use."""
        return self._by_side[kind, split == "test"]

    @cached_property
    def _by_side(self) -> dict[tuple[FeedbackKind, bool], list[str]]:
        said = [(kind, text) for kind, texts in self.sayings.items() for text in texts]
        texts = [text for _, text in said]
        apart = keep_apart(texts, [share_of(text) < HELD_OUT_FEEDBACK for text in texts])
        found: dict[tuple[FeedbackKind, bool], list[str]] = {
            (kind, held_out): [] for kind in self.sayings for held_out in (False, True)
        }
        for (kind, text), held_out in zip(said, apart, strict=True):
            found[kind, bool(held_out)].append(text)
        return found


def write_feedback(languages: Sequence[Language], folder: Path) -> None:
    """feedback-train.json and feedback-test.json: the sentences of some languages by kind."""
    # The whole bank takes seconds to load, its feedback alone none.
    every = [Feedback(read_yaml(BANK / language / "feedback.yaml")) for language in languages]
    for split in _SPLITS:
        sayings = {
            kind: [text for feedback in every for text in feedback.of(kind, split)]
            for kind in FEEDBACK_KINDS
        }
        path = folder / f"feedback-{split}.json"
        path.write_text(json.dumps(sayings, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
