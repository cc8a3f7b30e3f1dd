"""The seam between the policy and whatever runs the model: prefill, decide, explain.

An engine works on token ids and patches; the prompt builder and the codec stay outside. The
prefix of a frame is prefilled once and can serve many decisions: an engine never changes it.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ridetune.prompt import TokenIds


@dataclass(frozen=True)
class Prefix:
    """A prefilled frame: the engine's own key/value cache and where the next token stands."""

    cache: Any
    num_tokens: int
    next_position: int


@dataclass(frozen=True)
class ActionPass:
    """The result of the one decision pass: logits [6, 256] and the cache for what follows."""

    logits: NDArray[np.float32]
    after: Prefix


class Engine(Protocol):
    """What the policy needs of a runtime."""

    def prefill(self, patches: NDArray[np.float32]) -> Prefix:
        """Read system message and image; patches [num_patches, 3 * t * p * p]."""

    def decide(self, prefix: Prefix, suffix: Sequence[int]) -> ActionPass:
        """One forward pass over the suffix and the six action queries."""

    def explain(self, decided: ActionPass, bins: Sequence[int], max_tokens: int) -> Iterator[int]:
        """After the six chosen action tokens: token ids of scene and explanation, greedily."""

    def write_matrix(self, prefix: Prefix, suffix: Sequence[int], max_tokens: int) -> list[int]:
        """The paper's way, for comparison: the matrix as text, token by token."""


class CachedEngine(ABC):
    """An Engine made from two steps of a runtime: advance the cache, read the hidden states."""

    def __init__(self, ids: TokenIds) -> None:
        self.ids = ids

    @abstractmethod
    def prefill(self, patches: NDArray[np.float32]) -> Prefix:
        """Read system message and image; patches [num_patches, 3 * t * p * p]."""

    @abstractmethod
    def advance(
        self, prefix: Prefix, ids: Sequence[int], *, num_hidden: int
    ) -> tuple[NDArray[np.float32], Prefix]:
        """Run text tokens after a prefix, which stays as it is.

        Returns the last hidden states of the last `num_hidden` tokens [num_hidden, hidden], after
        the final norm, and the longer prefix.
        """

    @abstractmethod
    def action_logits(self, hidden: NDArray[np.float32]) -> NDArray[np.float32]:
        """Hidden states [tokens, hidden] -> logits of the 256 action tokens [tokens, 256]."""

    @abstractmethod
    def next_token(self, hidden: NDArray[np.float32]) -> int:
        """Hidden state of one token [1, hidden] -> the likeliest token of the vocabulary."""

    def decide(self, prefix: Prefix, suffix: Sequence[int]) -> ActionPass:
        """One forward pass over the suffix and the six action queries."""
        queries = self.ids.queries
        hidden, after = self.advance(prefix, [*suffix, *queries], num_hidden=len(queries))
        return ActionPass(self.action_logits(hidden), after)

    def explain(self, decided: ActionPass, bins: Sequence[int], max_tokens: int) -> Iterator[int]:
        """After the six chosen action tokens: token ids of scene and explanation, greedily.

        Ends before <|im_end|>, which is not yielded, or after `max_tokens`.
        """
        actions = [self.ids.actions[b] for b in bins]
        return self._write(decided.after, actions, max_tokens)

    def write_matrix(self, prefix: Prefix, suffix: Sequence[int], max_tokens: int) -> list[int]:
        """The paper's way, for comparison: the matrix as text, token by token."""
        return list(self._write(prefix, suffix, max_tokens))

    def _write(self, prefix: Prefix, ids: Sequence[int], max_tokens: int) -> Iterator[int]:
        """Read `ids`, then yield the likeliest tokens one by one."""
        unread = list(ids)
        for _ in range(max_tokens):
            hidden, prefix = self.advance(prefix, unread, num_hidden=1)
            token = self.next_token(hidden)
            if token == self.ids.end:
                return
            yield token
            unread = [token]
