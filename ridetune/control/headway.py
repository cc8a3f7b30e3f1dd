"""The safe-gap rule: how fast the car may go, and how hard it must brake, for what is ahead.

A cap on the reference speed (Gipps 1981, with equal braking of both cars): the car that takes
`reaction_s` to react and then brakes with `braking_mps2` comes to rest `standstill_m` behind what
is ahead, wherever that brakes as hard. At equal speeds the gap settles at
standstill_m + reaction_s * speed. A standing object or a closed stop line is a lead at speed 0.

Slow gains would follow a falling cap too late, so the acceleration command has a ceiling as well,
whatever the gains: above the cap it is at most -(speed - cap) / recovery_s, and once the constant
braking that the gap demands comes near `braking_mps2`, at most minus that.
"""

import math
from typing import NamedTuple

from ridetune.control.kernel import kernel

GRAVITY_MPS2 = 9.81
# Below this the capped reference is 0 and the car holds its brake [m/s, m/s^2].
CREEP_MPS = 0.3
HOLD_MPS2 = -0.6
# The ceiling goes from free to the demanded braking between these shares of `braking_mps2`.
CEILING_FROM, CEILING_TO = 0.5, 1.0
# No shorter distance is divided by [m].
_SHORTEST_M = 0.05


class Headway(NamedTuple):
    """The rule's parameters; dead_time_s is what passes before braking acts."""

    standstill_m: float = 3.0
    reaction_s: float = 1.0
    braking_mps2: float = 2.0
    recovery_s: float = 2.0
    dead_time_s: float = 0.4

    def on_friction(self, friction: float) -> "Headway":
        """The rule on a road of this friction coefficient: it plans with half of it at most."""
        return self._replace(braking_mps2=min(self.braking_mps2, 0.5 * friction * GRAVITY_MPS2))


@kernel
def safe_speed(gap_m: float, lead_mps: float, rule: Headway) -> float:
    """The cap on the reference speed [m/s]; infinite on a free road (infinite gap)."""
    if math.isinf(gap_m):
        return gap_m
    room = max(gap_m - rule.standstill_m, 0.0)
    slowing = rule.braking_mps2 * rule.reaction_s
    speed = math.sqrt(slowing**2 + lead_mps**2 + 2.0 * rule.braking_mps2 * room) - slowing
    return speed if speed > CREEP_MPS else 0.0


@kernel
def braking_ceiling(
    gap_m: float, speed_mps: float, lead_mps: float, lead_mps2: float, rule: Headway
) -> float:
    """The upper limit of the acceleration command [m/s^2] that the gap allows; inf if free."""
    if math.isinf(gap_m):
        return math.inf
    excess, closing = speed_mps - safe_speed(gap_m, lead_mps, rule), speed_mps - lead_mps
    ceiling = -excess / rule.recovery_s if excess > 0.0 else math.inf
    if closing <= 0.0:
        return ceiling
    room = max(gap_m - rule.standstill_m - closing * rule.dead_time_s, _SHORTEST_M)
    demanded = closing**2 / (2.0 * room) - min(lead_mps2, 0.0)
    start = CEILING_FROM * rule.braking_mps2
    share = (demanded - start) / ((CEILING_TO - CEILING_FROM) * rule.braking_mps2)
    if share <= 0.0:
        return ceiling
    free = rule.braking_mps2
    return min(ceiling, free - min(share, 1.0) * (free + demanded))


@kernel
def hold_ceiling(reference_mps: float, speed_mps: float, ceiling_mps2: float) -> float:
    """The ceiling, lowered to a held brake where the car is to stand and nearly does."""
    if reference_mps <= 0.0 and speed_mps < 2.0 * CREEP_MPS:
        return min(ceiling_mps2, HOLD_MPS2)
    return ceiling_mps2
