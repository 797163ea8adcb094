"""A robot arm with hidden causes, for bags whose truth is known. It shares no code with the package's models."""

from semiparam_ros.simulation.scenario import EffectRequest, Scenario, SimulatedRecording
from semiparam_ros.simulation.simulate import simulate

__all__ = ['EffectRequest', 'Scenario', 'SimulatedRecording', 'simulate']
