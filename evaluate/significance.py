"""Exact statistics of counts: an interval for a share, and a test that two shares differ."""

import math
from collections.abc import Callable

# Bisection steps: what is sought in [0, 1] to within 1e-15.
_STEPS = 50
# Two tables are equally likely if their probabilities differ by rounding alone.
_ROUNDING = 1e-7


def clopper_pearson(events: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """The exact two-sided interval for a share (Clopper & Pearson 1934).

    The lower end is the share at which as many events or more have probability alpha / 2, the
    upper end the one at which as many or fewer have it. Assumes independent trials. Raises
    ValueError where the counts are impossible.
    """
    if not 0 <= events <= trials or trials < 1:
        raise ValueError(f"{events} events in {trials} trials are impossible")
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if events == 0 else solve(lambda p: 1 - _at_most(events - 1, trials, p), tail)
    high = 1.0 if events == trials else solve(lambda p: 1 - _at_most(events, trials, p), 1 - tail)
    return low, high


def fisher_exact(events: int, trials: int, other_events: int, other_trials: int) -> float:
    """Two-sided p that two shares are equal (Fisher's exact test).

    The sum over all tables with the same margins that are no more likely than the observed one.
    Raises ValueError where the counts are impossible.
    """
    if not (0 <= events <= trials and 0 <= other_events <= other_trials):
        raise ValueError(
            f"{events} of {trials} against {other_events} of {other_trials} is impossible"
        )
    total = events + other_events
    every = range(max(0, total - other_trials), min(trials, total) + 1)
    whole = _log_choose(trials + other_trials, total)
    likely = {
        k: math.exp(_log_choose(trials, k) + _log_choose(other_trials, total - k) - whole)
        for k in every
    }
    limit = likely[events] * (1.0 + _ROUNDING)
    return min(1.0, math.fsum(p for p in likely.values() if p <= limit))


def _at_most(events: int, trials: int, share: float) -> float:
    """The binomial probability of `events` or fewer."""
    if share in (0.0, 1.0):
        return 1.0 if share == 0.0 or events >= trials else 0.0
    yes, no = math.log(share), math.log1p(-share)
    return min(
        1.0,
        math.fsum(
            math.exp(_log_choose(trials, k) + k * yes + (trials - k) * no)
            for k in range(events + 1)
        ),
    )


def solve(
    rising: Callable[[float], float], target: float, *, low: float = 0.0, high: float = 1.0
) -> float:
    """Where a rising function on [low, high] meets the target, by bisection."""
    for _ in range(_STEPS):
        middle = (low + high) / 2.0
        low, high = (middle, high) if rising(middle) < target else (low, middle)
    return (low + high) / 2.0


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
