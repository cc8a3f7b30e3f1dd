"""The drives that the page shows: the middle of each style and the default, in the simulation.

Ranges and a vehicle in, drives and rows of Table 1 out. No model takes part: the matrices are the
middles of the styles' ranges, made a little calmer in bad weather for the oracle, as a passenger
of `ridetune.sim.passengers` would want it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from ridetune.alignment import command_alignment, scenario_alignment
from ridetune.codec import MatrixCodec
from ridetune.control.tracker import PERIOD_S
from ridetune.control.vehicle import Vehicle
from ridetune.matrix import STYLES, ControllerMatrix, Style
from ridetune.sample import CONDITIONS, Condition
from ridetune.sim.metrics import DriveMetrics, measure
from ridetune.sim.passengers import WISHES, Priors, matrix_of_taste
from ridetune.sim.rollout import rollout, rollout_batch
from ridetune.sim.scenarios import SCENARIOS
from ridetune.sim.trajectory import Trajectory

from .driving_score import (
    MANOEUVRES,
    DrivingScoreConfig,
    Manoeuvre,
    TenMetrics,
    mean_driving_score,
    mean_metrics,
    ten_metrics,
)

Signals = Mapping[str, NDArray[np.float64]]  # [row] by name, NaN behind an early end
# What the page draws of a drive, beside `felt_lateral_mps2`.
SHOWN = ("x_m", "y_m", "heading_rad", "speed_mps", "acceleration_mps2", "steer_rad")
# What a line of the page is called: a style, or the vehicle's default matrix.
DEFAULT = "default"
NAMES: tuple[str, ...] = (*STYLES, DEFAULT)


# Every so many control steps a row of a drive is shown.
EVERY = 4
FRAME_S = EVERY * PERIOD_S


@dataclass(frozen=True)
class StyleDrive:
    """One drive of the page and the matrix that it was driven with."""

    matrix: ControllerMatrix
    trajectory: Trajectory
    metrics: DriveMetrics
    status: str

    @property
    def signals(self) -> Signals:
        """What is shown of it, a row every FRAME_S."""
        drive = self.trajectory
        shown = {name: drive[name][::EVERY] for name in SHOWN}
        return {**shown, "felt_lateral_mps2": drive.felt_lateral_mps2[::EVERY]}


def style_matrix(style: Style, codec: MatrixCodec, condition: Condition) -> ControllerMatrix:
    """The middle of a style's ranges, moved towards caution where the weather is bad."""
    shift = 0.0 if condition == "sunny" else Priors().adverse_shift
    return matrix_of_taste(WISHES[style] + shift, codec)


def drive_styles(
    vehicle: Vehicle, codec: MatrixCodec, condition: Condition, seed: int
) -> dict[Manoeuvre, dict[str, StyleDrive]]:
    """Each manoeuvre with each style's middle and with the default, on the same noise."""
    matrices: dict[str, ControllerMatrix] = {
        style: style_matrix(style, codec, "sunny") for style in STYLES
    }
    matrices[DEFAULT] = codec.ranges.default
    found: dict[Manoeuvre, dict[str, StyleDrive]] = {}
    for manoeuvre in MANOEUVRES:
        found[manoeuvre] = {}
        for name, matrix in matrices.items():
            run = rollout(matrix, SCENARIOS[manoeuvre], condition, vehicle=vehicle, seed=seed)
            found[manoeuvre][name] = StyleDrive(
                matrix, run.trajectory, measure(run.trajectory), run.status
            )
    return found


def table_rows(
    vehicle: Vehicle, codec: MatrixCodec, score: DrivingScoreConfig, seeds: Sequence[int]
) -> dict[Manoeuvre, dict[str, dict[str, float]]]:
    """Table 1 in the simulation: the default and an oracle, means over conditions and styles.

    The oracle is told the style and the condition. Neither waits for a model, so both latencies
    are 0. `driven`, `failed`: drives, and how many of them broke off or hit something; these score
    0 and are left out of the other means.
    """
    told = {(c, s): style_matrix(s, codec, c) for c in CONDITIONS for s in STYLES}
    arms = {"baseline": dict.fromkeys(told, codec.ranges.default), "oracle": told}
    table: dict[Manoeuvre, dict[str, dict[str, float]]] = {}
    for manoeuvre in MANOEUVRES:
        drives = {
            arm: _drive_arm(matrices, manoeuvre, vehicle, codec, score, seeds)
            for arm, matrices in arms.items()
        }
        usual = mean_metrics([ten for drive, ten in drives["baseline"] if not drive.failed])
        table[manoeuvre] = {
            arm: {
                **asdict(mean_metrics([ten for drive, ten in pairs if not drive.failed])),
                "felt_ay": float(
                    np.mean([d.felt.mean_acceleration for d, _ in pairs if not d.failed])
                ),
                "driving_score": mean_driving_score(pairs, usual, manoeuvre, score),
                "driven": len(pairs),
                "failed": sum(drive.failed for drive, _ in pairs),
            }
            for arm, pairs in drives.items()
        }
    return table


def _drive_arm(
    matrices: Mapping[tuple[Condition, Style], ControllerMatrix],
    manoeuvre: Manoeuvre,
    vehicle: Vehicle,
    codec: MatrixCodec,
    score: DrivingScoreConfig,
    seeds: Sequence[int],
) -> list[tuple[DriveMetrics, TenMetrics]]:
    """Every condition, style and seed of one arm; the alignments are those of its matrices."""
    pairs = [
        (matrices["sunny", style], matrices[condition, style])
        for condition in CONDITIONS
        for style in STYLES
        if condition != "sunny"
    ]
    scenario = 100.0 * scenario_alignment(pairs, codec)
    found = []
    for (condition, style), matrix in matrices.items():
        batch = rollout_batch(
            [matrix], SCENARIOS[manoeuvre], condition, vehicle=vehicle, seeds=seeds
        )
        command = command_alignment(matrix, style, codec.ranges)
        for run in range(len(batch)):
            drive = measure(batch[run].trajectory)
            found.append(
                (
                    drive,
                    ten_metrics(
                        drive,
                        score,
                        latency_s=0.0,
                        command_alignment=command,
                        scenario_alignment=scenario,
                    ),
                )
            )
    return found
