"""The envelope's program: linear loops, certificates, counts, the box, and its file."""

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evaluate.envelope.monte_carlo import MonteCarlo, Search, draw_car, project
from evaluate.envelope.peeling import peel
from evaluate.envelope.proof import summarise
from evaluate.envelope.stability import certifies, common_lyapunov, modes, speed_loop, steering_loop
from evaluate.envelope.switching import corners, shortest_stay, worst_modes
from ridetune.control.tracker import PERIOD_S
from ridetune.control.vehicle import Sensors
from ridetune.envelope import Envelope, Limits, clamp, hash_of
from ridetune.matrix import PARAMETERS, ki_limit
from ridetune.sample import CONDITIONS
from ridetune.sim.plant import NOMINAL, Spread
from ridetune.sim.rollout import rollout
from ridetune.sim.scenarios import Scenario, Straight
from tests.shipped_car import DEFAULT, RANGES, VEHICLE

SHIPPED = Path("configs/verified.yaml")
QUIET = replace(VEHICLE, sensors=Sensors(0.0, 0.0, 0.0, 0.0))


def shipped() -> Envelope:
    return Envelope.load(SHIPPED, vehicle=VEHICLE, ranges=RANGES)


# --- eigenvalues ---


def test_the_speed_loop_predicts_the_simulated_one_step_by_step() -> None:
    """A step too small for any limit: from 10 to 10.02 m/s on a straight road."""
    matrix = replace(DEFAULT, kp=0.8, ki=0.05, kd=0.1)
    road = Scenario("straight", "", (Straight(400.0),), 10.0, 10.02)
    driven = rollout(matrix, road, vehicle=QUIET).trajectory["speed_mps"]
    A = speed_loop(matrix, QUIET, NOMINAL)
    # In coordinates around the new speed, the car starts 0.02 m/s below it; so does its filter.
    state = np.zeros(len(A))
    state[0] = state[2] = -0.02
    predicted = np.empty(200)
    for step in range(200):
        predicted[step] = 10.02 + state[0]
        state = A @ state
    np.testing.assert_allclose(predicted, driven[:200], atol=2e-5)


def test_the_steering_loop_decays_as_its_eigenvalues_say() -> None:
    A = steering_loop(DEFAULT, QUIET, NOMINAL, speed_mps=8.3)
    state = np.zeros(len(A))
    state[0] = 1.0
    sizes = []
    for _ in range(600):
        state = A @ state
        sizes.append(float(np.linalg.norm(state)))
    rate = -math.log(max(sizes[500:]) / max(sizes[300:400])) / (200 * PERIOD_S)
    assert rate == pytest.approx(modes(A).decay, rel=0.15)


def test_damping_falls_with_delay_and_gain_and_turns_negative() -> None:
    def damping(kp: float, delay: float) -> float:
        spread = Spread(mass=0.8, acceleration_delay_s=delay)
        return modes(speed_loop(replace(DEFAULT, kp=kp, ki=0.0, kd=0.0), VEHICLE, spread)).damping

    assert damping(1.2, 0.05) > damping(1.2, 0.15) > damping(2.4, 0.15) > 0.0
    assert damping(8.0, 0.15) < 0.0


def test_a_loop_with_a_growing_mode_has_a_negative_decay() -> None:
    assert modes(np.diag([0.5, 1.01])).decay < 0.0
    assert modes(np.diag([0.5, 0.99])).decay == pytest.approx(-math.log(0.99) / PERIOD_S)


# --- switching ---


def test_a_common_lyapunov_matrix_is_found_and_verified() -> None:
    loops = [
        steering_loop(replace(DEFAULT, ws=ws), VEHICLE, NOMINAL, speed_mps=8.3) for ws in (0.3, 0.4)
    ]
    P = common_lyapunov(loops)
    assert P is not None and certifies(P, loops)
    for A in loops:
        assert np.linalg.eigvalsh(P - A.T @ P @ A)[0] > 0.0


def test_no_matrix_is_certified_for_loops_that_diverge_when_switched() -> None:
    shear, back = np.array([[0.8, 1.0], [0.0, 0.8]]), np.array([[0.8, 0.0], [1.0, 0.8]])
    assert modes(shear).decay > 0.0 and modes(back).decay > 0.0
    assert max(abs(np.linalg.eigvals(shear @ back))) > 1.0
    assert common_lyapunov([shear, back]) is None
    assert not certifies(np.eye(2), [shear, back])


def test_long_enough_stays_make_the_same_loops_safe_to_switch() -> None:
    shear, back = np.array([[0.8, 1.0], [0.0, 0.8]]), np.array([[0.8, 0.0], [1.0, 0.8]])
    stay = shortest_stay([shear, back])
    assert stay is not None and stay > PERIOD_S


def test_a_matrix_that_is_not_positive_or_not_finite_certifies_nothing() -> None:
    loops = [np.diag([0.5, 0.5])]
    assert certifies(np.eye(2), loops)
    assert not certifies(-np.eye(2), loops)
    assert not certifies(np.full((2, 2), np.nan), loops)


# --- Monte Carlo and box ---


def test_matrices_are_drawn_inside_their_box_and_below_the_rule() -> None:
    carlo = MonteCarlo(VEHICLE, RANGES, Limits())
    rng = np.random.default_rng(2)
    envelope = shipped()
    box = envelope.box("snow")
    for _ in range(200):
        assert envelope.contains(carlo.draw(rng, box), "snow")


def test_cars_are_drawn_from_the_verified_population_and_its_corners() -> None:
    rng = np.random.default_rng(3)
    cars = [draw_car(rng) for _ in range(300)]
    assert {car.mass for car in cars} >= {0.8, 1.2}
    assert all(0.8 <= car.mass <= 1.2 and 0.7 <= car.tyres <= 1.1 for car in cars)
    assert all(0.0 <= (car.steer_delay_s or 0.0) <= 0.15 for car in cars)


def test_peeling_cuts_the_corner_that_breaks_limits_and_nothing_else() -> None:
    rng = np.random.default_rng(5)
    shares = rng.uniform(size=(2000, 6))
    slow = (shares[:, 3] < 0.3) & (shares[:, 5] > 0.6)
    inner, outer = np.full(6, 0.5), (np.zeros(6), np.ones(6))
    low, high = peel(Search(shares, slow, np.zeros(2000, bool)), inner, outer)
    inside = ((shares >= low) & (shares <= high)).all(axis=1)
    assert inside.any() and not (inside & slow).any()
    assert (low[[0, 1, 2]] == 0.0).all() and (high[[0, 1, 2, 3]] == 1.0).all()
    assert 0.2 < low[3] <= 0.5 or 0.5 <= high[5] < 0.7
    with pytest.raises(ValueError, match="around the default"):
        peel(Search(shares, np.ones(2000, bool), np.zeros(2000, bool)), inner, outer)


def test_a_projected_matrix_lies_in_its_box_and_keeps_the_rule() -> None:
    envelope = shipped()
    for condition in CONDITIONS:
        box = envelope.box(condition)
        for matrix in corners(tuple(zip(RANGES.lowest, RANGES.highest, strict=True))):
            assert envelope.contains(project(matrix, box), condition)


def test_corners_keep_the_rule_and_have_damped_modes_in_the_shipped_box() -> None:
    found = corners(shipped().box(None))
    assert all(matrix.ki <= ki_limit(matrix.kp) for matrix in found)
    for matrix in (found[0], found[-1]):
        assert worst_modes(matrix, VEHICLE)["steering"].damping > 0.2


def test_errors_of_both_kinds_are_counted_with_their_intervals() -> None:
    counts = {
        "uniform.accepted.fine.fine": 90,
        "step.limited.breaks.breaks": 1,
        "step.limited.fine.fine": 9,
        "corner.refused_by_check.fine.fine": 3,
        "corner.refused_by_check.breaks.fine": 1,
        "uniform.refused_by_bounds.fine.fine": 2,
        "alternating.fine": 7,
    }
    result = summarise(Counter(counts))
    assert (result["false_acceptance"]["events"], result["false_acceptance"]["of"]) == (1, 106)
    low, high = result["false_acceptance"]["interval"]
    assert low < 1 / 106 < high
    assert (result["needless"]["events"], result["needless"]["of"]) == (14, 104)
    assert result["asked_breaks"] == {"limited": 1, "refused_by_check": 1}
    assert result["alternating"] == {
        "events": 0,
        "of": 7,
        "interval": [0.0, pytest.approx(0.4096, abs=1e-3)],
    }


# --- the file ---


def test_an_envelope_survives_its_file(tmp_path: Path) -> None:
    shipped().save(tmp_path / "v.yaml", header="one\ntwo")
    again = Envelope.load(tmp_path / "v.yaml", vehicle=VEHICLE, ranges=RANGES)
    assert again == shipped()
    assert (tmp_path / "v.yaml").read_text().startswith("# one\n# two\n")


def test_the_shipped_envelope_rests_on_runs_without_a_violation() -> None:
    for condition in CONDITIONS:
        evidence = shipped().evidence[condition]
        assert evidence.violations == 0 and evidence.runs >= 1000
        assert evidence.upper < 0.004


def test_an_envelope_of_another_car_or_other_ranges_is_refused() -> None:
    heavy = replace(VEHICLE, body=replace(VEHICLE.body, mass_kg=2500.0))
    with pytest.raises(ValueError, match=r"another vehicle.*python -m evaluate\.envelope"):
        Envelope.load(SHIPPED, vehicle=heavy, ranges=RANGES)
    with pytest.raises(ValueError, match="another ranges"):
        Envelope.load(SHIPPED, vehicle=VEHICLE, ranges=replace(RANGES, slew=0.4))


def test_an_envelope_without_a_condition_or_with_crossed_ends_is_refused() -> None:
    good = shipped()
    with pytest.raises(ValueError, match="for snow"):
        replace(good, boxes={c: b for c, b in good.boxes.items() if c != "snow"})
    crossed = {**good.boxes, "rain": {**good.boxes["rain"], "W_s": (2.0, 1.0)}}
    with pytest.raises(ValueError, match=r"W_s for rain is \[2.0, 1.0\]"):
        replace(good, boxes=crossed)


def test_contains_and_clamp_refuse_nan_and_reach_the_edge() -> None:
    box = shipped().box("sunny")
    assert not shipped().contains(replace(DEFAULT, kp=math.nan), "sunny")
    assert clamp([99.0] * 6, box) == [high for _, high in box]
    assert len(box) == len(PARAMETERS)


def test_the_hash_of_a_config_follows_its_content() -> None:
    assert hash_of({"a": 1, "b": 2}) == hash_of({"b": 2, "a": 1}) != hash_of({"a": 1, "b": 3})
