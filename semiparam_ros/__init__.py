"""Online semi-parametric learning of a robot's inverse dynamics, as a ROS 2 package.

The names below are the public interface for Python programs; they load on first use, so that importing the package
costs nothing, and none of them needs ROS::

    from semiparam_ros import build_estimator, load_params, load_samples

    settings = load_params('estimator.yaml')
    bag = load_samples('recording.mcap', settings)
    estimator = build_estimator(settings, bag.robot_description)
    for sample in bag.samples:
        prediction = estimator.step(sample)  # predicts, then learns
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from semiparam_ros.errors import SemiparamError

if TYPE_CHECKING:
    from semiparam_ros.bags.loading import load_samples
    from semiparam_ros.core.estimator import Estimator
    from semiparam_ros.core.model import ModelOptions
    from semiparam_ros.core.robot.rigid_body import RigidBody
    from semiparam_ros.core.samples import Sample, Samples
    from semiparam_ros.diagnosis.config import DiagnosisConfig
    from semiparam_ros.diagnosis.diagnose import diagnose
    from semiparam_ros.effects.base import Effect
    from semiparam_ros.effects.registry import effect_from_text
    from semiparam_ros.settings.build import build_estimator
    from semiparam_ros.settings.files import load_params
    from semiparam_ros.settings.snapshot import Settings

__version__ = '0.2.0'

__all__ = [
    'DiagnosisConfig',
    'Effect',
    'Estimator',
    'ModelOptions',
    'RigidBody',
    'Sample',
    'Samples',
    'SemiparamError',
    'Settings',
    '__version__',
    'build_estimator',
    'diagnose',
    'effect_from_text',
    'load_params',
    'load_samples',
]

_MODULES = {
    'DiagnosisConfig': 'semiparam_ros.diagnosis.config',
    'Effect': 'semiparam_ros.effects.base',
    'Estimator': 'semiparam_ros.core.estimator',
    'ModelOptions': 'semiparam_ros.core.model',
    'RigidBody': 'semiparam_ros.core.robot.rigid_body',
    'Sample': 'semiparam_ros.core.samples',
    'Samples': 'semiparam_ros.core.samples',
    'Settings': 'semiparam_ros.settings.snapshot',
    'build_estimator': 'semiparam_ros.settings.build',
    'diagnose': 'semiparam_ros.diagnosis.diagnose',
    'effect_from_text': 'semiparam_ros.effects.registry',
    'load_params': 'semiparam_ros.settings.files',
    'load_samples': 'semiparam_ros.bags.loading',
}
"""Modules that define the public names, read when one is first asked for (PEP 562)."""


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = globals()[name] = getattr(importlib.import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
