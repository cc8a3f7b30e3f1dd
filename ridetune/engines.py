"""The seam between the policy and whatever runs the model: prefill, decide, explain.

An engine works on token ids and patches; the prompt builder and the codec stay outside. The
prefix of a frame is prefilled once and can serve many decisions: an engine never changes it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


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

    def explain(
        self, decided: ActionPass, bins: Sequence[int], max_tokens: int
    ) -> Iterator[int]:
        """After the six chosen action tokens: token ids of scene and explanation, greedily."""

    def write_matrix(self, prefix: Prefix, suffix: Sequence[int], max_tokens: int) -> list[int]:
        """The paper's way, for comparison: the matrix as text, token by token."""
