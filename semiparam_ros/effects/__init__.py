"""Effects: named physical causes that a rigid body with constant parameters does not hold."""

from semiparam_ros.effects.base import Coefficient, Effect
from semiparam_ros.effects.registry import effect_from_text, effect_to_text, effects_to_parameters, kinds

__all__ = ['Coefficient', 'Effect', 'effect_from_text', 'effect_to_text', 'effects_to_parameters', 'kinds']
