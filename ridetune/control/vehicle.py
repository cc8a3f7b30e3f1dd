"""The vehicle: its geometry, tyres, actuators, command limits and sensors, read from YAML.

In: `configs/vehicle.yaml`. Out: one frozen value that the controllers (as their nominal model) and
the simulation (as the centre of its spread) share. SI units, front-wheel angles.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

from ridetune.config import load_config


@dataclass(frozen=True)
class Body:
    """Geometry [m], mass [kg] and yaw inertia [kg m^2] of the loaded car."""

    length_m: float
    width_m: float
    wheelbase_m: float
    front_overhang_m: float
    cg_behind_front_m: float
    mass_kg: float
    yaw_inertia_kgm2: float

    @property
    def cg_before_rear_m(self) -> float:
        """From the rear axle forward to the centre of gravity."""
        return self.wheelbase_m - self.cg_behind_front_m

    @property
    def nose_m(self) -> float:
        """From the rear axle, the reference point of every pose, to the front bumper."""
        return self.wheelbase_m + self.front_overhang_m


@dataclass(frozen=True)
class Tyres:
    """Cornering stiffness of each axle [N/rad]."""

    front_n_per_rad: float
    rear_n_per_rad: float


@dataclass(frozen=True)
class Actuators:
    """First-order lags and pure delays [s] from a command to the wheels."""

    steer_lag_s: float
    steer_delay_s: float
    acceleration_lag_s: float
    acceleration_delay_s: float


@dataclass(frozen=True)
class Limits:
    """What a command may ask for; all positive, braking_mps2 and jerk_mps3 as magnitudes."""

    acceleration_mps2: float
    braking_mps2: float
    jerk_mps3: float
    steer_rad: float
    steer_rate_radps: float


@dataclass(frozen=True)
class Sensors:
    """Standard deviations of the white measurement noise."""

    lateral_m: float
    heading_rad: float
    speed_mps: float
    steer_rad: float


@dataclass(frozen=True)
class Vehicle:
    """One car. ValueError when it is made with a number that no car has."""

    name: str
    body: Body
    tyres: Tyres
    actuators: Actuators
    limits: Limits
    sensors: Sensors

    def __post_init__(self) -> None:
        for section in (self.body, self.tyres, self.limits):
            for key, value in asdict(section).items():
                if not 0.0 < value < float("inf"):
                    raise ValueError(f"vehicle {self.name}: {key} must be positive, got {value}")
        for part in (self.actuators, self.sensors):
            for key, value in asdict(part).items():
                if not 0.0 <= value < float("inf"):
                    raise ValueError(f"vehicle {self.name}: {key} must be 0 or more, got {value}")
        if min(self.actuators.steer_lag_s, self.actuators.acceleration_lag_s) < 0.02:
            raise ValueError(f"vehicle {self.name}: an actuator lag below 0.02 s is not resolved")
        if self.body.cg_behind_front_m >= self.body.wheelbase_m:
            raise ValueError(f"vehicle {self.name}: cg_behind_front_m must be below wheelbase_m")

    @property
    def understeer_rad_per_mps2(self) -> float:
        """Extra front-wheel angle per lateral acceleration in a steady turn."""
        body, tyres = self.body, self.tyres
        per_axle = body.cg_before_rear_m / tyres.front_n_per_rad
        per_axle -= body.cg_behind_front_m / tyres.rear_n_per_rad
        return body.mass_kg / body.wheelbase_m * per_axle

    @property
    def rear_slip_rad_per_mps2(self) -> float:
        """Slip angle of the rear axle per lateral acceleration in a steady turn."""
        body = self.body
        rear_load_share = body.cg_behind_front_m / body.wheelbase_m
        return body.mass_kg * rear_load_share / self.tyres.rear_n_per_rad

    @staticmethod
    def load(path: Path) -> "Vehicle":
        """Read a vehicle YAML; ValueError names the file and the wrong entry."""
        return load_config(Vehicle, path)
