"""Cohen's kappa: how far two annotators agree beyond chance.

Source: J. Cohen, A coefficient of agreement for nominal scales, Educational and Psychological
Measurement 20, 1960.
"""

from collections import Counter
from collections.abc import Sequence


def cohens_kappa(pairs: Sequence[tuple[str, str]]) -> float | None:
    """Agreement of two annotators beyond chance: (p_o - p_e) / (1 - p_e), Cohen 1960, Eq. 1.

    p_o: share of pairs that agree; p_e: share expected of each one's own frequencies. None where
    it is undefined: no pairs, or both always say the same one thing.
    """
    if not pairs:
        return None
    first, second = (Counter(labels) for labels in zip(*pairs, strict=True))
    observed = sum(one == other for one, other in pairs) / len(pairs)
    chance = sum(first[label] * second[label] for label in first) / len(pairs) ** 2
    return None if chance == 1 else (observed - chance) / (1 - chance)
