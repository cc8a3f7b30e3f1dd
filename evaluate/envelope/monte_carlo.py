"""Monte Carlo of one vehicle: matrices and cars are drawn and driven against the limits."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from evaluate.significance import clopper_pearson
from ridetune.codec import MatrixCodec
from ridetune.control.vehicle import Vehicle
from ridetune.envelope import Box, Evidence, Limits, clamp
from ridetune.matrix import (
    NUM_PARAMETERS,
    PARAMETERS,
    STYLES,
    ControllerMatrix,
    Ranges,
    Style,
    ki_limit,
)
from ridetune.sample import Condition
from ridetune.sim.check import (
    HARD_TRIALS,
    OPEN_ROAD,
    SHORT_TURN,
    Trial,
    drive_trial,
)
from ridetune.sim.plant import Spread, draw_spread
from ridetune.sim.scenarios import Scenario

Shares = NDArray[np.float64]  # [matrix, parameter], place within the ranges on the codec's scale


@dataclass(frozen=True)
class Search:
    """Matrices of one condition by place, and what they broke: nothing, the turn or the road."""

    shares: Shares
    turn: NDArray[np.bool_]
    road: NDArray[np.bool_]


class MonteCarlo:
    """Draws matrices and cars of one vehicle and drives them against the limits."""

    def __init__(self, vehicle: Vehicle, ranges: Ranges, limits: Limits) -> None:
        self.vehicle, self.ranges, self.limits = vehicle, ranges, limits
        self.codec = MatrixCodec(ranges)
        self.whole: Box = tuple(zip(ranges.lowest, ranges.highest, strict=True))

    def draw(self, rng: np.random.Generator, box: Box, *, corners: bool = True) -> ControllerMatrix:
        """A matrix of a box, even on the codec's scale: a quarter of them at a corner of the box.

        Without corners, each value is at an end of its own for one in six instead. K_i lies below
        its rule, on it in half of the cases.
        """
        if corners and rng.uniform() < 0.25:
            at = rng.integers(0, 2, NUM_PARAMETERS).astype(float)
        elif corners:
            at = rng.uniform(size=NUM_PARAMETERS)
        else:
            at = np.clip(rng.uniform(-0.1, 1.1, NUM_PARAMETERS), 0.0, 1.0)
        values = []
        for i, ends in enumerate(box):
            low, high = (self.codec.share(end, i) for end in ends)
            values.append(self.codec.value(low + float(at[i]) * (high - low), i))
        most = min(ki_limit(values[0]), box[1][1])
        values[1] = most if rng.uniform() < 0.5 else float(rng.uniform(box[1][0], most))
        return ControllerMatrix.of(clamp(values, box))

    @property
    def whole_named(self) -> dict[str, tuple[float, float]]:
        """The ranges as a box of an Envelope."""
        return dict(zip(PARAMETERS, self.whole, strict=True))

    def style_box(self, style: Style) -> Box:
        """From minimum to maximum of a style."""
        return tuple((r.minimum, r.maximum) for r in self.ranges.styles[style])

    def breaks(self, matrix: ControllerMatrix, trial: Trial, condition: Condition) -> str | None:
        """Which limit a trial breaks, or None."""
        return drive_trial(matrix, trial, condition, self.vehicle, self.limits)

    def search(self, rng: np.random.Generator, condition: Condition, count: int) -> Search:
        """Matrices of the styles' ranges and of all together, driven through the gate's trials.

        As many of each style, so that a box which keeps many keeps what passengers ask for.
        """
        boxes = [*(self.style_box(style) for style in STYLES), self.whole]
        matrices = [self.draw(rng, boxes[i % 4], corners=False) for i in range(count)]
        broken = np.zeros((2, count), bool)
        for i, matrix in enumerate(tqdm(matrices, desc=f"search {condition}", disable=None)):
            for row, scenario in enumerate((SHORT_TURN, OPEN_ROAD)):
                broken[row, i] = any(
                    self.breaks(matrix, trial, condition)
                    for trial in HARD_TRIALS
                    if trial.scenario is scenario
                )
        return Search(self.shares(matrices), broken[0], broken[1])

    def shares(self, matrices: Sequence[ControllerMatrix]) -> Shares:
        """Places [matrix, parameter] on the codec's scale."""
        return np.array(
            [[self.codec.share(v, i) for i, v in enumerate(m.values)] for m in matrices]
        )

    def ends(self, box: Box) -> tuple[Shares, Shares]:
        """Lowest and highest shares [parameter] of a box."""
        lowest = [self.codec.share(low, i) for i, (low, _) in enumerate(box)]
        highest = [self.codec.share(high, i) for i, (_, high) in enumerate(box)]
        return np.array(lowest), np.array(highest)

    def count(
        self,
        drives: Iterable[tuple[ControllerMatrix, Scenario]],
        rng: np.random.Generator,
        condition: Condition,
    ) -> tuple[Evidence, list[ControllerMatrix]]:
        """Drive each matrix once with its own car and noise; the evidence, and what failed."""
        failed, runs = [], 0
        for matrix, scenario in drives:
            runs += 1
            trial = Trial(scenario, draw_car(rng), int(rng.integers(2**31)))
            if self.breaks(matrix, trial, condition) is not None:
                failed.append(matrix)
        return Evidence(runs, len(failed), *clopper_pearson(len(failed), runs)), failed


def draw_car(rng: np.random.Generator) -> Spread:
    """A car of the verified population; half of them stand at one of its corners."""
    if rng.uniform() < 0.5:
        return draw_spread(rng)
    ends = ((0.8, 1.2), (0.7, 1.1), (0.0, 0.15), (0.05, 0.15))
    return Spread(*(float(pair[rng.integers(2)]) for pair in ends))


def project(matrix: ControllerMatrix, box: Box) -> ControllerMatrix:
    """The nearest matrix of a box that keeps the K_i rule."""
    values = clamp(matrix.values, box)
    values[1] = min(values[1], ki_limit(values[0]))
    return ControllerMatrix.of(values)
