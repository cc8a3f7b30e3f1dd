"""Lateral MPC (on-board VLM paper, Eq. 5) without limits: the model, Riccati recursion, preview.

    minimise  sum_j  W_l y_j^2 + (W_h + 0.3 v^2) c_j^2 + W_s v^2 (u_j - f_j)^2

over a horizon of 50 x 0.1 s, with the weights and their scaling by speed as in Autoware's lateral
MPC: y lateral error [m], c course error [rad], u steering command [rad], f feed-forward from
the smoothed curvature of the path. E^T Q E of the paper is the first two terms, R = W_s v^2.

The model is the linear bicycle in quasi-steady motion along the path at constant speed v, with the
steering's first-order lag as a third state (delta, front-wheel angle):

    y' = v c      c = heading error - k v w      w = v delta / (L + K v^2)      w' - v curvature

w is the yaw rate, K the understeer gradient and k the rear axle's slip per lateral acceleration, so
the car is steered by where its rear axle moves, not by where it points; a rigid kinematic car
has K = k = 0. Delay is handled before: the state is rolled forward over the commands under way.

The optimal command is linear in the state and in the path ahead, so per speed one recursion gives
a row of gains (`preview_gains`) and a command is one scalar product (`preview_command`).
"""

import math
from typing import NamedTuple

import numpy as np

from ridetune.control.kernel import Numbers, kernel
from ridetune.control.path import read_curvatures
from ridetune.control.vehicle import Vehicle

NUM_STEPS = 50
STEP_S = 0.1
HEADING_V2 = 0.3
# Below this the model stands in for slower speeds: a standing car cannot be steered.
MIN_MODEL_MPS = 2.0
NUM_STATES = 3
# A row of preview gains: on the state, on the curvature and on the feed-forward of each step.
NUM_GAINS = NUM_STATES + 2 * NUM_STEPS


class BicycleModel(NamedTuple):
    """The nominal car of the controller: wheelbase [m], gradients [rad s^2/m], steering lag [s]."""

    wheelbase_m: float
    understeer: float
    rear_slip: float
    lag_s: float

    @staticmethod
    def of(vehicle: Vehicle) -> "BicycleModel":
        """The nominal model of a vehicle."""
        return BicycleModel(
            vehicle.body.wheelbase_m,
            vehicle.understeer_rad_per_mps2,
            vehicle.rear_slip_rad_per_mps2,
            vehicle.actuators.steer_lag_s,
        )


@kernel
def yaw_gain(model: BicycleModel, speed_mps: float) -> float:
    """Yaw rate per front-wheel angle in a steady turn [1/s]."""
    return speed_mps / (model.wheelbase_m + model.understeer * speed_mps * speed_mps)


@kernel
def slip_gain(model: BicycleModel, speed_mps: float) -> float:
    """Heading error less course error, per front-wheel angle."""
    return model.rear_slip * speed_mps * yaw_gain(model, speed_mps)


class Step(NamedTuple):
    """What differs from 0 and 1 in x' = A x + B u + D curvature, row and column in the names."""

    a01: float
    a02: float
    a12: float
    a22: float
    b0: float
    b1: float
    b2: float
    d0: float
    d1: float


@kernel
def discretise(model: BicycleModel, speed_mps: float, step_s: float) -> Step:
    """Exact discretisation for a command held over `step_s`, at constant speed and curvature.

    x = (lateral error, course error, front-wheel angle).
    """
    v, t, lag = speed_mps, step_s, model.lag_s
    gain, slip = yaw_gain(model, v), slip_gain(model, v)
    kept = math.exp(-t / lag)
    once = lag * (1.0 - kept)  # integral of exp(-t / lag)
    twice = lag * (t - once)  # its integral again
    return Step(
        v * t,
        v * (t * slip + gain * twice - slip * once),
        slip * (1.0 - kept) + gain * once,
        kept,
        v * (gain * (0.5 * t * t - twice) - slip * (t - once)),
        gain * (t - once) - slip * (1.0 - kept),
        1.0 - kept,
        -0.5 * v * v * t * t,
        -v * t,
    )


@kernel
def matrices(step: Step) -> tuple[Numbers, Numbers, Numbers]:
    """A [3, 3], B [3] and D [3] of a discretisation."""
    A, B, D = np.eye(NUM_STATES), np.zeros(NUM_STATES), np.zeros(NUM_STATES)
    A[0, 1], A[0, 2], A[1, 2], A[2, 2] = step.a01, step.a02, step.a12, step.a22
    B[0], B[1], B[2] = step.b0, step.b1, step.b2
    D[0], D[1] = step.d0, step.d1
    return A, B, D


@kernel
def state_weights(wl: float, wh: float, speed_mps: float) -> tuple[float, float]:
    """The diagonal of Q for lateral and course error."""
    return wl, wh + HEADING_V2 * speed_mps * speed_mps


@kernel
def riccati(step: Step, q_lateral: float, q_course: float, r: float) -> tuple[Numbers, Numbers]:
    """Finite-horizon Riccati recursion, backwards from P_N = Q = diag(q_lateral, q_course, 0).

    Returns the cost-to-go P [NUM_STEPS + 1, 3, 3] and the feedback K [NUM_STEPS, 3].
    """
    A, B, _ = matrices(step)
    P = np.empty((NUM_STEPS + 1, NUM_STATES, NUM_STATES))
    K = np.empty((NUM_STEPS, NUM_STATES))
    n = NUM_STATES
    PA = np.empty((n, n))
    P[NUM_STEPS] = 0.0
    P[NUM_STEPS, 0, 0] = q_lateral
    P[NUM_STEPS, 1, 1] = q_course
    for j in range(NUM_STEPS - 1, -1, -1):
        following = P[j + 1]
        s = r
        for a in range(n):
            pb = following[a, 0] * B[0] + following[a, 1] * B[1] + following[a, 2] * B[2]
            s += B[a] * pb
            for b in range(n):
                PA[a, b] = (
                    following[a, 0] * A[0, b]
                    + following[a, 1] * A[1, b]
                    + following[a, 2] * A[2, b]
                )
        for b in range(n):
            K[j, b] = (B[0] * PA[0, b] + B[1] * PA[1, b] + B[2] * PA[2, b]) / s
        for a in range(n):
            for b in range(a, n):
                value = A[0, a] * PA[0, b] + A[1, a] * PA[1, b] + A[2, a] * PA[2, b]
                value -= s * K[j, a] * K[j, b]
                P[j, a, b] = value
                P[j, b, a] = value
        P[j, 0, 0] += q_lateral
        P[j, 1, 1] += q_course
    return P, K


@kernel
def preview_gains(model: BicycleModel, weights: Numbers, speed_mps: float, gains: Numbers) -> None:
    """The optimal first command as a linear map, at one speed [m/s]; fills gains [NUM_GAINS].

    weights: (W_l, W_h, W_s). Order of the gains: NUM_STATES on the state, NUM_STEPS on the
    curvature and NUM_STEPS on the feed-forward angle of each step of the horizon.
    """
    step = discretise(model, speed_mps, STEP_S)
    A, B, D = matrices(step)
    q_lateral, q_course = state_weights(weights[0], weights[1], speed_mps)
    r = weights[2] * speed_mps * speed_mps
    P, K = riccati(step, q_lateral, q_course, r)
    s = r
    for a in range(3):
        s += B[a] * (P[1, a, 0] * B[0] + P[1, a, 1] * B[1] + P[1, a, 2] * B[2])
    row, pushed = B / s, np.empty(3)
    gains[:3] = -K[0]
    for j in range(NUM_STEPS):
        for a in range(3):
            pushed[a] = row[0] * P[j + 1, 0, a] + row[1] * P[j + 1, 1, a] + row[2] * P[j + 1, 2, a]
        gains[3 + j] = -(pushed[0] * D[0] + pushed[1] * D[1] + pushed[2] * D[2])
        gains[3 + NUM_STEPS + j] = -(pushed[0] * B[0] + pushed[1] * B[1] + pushed[2] * B[2])
        if j + 1 < NUM_STEPS:  # row <- row (A - B K)^T
            pushed[:] = row
            back = K[j + 1, 0] * row[0] + K[j + 1, 1] * row[1] + K[j + 1, 2] * row[2]
            for a in range(3):
                row[a] = A[a, 0] * pushed[0] + A[a, 1] * pushed[1] + A[a, 2] * pushed[2]
                row[a] -= B[a] * back
    gains[3 + NUM_STEPS] += 1.0


@kernel
def feed_forward(model: BicycleModel, speed_mps: float, smooth_curvature: float) -> float:
    """The front-wheel angle [rad] of a steady turn of this curvature [1/m]."""
    return (model.wheelbase_m + model.understeer * speed_mps * speed_mps) * smooth_curvature


@kernel
def preview_command(
    model: BicycleModel,
    low: Numbers,
    high: Numbers,
    share: float,
    speed_mps: float,
    state: Numbers,
    path: Numbers,
    at_m: float,
) -> float:
    """The optimal first command [rad], before limits, from the state at arc length `at_m` [m].

    low, high: gains at the speeds around; `share` in [0, 1] is the place between them, 0 for
    exact gains in `low`. Reads the path at the middle of each step of the horizon.
    """
    fed_back, bent, ahead = 0.0, 0.0, 0.0
    rest = 1.0 - share
    for a in range(NUM_STATES):
        fed_back += (rest * low[a] + share * high[a]) * state[a]
    for j in range(NUM_STEPS):
        bend, smooth = read_curvatures(path, at_m + (j + 0.5) * STEP_S * speed_mps)
        i, k = NUM_STATES + j, NUM_STATES + NUM_STEPS + j
        bent += (rest * low[i] + share * high[i]) * bend
        ahead += (rest * low[k] + share * high[k]) * smooth
    return fed_back + bent + ahead * feed_forward(model, speed_mps, 1.0)


@kernel
def roll_forward(
    model: BicycleModel,
    speed_mps: float,
    period_s: float,
    under_way: Numbers,
    path: Numbers,
    at_m: float,
    state: Numbers,
) -> float:
    """Delay compensation: the state and the arc length [m] when the next command takes effect.

    under_way: commands sent and not yet in effect, oldest first, one per control period [s].
    Updates `state` in place.
    """
    step = discretise(model, speed_mps, period_s)
    lateral, course, angle = state[0], state[1], state[2]
    for u in under_way:
        bend = read_curvatures(path, at_m + 0.5 * speed_mps * period_s)[0]
        lateral += step.a01 * course + step.a02 * angle + step.b0 * u + step.d0 * bend
        course += step.a12 * angle + step.b1 * u + step.d1 * bend
        angle = step.a22 * angle + step.b2 * u
        at_m += speed_mps * period_s
    state[0], state[1], state[2] = lateral, course, angle
    return at_m


@kernel
def clamp_steering(
    command_rad: float, last_rad: float, highest_rad: float, rate_radps: float, period_s: float
) -> float:
    """The command within the angle limit and the rate limit since the last one."""
    step = rate_radps * period_s
    command_rad = min(max(command_rad, last_rad - step), last_rad + step)
    return min(max(command_rad, -highest_rad), highest_rad)
