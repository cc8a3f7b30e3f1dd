"""What a pair must fulfil before it stands in a dataset, each by itself and all together.

    Proposal -> fault_of (its own picture, words, labels) -> Ledger (repeats, and what would cross
    the split) -> kept or left out, with a reason

The ledger lies on disk: it takes the same memory for a hundred pairs and for a million.
"""

import hashlib
import math
import sqlite3
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import get_args

from ridetune.codec import ROUNDING, MatrixCodec
from ridetune.matrix import PARAMETERS, STYLES, ControllerMatrix, ki_limit
from ridetune.prompt import InstructionError, clean_instruction
from ridetune.sample import CONDITIONS, LEVELS, Observation, Sample, Split

from .proposals import Proposal
from .sources.seen import fault_of_frame

SPLITS: tuple[Split, ...] = get_args(Split)
_KNOWN: dict[str, tuple[str, ...]] = {
    "style": STYLES,
    "level": LEVELS,
    "condition": CONDITIONS,
    "split": SPLITS,
}
_MAX_NAMED = 3  # of those that cross the split, in the message

# Kind of a key -> what it is called in a message.
_BOUND = {"scene_id": "scene", "phrase_id": "phrase"}
_TIES = {"picture": "its picture", "words": "its instruction"}


@dataclass(frozen=True)
class Fault:
    """Why a pair is left out: a kind to count by, and the reason in words."""

    kind: str
    reason: str


@dataclass(frozen=True)
class Judged:
    """A pair, why it is left out or None, and whether a reviewer looked at it."""

    proposal: Proposal
    fault: Fault | None = None
    reviewed: bool = False


class Checker:
    """Finds what is wrong with one pair by itself, for one vehicle."""

    def __init__(self, codec: MatrixCodec) -> None:
        self._codec = codec
        self._looked_at: tuple[str, str | None] = ("", None)

    def fault_of(self, proposal: Proposal) -> Fault | None:
        """The first fault of a pair, or None."""
        sample = proposal.sample
        for field, known in _KNOWN.items():
            value = getattr(sample, field)
            if value not in known:
                return Fault("label", f"its {field} {value!r} is none of {', '.join(known)}")
        for name, number in (
            ("speed", sample.observation.speed_mps),
            ("confidence", proposal.confidence),
        ):
            if number is not None and not math.isfinite(number):
                return Fault("number", f"its {name} is {number}")
        try:
            clean_instruction(sample.instruction)
        except InstructionError as error:
            return Fault("instruction", str(error))
        wrong = self._fault_of_matrix(sample) or self._fault_of_memories(sample)
        if wrong is not None:
            return Fault("matrix", wrong)
        unreadable = self._fault_of_picture(sample.observation.frame)
        return None if unreadable is None else Fault("picture", unreadable)

    def _fault_of_matrix(self, sample: Sample) -> str | None:
        """Outside the vehicle's or the style's limits, or K_i above K_p^2/8."""
        matrix = sample.matrix
        outside = self._outside_vehicle(matrix)
        if outside is not None:
            return outside
        limit = ki_limit(matrix.kp)
        if matrix.ki > limit * (1 + ROUNDING):
            return f"K_i = {matrix.ki:.6g} is above K_p^2/8 = {limit:.6g}"
        limits = self._codec.ranges.styles[sample.style]
        for name, value, of in zip(PARAMETERS, matrix.values, limits, strict=True):
            slack = ROUNDING * (of.maximum - of.minimum)
            if not of.minimum - slack <= value <= of.maximum + slack:
                return (
                    f"{name} = {value:.6g} lies outside [{of.minimum}, {of.maximum}], "
                    f"the {sample.style} range"
                )
        return None

    def _fault_of_memories(self, sample: Sample) -> str | None:
        for memory in sample.memories:
            outside = self._outside_vehicle(memory.matrix)
            if outside is not None:
                return f"of a remembered drive: {outside}"
        return None

    def _outside_vehicle(self, matrix: ControllerMatrix) -> str | None:
        try:
            self._codec.encode(matrix)
        except ValueError as error:  # also for NaN and infinity
            return str(error)
        return None

    def _fault_of_picture(self, frame: bytes) -> str | None:
        """Pairs of one picture follow each other: it is decoded once."""
        digest = picture_digest(frame)
        if digest != self._looked_at[0]:
            self._looked_at = (digest, fault_of_frame(frame))
        return self._looked_at[1]


def picture_digest(frame: bytes) -> str:
    """The name of a picture by its bytes."""
    return hashlib.blake2b(frame, digest_size=16).hexdigest()


class Ledger:
    """Which pairs are kept, in order, and what stands on which side of the split.

    On the one side stands what is learned from (train and calibration), on the other the test.
    """

    def __init__(self) -> None:
        # An empty name is a file of SQLite's own, gone when the process ends, however it ends.
        self._base = sqlite3.connect("", isolation_level=None)
        self._base.executescript(
            "PRAGMA journal_mode = OFF;"
            "PRAGMA cache_size = -4096;"  # KiB
            "CREATE TABLE kept (number INTEGER PRIMARY KEY, twin BLOB UNIQUE, content BLOB);"
            "CREATE TABLE side (kind TEXT, name TEXT, tested INTEGER,"
            " PRIMARY KEY (kind, name, tested)) WITHOUT ROWID;"
            "BEGIN;"
        )

    def close(self) -> None:
        """Give the disk space back."""
        self._base.close()

    def add(self, proposal: Proposal) -> Fault | None:
        """Keep a faultless pair; a fault where its frame and instruction are kept already."""
        sample = proposal.sample
        keys = _keys_of(sample)
        twin = _digest(keys["picture"], keys["words"])
        added = self._base.execute(
            "INSERT OR IGNORE INTO kept (twin, content) VALUES (?, ?)", (twin, _content(proposal))
        )
        if added.rowcount == 0:
            return Fault("repeat", "the same frame and instruction stand before it")
        self._base.executemany(
            "INSERT OR IGNORE INTO side VALUES (?, ?, ?)",
            [(kind, name, sample.split == "test") for kind, name in keys.items()],
        )
        return None

    def refuse_leaks(self) -> None:
        """ValueError where a scene or a phrase stands on both sides of the split."""
        for kind, called in _BOUND.items():
            crossing = self._base.execute(
                "SELECT name FROM side WHERE kind = ? GROUP BY name HAVING COUNT(*) > 1", (kind,)
            ).fetchmany(_MAX_NAMED + 1)
            if crossing:
                named = ", ".join(name for (name,) in crossing[:_MAX_NAMED])
                more = ", ..." if len(crossing) > _MAX_NAMED else ""
                raise ValueError(
                    f"the {called} {named}{more} stands in the test split and in one that is "
                    "learned from; propose again with one config, so that each stands on one side"
                )

    def kept(self, pairs: Iterable[Judged]) -> Iterator[Judged]:
        """Those of the same pairs that were added, at fault where the test split forbids them.

        ValueError if they are no longer what was added.
        """
        contents = self._base.execute("SELECT content FROM kept ORDER BY number")
        awaited = contents.fetchone()
        for pair in pairs:
            if awaited is None or pair.fault or awaited[0] != _content(pair.proposal):
                continue
            yield replace(pair, fault=self._tie_of(pair.proposal.sample))
            awaited = contents.fetchone()
        if awaited is not None:
            raise ValueError(
                "the proposals or their reviews changed while they were exported; "
                "let the other run end, then export again"
            )

    def _tie_of(self, sample: Sample) -> Fault | None:
        """A pair that is learned from must not show the picture or the words of a test pair."""
        if sample.split == "test":
            return None
        keys = _keys_of(sample)
        for kind, called in _TIES.items():
            tested = self._base.execute(
                "SELECT 1 FROM side WHERE kind = ? AND name = ? AND tested", (kind, keys[kind])
            ).fetchone()
            if tested is not None:
                return Fault("in the test split", f"{called} is in the test split too")
        return None


def _keys_of(sample: Sample) -> dict[str, str]:
    said = clean_instruction(sample.instruction).casefold()
    return {
        "scene_id": sample.scene_id,
        "phrase_id": sample.phrase_id,
        "picture": picture_digest(sample.observation.frame),
        "words": said,
    }


def _content(proposal: Proposal) -> bytes:
    """A digest of all that a proposal holds."""
    sample = proposal.sample
    picture = picture_digest(sample.observation.frame).encode()
    bare = replace(sample, observation=Observation(picture, sample.observation.speed_mps))
    return _digest(repr(replace(proposal, sample=bare)))


def _digest(*parts: str) -> bytes:
    return hashlib.blake2b("\0".join(parts).encode(), digest_size=16).digest()
