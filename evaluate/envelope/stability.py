"""Linear stability of the two closed loops: eigenvalues, and a common Lyapunov matrix for switches.

Both loops are the compiled ones of the simulation (`pid_step`, `steer`, `move`), driven one control
step from a small push of each state: the columns of A in z+ = A z, commands under way
included. An eigenvalue lambda over a period T is the mode s = ln(lambda) / T, with damping
-Re(s) / |s|.

Switching between matrices at every step is stable at a speed if one P > 0 satisfies
P - A^T P A > 0 for all of them (quadratic stability; Boyd et al., Linear Matrix Inequalities in
System and Control Theory, 1994, 5.1).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ridetune.control.kernel import Numbers
from ridetune.control.pid import COMMAND, FILTERED, INTEGRAL, CommandLimits, pid_step
from ridetune.control.tracker import PERIOD_S
from ridetune.control.vehicle import Vehicle
from ridetune.matrix import ControllerMatrix
from ridetune.sim.loop import Ego, begin, new_gains, steer
from ridetune.sim.plant import (
    ACCELERATION,
    HEADING,
    LATERAL,
    NUM_CELLS,
    SPEED,
    STEER,
    SUBSTEPS,
    YAW_RATE,
    Plant,
    Spread,
    Y,
    move,
)
from ridetune.sim.road import lay_out
from ridetune.sim.scenarios import Scenario, Straight

# Commands that are remembered: a delay of 0.15 s at 0.03 s.
_UNDER_WAY = 5
_PUSH = 1e-6
# A mode that decays faster is over before anyone notices [1/s]; most of these belong to the delay.
_BRIEF = 5.0
# The least t at which a common Lyapunov matrix counts; below it rounding decides.
_LEAST = 1e-8
_LATERAL_CELLS = (Y, HEADING, LATERAL, YAW_RATE, STEER)
_MIDDLE_M = 400.0
_LONG_STRAIGHT = Scenario("straight", "", (Straight(1000.0),), 10.0, 10.0)


@dataclass(frozen=True)
class Modes:
    """The worst of a loop's lasting modes: least damping, slowest decay [1/s], < 0 if unstable."""

    damping: float
    decay: float


def modes(loop: Numbers) -> Modes:
    """The worst modes of z+ = A z over one control period, A = loop."""
    values = np.linalg.eigvals(loop)
    rates = np.log(values[np.abs(values) > 1e-9].astype(complex)) / PERIOD_S
    lasting = rates[rates.real > -_BRIEF]
    damping = (-lasting.real / np.maximum(np.abs(lasting), 1e-12)).min(initial=1.0)
    return Modes(float(damping), float(-rates.real.max()))


def speed_loop(
    matrix: ControllerMatrix, vehicle: Vehicle, spread: Spread, *, speed_mps: float = 10.0
) -> Numbers:
    """A [9, 9] of the speed loop at constant speed; state: speed, acceleration, filter, integral,
    commands under way (oldest first). Without K_i the integral is no state: [8, 8].
    """
    plant = Plant.of(vehicle, spread, 1.0, PERIOD_S)
    limits = CommandLimits.of(vehicle.limits, PERIOD_S)
    assert plant.acceleration_delay <= _UNDER_WAY * SUBSTEPS
    columns = []
    for push in _PUSH * np.eye(4 + _UNDER_WAY):
        state, pid = np.zeros(NUM_CELLS), np.zeros(3)
        state[SPEED], state[ACCELERATION] = speed_mps + push[0], push[1]
        pid[FILTERED], pid[INTEGRAL], pid[COMMAND] = speed_mps + push[2], push[3], push[-1]
        sent = np.append(push[4:], 0.0)
        sent[-1] = pid_step(
            pid, matrix.kp, matrix.ki, matrix.kd, speed_mps, state[SPEED], np.inf, limits
        )
        move(plant, state, np.zeros(_UNDER_WAY + 1), sent, _UNDER_WAY, PERIOD_S)
        after = (state[SPEED] - speed_mps, state[ACCELERATION], pid[FILTERED] - speed_mps)
        columns.append([*after, pid[INTEGRAL], *sent[1:]])
    A = np.array(columns).T / _PUSH
    return A if matrix.ki > 0.0 else np.delete(np.delete(A, 3, 0), 3, 1)


def steering_loop(
    matrix: ControllerMatrix,
    vehicle: Vehicle,
    spread: Spread,
    *,
    speed_mps: float,
    friction: float = 0.9,
) -> Numbers:
    """A [10, 10] of the steering loop on a straight at constant speed.

    State: lateral error, heading error, lateral speed, yaw rate, front-wheel angle, commands under
    way (oldest first). The controller knows the nominal car and compensates its delay.
    """
    plant = Plant.of(vehicle, spread, friction, PERIOD_S)
    ego = Ego.of(vehicle, PERIOD_S)
    road = lay_out(_LONG_STRAIGHT, "sunny", vehicle, PERIOD_S)
    memory = begin(road, _UNDER_WAY + 1, *new_gains())
    values, cells = np.array(matrix.values), list(_LATERAL_CELLS)
    assert max(plant.steer_delay / SUBSTEPS, ego.delay_steps) <= _UNDER_WAY
    columns = []
    for push in _PUSH * np.eye(len(cells) + _UNDER_WAY):
        state = np.zeros(NUM_CELLS)
        state[SPEED], state[cells] = speed_mps, push[: len(cells)]
        memory.steer_sent[:-1] = push[len(cells) :]
        measured = np.array([state[Y], state[HEADING], state[STEER]])
        memory.steer_sent[-1] = steer(
            values, ego, road, memory, _UNDER_WAY, _MIDDLE_M, measured, speed_mps
        )
        move(plant, state, memory.steer_sent, np.zeros(_UNDER_WAY + 1), _UNDER_WAY, PERIOD_S)
        columns.append([*state[cells], *memory.steer_sent[1:]])
    return np.array(columns).T / _PUSH


def certifies(candidate: Numbers, loops: Sequence[Numbers], *, slack: float = 1e-9) -> bool:
    """Whether P = candidate is positive and P - A^T P A > 0 for every loop A, beyond rounding."""
    if not np.isfinite(candidate).all() or np.linalg.eigvalsh(candidate)[0] <= 0.0:
        return False
    stacked = np.asarray(loops)
    falls = candidate - stacked.transpose(0, 2, 1) @ candidate @ stacked
    # In coordinates where P is the identity, so that well and badly scaled states count alike.
    root = np.linalg.cholesky(candidate).T
    sizes = np.linalg.norm(root @ stacked @ np.linalg.inv(root), 2, axis=(1, 2))
    rounding = slack * float(np.linalg.norm(candidate, 2))
    return bool(sizes.max() < 1.0 - slack and np.linalg.eigvalsh(falls).min() > -rounding)


def common_lyapunov(loops: Sequence[Numbers], *, rounds: int = 12) -> Numbers | None:
    """P with P - A^T P A > 0 for every loop A, or None if none was found.

    Solved for a few loops; the loops that its P does not certify join them, until it certifies all.
    """
    scale = _gramian(np.mean(loops, axis=0))
    root = np.linalg.cholesky(scale).T
    inner = np.array([root @ A @ np.linalg.inv(root) for A in loops])
    norms = np.linalg.norm(inner, 2, axis=(1, 2))
    chosen = list(np.argsort(norms)[-8:])
    for _ in range(rounds):
        Q = _feasible(inner[chosen])
        if Q is None:
            return None
        P = root.T @ Q @ root
        if certifies(P, loops):
            return np.asarray(P)
        half = np.linalg.cholesky(Q).T
        norms = np.linalg.norm(half @ inner @ np.linalg.inv(half), 2, axis=(1, 2))
        chosen = sorted({*chosen, *(int(i) for i in np.argsort(norms)[-8:])})
    return None


def _gramian(loop: Numbers) -> Numbers:
    """Sum of (A^k)^T A^k by doubling: a scale in which A = loop hardly grows."""
    A = loop
    if np.abs(np.linalg.eigvals(A)).max() >= 1.0:
        return np.eye(len(A))
    total, power = np.eye(len(A)), A.copy()
    for _ in range(12):
        total = total + power.T @ total @ power
        power = power @ power
    return np.asarray(total + 1e-6 * np.trace(total) / len(A) * np.eye(len(A)))


def _feasible(loops: Numbers, *, steps: int = 400) -> Numbers | None:
    """P < I with P - A^T P A > t I and t > 0, by a barrier method over (P, t); None if t stays < 0.

    loops [loop, n, n]. Minimises -tau t - sum log det(P - A^T P A - t I) - log det(I - P) with
    Newton steps (Boyd & Vandenberghe 2004, 11.3), tau growing; no t above t + (rows) / tau exists.
    """
    n = loops.shape[1]
    rows, columns = np.triu_indices(n)
    basis = np.zeros((len(rows), n, n))
    basis[np.arange(len(rows)), rows, columns] = basis[np.arange(len(rows)), columns, rows] = 1.0
    pushed = basis[None] - loops.transpose(0, 2, 1)[:, None] @ basis[None] @ loops[:, None]
    last = np.broadcast_to(-np.eye(n), (len(loops), 1, n, n))
    faces = np.concatenate([pushed, last], axis=1)  # [loop, variable, n, n]
    upper = np.concatenate([-basis, np.zeros((1, n, n))])[None]
    x = np.append(0.5 * (rows == columns), 0.0)
    x[-1] = np.linalg.eigvalsh(_blocks(faces, x, np.zeros((n, n)))).min() - 0.1
    tau, num_rows = 1.0, n * (len(loops) + 1)
    for _ in range(steps):
        gradient, hessian = np.zeros(len(x)), np.zeros((len(x), len(x)))
        gradient[-1] = -tau
        for group, offset in ((faces, np.zeros((n, n))), (upper, np.eye(n))):
            inverse = np.linalg.inv(np.linalg.cholesky(_blocks(group, x, offset)))
            white = inverse[:, None] @ group @ inverse.transpose(0, 2, 1)[:, None]
            gradient -= np.trace(white, axis1=2, axis2=3).sum(axis=0)
            flat = white.transpose(1, 0, 2, 3).reshape(len(x), -1)
            hessian += flat @ flat.T
        move_by = -np.linalg.solve(hessian + 1e-12 * np.trace(hessian) * np.eye(len(x)), gradient)
        x = x + _longest(x, move_by, ((faces, np.zeros((n, n))), (upper, np.eye(n)))) * move_by
        if -gradient @ move_by < 0.25:
            if x[-1] > 0.0:
                return np.asarray(np.tensordot(x[:-1], basis, 1))
            if x[-1] + num_rows / tau < _LEAST:
                return None
            tau *= 8.0
    return None


def _blocks(group: Numbers, x: Numbers, offset: Numbers) -> Numbers:
    return np.asarray(np.tensordot(group, x, (1, 0)) + offset)


def _longest(x: Numbers, by: Numbers, groups: Sequence[tuple[Numbers, Numbers]]) -> float:
    """The longest of 1, 1/2, 1/4, ... that keeps every block positive definite."""
    share = 1.0
    while share > 1e-9:
        if all(
            np.linalg.eigvalsh(_blocks(group, x + share * by, offset)).min() > 0.0
            for group, offset in groups
        ):
            return share if share == 1.0 else 0.9 * share
        share *= 0.5
    return 0.0
