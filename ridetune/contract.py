"""What a set of weights was trained with: prompt version, image cut, ranges, codec.

Saved as ridetune.json beside the weights and carried through every stage into the bundle, so
that training and serving cannot drift apart.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tokenizers import Tokenizer

from ridetune.codec import KNEES, NUM_BINS, MatrixCodec
from ridetune.matrix import Ranges
from ridetune.prompt import PROMPT_VERSION, PromptBuilder
from ridetune.vision import VisionSpec

CONTRACT_FILE = "ridetune.json"
TOKENIZER_FILE = "tokenizer.json"


@dataclass(frozen=True)
class Contract:
    """The image cut and the ranges; prompt version and codec are checked when it is read."""

    vision: VisionSpec
    ranges: Ranges

    @property
    def codec(self) -> MatrixCodec:
        """The action codec on these ranges."""
        return MatrixCodec(self.ranges)

    def prompts(self, tokenizer: Tokenizer) -> PromptBuilder:
        """The prompt builder for a tokenizer of this contract's model."""
        return PromptBuilder(tokenizer, (self.vision.rows, self.vision.columns), self.codec)

    def as_dict(self) -> dict[str, Any]:
        """The JSON form that `Contract.parse` reads."""
        return {
            "prompt_version": PROMPT_VERSION,
            "codec": {"bins": NUM_BINS, "knees": list(KNEES)},
            "vision": asdict(self.vision),
            "ranges": self.ranges.as_dict(),
        }

    def save(self, folder: Path) -> None:
        """Write ridetune.json into a model folder."""
        (folder / CONTRACT_FILE).write_text(json.dumps(self.as_dict(), indent=2) + "\n")

    @staticmethod
    def parse(raw: dict[str, Any], *, where: str) -> "Contract":
        """Read the form that `as_dict` writes; ValueError where this code does not match it."""
        if raw.get("prompt_version") != PROMPT_VERSION:
            raise ValueError(
                f"{where} was made with prompt version {raw.get('prompt_version')}, this code "
                f"writes version {PROMPT_VERSION}; train again or use the matching release"
            )
        if raw["codec"] != {"bins": NUM_BINS, "knees": list(KNEES)}:
            raise ValueError(f"{where} was made with another action codec; train again")
        vision = dict(raw["vision"])
        vision["mean"], vision["std"] = tuple(vision["mean"]), tuple(vision["std"])
        return Contract(VisionSpec(**vision), Ranges.parse(raw["ranges"], where=where))

    @staticmethod
    def load(folder: Path) -> "Contract":
        """Read ridetune.json of a model folder; ValueError if it is missing or does not match."""
        path = folder / CONTRACT_FILE
        if not path.is_file():
            raise ValueError(
                f"{folder} holds no {CONTRACT_FILE}; it is not a model of this project, "
                "`python -m train` and `python -m train.tiny` write such folders"
            )
        return Contract.parse(json.loads(path.read_text()), where=str(path))


def load_tokenizer(folder: Path) -> Tokenizer:
    """The tokenizer of a model or bundle folder; ValueError if it is missing."""
    path = folder / TOKENIZER_FILE
    if not path.is_file():
        raise ValueError(f"{folder} holds no {TOKENIZER_FILE}")
    return Tokenizer.from_file(str(path))
