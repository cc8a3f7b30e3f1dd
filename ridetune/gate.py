"""The safety gate: a proposed matrix in, the matrix that the car may run and the reasons out.

    format     six finite numbers                                     else refused
    bounds     every value within the vehicle's ranges                else refused
    context    every value within what is verified for the condition, else moved to its edge
               or for all of them where it is not known
    coupling   K_i <= K_p^2 / 8, no overshoot of the speed loop       else K_i is lowered
    slew       one decision moves a parameter by at most a share      else the step is shortened
               of its range, on the codec's scale
    context, coupling   once more, for what the slew held back: these outrank it
    check      the matrix drives a few hard trials in simulation      else refused

A refusal keeps the last safe matrix, moved into the context's box where the condition has changed.
Nothing raises out of `SafetyGate.judge`. Without an envelope the ranges are the only box, without a
check nothing is driven; the server builds its gate with both.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Literal

import numpy as np

from ridetune.codec import MatrixCodec
from ridetune.envelope import Box, Envelope, clamp
from ridetune.matrix import NUM_PARAMETERS, PARAMETERS, ControllerMatrix, Ranges, ki_limit
from ridetune.sample import CONDITIONS, Condition

Outcome = Literal["accepted", "limited", "refused"]
# Why a matrix must not be run in a condition (None: not known), or None if it may.
Check = Callable[[ControllerMatrix, Condition | None], str | None]

_KI = PARAMETERS.index("K_i")
# Steps that exceed the slew limit by rounding only are no steps too large.
_ROUNDING = 1e-9
_KEPT = "the last safe matrix stays"


@dataclass(frozen=True)
class Verdict:
    """What the gate says of a proposal; `matrix` is what the car may run."""

    outcome: Outcome
    matrix: ControllerMatrix
    reasons: tuple[str, ...]


class SafetyGate:
    """Judges proposals for one vehicle; it holds no state, the caller keeps the last safe matrix.

    Raises ValueError when it is made if the vehicle's certified default is itself not safe. That
    also runs the check once per condition, so that it is compiled before the first proposal.
    """

    def __init__(
        self,
        ranges: Ranges,
        codec: MatrixCodec,
        *,
        envelope: Envelope | None = None,
        check: Check | None = None,
    ) -> None:
        self._ranges = ranges
        self._codec = codec
        self._check = check
        self._bounds: Box = tuple(zip(ranges.lowest, ranges.highest, strict=True))
        contexts: tuple[Condition | None, ...] = (*CONDITIONS, None)
        self._boxes = {c: envelope.box(c) if envelope else self._bounds for c in contexts}
        default = ranges.default.values
        fault = self._fault(default)
        for context, box in self._boxes.items():
            fault = fault or _outside(default, box) or self._drive(default, context)
            if fault is not None:
                raise ValueError(f"the default matrix of {ranges.vehicle} is not safe: {fault}")

    def judge(
        self, proposal: object, last_safe: object, condition: Condition | None = None
    ) -> Verdict:
        """Check any object as a proposal; never raises.

        A matrix is a ControllerMatrix, six numbers or two rows of three. A `last_safe` that is
        not safe itself is replaced by the vehicle's certified default. condition: of the road
        now; None, or anything that is no condition, means that it is not known.
        """
        known = isinstance(condition, str) and condition in CONDITIONS
        context: Condition | None = condition if known else None
        reasons: list[str] = []
        kept = self._keep(last_safe, context, reasons)
        asked = _read(proposal)
        fault = asked if isinstance(asked, str) else _outside(asked, self._bounds)
        if isinstance(asked, str) or fault is not None:
            return _refuse(kept, [*reasons, f"{fault}; {_KEPT}"])
        limited: list[str] = []
        values = self._confine(asked, context, limited)
        values = self._slew(values, kept, limited)
        values = self._confine(values, context, limited)
        if values[_KI] < self._boxes[context][_KI][0]:
            fault = f"no K_i of this vehicle is small enough for K_p = {_say(values[0])}"
        else:
            fault = self._drive(values, context)
        if fault is not None:
            return _refuse(kept, [*reasons, *limited, f"{fault}; {_KEPT}"])
        outcome: Outcome = "limited" if limited else "accepted"
        return Verdict(outcome, ControllerMatrix.of(values), (*reasons, *limited))

    def _keep(
        self, last_safe: object, context: Condition | None, reasons: list[str]
    ) -> list[float]:
        """What the car runs if the proposal is refused."""
        kept = _read(last_safe)
        if isinstance(kept, str) or self._fault(kept) is not None:
            reasons.append("the last matrix was not a safe one, the default takes its place")
            return list(self._ranges.default.values)
        moved: list[str] = []
        values = self._confine(kept, context, moved)
        reasons.extend(f"the last matrix, before this proposal: {reason}" for reason in moved)
        return values

    def _confine(
        self, values: Sequence[float], context: Condition | None, reasons: list[str]
    ) -> list[float]:
        """The nearest values in the context's box, with K_i below its coupling."""
        confined = clamp(values, self._boxes[context])
        where = f"for {context}" if context else "for every condition"
        reasons.extend(
            f"{name} moves from {_say(value)} to {_say(inside)}: no further is verified {where}"
            for name, value, inside in zip(PARAMETERS, values, confined, strict=True)
            if value != inside
        )
        return self._couple(confined, reasons)

    def _drive(self, values: Sequence[float], context: Condition | None) -> str | None:
        """What the rollout check finds; a check that fails to answer counts as a violation."""
        if self._check is None:
            return None
        try:
            return self._check(ControllerMatrix.of(values), context)
        # Nothing raises out of the gate, whatever a simulation does.
        except Exception as error:  # noqa: BLE001
            return f"the rollout check gave no answer ({type(error).__name__})"

    def _fault(self, values: Sequence[float]) -> str | None:
        """Why a matrix may not be run as it is, or None if it may."""
        outside = _outside(values, self._bounds)
        if outside is None and not values[_KI] <= ki_limit(values[0]):
            return f"K_i = {_say(values[_KI])} is above K_p^2/8 = {_say(ki_limit(values[0]))}"
        return outside

    def _couple(self, values: Sequence[float], reasons: list[str]) -> list[float]:
        limit = ki_limit(values[0])
        coupled = list(values)
        if values[_KI] > limit:
            coupled[_KI] = limit
            reasons.append(
                f"K_i is lowered from {_say(values[_KI])} to {_say(limit)}: with "
                f"K_p = {_say(values[0])} the speed would overshoot above that (K_p^2/8)"
            )
        return coupled

    def _slew(
        self, values: Sequence[float], kept: Sequence[float], reasons: list[str]
    ) -> list[float]:
        limited = list(values)
        largest = self._ranges.slew
        for i, (value, last, (low, high)) in enumerate(
            zip(values, kept, self._bounds, strict=True)
        ):
            if low == high:
                continue
            start = self._codec.share(last, i)
            step = self._codec.share(value, i) - start
            if abs(step) <= largest + _ROUNDING:
                continue
            limited[i] = self._codec.value(start + math.copysign(largest, step), i)
            reasons.append(
                f"{PARAMETERS[i]} moves from {_say(last)} to {_say(limited[i])} instead of "
                f"{_say(value)}: at most {largest:.0%} of its range in one decision"
            )
        return limited


def _outside(values: Sequence[float], box: Box) -> str | None:
    faults = [
        f"{name} = {_say(value)} lies outside {_say(low)} to {_say(high)}"
        for name, value, (low, high) in zip(PARAMETERS, values, box, strict=True)
        if not low <= value <= high
    ]
    return ", ".join(faults) or None


def _refuse(kept: Sequence[float], reasons: Sequence[str]) -> Verdict:
    return Verdict("refused", ControllerMatrix.of(kept), tuple(reasons))


def _read(matrix: object) -> tuple[float, ...] | str:
    """The six numbers of any object, or what is wrong with it."""
    try:
        return _numbers(matrix)
    # The object is foreign and its methods may do anything; the answer is always a refusal.
    except Exception as error:  # noqa: BLE001
        return f"the proposal cannot be read as a matrix ({type(error).__name__})"


def _numbers(matrix: object) -> tuple[float, ...] | str:
    items: object = matrix.values if isinstance(matrix, ControllerMatrix) else matrix
    if not isinstance(items, (list, tuple, np.ndarray)):
        return f"the proposal is not a matrix but {type(items).__name__}"
    cells = list(items)
    if len(cells) == 2:
        if any(not isinstance(row, (list, tuple, np.ndarray)) or len(row) != 3 for row in cells):
            return "the proposal is not two rows of three numbers"
        cells = [cell for row in cells for cell in row]
    if len(cells) != NUM_PARAMETERS:
        return f"the proposal has {len(cells)} values instead of {NUM_PARAMETERS}"
    numbers = []
    for name, cell in zip(PARAMETERS, cells, strict=True):
        if isinstance(cell, bool) or not isinstance(cell, Real):
            return f"{name} is not a number but {type(cell).__name__}"
        number = float(cell)
        if not math.isfinite(number):
            return f"{name} is not a finite number"
        numbers.append(number)
    return tuple(numbers)


def _say(value: float) -> str:
    return f"{value:.4g}"
