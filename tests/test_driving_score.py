"""Published scores come out of their recovered formulas; ours keeps to its stated rules."""

import math
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest

from evaluate import lampilot, talk2drive
from evaluate.driving_score import (
    MANOEUVRES,
    METRICS,
    TABLE_1,
    DrivingScoreConfig,
    LongitudinalShare,
    Manoeuvre,
    TenMetrics,
    driving_score,
    mean_driving_score,
    mean_metrics,
    printed_against_ours,
    sub_scores,
    ten_metrics,
)
from evaluate.lampilot import LampilotRow
from evaluate.talk2drive import Talk2DriveRow
from ridetune.config import load_config
from ridetune.sim.metrics import DriveMetrics, measure
from ridetune.sim.trajectory import SIGNALS, Trajectory

# Survey, Table VIII: per behaviour the rows I, II, III and the baseline as
# (TTC, speed variance, |a|, |J|, printed score).
TALK2DRIVE = {
    "overtake": (
        (2.88, 5.02, 0.24, 2.64, 85.05),
        (1.94, 4.05, 0.24, 2.81, 86.12),
        (3.07, 1.26, 0.18, 2.64, 91.12),
        (3.26, 2.91, 0.35, 2.83, 86.00),
    ),
    "following": (
        (6.52, 0.94, 0.15, 2.35, 87.10),
        (7.84, 1.11, 0.15, 2.38, 86.23),
        (6.78, 1.37, 0.09, 2.31, 86.26),
        (4.02, 0.78, 0.22, 2.50, 86.00),
    ),
    "right lane": (
        (8.77, 1.69, 0.17, 2.39, 90.88),
        (4.54, 1.18, 0.15, 2.44, 91.51),
        (7.29, 0.23, 0.13, 2.61, 92.18),
        (4.70, 7.39, 0.22, 2.77, 86.00),
    ),
    "not yield": (
        (0.89, 0.29, 0.26, 2.28, 59.67),
        (0.89, 0.22, 0.28, 2.55, 59.60),
        (1.04, 0.21, 0.26, 2.32, 60.32),
        (1.14, 0.46, 0.46, 2.34, 56.00),
    ),
    "yield": (
        (math.inf, 0.29, 0.52, 2.27, 91.53),
        (math.inf, 0.22, 0.82, 2.54, 89.50),
        (math.inf, 0.21, 0.48, 2.28, 91.92),
        (math.inf, 1.67, 0.90, 2.32, 86.00),
    ),
}

# Survey, Table IV: collisions [%], completion [%], TTC, SV, TE, printed score.
LAMPILOT = {
    "IDM": (0.0, 20.4, 92.8, 80.9, 71.0, 17.3),
    "MOBIL": (0.0, 15.3, 82.8, 85.9, 46.7, 11.7),
    "Human Driver": (0.0, 98.0, 93.4, 86.3, 81.3, 84.6),
    "Llama 2, 0-shot": (0.0, 20.4, 92.8, 81.4, 68.9, 17.3),
    "PaLM 2, 0-shot": (3.1, 35.7, 78.6, 76.5, 78.8, 12.8),
    "ChatGPT, 0-shot": (1.0, 40.8, 83.9, 75.5, 74.0, 27.8),
    "GPT-4, 0-shot": (4.1, 72.4, 61.3, 70.5, 74.0, 28.5),
    "GPT-4 Turbo, 0-shot": (3.1, 74.5, 73.2, 70.1, 73.9, 39.1),
    "Llama 2, 3-shot": (1.0, 63.3, 68.3, 71.4, 73.8, 39.6),
    "PaLM 2, 3-shot": (3.1, 71.4, 73.4, 69.7, 72.0, 36.6),
    "ChatGPT, 3-shot": (4.1, 83.7, 70.9, 73.7, 77.7, 41.2),
    "GPT-4, 3-shot": (1.0, 84.7, 69.4, 72.0, 76.7, 55.9),
    "GPT-4 Turbo, 3-shot": (1.0, 80.6, 69.1, 71.5, 74.9, 52.6),
    "Llama 2, feedback": (0.9, 32.7, 83.9, 74.6, 74.6, 21.4),
    "PaLM 2, feedback": (0.0, 45.5, 81.1, 74.4, 77.6, 35.6),
    "ChatGPT, feedback": (0.9, 80.9, 70.2, 71.7, 77.5, 54.2),
    "GPT-4, feedback": (0.9, 92.7, 67.6, 72.2, 76.8, 64.0),
    "GPT-4 Turbo, feedback": (0.9, 87.3, 74.1, 73.4, 75.5, 60.5),
}
# Two rows that the formula misses by 2.5 and 2.9, whatever was done to print them.
LAMPILOT_MISSED = {"Human Driver", "GPT-4, feedback"}


@pytest.fixture(scope="module")
def config(root: Path) -> DrivingScoreConfig:
    return load_config(DrivingScoreConfig, root / "configs/driving_score.yaml")


BASELINE = TenMetrics(2.0, 28.8, 0.0036, 0.78, 3.27, 0.046, 0.44, 0.0, 60.0, 0.0)


@pytest.mark.parametrize("behaviour", sorted(TALK2DRIVE))
def test_talk2drive_table_comes_out(behaviour: str) -> None:
    *rows, baseline = TALK2DRIVE[behaviour]
    usual = Talk2DriveRow(*baseline[:-1])
    assert talk2drive.driving_score(usual, usual) == pytest.approx(baseline[-1], abs=1e-9)
    for row in rows:
        ours = talk2drive.driving_score(Talk2DriveRow(*row[:-1]), usual)
        assert ours == pytest.approx(row[-1], abs=0.12)


def test_lampilot_table_comes_out_but_for_two_rows() -> None:
    far = {
        name
        for name, row in LAMPILOT.items()
        if abs(lampilot.driving_score(LampilotRow(*row[:-1])) - row[-1]) > 0.8
    }
    assert far == LAMPILOT_MISSED


def test_lampilot_sub_scores_follow_their_equations() -> None:
    assert [lampilot.ttc_score(t) for t in (2.1, 2.0, 0.5, 0.005, 0.0, -1.0)] == [
        100.0,
        99.5,
        98.0,
        0.0,
        0.0,
        0.0,
    ]
    assert [lampilot.sv_score(s) for s in (0.0, 2.5, 12.0)] == [100.0, 75.0, 0.0]
    assert [lampilot.te_score(t) for t in (0.0, 15.0, 90.0)] == [100.0, 75.0, 0.0]


@pytest.mark.parametrize("manoeuvre", MANOEUVRES)
def test_weights_sum_to_one_in_every_manoeuvre(
    manoeuvre: Manoeuvre, config: DrivingScoreConfig
) -> None:
    weights = config.weights_of(manoeuvre)
    assert len(weights) == len(METRICS) == 10
    assert min(weights) > 0
    assert sum(weights) == pytest.approx(1.0)


def test_longitudinal_motion_weighs_more_in_acceleration_and_lateral_in_turning(
    config: DrivingScoreConfig,
) -> None:
    named = {m: dict(zip(METRICS, config.weights_of(m), strict=True)) for m in MANOEUVRES}
    for x, y in (("sv_x", "sv_y"), ("mean_ax", "mean_ay"), ("mean_jx", "mean_jy")):
        assert named["acceleration"][x] > named["acceleration"][y]
        assert named["left_turn"][x] < named["left_turn"][y]
        assert named["acceleration"][x] > named["lane_change"][x] > named["left_turn"][x]


def test_what_equals_the_baseline_scores_80_and_better_scores_more(
    config: DrivingScoreConfig,
) -> None:
    same = sub_scores(BASELINE, BASELINE, config)
    assert same == pytest.approx((100, *[80] * 6, 100, 60, 0))
    for i in range(1, 7):
        values = list(astuple(BASELINE))
        values[i] /= 2
        assert sub_scores(TenMetrics(*values), BASELINE, config)[i] > 80
        values[i] *= 20
        assert sub_scores(TenMetrics(*values), BASELINE, config)[i] == 0


def test_time_to_collision_is_a_hard_threshold_and_latency_a_slope(
    config: DrivingScoreConfig,
) -> None:
    for ttc_s, expected in ((1.49, 0), (1.5, 100), (math.inf, 100), (math.nan, 0)):
        assert sub_scores(replace(BASELINE, ttc_s=ttc_s), BASELINE, config)[0] == expected
    for latency_s, expected in ((0.0, 100), (1.25, 75), (5.0, 0), (9.0, 0), (math.inf, 0)):
        assert sub_scores(replace(BASELINE, latency_s=latency_s), BASELINE, config)[7] == expected


def test_motion_that_nobody_notices_is_not_compared(config: DrivingScoreConfig) -> None:
    still = replace(BASELINE, sv_y=1e-12, mean_ay=0.0, mean_jy=1e-9)
    noisy = replace(BASELINE, sv_y=1e-6, mean_ay=1e-4, mean_jy=1e-3)
    assert sub_scores(noisy, still, config)[2:7] == pytest.approx([80.0] * 5)
    assert driving_score(noisy, still, "left_turn", config) == pytest.approx(
        driving_score(still, still, "left_turn", config)
    )


def test_score_of_a_perfect_and_of_a_hopeless_row(config: DrivingScoreConfig) -> None:
    perfect = TenMetrics(math.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 100.0, 100.0)
    coarse = replace(BASELINE, sv_y=10.0, mean_ay=10.0, mean_jy=100.0)
    hopeless = TenMetrics(0.0, 1e9, 1e9, 1e9, 1e9, 1e9, 1e9, 60.0, 0.0, 0.0)
    for manoeuvre in MANOEUVRES:
        assert 99 < driving_score(perfect, coarse, manoeuvre, config) <= 100
        assert driving_score(hopeless, coarse, manoeuvre, config) == 0


def test_hundred_points_of_alignment_are_worth_their_weight(config: DrivingScoreConfig) -> None:
    aligned = replace(BASELINE, command_alignment=100.0, scenario_alignment=100.0)
    gain = driving_score(aligned, BASELINE, "lane_change", config) - driving_score(
        BASELINE, BASELINE, "lane_change", config
    )
    assert gain == pytest.approx(0.2 * 40 + 0.15 * 100)


def test_table_1_scores_stay_near_the_printed_ones_without_being_fitted(
    config: DrivingScoreConfig,
) -> None:
    found = printed_against_ours(config)
    assert len(found) == 9
    assert {model for _, model in found} == {"baseline", "GPT-4o", "on-board VLM"}
    differences = [ours - printed for printed, ours in found.values()]
    assert max(np.abs(differences)) == pytest.approx(12.8, abs=0.05)
    assert np.mean(differences) == pytest.approx(7.0, abs=0.05)
    by_hand = 18 + 0.42 * 80 + 5 + 0.2 * 92 + 0.15 * 60
    assert found["acceleration", "baseline"] == pytest.approx((75.6, by_hand))
    assert all(len(row) == 11 for rows in TABLE_1.values() for row in rows.values())


def drive_metrics(collide: bool = False) -> DriveMetrics:
    time = np.arange(0.0, 5.0, 0.1)
    signals = np.zeros((len(time), len(SIGNALS)))
    column = {name: signals[:, i] for i, name in enumerate(SIGNALS)}
    column["speed_mps"][:] = column["reference_speed_mps"][:] = 10.0
    column["lead_speed_mps"][:], column["gap_m"][:] = 10.0, -1.0 if collide else 12.0
    column["acceleration_mps2"][:] = np.sin(time)
    column["yaw_rate_radps"][:] = 0.1
    column["lateral_speed_mps"][:] = 0.5 * np.sin(time)
    return measure(Trajectory(0.1, signals))


def test_lateral_columns_follow_the_configured_definition(config: DrivingScoreConfig) -> None:
    drive = drive_metrics()
    rows = {
        lateral: ten_metrics(
            drive,
            replace(config, lateral=lateral),
            latency_s=0.3,
            command_alignment=90.0,
            scenario_alignment=80.0,
        )
        for lateral in ("body", "felt")
    }
    assert rows["body"].mean_ay == drive.body.mean_acceleration
    assert rows["felt"].mean_ay == pytest.approx(1.0)
    assert rows["felt"].mean_jy == pytest.approx(0.0, abs=1e-9)
    assert rows["felt"].latency_s == 0.3


def test_drive_that_collides_scores_nothing(config: DrivingScoreConfig) -> None:
    def row(drive: DriveMetrics) -> TenMetrics:
        return ten_metrics(
            drive, config, latency_s=0.0, command_alignment=100.0, scenario_alignment=100.0
        )

    fine, crashed = drive_metrics(), drive_metrics(collide=True)
    baseline = mean_metrics([row(fine)])
    one = mean_driving_score([(fine, row(fine))], baseline, "lane_change", config)
    both = [(fine, row(fine)), (crashed, row(crashed))]
    assert one > 80
    assert mean_driving_score(both, baseline, "lane_change", config) == pytest.approx(one / 2)
    with pytest.raises(ValueError, match="no drive"):
        mean_driving_score([], baseline, "lane_change", config)


def test_baseline_is_the_mean_of_whole_drives_only() -> None:
    other = replace(BASELINE, sv_x=BASELINE.sv_x + 2.0)
    assert mean_metrics([BASELINE, other]).sv_x == pytest.approx(29.8)
    with pytest.raises(ValueError, match="whole drives"):
        mean_metrics([])
    with pytest.raises(ValueError, match="broke off"):
        mean_metrics([BASELINE, replace(BASELINE, mean_jx=math.nan)])


def test_config_without_a_proper_score_is_refused(config: DrivingScoreConfig) -> None:
    with pytest.raises(ValueError, match="sum to 1"):
        replace(config, weights=replace(config.weights, jerk=0.5))
    with pytest.raises(ValueError, match="longitudinal_share"):
        replace(config, longitudinal_share=LongitudinalShare(1.2, 0.3, 0.2))
    with pytest.raises(ValueError, match="above 0"):
        replace(config, latency_limit_s=0.0)
