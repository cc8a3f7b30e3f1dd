"""Which wordings are held out for testing, and which ones repeat them.

Whether a text is held out follows from its words alone, so a longer list changes nothing about
the texts that stood in it before.
"""

import hashlib
import re

import numpy as np
from numpy.typing import NDArray

NEAR_REPEAT = 0.7  # Jaccard similarity of the word sets

# A Chinese character counts as a word: they are written without spaces.
_WORDS = re.compile(r"[\u4e00-\u9fff]|(?:(?![\u4e00-\u9fff])[^\W\d_]|')+")


def normal(text: str) -> str:
    """The words alone, in lower case, one space between them."""
    return " ".join(_WORDS.findall(text.lower()))


def digest(text: str) -> str:
    """Sixteen hexadecimal digits that depend on the words alone."""
    return hashlib.blake2b(normal(text).encode(), digest_size=8).hexdigest()


def share_of(text: str) -> float:
    """A number in [0, 1) that depends on the words alone."""
    return int(digest(text), 16) / 2**64


def keep_apart(texts: list[str], asked: list[bool]) -> NDArray[np.bool_]:
    """Which texts are held out: those asked for that do not nearly repeat a training text."""
    held_out = np.array(asked, bool)
    index = WordIndex(texts)
    near = {i: np.flatnonzero(index.repeats(texts[i])) for i in np.flatnonzero(held_out).tolist()}
    moved = ~held_out  # what the remaining held-out texts are still to be compared with
    while moved.any() and held_out.any():
        repeats = np.zeros(len(texts), bool)
        repeats[[i for i in near if held_out[i] and moved[near[i]].any()]] = True
        held_out &= ~repeats
        moved = repeats
    return held_out


class WordIndex:
    """Finds which of many texts say nearly the same words as another one."""

    def __init__(self, texts: list[str]) -> None:
        words = [set(normal(text).split()) for text in texts]
        self._sizes = np.array([len(own) for own in words], int)
        lists: dict[str, list[int]] = {}
        for number, own in enumerate(words):
            for word in own:
                lists.setdefault(word, []).append(number)
        self._texts_with = {word: np.array(numbers) for word, numbers in lists.items()}

    def repeats(self, text: str) -> NDArray[np.bool_]:
        """For each of the texts, whether it nearly repeats this one."""
        words = set(normal(text).split())
        shared = np.zeros(len(self._sizes), int)
        for word in words & self._texts_with.keys():
            shared[self._texts_with[word]] += 1
        either = len(words) + self._sizes - shared
        return np.asarray((shared > 0) & (shared >= NEAR_REPEAT * either))
