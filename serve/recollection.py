"""What the server remembers of its passengers: recalled before a decision, added after feedback.

question with a passenger -> recall -> the newest drives, for the prompt
decision                  -> hold   -> in memory, until feedback comes
feedback on it            -> remember -> one entry, on the disk -> acknowledged
"""

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

from ridetune.codec import MatrixCodec
from ridetune.memory import PassengerMemory
from ridetune.memory_entry import Entry
from ridetune.prompt import MAX_MEMORIES
from ridetune.sample import Condition, Memory

from .wire import EntryOut, FeedbackIn, PassengerOut, RequestError, rows

NUM_HELD = 512
_LOOK_BACK = 32  # entries that are looked through for ones within this bundle's envelope
_log = logging.getLogger(__name__)
Found = TypeVar("Found")


@dataclass(frozen=True)
class Recalled:
    """Entries for a prompt, the newest first; private: nothing personal may be written."""

    entries: tuple[Entry, ...] = ()
    private: bool = False


@dataclass(frozen=True)
class Held:
    """A decision that waits for feedback; drive, whose feedback is empty, is None if private."""

    passenger: str
    drive: Memory | None
    condition: Condition | None
    session: str


class Recollection:
    """The passengers' memory, or none, and the last decisions; lives on the event loop.

    RequestError 404 where there is no memory, 503 where its file or its disk fails.
    """

    def __init__(self, memory: PassengerMemory | None, codec: MatrixCodec, bundle: str) -> None:
        self._memory = memory
        self._codec = codec
        self._bundle = bundle
        self._held: OrderedDict[str, Held] = OrderedDict()

    async def recall(self, passenger: str, *, within_s: float) -> Recalled:
        """What a passenger's decision is shown; nothing if the memory fails or is late [s]."""
        if self._memory is None or not passenger:
            return Recalled()
        try:
            async with asyncio.timeout(within_s):
                return await asyncio.to_thread(self._recall, self._memory, passenger)
        except (OSError, ValueError) as error:  # a TimeoutError is an OSError
            _log.warning("event=no_recall error=%s: decides without it", type(error).__name__)
            return Recalled(private=True)  # it is not known whether it is

    def hold(self, decision: str, held: Held) -> None:
        """Keep a decision for its feedback; the oldest goes."""
        if self._memory is None:
            return
        self._held[decision] = held
        if len(self._held) > NUM_HELD:
            self._held.popitem(last=False)

    async def remember(self, said: FeedbackIn) -> int | None:
        """Write the entry of a decision and its feedback; its number once it is on the disk.

        None in privacy mode, then or at the decision. RequestError 404 for a decision that is not
        held, or that is another passenger's.
        """
        memory = self._on()
        held = self._held.get(said.decision)
        if held is None or held.passenger not in ("", said.passenger):
            raise RequestError(
                404,
                f"no such decision of this passenger among the last {NUM_HELD} of this server; "
                "give feedback on a later one",
            )
        if held.drive is None:
            return None
        # Whoever speaks first has taken the drive: its words are never another passenger's.
        self._held[said.decision] = replace(held, passenger=said.passenger)
        drive = replace(held.drive, feedback=said.feedback)
        entry = await _in_thread(
            lambda: memory.add(
                said.passenger,
                drive,
                condition=held.condition,
                session=held.session,
                bundle=self._bundle,
            )
        )
        return None if entry is None else entry.number

    async def profile(self, passenger: str) -> bytes:
        """All that is kept about a passenger, as the JSON of a PassengerOut."""
        memory = self._on()
        return await _in_thread(lambda: _profile(memory, passenger))

    async def erase(self, passenger: str) -> int:
        """Remove all of a passenger without a trace; how many entries there were."""
        memory = self._on()
        theirs = [key for key, held in self._held.items() if held.passenger == passenger]
        for key in theirs:
            del self._held[key]
        return await _in_thread(lambda: memory.erase(passenger))

    async def set_privacy(self, passenger: str, on: bool) -> None:
        """Privacy mode on or off."""
        memory = self._on()
        await _in_thread(lambda: memory.set_privacy(passenger, on))

    async def retire(self) -> None:
        """Remove what is older than the retention; where that fails it is said and tried later."""
        if self._memory is None:
            return
        try:
            num_entries = await asyncio.to_thread(self._memory.retire)
        except (OSError, ValueError) as error:
            _log.warning("event=not_retired reason=%r", str(error))
            return
        _log.info("event=retired num_entries=%s", num_entries)

    def _on(self) -> PassengerMemory:
        if self._memory is None:
            raise RequestError(
                404, "this server keeps no memory of passengers; start it with memory=<folder>"
            )
        return self._memory

    def _recall(self, memory: PassengerMemory, passenger: str) -> Recalled:
        newest = memory.newest(passenger, _LOOK_BACK)
        fitting = tuple(entry for entry in newest if self._fits(entry))[:MAX_MEMORIES]
        return Recalled(fitting, memory.is_private(passenger))

    def _fits(self, entry: Entry) -> bool:
        try:
            self._codec.encode(entry.memory.matrix)
        except ValueError:
            return False
        return True


async def _in_thread(call: Callable[[], Found]) -> Found:
    try:
        return await asyncio.to_thread(call)
    except (OSError, ValueError) as error:
        _log.warning("event=memory_failed error=%s", type(error).__name__)
        sentence = f"the passengers' memory failed: {error}"
        raise RequestError(503, sentence, quotes=True) from error


def _profile(memory: PassengerMemory, passenger: str) -> bytes:
    entries = [
        EntryOut(
            number=entry.number,
            time=entry.time,
            instruction=entry.memory.instruction,
            scene=entry.memory.scene,
            matrix=rows(entry.memory.matrix),
            feedback=entry.memory.feedback,
            condition=entry.condition,
            session=entry.session,
            bundle=entry.bundle,
        )
        for entry in memory.entries(passenger)
    ]
    private = memory.is_private(passenger)
    out = PassengerOut(count=len(entries), private=private, entries=entries)
    return out.model_dump_json().encode()
