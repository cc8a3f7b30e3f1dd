"""Sentences with some words exchanged for others that are used alike.

A small student of a large teacher learns more from many nearby sentences, which the teacher
judges, than from a few that people judged (Jiao et al. 2020, section 3.2, does so with GloVe).
Here a word's neighbours are the nearest of the teacher's own word vectors. "quick" may become
"slow": that is the point, the teacher hears the difference.
"""

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

NEIGHBOURS = 12
EXCHANGED = 0.25  # share of the words that have neighbours

_WORD = re.compile(r"[a-z]+")


class Rewording:
    """The neighbours of every whole word among some word pieces."""

    def __init__(self, pieces: Sequence[str], vectors: NDArray[np.float32]) -> None:
        whole = [i for i, piece in enumerate(pieces) if len(piece) > 2 and _WORD.fullmatch(piece)]
        self._words = [pieces[i] for i in whole]
        self._row = {word: row for row, word in enumerate(self._words)}
        unit = vectors[whole] / np.linalg.norm(vectors[whole], axis=1, keepdims=True)
        likeness = unit @ unit.T
        np.fill_diagonal(likeness, -1)
        self._near = np.argsort(-likeness, axis=1)[:, :NEIGHBOURS]

    def __call__(self, text: str, rng: np.random.Generator) -> str:
        """The text in lower case with about a quarter of its words exchanged."""

        def exchange(found: re.Match[str]) -> str:
            row = self._row.get(found[0])
            if row is None or rng.random() >= EXCHANGED:
                return found[0]
            return self._words[int(rng.choice(self._near[row]))]

        return _WORD.sub(exchange, text.lower())
