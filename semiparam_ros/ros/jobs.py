"""What the node's background process does. Functions of picklable arguments; nothing here knows ROS."""

from __future__ import annotations

from typing import NamedTuple

from semiparam_ros.core.horizon import HorizonErrors
from semiparam_ros.core.hyperparameters import Hyperparameters
from semiparam_ros.core.model import Estimator, Prediction
from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.ros.history import Chapter
from semiparam_ros.settings.build import declared_effects, hyperparameter_values, model_options
from semiparam_ros.settings.snapshot import Settings


class Known(NamedTuple):
    """Hyperparameters that an earlier estimate gave for the same model, with the scaling of its inputs."""

    hyperparameters: Hyperparameters
    input_mean: tuple[float, ...]
    input_scale: tuple[float, ...]


def observe(estimator: Estimator, prediction: Prediction) -> tuple[Estimator, HorizonErrors | None]:
    """Learn the sample that completes the initial window: the hyperparameters are estimated here."""
    errors = estimator.observe(prediction)
    return estimator, errors


def build(settings: Settings, body: RigidBody, chapter: Chapter, known: Known | None) -> Estimator:
    """A new estimator that has seen all samples of a chapter."""
    return absorb(new_estimator(settings, body, known), chapter)


def new_estimator(settings: Settings, body: RigidBody, known: Known | None = None) -> Estimator:
    """An estimator that has learnt nothing yet."""
    if known is not None:
        settings = settings.changed(hyperparameter_values(*known))
    return Estimator(body, model_options(settings), declared_effects(settings, body))


def absorb(estimator: Estimator, chapter: Chapter) -> Estimator:
    """Predict and learn further samples, as the node did when they came."""
    for sample, learnt in chapter.pairs():
        estimator.step(sample, learnt)
    return estimator


def known_of(estimator: Estimator) -> Known | None:
    """The hyperparameters of an estimator whose initial window is over."""
    if not estimator.ready or estimator.input_scaling is None:
        return None
    mean, scale = estimator.input_scaling
    return Known(estimator.model.hyperparameters, tuple(mean.tolist()), tuple(scale.tolist()))
