"""What the car saw, what the passenger said, and what the right answer is.

An Observation and an instruction go in; a Sample adds the label and the targets that training
needs. A row is a Sample as the dataset file holds it: plain values, the frame as encoded bytes.
"""

import random
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from ridetune.matrix import NUM_PARAMETERS, ControllerMatrix, Style

Condition = Literal["sunny", "rain", "fog", "snow", "night"]
CONDITIONS: tuple[Condition, ...] = get_args(Condition)
ADVERSE: tuple[Condition, ...] = ("rain", "fog", "snow", "night")

Level = Literal["I", "II", "III"]
LEVELS: tuple[Level, ...] = get_args(Level)
FeedbackKind = Literal["too_aggressive", "too_conservative", "just_right"]
FEEDBACK_KINDS: tuple[FeedbackKind, ...] = ("too_aggressive", "too_conservative", "just_right")

Split = Literal["train", "calibration", "test"]


@dataclass(frozen=True)
class Observation:
    """One camera frame as encoded JPEG or PNG bytes, and the car's own speed where known [m/s]."""

    frame: bytes
    speed_mps: float | None = None


@dataclass(frozen=True)
class Memory:
    """One remembered drive (I, C, P, F): what was said, the scene, the matrix, the feedback."""

    instruction: str
    scene: str
    matrix: ControllerMatrix
    feedback: str


@dataclass(frozen=True)
class Sample:
    """One image-instruction-action pair with its provenance.

    scene_id names the scene without its condition: the five frames of one scene share it.
    phrase_id names the sentence or template that the instruction comes from; language is its ISO
    639-1 code.
    """

    observation: Observation
    instruction: str
    memories: tuple[Memory, ...]
    matrix: ControllerMatrix
    scene: str
    explanation: str
    style: Style
    level: Level
    intent: str
    condition: Condition
    split: Split
    scene_id: str
    phrase_id: str
    language: str = "en"

    def as_row(self) -> dict[str, Any]:
        """The row of the dataset file; `Sample.of_row` is its inverse."""
        return {
            "image": {"bytes": self.observation.frame, "path": None},
            "speed_mps": self.observation.speed_mps,
            "instruction": self.instruction,
            "memories": [
                {
                    "instruction": m.instruction,
                    "scene": m.scene,
                    "matrix": list(m.matrix.values),
                    "feedback": m.feedback,
                }
                for m in self.memories
            ],
            "matrix": list(self.matrix.values),
            "scene": self.scene,
            "explanation": self.explanation,
            "style": self.style,
            "level": self.level,
            "intent": self.intent,
            "condition": self.condition,
            "split": self.split,
            "scene_id": self.scene_id,
            "phrase_id": self.phrase_id,
            "language": self.language,
        }

    @staticmethod
    def of_row(row: dict[str, Any]) -> "Sample":
        """Read a row with its image undecoded (`datasets.Image(decode=False)`)."""
        frame = row["image"]["bytes"]
        if not frame:
            raise ValueError(f"row of scene {row['scene_id']}: the image has no bytes")
        memories = tuple(
            Memory(m["instruction"], m["scene"], ControllerMatrix.of(m["matrix"]), m["feedback"])
            for m in row["memories"]
        )
        kept = {name: row[name] for name in _PLAIN_FIELDS}
        language = row.get("language") or "en"  # rows of older datasets name none
        return Sample(
            observation=Observation(frame, row.get("speed_mps")),
            memories=memories,
            matrix=ControllerMatrix.of(row["matrix"]),
            language=language,
            **kept,
        )


_PLAIN_FIELDS = (
    "instruction",
    "scene",
    "explanation",
    "style",
    "level",
    "intent",
    "condition",
    "split",
    "scene_id",
    "phrase_id",
)


def dataset_features() -> Any:
    """The `datasets.Features` of a row; the frame stays encoded."""
    from datasets import Features, Image, Value
    from datasets import Sequence as Series

    matrix = Series(Value("float32"), length=NUM_PARAMETERS)
    text = Value("string")
    memory = {"instruction": text, "scene": text, "matrix": matrix, "feedback": text}
    return Features(
        {
            "image": Image(decode=False),
            "speed_mps": Value("float32"),
            "memories": [memory],
            "matrix": matrix,
            **dict.fromkeys(_PLAIN_FIELDS, text),
            "language": text,
        }
    )


def read_samples(path: Path) -> list[Sample]:
    """All samples of a parquet file; ValueError if it is missing, damaged or empty."""
    import pyarrow.parquet as parquet

    if not path.is_file():
        raise ValueError(f"no dataset at {path}; run `make data`, or set `data` in the config")
    try:
        rows = parquet.read_table(path).to_pylist()
    except OSError as error:
        raise ValueError(f"{path} is damaged ({error}); build the dataset again") from error
    if not rows:
        raise ValueError(f"{path} holds no samples; build the dataset with more scenes")
    return [Sample.of_row(row) for row in rows]


def some_of(samples: list[Sample], count: int, seed: int = 0) -> list[Sample]:
    """A fixed random part of the samples; all of them where there are fewer."""
    order = random.Random(seed).sample(range(len(samples)), min(count, len(samples)))
    return [samples[i] for i in sorted(order)]
