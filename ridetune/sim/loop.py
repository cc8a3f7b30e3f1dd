"""The closed loop, compiled: road, car and matrix -> one row of signals per control step.

Each step: place on the path -> what is ahead -> one row -> still driving? -> noisy measurement ->
PID and MPC -> commands -> the plant moves on. It runs in stretches of steps, so that a matrix can
change between them; a stretch picks up where the last one left its `Memory`.

Exact: the plant, the PID, the delay compensation and the MPC without limits at the speeds of its
bins. Approximate: the MPC's gains between bins (linear; see `tests/test_rollout.py` for the size),
and its limits, which clamp the first command instead of entering the optimisation, as in
Autoware's unconstrained solver.
"""

import math
from typing import NamedTuple

import numpy as np

from ridetune.control.headway import braking_ceiling, hold_ceiling, safe_speed
from ridetune.control.kernel import Numbers, kernel
from ridetune.control.mpc import (
    MIN_MODEL_MPS,
    NUM_GAINS,
    NUM_STATES,
    BicycleModel,
    clamp_steering,
    preview_command,
    preview_gains,
    roll_forward,
    slip_gain,
)
from ridetune.control.path import SPEED as PATH_SPEED
from ridetune.control.path import locate, wrap
from ridetune.control.pid import CommandLimits, pid_step, swap_integral
from ridetune.control.vehicle import Vehicle
from ridetune.sim.plant import (
    ACCELERATION,
    HEADING,
    LATERAL,
    NUM_CELLS,
    SPEED,
    STEER,
    YAW_RATE,
    Plant,
    X,
    Y,
    move,
)
from ridetune.sim.road import WAITS, Road, bumper_gap, in_the_way

# How a run goes: it drives on, or why it ended.
DRIVING, COLLIDED, LEFT_LANE, UNSTABLE = range(4)
LANE_MARGIN_M = 1.5
# A car that points this far from its path has spun [rad].
_SPUN_RAD = 1.0
STANDING_MPS = 0.1
# Gains are exact at these speeds and linear between them.
BIN_MPS = 0.5
NUM_BINS = 64
# How the car stops in its lane when no matrix comes any more.
STOP_MPS2 = 1.5
NUM_NOISES = 4


class Ego(NamedTuple):
    """The controllers' side of one car: nominal model, limits, delay, and its noise levels."""

    model: BicycleModel
    limits: CommandLimits
    steer_rad: float
    steer_rate_radps: float
    delay_steps: int
    noise_lateral_m: float
    noise_heading_rad: float
    noise_speed_mps: float
    noise_steer_rad: float

    @staticmethod
    def of(vehicle: Vehicle, period_s: float) -> "Ego":
        """The nominal controllers of a vehicle at a control period [s]."""
        sensors = vehicle.sensors
        return Ego(
            model=BicycleModel.of(vehicle),
            limits=CommandLimits.of(vehicle.limits, period_s),
            steer_rad=vehicle.limits.steer_rad,
            steer_rate_radps=vehicle.limits.steer_rate_radps,
            delay_steps=round(vehicle.actuators.steer_delay_s / period_s),
            noise_lateral_m=sensors.lateral_m,
            noise_heading_rad=sensors.heading_rad,
            noise_speed_mps=sensors.speed_mps,
            noise_steer_rad=sensors.steer_rad,
        )


class Memory(NamedTuple):
    """What a run carries from step to step; `place` is the index on the path and a stop's speed."""

    state: Numbers
    pid: Numbers
    place: Numbers
    clocks: Numbers
    steer_sent: Numbers
    acceleration_sent: Numbers
    gains: Numbers
    ready: Numbers


def begin(road: Road, steps: int, gains: Numbers, ready: Numbers) -> Memory:
    """A car at the start of its road, rolling straight at the initial speed.

    gains [NUM_BINS, NUM_GAINS], and ready [NUM_BINS]: 0 where they are still to be computed. Runs
    with the same matrix may share both.
    """
    state, pid = np.zeros(NUM_CELLS), np.zeros(3)
    state[SPEED] = pid[0] = road.initial_mps
    place, clocks = np.array([0.0, np.inf]), np.zeros(len(road.bodies))
    return Memory(state, pid, place, clocks, np.zeros(steps), np.zeros(steps), gains, ready)


def new_gains() -> tuple[Numbers, Numbers]:
    """Gains [NUM_BINS, NUM_GAINS] that are still to be computed, and marks that say so."""
    return np.zeros((NUM_BINS, NUM_GAINS)), np.zeros(NUM_BINS)


def swap(memory: Memory, ki_before: float, ki_after: float) -> None:
    """Make ready for another matrix: the integral is carried over, the MPC's gains are not."""
    swap_integral(memory.pid, ki_before, ki_after)
    memory.ready[:] = 0.0


@kernel
def steer(
    matrix: Numbers,
    ego: Ego,
    road: Road,
    memory: Memory,
    step: int,
    at_m: float,
    measured: Numbers,
    speed_mps: float,
) -> float:
    """The steering command [rad]; measured: lateral error, heading error, front-wheel angle."""
    speed = max(speed_mps, MIN_MODEL_MPS)
    place = min((speed - MIN_MODEL_MPS) / BIN_MPS, NUM_BINS - 1.001)
    low = int(place)
    for b in (low, low + 1):
        if memory.ready[b] == 0.0:
            preview_gains(ego.model, matrix[3:], MIN_MODEL_MPS + b * BIN_MPS, memory.gains[b])
            memory.ready[b] = 1.0
    measured[1] -= slip_gain(ego.model, speed) * measured[2]
    last = memory.steer_sent[step - 1] if step > 0 else 0.0
    # Before the first command the wheels stood straight: zeros are under way.
    waiting = memory.steer_sent[max(step - ego.delay_steps, 0) : step]
    period_s = ego.limits.period_s
    at_m = roll_forward(ego.model, speed, period_s, waiting, road.path, at_m, measured)
    command = preview_command(
        ego.model,
        memory.gains[low],
        memory.gains[low + 1],
        place - low,
        speed,
        measured,
        road.path,
        at_m,
    )
    return clamp_steering(command, last, ego.steer_rad, ego.steer_rate_radps, period_s)


@kernel
def reference_speed(
    road: Road,
    memory: Memory,
    time_s: float,
    stopping: bool,
    gap: float,
    lead_mps: float,
    period_s: float,
) -> float:
    """The speed asked for [m/s]: the path's, capped by the gap ahead and by a stop in the lane."""
    asked = road.path[int(memory.place[0]), PATH_SPEED] if time_s >= road.drive_off_s else 0.0
    if stopping:
        before = min(memory.place[1], memory.state[SPEED])
        memory.place[1] = max(before - STOP_MPS2 * period_s, 0.0)
        asked = min(asked, memory.place[1])
    else:
        memory.place[1] = np.inf
    return min(asked, safe_speed(gap, lead_mps, road.headway))


@kernel
def record(
    row: Numbers,
    state: Numbers,
    reference: float,
    lateral: float,
    error: float,
    gap: float,
    lead: float,
) -> None:
    """Fill one row in the order of SIGNALS."""
    row[0], row[1], row[2], row[3] = state[X], state[Y], state[HEADING], state[SPEED]
    row[4], row[5], row[6] = state[ACCELERATION], state[STEER], state[YAW_RATE]
    row[7], row[8], row[9], row[10] = state[LATERAL], reference, lateral, error
    row[11], row[12] = gap, lead


@kernel
def drive(
    first: int,
    last: int,
    matrix: Numbers,
    stopping: bool,
    ego: Ego,
    plant: Plant,
    road: Road,
    noise: Numbers,
    memory: Memory,
    signals: Numbers,
) -> int:
    """Drive the steps first..last-1; returns DRIVING, or why the run ended.

    matrix [6] in the order of PARAMETERS; noise [step, NUM_NOISES], standard normal; signals
    [step, signal] is filled, and left alone behind the end of the run. stopping: brake to rest
    in the lane, whatever the path asks for.
    """
    state, period_s = memory.state, ego.limits.period_s
    for k in range(first, last):
        index, at_m, lateral, path_heading = locate(
            road.path, int(memory.place[0]), state[X], state[Y]
        )
        memory.place[0] = index
        error = wrap(state[HEADING] - path_heading)
        speed = state[SPEED] + ego.noise_speed_mps * noise[k, 2]
        speed = max(speed, 0.0)
        gap, lead, braking = in_the_way(road, memory.clocks, state[X], at_m)
        ahead, ahead_mps, hit = bumper_gap(road, memory.clocks, state)
        reference = reference_speed(road, memory, k * period_s, stopping, gap, lead, period_s)
        record(signals[k], state, reference, lateral, error, ahead, ahead_mps)
        if hit:
            return COLLIDED
        if abs(lateral) > LANE_MARGIN_M:
            return LEFT_LANE
        ceiling = braking_ceiling(gap, speed, lead, braking, road.headway)
        if stopping:
            ceiling = min(ceiling, -STOP_MPS2)
        ceiling = hold_ceiling(reference, speed, ceiling)
        measured = np.empty(NUM_STATES)
        measured[0] = lateral + ego.noise_lateral_m * noise[k, 0]
        measured[1] = error + ego.noise_heading_rad * noise[k, 1]
        measured[2] = state[STEER] + ego.noise_steer_rad * noise[k, 3]
        angle = steer(matrix, ego, road, memory, k, at_m, measured, speed)
        pull = pid_step(
            memory.pid, matrix[0], matrix[1], matrix[2], reference, speed, ceiling, ego.limits
        )
        if not (math.isfinite(angle) and math.isfinite(pull)) or abs(error) > _SPUN_RAD:
            return UNSTABLE
        memory.steer_sent[k], memory.acceleration_sent[k] = angle, pull
        move(plant, state, memory.steer_sent, memory.acceleration_sent, k, period_s)
        standing = state[SPEED] < STANDING_MPS and (k + 1) * period_s > road.drive_off_s + 1.0
        for actor in range(len(road.bodies)):
            if road.bodies[actor, WAITS] == 0.0 or memory.clocks[actor] > 0.0 or standing:
                memory.clocks[actor] += 1.0
    return DRIVING
