"""What the weather and the light do to a drive: friction of the road and how far one sees.

Friction coefficients are round values of a passenger car's tyres (dry asphalt 0.9, wet 0.6, packed
snow 0.35); fog and night leave the road a little damp. Visibility is the distance [m] at which the
car notices what is ahead: low beams at night, moderate fog.
"""

from dataclasses import dataclass

from ridetune.sample import Condition


@dataclass(frozen=True)
class ConditionEffects:
    """One condition in numbers: peak friction coefficient, visibility [m]."""

    friction: float
    visibility_m: float


EFFECTS: dict[Condition, ConditionEffects] = {
    "sunny": ConditionEffects(friction=0.9, visibility_m=250.0),
    "rain": ConditionEffects(friction=0.6, visibility_m=120.0),
    "fog": ConditionEffects(friction=0.8, visibility_m=60.0),
    "snow": ConditionEffects(friction=0.35, visibility_m=80.0),
    "night": ConditionEffects(friction=0.85, visibility_m=70.0),
}
