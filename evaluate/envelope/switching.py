"""What the linear loops say of the styles and of a box: damping, decay, and free switching.

Speed x mass x tyres x delay at the corners of the styles' ranges and of each condition's box; a
common Lyapunov matrix per speed, and jointly over neighbouring speeds, for the steering weights.
"""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ridetune.control.kernel import Numbers
from ridetune.control.tracker import PERIOD_S
from ridetune.control.vehicle import Vehicle
from ridetune.envelope import Box
from ridetune.matrix import STYLES, ControllerMatrix, Ranges, ki_limit
from ridetune.sample import CONDITIONS, Condition
from ridetune.sim.conditions import EFFECTS
from ridetune.sim.plant import Spread

from .stability import Modes, common_lyapunov, modes, speed_loop, steering_loop

SPEEDS_MPS = (3.0, 5.0, 8.3, 13.9)
# Stays with one matrix that are tried [control steps]; the first means a switch at every step.
STAYS = (1, 17, 34)
_CARS = tuple(itertools.product((0.8, 1.2), (0.7, 1.1)))  # mass, tyres
_STEER_DELAYS_S, _PULL_DELAYS_S = (0.0, 0.1, 0.15), (0.05, 0.15)


def corners(box: Box) -> list[ControllerMatrix]:
    """The matrices at the corners of a box, K_i on its rule at most."""
    drawn = (ControllerMatrix.of(values) for values in itertools.product(*box))
    return sorted(
        {ControllerMatrix.of((m.kp, min(m.ki, ki_limit(m.kp)), *m.values[2:])) for m in drawn},
        key=lambda m: m.values,
    )


def worst(found: Iterable[Modes]) -> Modes:
    """Least damping and slowest decay of many loops."""
    listed = list(found)
    return Modes(min(m.damping for m in listed), min(m.decay for m in listed))


def worst_modes(
    matrix: ControllerMatrix, vehicle: Vehicle, *, friction: float = 0.9
) -> dict[str, Modes]:
    """The worst modes of one matrix over speed x mass x tyres x delay: the steering, the speed."""
    steering = worst(
        modes(
            steering_loop(
                matrix, vehicle, Spread(mass, tyres, delay), speed_mps=v, friction=friction
            )
        )
        for v in SPEEDS_MPS
        for mass, tyres in _CARS
        for delay in _STEER_DELAYS_S
    )
    speed = worst(
        modes(speed_loop(matrix, vehicle, Spread(mass, acceleration_delay_s=delay)))
        for mass in (0.8, 1.2)
        for delay in _PULL_DELAYS_S
    )
    return {"steering": steering, "speed": speed}


def badly_damped(
    box: Box, vehicle: Vehicle, condition: Condition, damping: float
) -> list[ControllerMatrix]:
    """The corners of a box whose worst mode is damped less than asked for, or does not decay."""
    friction = EFFECTS[condition].friction
    bad = []
    for loop, which in (("steering", steering_corners(box)), ("speed", speed_corners(box))):
        for matrix in which:
            found = worst_modes(matrix, vehicle, friction=friction)[loop]
            if not (found.damping >= damping and found.decay > 0.0):
                bad.append(matrix)
    return bad


def study_loops(vehicle: Vehicle, ranges: Ranges, boxes: dict[Condition, Box]) -> dict[str, Any]:
    """Worst modes per style and box, and how soon the styles' corners may be switched freely."""
    styles = {s: tuple((r.minimum, r.maximum) for r in ranges.styles[s]) for s in STYLES}
    table: dict[str, Any] = {s: _worst_of(box, vehicle, 0.9) for s, box in styles.items()}
    for condition in CONDITIONS:
        friction = EFFECTS[condition].friction
        table[condition] = _worst_of(boxes[condition], vehicle, friction)
    return {"modes": table, "shortest_stay_s": _switching(styles.values(), vehicle)}


def steering_corners(box: Box) -> list[ControllerMatrix]:
    """The corners of a box in the steering weights, at speed gains that disturb them least."""
    return corners(((0.35, 0.35), (0.0, 0.0), (0.0, 0.0), *box[3:]))


def speed_corners(box: Box) -> list[ControllerMatrix]:
    """The corners of a box in the speed gains, with steering of middling firmness."""
    return corners((*box[:3], (0.2, 0.2), (1.0, 1.0), (0.35, 0.35)))


def _worst_of(box: Box, vehicle: Vehicle, friction: float) -> dict[str, dict[str, float]]:
    result = {}
    for loop, which in (("steering", steering_corners(box)), ("speed", speed_corners(box))):
        found = worst(worst_modes(m, vehicle, friction=friction)[loop] for m in which)
        result[loop] = {"damping": round(found.damping, 4), "decay": round(found.decay, 4)}
    return result


def _switching(boxes: Iterable[Box], vehicle: Vehicle) -> dict[str, float | None]:
    """The shortest time between free switches that is certified [s], per speed and jointly.

    One P for the corner matrices of all boxes and all cars: V falls over each stay, however long
    beyond the shortest (a longer one is made of stays of one to two of it). None: not even 1 s.
    """
    listed = list(boxes)
    per_speed = {v: _loops(listed, vehicle, v) for v in SPEEDS_MPS}
    found = {f"{v} m/s": shortest_stay(loops) for v, loops in per_speed.items()}
    for a, b in itertools.pairwise(SPEEDS_MPS):
        found[f"{a} to {b} m/s"] = shortest_stay([*per_speed[a], *per_speed[b]])
    return found


def shortest_stay(loops: Sequence[Numbers]) -> float | None:
    """The shortest of STAYS [steps] between free switches among loops that is certified, in s."""
    for steps in STAYS:
        stays = [
            np.linalg.matrix_power(A, n) for A in loops for n in range(steps, max(2 * steps, 2))
        ]
        if common_lyapunov(stays) is not None:
            return steps * PERIOD_S
    return None


def _loops(boxes: Sequence[Box], vehicle: Vehicle, speed_mps: float) -> list[Numbers]:
    weights = {m.values[3:] for box in boxes for m in corners(box)}
    return [
        steering_loop(
            ControllerMatrix.of((0.35, 0.0, 0.0, *w)), vehicle, Spread(*car), speed_mps=speed_mps
        )
        for w in sorted(weights)
        for car in _CARS
    ]
