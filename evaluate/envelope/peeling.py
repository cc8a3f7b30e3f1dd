"""A box without violations, cut out of a search.

Steering that is too calm leaves the lane: the least W_l and the most W_s are chosen together, for
the box that keeps the most safe matrices of the search. What is left is peeled as in patient rule
induction (Friedman & Fisher 1999), the slice with the largest share of violations first: along
W_l and W_s what breaks limits in the turn, along the speed gains what breaks them on the empty
road. Simulation.
"""

import numpy as np
from numpy.typing import NDArray

from ridetune.matrix import PARAMETERS

from .monte_carlo import Search, Shares

_WL, _WS = PARAMETERS.index("W_l"), PARAMETERS.index("W_s")
# K_i has its rule instead of a face of the box; W_h changes little and is not cut.
_SPEED_GAINS = (0, 2)
# A slice holds this share of the matrices inside, and is no thinner than this on the scale.
_PEEL, _THIN = 0.06, 0.02
# Places tried for a cut on each axis, and how many safe matrices a violation outweighs.
_CUTS, _PRICE = 41, 1000.0


def peel(search: Search, inner: Shares, outer: tuple[Shares, Shares]) -> tuple[Shares, Shares]:
    """Lowest and highest shares [parameter] of a box that holds no violation of the search.

    The box keeps the place `inner` [parameter] and stays within `outer`, lowest and highest shares.
    ValueError where there is no such box.
    """
    low, high = outer[0].copy(), outer[1].copy()
    calm = _cut_calm_corner(search.shares, search.turn, inner)
    low[_WL], high[_WS] = max(low[_WL], calm[0]), min(high[_WS], calm[1])
    for broken, parameters in ((search.turn, (_WL, _WS)), (search.road, _SPEED_GAINS)):
        while True:
            inside = ((search.shares >= low) & (search.shares <= high)).all(axis=1)
            if not (inside & broken).any():
                break
            faces = [(i, end) for i in parameters for end in (low, high)]
            cuts = [_slice(search.shares[inside], broken[inside], i, low, end) for i, end in faces]
            allowed = [
                share if (at <= inner[i] if end is low else at >= inner[i]) else -1.0
                for (share, at), (i, end) in zip(cuts, faces, strict=True)
            ]
            best = int(np.argmax(allowed))
            if allowed[best] < 0.0:
                raise ValueError("no box around the default matrix is free of violations")
            i, end = faces[best]
            end[i] = cuts[best][1]
        if not inside.any():
            raise ValueError("no box around the default matrix is free of violations")
    return low, high


def _cut_calm_corner(
    shares: Shares, broken: NDArray[np.bool_], inner: Shares
) -> tuple[float, float]:
    """Least share of W_l and most of W_s, together, that keep the most of the fewest violations.

    Violations that other corners cause stay inside in any case and are peeled afterwards.
    """
    best = (-np.inf, 0.0, 1.0)
    for least in np.linspace(0.0, float(inner[_WL]), _CUTS):
        for most in np.linspace(1.0, float(inner[_WS]), _CUTS):
            inside = (shares[:, _WL] >= least) & (shares[:, _WS] <= most)
            worth = float((inside & ~broken).sum() - _PRICE * (inside & broken).sum())
            if worth > best[0]:
                best = (worth, float(least), float(most))
    return best[1], best[2]


def _slice(
    shares: Shares, broken: NDArray[np.bool_], i: int, low: Shares, end: Shares
) -> tuple[float, float]:
    """The slice off one face of parameter i: its share of violations, and where it ends."""
    places = shares[:, i]
    if end is low:
        at = max(float(np.quantile(places, _PEEL)), float(end[i]) + _THIN)
        return float(broken[places < at].sum()) / max(int((places < at).sum()), 1), at
    at = min(float(np.quantile(places, 1.0 - _PEEL)), float(end[i]) - _THIN)
    return float(broken[places > at].sum()) / max(int((places > at).sum()), 1), at
