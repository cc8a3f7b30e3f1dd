"""The simulated car: a dynamic bicycle with saturating tyres, lags, delays and a spread.

State: pose of the rear axle's middle, body speeds at the centre of gravity, yaw rate, front-wheel
angle, acceleration. Tyres are Fiala's brush model: linear with the cornering stiffness at small
slip, bounded by friction times load, less what acceleration takes of it (friction circle). Below a
walking pace the car rolls kinematically, above it dynamically, with a blend between (the slip of
a standing tyre is not defined).

Source: R. Rajamani, Vehicle Dynamics and Control, 2nd ed., 2.3 (bicycle), 13.5 (brush tyre).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ridetune.control.headway import GRAVITY_MPS2
from ridetune.control.kernel import Numbers, kernel
from ridetune.control.vehicle import Vehicle

# The cells of a plant state.
X, Y, HEADING, SPEED, LATERAL, YAW_RATE, STEER, ACCELERATION = range(8)
NUM_CELLS = 8
SUBSTEPS = 3
# Purely kinematic below the first speed, purely dynamic above the second [m/s].
KINEMATIC_BELOW_MPS, DYNAMIC_ABOVE_MPS = 1.5, 3.5
# Braking and accelerating never take the whole friction [share].
_LARGEST_GRIP = 0.95


@dataclass(frozen=True)
class Spread:
    """How one car differs from its nominal: scales of mass and tyres, and its own delays [s].

    None takes the vehicle's delay. The mass acts on the tyres and, as drive and brake are
    mapped for the nominal car, divides the acceleration that a command gives.
    """

    mass: float = 1.0
    tyres: float = 1.0
    steer_delay_s: float | None = None
    acceleration_delay_s: float | None = None


NOMINAL = Spread()


def draw_spread(rng: np.random.Generator) -> Spread:
    """A car of the verified population: mass +-20 %, tyres 0.7-1.1, steering delay to 0.15 s."""
    return Spread(
        mass=float(rng.uniform(0.8, 1.2)),
        tyres=float(rng.uniform(0.7, 1.1)),
        steer_delay_s=float(rng.uniform(0.0, 0.15)),
        acceleration_delay_s=float(rng.uniform(0.05, 0.15)),
    )


class Plant(NamedTuple):
    """One car on one road in numbers; delays in substeps, `pull` is acceleration per command."""

    mass_kg: float
    yaw_inertia_kgm2: float
    front_m: float
    rear_m: float
    front_stiffness: float
    rear_stiffness: float
    friction: float
    pull: float
    steer_lag_s: float
    acceleration_lag_s: float
    steer_delay: int
    acceleration_delay: int

    @staticmethod
    def of(vehicle: Vehicle, spread: Spread, friction: float, period_s: float) -> "Plant":
        """A vehicle's spread copy on a road of this friction; delays rounded to substeps."""
        body, actuators = vehicle.body, vehicle.actuators
        steer = spread.steer_delay_s
        acceleration = spread.acceleration_delay_s
        steer = actuators.steer_delay_s if steer is None else steer
        acceleration = actuators.acceleration_delay_s if acceleration is None else acceleration
        return Plant(
            mass_kg=body.mass_kg * spread.mass,
            yaw_inertia_kgm2=body.yaw_inertia_kgm2 * spread.mass,
            front_m=body.cg_behind_front_m,
            rear_m=body.cg_before_rear_m,
            front_stiffness=vehicle.tyres.front_n_per_rad * spread.tyres,
            rear_stiffness=vehicle.tyres.rear_n_per_rad * spread.tyres,
            friction=friction,
            pull=1.0 / spread.mass,
            steer_lag_s=actuators.steer_lag_s,
            acceleration_lag_s=actuators.acceleration_lag_s,
            steer_delay=round(steer * SUBSTEPS / period_s),
            acceleration_delay=round(acceleration * SUBSTEPS / period_s),
        )


@kernel
def tyre_force(stiffness: float, slip_rad: float, largest_n: float) -> float:
    """Lateral force of an axle [N] at a slip angle, brush model, at most `largest_n`."""
    linear = stiffness * slip_rad
    share = abs(linear) / (3.0 * largest_n)
    if share >= 1.0:
        return math.copysign(largest_n, linear)
    return linear * (1.0 - share + share * share / 3.0)


@kernel
def slide(
    plant: Plant, speed: float, lateral: float, yaw_rate: float, steer: float, pull: float
) -> tuple[float, float]:
    """Time derivatives of the lateral speed at the centre of gravity and of the yaw rate."""
    grip = plant.friction * GRAVITY_MPS2
    left = math.sqrt(max(1.0 - (pull / grip) ** 2, 0.05))
    per_metre = plant.mass_kg * grip * left / (plant.front_m + plant.rear_m)
    front_slip = steer - (lateral + plant.front_m * yaw_rate) / speed
    rear_slip = -(lateral - plant.rear_m * yaw_rate) / speed
    front = tyre_force(plant.front_stiffness, front_slip, per_metre * plant.rear_m)
    rear = tyre_force(plant.rear_stiffness, rear_slip, per_metre * plant.front_m)
    turning = (plant.front_m * front - plant.rear_m * rear) / plant.yaw_inertia_kgm2
    return (front + rear) / plant.mass_kg - speed * yaw_rate, turning


@kernel
def delayed(sent: Numbers, substep: int, delay: int) -> float:
    """The command that acts at a substep; before the first one that was sent, 0."""
    at = substep - delay
    return sent[at // SUBSTEPS] if at >= 0 else 0.0


@kernel
def move(
    plant: Plant,
    state: Numbers,
    steer_sent: Numbers,
    acceleration_sent: Numbers,
    step: int,
    period_s: float,
) -> None:
    """Drive one control period on, in SUBSTEPS midpoint steps; updates `state` in place.

    steer_sent [rad], acceleration_sent [m/s^2]: all commands so far, one per control step; the
    last one is at index `step`.
    """
    h = period_s / SUBSTEPS
    steer_share = 1.0 - math.exp(-h / plant.steer_lag_s)
    pull_share = 1.0 - math.exp(-h / plant.acceleration_lag_s)
    most = _LARGEST_GRIP * plant.friction * GRAVITY_MPS2
    for i in range(SUBSTEPS):
        now = step * SUBSTEPS + i
        steer = delayed(steer_sent, now, plant.steer_delay)
        pull = plant.pull * delayed(acceleration_sent, now, plant.acceleration_delay)
        state[STEER] += steer_share * (steer - state[STEER])
        state[ACCELERATION] += pull_share * (pull - state[ACCELERATION])
        state[ACCELERATION] = min(max(state[ACCELERATION], -most), most)
        _substep(plant, state, h)


@kernel
def _substep(plant: Plant, state: Numbers, h: float) -> None:
    pull, steer, yaw_before = state[ACCELERATION], state[STEER], state[YAW_RATE]
    speed = state[SPEED] + 0.5 * h * pull
    wheelbase = plant.front_m + plant.rear_m
    share = (speed - KINEMATIC_BELOW_MPS) / (DYNAMIC_ABOVE_MPS - KINEMATIC_BELOW_MPS)
    share = min(max(share, 0.0), 1.0)
    lateral, yaw_rate = 0.0, 0.0
    if share < 1.0:
        yaw_rate = (1.0 - share) * max(speed, 0.0) * math.tan(steer) / wheelbase
        lateral = plant.rear_m * yaw_rate
    if share > 0.0:
        first, turning = slide(plant, speed, state[LATERAL], yaw_before, steer, pull)
        mid_lateral = state[LATERAL] + 0.5 * h * first
        mid_yaw = yaw_before + 0.5 * h * turning
        second, turning = slide(plant, speed, mid_lateral, mid_yaw, steer, pull)
        lateral += share * (state[LATERAL] + h * second)
        yaw_rate += share * (yaw_before + h * turning)
    across = 0.5 * (state[LATERAL] + lateral) - plant.rear_m * 0.5 * (yaw_before + yaw_rate)
    heading = state[HEADING] + 0.25 * h * (yaw_before + yaw_rate)
    state[X] += h * (max(speed, 0.0) * math.cos(heading) - across * math.sin(heading))
    state[Y] += h * (max(speed, 0.0) * math.sin(heading) + across * math.cos(heading))
    state[HEADING] += 0.5 * h * (yaw_before + yaw_rate)
    state[LATERAL], state[YAW_RATE] = lateral, yaw_rate
    state[SPEED] += h * pull
    if state[SPEED] <= 0.0:
        state[SPEED] = 0.0
        state[ACCELERATION] = max(pull, 0.0)
