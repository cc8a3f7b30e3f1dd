"""What a vision model is asked about a pair, and what its answer must be.

    picture + words -> messages -> JSON text -> Answer

In: the bytes of a frame, an instruction and the prompt of the config. Out: an Answer in the words
that the scenes and explanations of the dataset use, or a Refusal that says what is wrong with it.
"""

import base64
import json
import re
from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from ridetune.matrix import Style
from ridetune.sample import CONDITIONS, Condition
from ridetune.scene import scene_answers
from ridetune.vision import decode_frame

from ..build import encode

MAX_WIDTH_PX = 768
SCENE_CHARACTERS, EXPLANATION_CHARACTERS = 200, 240

Messages = list[dict[str, Any]]  # as chat completions have them

_FENCED = re.compile(r"\s*```(?:json)?\s*(.*?)\s*```\s*", re.DOTALL | re.IGNORECASE)
_FULL_STOP = re.compile(r"\.(?!\d)")
_ONE_SENTENCE = re.compile(r"because (?:[^.!?]|\.(?=\d))+\.")
_QUOTED_CHARACTERS = 4000  # of a wrong answer that is sent back
_FAULT_CHARACTERS = 400


@dataclass(frozen=True)
class Refusal:
    """Why a pair has no answer."""

    reason: str


def _one_line(text: str, characters: int) -> str:
    """The text in lower case; ValueError where it is not one line of at most so many."""
    text = text.strip().lower()
    if not text.isprintable():
        raise ValueError("must be one line without control characters")
    if not 0 < len(text) <= characters:
        raise ValueError(f"must have 1 to {characters} characters, not {len(text)}")
    return text


def _scene(text: str) -> str:
    # The first full stop ends the scene where the model's words are read (`policy.parse_answer`).
    text = _one_line(text.strip().rstrip(". "), SCENE_CHARACTERS)
    if _FULL_STOP.search(text):
        raise ValueError("must be one line of phrases with commas between them, no full stop")
    return text


def _explanation(text: str) -> str:
    text = _one_line(text, EXPLANATION_CHARACTERS)
    if not _ONE_SENTENCE.fullmatch(text):
        raise ValueError("must be one sentence that starts with 'because' and ends in a full stop")
    return text


def _clip(value: object) -> object:
    return min(max(value, 0), 1) if isinstance(value, int | float) else value


class Answer(BaseModel):
    """What the model says of a picture and of the words to it; confidence: 0..1, by itself."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    scene: Annotated[str, AfterValidator(_scene)]
    condition: Condition
    style: Style
    explanation: Annotated[str, AfterValidator(_explanation)]
    confidence: Annotated[float, Field(allow_inf_nan=False), BeforeValidator(_clip)]

    @model_validator(mode="after")
    def _says_its_condition(self) -> "Answer":
        if scene_answers(self.scene)[0] != CONDITIONS.index(self.condition):
            raise ValueError(
                f"the scene must name the condition {self.condition!r} and no other, "
                "by the word sunny, rainy, foggy, snowy or night-time"
            )
        return self


def parse_answer(text: str) -> Answer | Refusal:
    """The JSON object of an answer, bare or in a fence; a Refusal says what is wrong with it."""
    fenced = _FENCED.fullmatch(text)
    try:
        return Answer.model_validate_json(fenced[1] if fenced else text)
    except ValidationError as error:
        faults = [
            ": ".join([*map(str, fault["loc"]), fault["msg"].removeprefix("Value error, ")])
            for fault in error.errors()
        ]
        return Refusal("; ".join(faults)[:_FAULT_CHARACTERS])


def shrink(frame: bytes) -> bytes:
    """A JPEG at most MAX_WIDTH_PX wide, without what else the file says; FrameError if unusable."""
    pixels = decode_frame(frame, (MAX_WIDTH_PX, 1))
    height, width = pixels.shape[:2]
    if width > MAX_WIDTH_PX:
        size = (MAX_WIDTH_PX, max(1, round(height * MAX_WIDTH_PX / width)))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    return encode(pixels)


def first_messages(prompt: str, jpeg: bytes, instruction: str) -> Messages:
    """The prompt, then the picture and the words that it is asked about."""
    url = f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}"
    words = f"The passenger says: {json.dumps(instruction, ensure_ascii=False)}"
    content = [
        {"type": "image_url", "image_url": {"url": url}},
        {"type": "text", "text": words},
    ]
    return [{"role": "system", "content": prompt}, {"role": "user", "content": content}]


def repair_messages(messages: Messages, text: str, fault: str) -> Messages:
    """The same question after a wrong answer, with what is wrong with it."""
    demand = (
        f"This answer cannot be used: {fault}. Answer again, with the corrected JSON object alone."
    )
    return [
        *messages,
        {"role": "assistant", "content": text[:_QUOTED_CHARACTERS] or "(nothing)"},
        {"role": "user", "content": demand},
    ]
