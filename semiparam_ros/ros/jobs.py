"""What the node's background process does. Functions of picklable arguments; nothing here knows ROS."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from semiparam_ros.core.horizon import HorizonErrors
from semiparam_ros.core.hyperparameters import Hyperparameters
from semiparam_ros.core.model import Estimator, Prediction
from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.history import Chapter
from semiparam_ros.settings.build import declared_effects, hyperparameter_values, model_options
from semiparam_ros.settings.snapshot import Settings

EstimatorJob = Callable[..., Estimator]
"""Gives an estimator, in the background."""


class Known(NamedTuple):
    """Hyperparameters that an earlier estimate gave for the same model, with the scaling of its inputs."""

    hyperparameters: Hyperparameters
    input_mean: tuple[float, ...]
    input_scale: tuple[float, ...]


class Window(NamedTuple):
    """An estimator after its initial window: ready, or with ``failure`` to say why it is not, and the window empty."""

    estimator: Estimator
    errors: HorizonErrors | None = None
    failure: SemiparamError | None = None


def finish_window(estimator: Estimator, prediction: Prediction) -> Window:
    """Learn the sample that completes the initial window: the hyperparameters are estimated here."""
    try:
        return Window(estimator, estimator.observe(prediction))
    except SemiparamError as error:  # the provisional model has learnt the sample all the same
        estimator.window = []
        return Window(estimator, failure=error)


def build(settings: Settings, body: RigidBody, chapter: Chapter, known: Known | None) -> Estimator:
    """A new estimator that has seen all samples of a chapter."""
    origin = None if chapter.samples is None else chapter.samples.origin
    return absorb(new_estimator(settings, body, known, origin), chapter)


def new_estimator(settings: Settings, body: RigidBody, known: Known | None = None,
                  origin: int | None = None) -> Estimator:
    """An estimator that has learnt nothing yet; time counts from ``origin`` [ns]."""
    if known is not None:
        settings = settings.changed(hyperparameter_values(*known))
    return Estimator(body, model_options(settings), declared_effects(settings, body), origin)


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
