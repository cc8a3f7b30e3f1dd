"""The shipped car and its ranges, and how the tests of the simulation drive it."""

from pathlib import Path

from ridetune.control.vehicle import Vehicle
from ridetune.matrix import ControllerMatrix, Ranges, Style
from ridetune.sample import Condition
from ridetune.sim.rollout import Rollout, rollout
from ridetune.sim.scenarios import Scenario

VEHICLE = Vehicle.load(Path("configs/vehicle.yaml"))
RANGES = Ranges.load(Path("configs/ranges.yaml"))
DEFAULT = RANGES.default


def middle(style: Style) -> ControllerMatrix:
    """The middle of each parameter's full-score range."""
    return ControllerMatrix.of([(r.lower + r.upper) / 2 for r in RANGES.styles[style]])


def run(
    matrix: ControllerMatrix, scenario: Scenario, condition: Condition = "sunny", seed: int = 0
) -> Rollout:
    """A run of the shipped car."""
    return rollout(matrix, scenario, condition, vehicle=VEHICLE, seed=seed)
