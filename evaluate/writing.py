"""The paper's way on the same bundle: the matrix as text, token by token.

frame, words -> up to MAX_MATRIX_TOKENS tokens -> a matrix, or None where the text holds none
"""

from collections.abc import Sequence

from tokenizers import Tokenizer

from ridetune.contract import Contract
from ridetune.engines import Engine
from ridetune.matrix import ControllerMatrix
from ridetune.policy import MAX_MATRIX_TOKENS, read_text
from ridetune.sample import Memory
from ridetune.vision import read_patches


class MatrixWriter:
    """Lets an engine write the matrix instead of deciding its six bins in one pass."""

    def __init__(self, engine: Engine, contract: Contract, tokenizer: Tokenizer) -> None:
        self._engine, self._tokenizer = engine, tokenizer
        self._vision, self._codec = contract.vision, contract.codec
        self._prompts = contract.prompts(tokenizer)

    def write(
        self, frame: bytes, instruction: str, memories: Sequence[Memory] = ()
    ) -> tuple[ControllerMatrix | None, int]:
        """The matrix, or None if the text is not well formed, and the number of tokens."""
        prefix = self._engine.prefill(read_patches(frame, self._vision))
        suffix = self._prompts.suffix(instruction, memories)
        ids = self._engine.write_matrix(prefix, suffix, MAX_MATRIX_TOKENS)
        return self._codec.parse(read_text(self._tokenizer, ids)), len(ids)
