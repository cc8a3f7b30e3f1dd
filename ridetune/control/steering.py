"""The lateral controller of the car: Riccati where no limit is active, a QP where one is.

The unconstrained optimum over the whole horizon comes from the Riccati recursion. If it keeps the
steering angle and rate limits at every step it is also the constrained optimum; otherwise the same
problem is condensed to a quadratic program in the commands and solved by DAQP (Arnstrom et al.
2022). What cannot be solved is a status, never an exception.
"""

from dataclasses import dataclass
from typing import Literal, cast

import daqp
import numpy as np

from ridetune.control.kernel import Numbers, kernel
from ridetune.control.mpc import (
    MIN_MODEL_MPS,
    NUM_STATES,
    NUM_STEPS,
    STEP_S,
    BicycleModel,
    Step,
    discretise,
    feed_forward,
    matrices,
    riccati,
    state_weights,
)
from ridetune.control.path import read_curvatures
from ridetune.control.vehicle import Vehicle

Status = Literal["unconstrained", "constrained", "infeasible", "invalid"]
_SOLVED = 1
_TOLERANCE = 1e-10


@dataclass(frozen=True)
class Steering:
    """A steering command [rad] and how it was found; it repeats the last one if it was not."""

    angle_rad: float
    status: Status


@dataclass(frozen=True)
class LateralProblem:
    """One MPC problem in the commands U [NUM_STEPS]: its model along the path, cost and limits."""

    step: Step
    pushes: Numbers  # [step, 3], what the bending path adds to the state
    feed_forward: Numbers  # [step], rad
    q_lateral: float
    q_course: float
    r: float
    state: Numbers  # [3]: lateral error, course error, front-wheel angle
    lowest: Numbers  # [step], rad
    highest: Numbers
    slowest: Numbers  # [step], least and greatest change since the command before
    fastest: Numbers

    def allows(self, commands: Numbers) -> bool:
        """Whether every command keeps the limits; a NaN never does."""
        changes = np.diff(commands, prepend=0.0)
        inside = (commands >= self.lowest) & (commands <= self.highest)
        steady = (changes >= self.slowest) & (changes <= self.fastest)
        return bool((inside & steady).all())


class LateralController:
    """Steers one car at a fixed control period [s]; the weights are given at each step."""

    def __init__(self, vehicle: Vehicle, period_s: float) -> None:
        self._model = BicycleModel.of(vehicle)
        self._limits = vehicle.limits
        self._period_s = period_s

    def step(
        self,
        weights: Numbers,
        state: Numbers,
        speed_mps: float,
        path: Numbers,
        at_m: float,
        last_rad: float,
    ) -> Steering:
        """The command from (W_l, W_h, W_s) and the rolled-forward state at arc length `at_m`."""
        problem = self.problem(weights, state, speed_mps, path, at_m, last_rad)
        commands = solve_riccati(problem)
        if not np.isfinite(commands).all():
            return Steering(last_rad, "invalid")
        if problem.allows(commands):
            return Steering(float(commands[0]), "unconstrained")
        limited = solve_qp(problem)
        if limited is None:
            return Steering(last_rad, "infeasible")
        return Steering(float(limited[0]), "constrained")

    def problem(
        self,
        weights: Numbers,
        state: Numbers,
        speed_mps: float,
        path: Numbers,
        at_m: float,
        last_rad: float,
    ) -> LateralProblem:
        """The problem at this moment; speeds below MIN_MODEL_MPS are planned at that speed."""
        speed = max(speed_mps, MIN_MODEL_MPS)
        step = discretise(self._model, speed, STEP_S)
        curvature, angles = np.empty(NUM_STEPS), np.empty(NUM_STEPS)
        _preview(self._model, speed, path, at_m, curvature, angles)
        q_lateral, q_course = state_weights(weights[0], weights[1], speed)
        reach = np.full(NUM_STEPS, self._limits.steer_rad)
        change = np.full(NUM_STEPS, self._limits.steer_rate_radps * STEP_S)
        change[0] = self._limits.steer_rate_radps * self._period_s
        slowest, fastest = -change, change.copy()
        # The change of the first command is counted from the last one sent.
        slowest[0] += last_rad
        fastest[0] += last_rad
        return LateralProblem(
            step=step,
            pushes=np.outer(curvature, (step.d0, step.d1, 0.0)),
            feed_forward=angles,
            q_lateral=float(q_lateral),
            q_course=float(q_course),
            r=float(weights[2]) * speed * speed,
            state=np.asarray(state, float),
            lowest=-reach,
            highest=reach,
            slowest=slowest,
            fastest=fastest,
        )


def solve_riccati(problem: LateralProblem) -> Numbers:
    """The optimal commands [NUM_STEPS] without limits; NaN where there is no optimum."""
    commands = np.empty(NUM_STEPS)
    _recursion(
        problem.step,
        problem.pushes,
        problem.feed_forward,
        problem.q_lateral,
        problem.q_course,
        problem.r,
        problem.state,
        commands,
    )
    return commands


def solve_qp(problem: LateralProblem) -> Numbers | None:
    """The optimal commands [NUM_STEPS] within the limits; None if there are none."""
    H, f = _condense(problem)
    if not (np.isfinite(H).all() and np.isfinite(f).all()):
        return None
    changes = np.eye(NUM_STEPS) - np.eye(NUM_STEPS, k=-1)
    commands, _, flag, _ = daqp.solve(
        H,
        f,
        changes,
        np.concatenate([problem.highest, problem.fastest]),
        np.concatenate([problem.lowest, problem.slowest]),
        primal_tol=_TOLERANCE,
    )
    solved = flag == _SOLVED and np.isfinite(commands).all()
    return cast(Numbers, commands) if solved else None


def _condense(problem: LateralProblem) -> tuple[Numbers, Numbers]:
    """H [step, step] and f [step] of the cost U^T H U / 2 + f^T U, states eliminated."""
    n = NUM_STATES
    A, B, _ = matrices(problem.step)
    free = np.empty((NUM_STEPS, n))  # states where the deviations from the feed-forward are 0
    response = np.zeros((NUM_STEPS, n, NUM_STEPS))
    state, effect = problem.state, np.zeros((n, NUM_STEPS))
    for j in range(NUM_STEPS):
        state = A @ state + problem.pushes[j]
        effect = A @ effect
        effect[:, j] += B
        free[j], response[j] = state, effect
    Q = np.array([problem.q_lateral, problem.q_course, 0.0])
    weighted = response * Q[None, :, None]
    H = np.einsum("jai,jak->ik", weighted, response) + problem.r * np.eye(NUM_STEPS)
    f = np.einsum("jai,ja->i", weighted, free) - problem.r * problem.feed_forward
    return H, f


@kernel
def _preview(
    model: BicycleModel,
    speed_mps: float,
    path: Numbers,
    at_m: float,
    curvature: Numbers,
    angles: Numbers,
) -> None:
    for j in range(NUM_STEPS):
        place = at_m + (j + 0.5) * STEP_S * speed_mps
        curvature[j], smooth = read_curvatures(path, place)
        angles[j] = feed_forward(model, speed_mps, smooth)


@kernel
def _recursion(
    step: Step,
    pushes: Numbers,
    angles: Numbers,
    q_lateral: float,
    q_course: float,
    r: float,
    state: Numbers,
    commands: Numbers,
) -> None:
    """Backwards for feedback and affine term, forwards for the commands.

    With u = f + w, x' = A x + B w + d, d = B f + push: w = -K x - (B^T (P d + p)) / s and
    p_j = (A - B K_j)^T (P_{j+1} d_j + p_{j+1}).
    """
    n = NUM_STATES
    A, B, _ = matrices(step)
    P, K = riccati(step, q_lateral, q_course, r)
    offsets, p, q = np.empty(NUM_STEPS), np.zeros(n), np.empty(n)
    for j in range(NUM_STEPS - 1, -1, -1):
        s, bq = r, 0.0
        for a in range(n):
            q[a] = p[a]
            for b in range(n):
                q[a] += P[j + 1, a, b] * (B[b] * angles[j] + pushes[j, b])
                s += B[a] * P[j + 1, a, b] * B[b]
            bq += B[a] * q[a]
        offsets[j] = bq / s
        for b in range(n):
            p[b] = A[0, b] * q[0] + A[1, b] * q[1] + A[2, b] * q[2] - K[j, b] * bq
    x = state.copy()
    for j in range(NUM_STEPS):
        u = angles[j] - offsets[j] - K[j, 0] * x[0] - K[j, 1] * x[1] - K[j, 2] * x[2]
        commands[j] = u
        for a in range(n):
            q[a] = A[a, 0] * x[0] + A[a, 1] * x[1] + A[a, 2] * x[2] + B[a] * u + pushes[j, a]
        x[:] = q
