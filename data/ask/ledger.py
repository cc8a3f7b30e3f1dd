"""What the requests of a run took and cost, and whether one more may be made."""

import threading
from collections import Counter

from .answers import Answer, Refusal
from .config import AskConfig
from .replies import Reply

ASSUMED_TOKENS = (2000, 300)  # of a request and its answer, until the first one has come


class Ledger:
    """What was asked and what it cost; several threads may write. Costs in the prices' currency."""

    def __init__(self, config: AskConfig) -> None:
        self.counts: Counter[str] = Counter()
        self._prices = (config.input_price / 1e6, config.output_price / 1e6)
        self._max_cost = config.max_cost
        self._open = 0
        self._dearest: float | None = None
        self._in_a_row = 0
        self._lock = threading.Lock()

    @property
    def cost(self) -> float:
        """Of all counted tokens."""
        return self._cost_of(self.counts["tokens in"], self.counts["tokens out"])

    @property
    def limited(self) -> bool:
        """Whether a request could break the limit."""
        return self._max_cost is not None and any(self._prices)

    def count(self, what: str) -> None:
        """One more of something."""
        with self._lock:
            self.counts[what] += 1

    def failures_in_a_row(self, outcome: Answer | Refusal) -> int:
        """Pairs since the last answer, with this one, in the order in which they end."""
        with self._lock:
            self._in_a_row = 0 if isinstance(outcome, Answer) else self._in_a_row + 1
            return self._in_a_row

    def reserve(self) -> bool:
        """Whether one more request may be made; it is taken to cost as the dearest so far."""
        with self._lock:
            dearest = self._cost_of(*ASSUMED_TOKENS) if self._dearest is None else self._dearest
            bound = self.cost + (self._open + 1) * dearest
            if self._max_cost is not None and bound > self._max_cost:
                return False
            self._open += 1
            self.counts["requests"] += 1
            return True

    def settle(self, reply: Reply | None) -> None:
        """End of a reserved request, with the reply that it brought."""
        with self._lock:
            self._open -= 1
            if reply is None or reply.tokens_in is None or reply.tokens_out is None:
                self.counts["requests without a count of tokens"] += 1
                return
            self.counts["tokens in"] += reply.tokens_in
            self.counts["tokens out"] += reply.tokens_out
            cost = self._cost_of(reply.tokens_in, reply.tokens_out)
            self._dearest = max(self._dearest or 0.0, cost)

    def _cost_of(self, tokens_in: int, tokens_out: int) -> float:
        return tokens_in * self._prices[0] + tokens_out * self._prices[1]
