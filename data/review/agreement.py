"""How well first and second opinions agree: Cohen's kappa on styles, ICC(2,1) on each value.

Source of ICC: P. Shrout and J. Fleiss, Intraclass correlations: uses in assessing rater
reliability, Psychological Bulletin 86, 1979. "First" and "second" are places in time: with more
than two annotators a place is held by several people, whose own habits it then averages.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ridetune.matrix import NUM_PARAMETERS, STYLES

from ..kappa import cohens_kappa
from .settle import difference
from .store import Review


@dataclass(frozen=True)
class Agreement:
    """What pairs of opinions amount to.

    pairs: proposals with two opinions. kept: of these, what neither rejects; the scores are over
    them. styles: how often the first [row] and the second [column] gave which style. icc: of each
    value. None where a score is not defined: too few pairs, or nothing that differs.
    """

    pairs: int
    both_rejected: int
    one_rejected: int
    kept: int
    disputed: int
    styles: tuple[tuple[int, ...], ...]
    kappa: float | None
    icc: tuple[float | None, ...]


def measure(opinions: Iterable[Sequence[Review]]) -> Agreement:
    """The agreement of the first two opinions on each proposal."""
    pairs = [(said[0], said[1]) for said in opinions if len(said) > 1]
    rejections = [sum(o.action == "reject" for o in pair) for pair in pairs]
    kept = [pair for pair, count in zip(pairs, rejections, strict=True) if not count]
    table = [[0] * len(STYLES) for _ in STYLES]
    for first, second in kept:
        table[STYLES.index(first.style)][STYLES.index(second.style)] += 1
    values = np.array([[o.values for o in pair] for pair in kept], dtype=np.float64)
    values = values.reshape(len(kept), 2, NUM_PARAMETERS)  # also where there are none
    return Agreement(
        pairs=len(pairs),
        both_rejected=rejections.count(2),
        one_rejected=rejections.count(1),
        kept=len(kept),
        disputed=sum(difference(pair) is not None for pair in pairs),
        styles=tuple(tuple(row) for row in table),
        kappa=cohens_kappa([(first.style, second.style) for first, second in kept]),
        icc=tuple(icc_2_1(values[:, :, i]) for i in range(NUM_PARAMETERS)),
    )


def icc_2_1(ratings: NDArray[np.float64]) -> float | None:
    """ICC(2,1) of ratings [target, judge]: two-way random, one judge, absolute agreement.

    (BMS - EMS) / (BMS + (k - 1) EMS + k (JMS - EMS) / n), with BMS, JMS and EMS the mean squares
    between targets, between judges and of the residue, n targets and k judges (Shrout and Fleiss
    1979, p. 423). None for fewer than two targets, or where all ratings are equal.
    """
    n, k = ratings.shape
    if n < 2 or not np.ptp(ratings):
        return None
    mean, of_targets, of_judges = ratings.mean(), ratings.mean(axis=1), ratings.mean(axis=0)
    bms = k * ((of_targets - mean) ** 2).sum() / (n - 1)
    jms = n * ((of_judges - mean) ** 2).sum() / (k - 1)
    residue = ratings - of_targets[:, None] - of_judges[None] + mean
    ems = (residue**2).sum() / ((n - 1) * (k - 1))
    whole = bms + (k - 1) * ems + k * (jms - ems) / n
    return float((bms - ems) / whole) if whole > 0.0 else None
