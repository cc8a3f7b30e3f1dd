"""The dataset card: what an exported folder holds, counted, drawn and shown.

    pairs -> Card (counts, histograms, a few to show) -> README.md, plots/*.svg, contact_sheet.jpg

README.md opens with the front matter that the Hugging Face hub and `datasets` read. A card takes
the same memory for any number of pairs.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from itertools import zip_longest
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from ridetune.codec import MatrixCodec
from ridetune.matrix import NUM_PARAMETERS, STYLES
from ridetune.sample import CONDITIONS, LEVELS, Split

from .bank_files import LANGUAGES, Language
from .card_charts import NUM_BARS, draw_conditions, draw_values
from .card_sheet import Shown, draw_sheet
from .checks import SPLITS
from .formats import dataset_name
from .proposals import Proposal

CARD_FILE, SHEET_FILE, PLOTS = "README.md", "contact_sheet.jpg", "plots"
NUM_SHOWN = 24

_TEXT = Path(__file__).with_name("card.md")
# In this order in the card; what has no order of its own goes by name.
_FACETS: dict[str, tuple[str, ...]] = {
    "style": STYLES,
    "level": LEVELS,
    "condition": CONDITIONS,
    "language": LANGUAGES,
    "source": (),
    "annotator": (),
    "reviewed": ("yes", "no"),
    "licence": (),
}
_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (10**6, "100K<n<1M"))
_WARNINGS: dict[Split, str] = {
    "calibration": "No pair is for calibration, which `python -m quantize` needs; "
    "propose from more scenes, or with a larger calibration_share.",
    "test": "No pair is for testing, without which `python -m train` refuses to run; "
    "propose from more scenes, or with a larger test_share.",
}


class Card:
    """Counts pairs as they are written and remembers a few to show."""

    def __init__(self, codec: MatrixCodec) -> None:
        self.codec = codec
        # bars[parameter, style, bar]: even steps on the codec's scale
        self.bars: NDArray[np.int64] = np.zeros((NUM_PARAMETERS, len(STYLES), NUM_BARS), np.int64)
        self.levels: Counter[tuple[str, str]] = Counter()  # by condition and level
        self._counts: Counter[tuple[str, str, Split]] = Counter()  # by facet, value and split
        self._shown: dict[tuple[str, str], list[Shown]] = {
            (condition, style): [] for condition in CONDITIONS for style in STYLES
        }

    def add(self, proposal: Proposal, image: str, *, reviewed: bool) -> None:
        """Count one pair; image: its picture's file, relative to the folder."""
        sample = proposal.sample
        values = {
            "split": sample.split,
            "style": sample.style,
            "level": sample.level,
            "condition": sample.condition,
            "language": sample.language,
            "source": proposal.source,
            "annotator": proposal.annotator,
            "reviewed": "yes" if reviewed else "no",
            "licence": f"{proposal.source}: {proposal.licence}",
        }
        for facet, value in values.items():
            self._counts[facet, value, sample.split] += 1
        self.levels[sample.condition, sample.level] += 1
        for i, number in enumerate(sample.matrix.values):
            bar = int(max(self.codec.share(number, i), 0.0) * NUM_BARS)
            self.bars[i, STYLES.index(sample.style), min(bar, NUM_BARS - 1)] += 1
        shown = self._shown[sample.condition, sample.style]
        shown.append(
            Shown(proposal.proposal_id, image, sample.instruction, sample.style, sample.condition)
        )
        shown.sort()
        del shown[NUM_SHOWN:]

    def pairs(self, split: Split) -> int:
        """Pairs of a split."""
        return self._counts["split", split, split]

    @property
    def splits(self) -> list[Split]:
        """The splits that hold pairs."""
        return [split for split in SPLITS if self.pairs(split)]

    @property
    def languages(self) -> list[Language]:
        """The languages of the pairs."""
        found = {value for facet, value, _ in self._counts if facet == "language"}
        return [language for language in LANGUAGES if language in found]

    def table(self, facet: str) -> str:
        """Pairs by one facet and split, as a Markdown table whose last row is the sum."""
        found = {value for name, value, _ in self._counts if name == facet}
        order = [value for value in _FACETS[facet] if value in found]
        rows = [
            (_cell(value), [self._counts[facet, value, split] for split in self.splits])
            for value in [*order, *sorted(found - set(order))]
        ]
        rows.append(("**all**", [self.pairs(split) for split in self.splits]))
        head = f"| {facet} | {' | '.join(self.splits)} | all |"
        lines = [head, "|---|" + "---:|" * (len(self.splits) + 1)]
        lines += [
            f"| {name} | {' | '.join(f'{count:,}' for count in counts)} | {sum(counts):,} |"
            for name, counts in rows
        ]
        return "\n".join(lines)

    def shown(self) -> list[Shown]:
        """Pairs to show: of every condition and style in turn, each picture once where it can be.

        Which ones follows from their ids.
        """
        turns = zip_longest(*self._shown.values())
        seen: set[str] = set()
        fresh: list[Shown] = []
        again: list[Shown] = []
        for pair in (pair for turn in turns for pair in turn if pair is not None):
            (again if pair.image in seen else fresh).append(pair)
            seen.add(pair.image)
        chosen = (fresh + again)[:NUM_SHOWN]
        return sorted(
            chosen, key=lambda p: (CONDITIONS.index(p.condition), STYLES.index(p.style), p)
        )

    def warnings(self) -> list[str]:
        """What the later stages will miss, in words."""
        return [text for split, text in _WARNINGS.items() if not self.pairs(split)]


def write_card(card: Card, folder: Path, *, name: str, skipped: Mapping[str, int]) -> None:
    """README.md, the plots and the contact sheet of a folder whose pairs are written."""
    (folder / PLOTS).mkdir()
    (folder / PLOTS / "values.svg").write_text(draw_values(card.bars, card.codec))
    (folder / PLOTS / "conditions.svg").write_text(draw_conditions(card.levels))
    (folder / SHEET_FILE).write_bytes(draw_sheet(card.shown(), folder))
    parts = {
        "name": _cell(name),
        "warnings": "".join(f"\n> **Note:** {warning}\n" for warning in card.warnings()),
        "splits": _list(f"{s} {card.pairs(s):,}" for s in card.splits),
        "pairs": f"{sum(map(card.pairs, SPLITS)):,}",
        "vehicle": _cell(card.codec.ranges.vehicle),
        "tables": "\n\n".join(card.table(f) for f in _FACETS if f != "licence"),
        "licences": card.table("licence"),
        "skipped": _skipped(skipped),
        "llama_factory": dataset_name(name, "train"),
    }
    text = _TEXT.read_text()
    for key, value in parts.items():
        text = text.replace("{" + key + "}", value)
    (folder / CARD_FILE).write_text(f"---\n{_front_matter(card, name)}---\n\n{text}")


def _front_matter(card: Card, name: str) -> str:
    total = sum(map(card.pairs, SPLITS))
    files = [{"split": split, "path": f"{split}.parquet"} for split in card.splits]
    matter = {
        "pretty_name": name,
        "language": card.languages,
        "license": "other",
        "license_name": "as-each-source-says",
        "task_categories": ["image-text-to-text", "robotics"],
        "tags": ["autonomous-driving", "vision-language", "personalisation", "ridetune"],
        "size_categories": [next((s for limit, s in _SIZES if total < limit), "n>1M")],
        "configs": [{"config_name": "default", "data_files": files}],
    }
    return yaml.safe_dump(matter, sort_keys=False, allow_unicode=True)


def _skipped(counts: Mapping[str, int]) -> str:
    if not counts:
        return "Nothing was left out."
    total = sum(counts.values())
    kinds = _list(f"{kind} {count:,}" for kind, count in sorted(counts.items()))
    left_out = (
        "1 pair was left out, with its"
        if total == 1
        else f"{total:,} pairs were left out, each with its"
    )
    return f"{left_out} reason in `skipped.csv`: {kinds}."


def _list(parts: Iterable[str]) -> str:
    return ", ".join(parts)


def _cell(text: str) -> str:
    """Foreign text that cannot break a Markdown table."""
    plain = " ".join(text.split())
    return plain.replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;") or "(empty)"
