"""Asks an OpenAI-compatible endpoint about pairs: a few at once, and again after what may pass.

    frame + words -> messages -> cache, or POST and retries -> Reply -> Answer or Refusal

StoppedError ends the run: no request starts any more, and those on their way are waited for.
"""

import hashlib
import json
import logging
import random
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Self

import httpx

from ridetune.sample import Sample
from ridetune.vision import FrameError

from .answers import (
    Answer,
    Messages,
    Refusal,
    first_messages,
    parse_answer,
    repair_messages,
    shrink,
)
from .config import AskConfig, completions_url, read_key
from .ledger import Ledger
from .replies import Reply, keep_reply, pause_asked, read_completion, read_reply

LONGEST_PAUSE_S = 300.0  # an endpoint that asks for more ends the run

_QUOTED_CHARACTERS = 200  # of what an endpoint says in a refusal
# What an endpoint says to every request alike.
_REMEDIES = {
    401: "it refuses the key; check api_key_file={config.api_key_file}",
    404: "there is nothing to ask; check base_url (it often ends in /v1) and model={config.model}",
}

log = logging.getLogger(__name__)


class StoppedError(ValueError):
    """The run cannot go on; the message says why and what to do."""


class LimitReachedError(StoppedError):
    """The run may not cost more."""


@dataclass(frozen=True)
class Failure:
    """A request that may succeed later; pause_s: what the endpoint asks to wait."""

    reason: str
    pause_s: float = 0.0


class ModelAnnotator:
    """Asks the endpoint about pairs, a few at once; a context that ends what still runs."""

    def __init__(self, config: AskConfig) -> None:
        self._config = config
        self._url = completions_url(config)
        self._key = read_key(config.api_key_file)
        headers = {"Content-Type": "application/json"}
        if self._key:
            headers["Authorization"] = f"Bearer {self._key}"
        self._client = httpx.Client(headers=headers, timeout=config.timeout_s)
        self._pool = ThreadPoolExecutor(config.max_concurrent)
        self._ended = threading.Event()
        self.why_ended: StoppedError | None = None
        self.ledger = Ledger(config)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end(StoppedError("the run was ended"))
        self._pool.shutdown(cancel_futures=True)  # waits for answers that are on their way
        self._client.close()

    def annotate_all(self, samples: Sequence[Sample]) -> Iterator[Answer | Refusal | None]:
        """The outcome of each pair, in order; None for those that the end of the run left out."""
        asked = [
            self._pool.submit(self.annotate, s.observation.frame, s.instruction) for s in samples
        ]
        for outcome in asked:
            try:
                yield outcome.result()
            except StoppedError:
                yield None

    def annotate(self, picture_bytes: bytes, instruction: str) -> Answer | Refusal:
        """The model's answer about a JPEG or PNG and the words to it, or why there is none.

        A wrong answer is sent back once. StoppedError where the endpoint cannot be used or the
        money is spent.
        """
        try:
            jpeg = shrink(picture_bytes)
        except FrameError as error:
            return Refusal(str(error))
        messages = first_messages(self._config.prompt, jpeg, instruction)
        outcome, text, fresh = self._answer(messages)
        if isinstance(outcome, Refusal) and text is not None:
            messages = repair_messages(messages, text, outcome.reason)
            outcome, text, again = self._answer(messages)
            fresh = fresh or again
            if isinstance(outcome, Answer):
                self.ledger.count("repaired")
            elif text is not None:
                outcome = Refusal(f"unusable twice: {outcome.reason}")
        if fresh:
            self._note(outcome)
        return outcome

    def _note(self, outcome: Answer | Refusal) -> None:
        """Give up after too many pairs in a row without an answer."""
        failures = self.ledger.failures_in_a_row(outcome)
        if isinstance(outcome, Refusal) and failures >= self._config.give_up_after:
            why = f"gave up: {failures} pairs in a row got no usable answer from"
            self._end(
                StoppedError(
                    f"{why} {self._config.base_url}, the last: {outcome.reason}; check model, "
                    "prompt and options, or raise give_up_after"
                )
            )

    def _answer(self, messages: Messages) -> tuple[Answer | Refusal, str | None, bool]:
        """The outcome, the text where one came, and whether it was asked for just now."""
        body = {**self._config.options, "model": self._config.model, "messages": messages}
        sent = json.dumps(body, sort_keys=True).encode()
        digest = hashlib.sha256(self._url.encode() + b"\n" + sent).hexdigest()
        place = self._config.cache / digest[:2] / f"{digest}.json"
        kept = read_reply(place)
        reply = kept or self._request(sent)
        if isinstance(reply, Refusal):
            return reply, None, True
        if kept:
            self.ledger.count("replies from the cache")
        else:
            keep_reply(reply, place)
        return parse_answer(reply.text), reply.text, kept is None

    def _request(self, sent: bytes) -> Reply | Refusal:
        """A reply, after as many attempts as it takes and may take."""
        attempts, failure = self._config.attempts, Failure("")
        for attempt in range(attempts):
            if attempt:
                self._pause(failure, attempt - 1)
            if self.why_ended:
                raise self.why_ended
            if not self.ledger.reserve():
                raise self._end(LimitReachedError(f"max_cost={self._config.max_cost} is reached"))
            outcome: Reply | Refusal | Failure | None = None
            try:
                outcome = self._post(sent)
            finally:
                self.ledger.settle(outcome if isinstance(outcome, Reply) else None)
            if not isinstance(outcome, Failure):
                return outcome
            failure = outcome
            log.info("failed attempt=%d of=%d reason=%s", attempt + 1, attempts, failure.reason)
        return Refusal(f"{failure.reason}, in each of {attempts} attempts")

    def _post(self, sent: bytes) -> Reply | Refusal | Failure:
        """One attempt; StoppedError where no other request can succeed either."""
        try:
            response = self._client.post(self._url, content=sent)
        except httpx.TimeoutException:
            return Failure(f"no answer within timeout_s={self._config.timeout_s}")
        except httpx.ConnectError as error:
            why = f"cannot reach {self._config.base_url} ({error}); check that a server runs there"
            raise self._end(StoppedError(f"{why}, and base_url")) from error
        except httpx.RequestError as error:
            return Failure(f"the connection broke: {error}")
        return self._read(response)

    def _read(self, response: httpx.Response) -> Reply | Refusal | Failure:
        """What a response amounts to, without the key; StoppedError as above."""
        config, said = self._config, response.text
        if self._key:
            said = said.replace(self._key, "***")
        if response.status_code in _REMEDIES:
            remedy = _REMEDIES[response.status_code].format(config=config)
            raise self._end(
                StoppedError(f"{config.base_url} answers {response.status_code}: {remedy}")
            )
        if response.status_code == 429 or response.status_code >= 500:
            return Failure(f"status {response.status_code}", pause_asked(response.headers))
        if not response.is_success:
            return Refusal(f"status {response.status_code}: {said[:_QUOTED_CHARACTERS]!r}")
        reply = read_completion(said)
        if isinstance(reply, Reply) and reply.tokens_in is None and self.ledger.limited:
            why = f"{config.base_url} counts no tokens, so max_cost cannot be kept"
            raise self._end(StoppedError(f"{why}; set the prices to 0, or max_cost=null"))
        return reply

    def _pause(self, failure: Failure, attempt: int) -> None:
        """Wait as long as asked, and longer each time; the jitter keeps requests apart."""
        if failure.pause_s > LONGEST_PAUSE_S:
            why = f"{self._config.base_url} asks to wait {failure.pause_s:.0f} s"
            raise self._end(StoppedError(f"{why} ({failure.reason}); run again then"))
        grown = min(self._config.backoff_s * 2**attempt, LONGEST_PAUSE_S)
        self._ended.wait(failure.pause_s + grown * random.uniform(0.5, 1.0))

    def _end(self, why: StoppedError) -> StoppedError:
        """Let no further request start; the first reason stands."""
        self.why_ended = self.why_ended or why
        self._ended.set()
        return self.why_ended
