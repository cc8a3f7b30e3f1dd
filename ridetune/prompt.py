"""The one prompt builder, for training and for serving.

    prefix    system, image                                  (known before the passenger speaks)
    suffix    memories, instruction, "assistant"             (a few dozen tokens)
    queries   six action-query tokens: one forward pass reads one bin at each

After the queries come the six chosen action tokens, the scene and the explanation. The paper's
way leaves the queries out and writes the matrix as text. The layout is part of the bundle: a
change here is a new PROMPT_VERSION.
"""

import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from tokenizers import Tokenizer

from ridetune.codec import NUM_BINS, MatrixCodec
from ridetune.matrix import PARAMETERS
from ridetune.sample import Memory

PROMPT_VERSION = 1

SYSTEM = "Set the six controller values of the car to the scene and the wish of the passenger."
MAX_INSTRUCTION_CHARACTERS = 400
MAX_MEMORIES = 3

END = "<|im_end|>"
IMAGE = "<|image_pad|>"
ACTION_TOKENS = tuple(f"<|action_{i:03d}|>" for i in range(NUM_BINS))
QUERY_TOKENS = tuple(f"<|query_{name}|>" for name in PARAMETERS)
CHAT_TOKENS = (
    "<|endoftext|>",
    "<|im_start|>",
    END,
    "<|vision_start|>",
    "<|vision_end|>",
    IMAGE,
    "<|video_pad|>",
)


class InstructionError(ValueError):
    """The instruction cannot be used; the message says why and what to say instead."""


@dataclass(frozen=True)
class TokenIds:
    """The ids of the tokens that the prompt and its readers name."""

    image: int
    end: int
    unknown: int | None
    actions: tuple[int, ...]
    queries: tuple[int, ...]


class PromptBuilder:
    """Writes prompts as token ids for one tokenizer, one camera grid and one codec."""

    def __init__(self, tokenizer: Tokenizer, grid: tuple[int, int], codec: MatrixCodec) -> None:
        self.tokenizer = tokenizer
        self.rows, self.columns = grid
        self.codec = codec
        self.ids = _token_ids(tokenizer)

    def prefix(self) -> list[int]:
        """System message and image: the same ids for every frame of this camera."""
        return list(self._prefix)

    def suffix(self, instruction: str, memories: Sequence[Memory] = ()) -> list[int]:
        """Memories and instruction up to where the assistant answers; InstructionError if unfit."""
        lines = [self._remember(memory) for memory in memories[:MAX_MEMORIES]]
        said = clean_instruction(instruction)
        self._check_language(said)
        lines.append(f"the passenger says: {said}")
        return self._encode("\n".join(lines) + f"{END}\n<|im_start|>assistant\n")

    def text(self, text: str) -> list[int]:
        """Ids of plain text in which no special token can hide."""
        return self._encode(quote(text))

    def positions(self, ids: Sequence[int], start: int = 0) -> NDArray[np.int64]:
        """mRoPE positions [3, tokens]: time, height, width (Qwen2.5-VL and Qwen3-VL alike).

        Text advances all three together. An image keeps one time, spreads rows and columns from
        where it starts, and text goes on after its longer side. `start` is the first position of
        a suffix that follows an already read prefix.
        """
        is_image = np.asarray(ids) == self.ids.image
        if not is_image.any():
            return np.tile(np.arange(start, start + len(ids)), (3, 1))
        num_pads, longer = self.rows * self.columns, max(self.rows, self.columns)
        pad = np.maximum(np.cumsum(is_image) - 1, 0)  # number of the image token so far
        images_before = np.where(is_image, pad // num_pads, np.cumsum(is_image) // num_pads)
        text = np.cumsum(~is_image) - ~is_image  # text tokens before this one
        base = start + text + images_before * longer
        row, column = np.divmod(pad % num_pads, self.columns)
        return np.stack([base, base + is_image * row, base + is_image * column])

    def next_position(self, ids: Sequence[int]) -> int:
        """The position of the first token after a prefix."""
        return int(self.positions(ids).max()) + 1

    @cached_property
    def _prefix(self) -> tuple[int, ...]:
        pads = IMAGE * (self.rows * self.columns)
        return tuple(
            self._encode(
                f"<|im_start|>system\n{SYSTEM}{END}\n"
                f"<|im_start|>user\n<|vision_start|>{pads}<|vision_end|>"
            )
        )

    def _remember(self, memory: Memory) -> str:
        actions = "".join(ACTION_TOKENS[b] for b in self.codec.encode(memory.matrix))
        return (
            f"remember: {quote(memory.instruction)} | {quote(memory.scene)} | {actions} | "
            f"{quote(memory.feedback)}"
        )

    def _check_language(self, said: str) -> None:
        if self.ids.unknown is None:
            return
        ids = self._encode(said)
        if ids.count(self.ids.unknown) * 3 > len(ids):
            raise InstructionError(
                "the instruction is in words or a script that this model does not know; "
                "say it in English, or serve a bundle of a multilingual model"
            )

    def _encode(self, text: str) -> list[int]:
        return list(self.tokenizer.encode(text, add_special_tokens=False).ids)


def clean_instruction(instruction: str) -> str:
    """The passenger's words on one line without control characters; InstructionError if unfit."""
    if len(instruction) > MAX_INSTRUCTION_CHARACTERS:
        raise InstructionError(
            f"the instruction has {len(instruction)} characters, "
            f"the limit is {MAX_INSTRUCTION_CHARACTERS}; say it in a sentence or two"
        )
    said = quote(instruction)
    if not any(character.isalnum() for character in said):
        raise InstructionError("the instruction holds no words; say what you would like")
    return said


def quote(text: str) -> str:
    """Foreign text made harmless: one line, no control characters, no special tokens."""
    spaced = "".join(
        " " if unicodedata.category(character)[0] in "CZ" else character for character in text
    )
    return " ".join(spaced.replace("<|", "< ").replace("|>", " >").split())


def _token_ids(tokenizer: Tokenizer) -> TokenIds:
    def of(token: str) -> int:
        found = tokenizer.token_to_id(token)
        if found is None:
            raise ValueError(
                f"the tokenizer lacks {token}; add the action and query tokens before training"
            )
        return int(found)

    return TokenIds(
        image=of(IMAGE),
        end=of(END),
        unknown=tokenizer.token_to_id("[UNK]"),
        actions=tuple(of(token) for token in ACTION_TOKENS),
        queries=tuple(of(token) for token in QUERY_TOKENS),
    )
