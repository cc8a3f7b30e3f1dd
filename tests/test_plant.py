"""The simulated car: what its tyres, its load, its lags and its delays do."""

import math

import numpy as np
import pytest

from ridetune.control.kernel import Numbers
from ridetune.control.mpc import BicycleModel, yaw_gain
from ridetune.control.tracker import PERIOD_S
from ridetune.sim.plant import (
    ACCELERATION,
    HEADING,
    NOMINAL,
    NUM_CELLS,
    SPEED,
    STEER,
    YAW_RATE,
    Plant,
    Spread,
    X,
    Y,
    move,
    slide,
)
from tests.shipped_car import VEHICLE


def turned(plant: Plant, speed: float, steer: float, seconds: float = 6.0) -> Numbers:
    """The plant's state after a constant steering command at a held speed."""
    state, steps = np.zeros(NUM_CELLS), round(seconds / PERIOD_S)
    state[SPEED] = speed
    steers, pulls = np.full(steps, steer), np.zeros(steps)
    for k in range(steps):
        move(plant, state, steers, pulls, k, PERIOD_S)
    return state


@pytest.mark.parametrize("speed", [1.0, 5.0, 8.0, 14.0])
def test_a_steady_turn_has_the_yaw_rate_of_the_bicycle_model(speed: float) -> None:
    state = turned(Plant.of(VEHICLE, NOMINAL, 5.0, PERIOD_S), speed, 0.02)
    model = BicycleModel.of(VEHICLE)
    rolling = speed / model.wheelbase_m if speed < 1.5 else yaw_gain(model, speed)
    assert state[YAW_RATE] == pytest.approx(0.02 * rolling, rel=0.02)


@pytest.mark.parametrize("friction", [0.35, 0.6, 0.9])
def test_friction_bounds_what_the_tyres_give_and_braking_takes_its_share(friction: float) -> None:
    plant, rng = Plant.of(VEHICLE, NOMINAL, friction, PERIOD_S), np.random.default_rng(2)
    most = friction * 9.81
    for _ in range(300):
        lateral, yaw_rate, steer = (
            rng.uniform(-3.0, 3.0),
            rng.uniform(-1, 1),
            rng.uniform(-0.5, 0.5),
        )
        sliding, _ = slide(plant, 14.0, lateral, yaw_rate, steer, 0.0)
        assert abs(sliding + 14.0 * yaw_rate) <= most * (1.0 + 1e-9)
        braked, _ = slide(plant, 14.0, lateral, yaw_rate, steer, -0.8 * most)
        assert abs(braked + 14.0 * yaw_rate) <= 0.6 * most * (1.0 + 1e-9)
    saturated, _ = slide(plant, 14.0, 0.0, 0.0, 0.5, 0.0)
    assert saturated == pytest.approx(most * plant.rear_m / VEHICLE.body.wheelbase_m)


def test_worn_tyres_and_a_heavy_load_turn_less() -> None:
    nominal = turned(Plant.of(VEHICLE, NOMINAL, 0.9, PERIOD_S), 14.0, 0.05)[YAW_RATE]
    worn = turned(Plant.of(VEHICLE, Spread(tyres=0.7), 0.9, PERIOD_S), 14.0, 0.05)[YAW_RATE]
    heavy = turned(Plant.of(VEHICLE, Spread(mass=1.2), 0.9, PERIOD_S), 14.0, 0.05)[YAW_RATE]
    assert worn < nominal and heavy < nominal


def test_a_standing_car_neither_moves_nor_turns_and_never_rolls_back() -> None:
    plant, state = Plant.of(VEHICLE, NOMINAL, 0.9, PERIOD_S), np.zeros(NUM_CELLS)
    steers, pulls = np.full(100, 0.3), np.full(100, -2.0)
    for k in range(100):
        move(plant, state, steers, pulls, k, PERIOD_S)
    assert state[X] == state[Y] == state[HEADING] == state[SPEED] == state[ACCELERATION] == 0.0
    assert state[STEER] == pytest.approx(0.3, rel=0.01)


def test_a_command_acts_after_its_delay_and_with_its_lag() -> None:
    plant = Plant.of(VEHICLE, Spread(acceleration_delay_s=0.12, mass=1.25), 0.9, PERIOD_S)
    state, accelerations = np.zeros(NUM_CELLS), []
    state[SPEED] = 10.0
    for k in range(60):
        move(plant, state, np.zeros(60), np.ones(60), k, PERIOD_S)
        accelerations.append(state[ACCELERATION])
    assert accelerations[3] == 0.0  # 0.12 s
    after = 0.3
    expected = (1.0 - math.exp(-after / 0.2)) / 1.25
    assert accelerations[round((0.12 + after) / PERIOD_S) - 1] == pytest.approx(expected, rel=1e-6)
