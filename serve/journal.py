"""The audit log as the server's routes write it: off the event loop, and never unnoticed.

decision -> write -> on the disk -> answer;  not on the disk -> no new matrix
anything else -> note -> on the disk, or a warning -> answer
"""

import asyncio
import logging
from datetime import datetime

from .audit.events import Event
from .audit.log import AuditLog, LogStoppedError

_log = logging.getLogger(__name__)


class UnrecordedError(RuntimeError):
    """The event is not in the audit log; the message says why."""


class Journal:
    """A log, or none where nothing is recorded; fault: why the last event is not in it, or None."""

    def __init__(self, log: AuditLog | None) -> None:
        self._audit = log
        self.fault: str | None = None

    async def write(self, event: Event) -> None:
        """Return when the event is on the disk; UnrecordedError if it is not."""
        if self._audit is None:
            return
        try:
            await asyncio.to_thread(self._audit.append, event)
        except (LogStoppedError, ValueError) as error:
            self.fault = str(error)
            raise UnrecordedError(self.fault) from error
        self.fault = None

    async def note(self, event: Event) -> None:
        """As `write`, but where it fails that is only said: no matrix depends on this event."""
        try:
            await self.write(event)
        except UnrecordedError as error:
            _log.warning("event=unrecorded kind=%s reason=%r", event.kind, str(error))

    async def prune(self, before: datetime) -> None:
        """Delete what is older, file by file; where that fails it is said and tried later."""
        if self._audit is None:
            return
        try:
            num_lines = await asyncio.to_thread(self._audit.prune, before)
        except (OSError, ValueError) as error:
            _log.warning("event=not_pruned reason=%r", str(error))
            return
        _log.info("event=pruned num_lines=%s", num_lines)
