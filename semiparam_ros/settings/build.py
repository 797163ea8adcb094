"""Building the estimator that the settings describe, for the node and the offline commands alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters
from semiparam_ros.core.model import ModelOptions
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.settings import robot_description as description
from semiparam_ros.settings.parameter_table import Table, Value

if TYPE_CHECKING:
    from semiparam_ros.core.hyperparameters.window import LengthScales, Noise
    from semiparam_ros.effects import Effect


def build_estimator(settings: Table, robot_description: str | None = None, origin: int | None = None) -> Estimator:
    """The estimator of these settings; ``robot_description`` is the URDF of the topic or the bag, if there is one.

    :param origin: [ns] where the effects' time starts; None: with the first sample.

    Raises SemiparamError when the URDF, a joint, the sensor frame, an effect or a hyperparameter does not fit.
    """
    body = build_rigid_body(settings, robot_description)
    return Estimator(body, model_options(settings), declared_effects(settings), origin)


def build_rigid_body(settings: Table, robot_description: str | None = None) -> RigidBody:
    """The rigid-body regressor of the moving joints."""
    urdf = description.robot_description(settings, robot_description)
    joints = description.moving_joints(settings, urdf)
    description.check_temperatures(settings, joints)
    locked = dict(zip(settings.locked_joints_names, settings.locked_joints_positions, strict=True))
    return RigidBody.from_urdf(urdf, joints, settings.outputs, settings.sensor_frame or None,
                               settings.wrench_convention, locked, settings.output_joints)


def model_options(settings: Table) -> ModelOptions:
    """The part of the settings that the model itself knows."""
    return ModelOptions(
        variant=settings.variant, features_count=settings.features_count, features_seed=settings.features_seed,
        features_frequencies=settings.features_frequencies,
        length_scales=cast('LengthScales', settings.features_length_scales), noise=cast('Noise', settings.noise),
        initial_samples=settings.initial_samples, horizon=settings.horizon_length, forgetting=settings.forgetting,
        joint_friction=settings.joint_friction, priors=settings.priors,
        learn_every=settings.learn_every, learn_least_gain=settings.learn_least_gain,
        hyperparameters=given_hyperparameters(settings), input_mean=settings.hyperparameters_input_mean,
        input_scale=settings.hyperparameters_input_scale)


def given_hyperparameters(settings: Table) -> Hyperparameters | None:
    """Hyperparameters of the parameter file; None when the initial window is to give them."""
    if not settings.hyperparameters_sigma:
        return None
    gamma, rho = settings.hyperparameters_gamma, settings.hyperparameters_rho
    return Hyperparameters(
        gamma=gamma[0] if gamma else 0.0, rho=rho[0] if rho else 0.0, tau=settings.hyperparameters_tau,
        sigma=settings.hyperparameters_sigma[0], output_scale=settings.hyperparameters_output_scale,
        pi=settings.hyperparameters_pi or None,
        autocorrelation_time=next(iter(settings.hyperparameters_autocorrelation_time), 1.0))


def hyperparameter_values(hyperparameters: Hyperparameters, input_mean: tuple[float, ...],
                          input_scale: tuple[float, ...]) -> dict[str, Value]:
    """The parameters that hand hyperparameters on to the next start; the inverse of :func:`given_hyperparameters`."""
    scalars = {name: float(getattr(hyperparameters, name)) for name in ('gamma', 'rho', 'sigma')}
    values: dict[str, tuple[float, ...]] = {name: (value,) if value > 0.0 else () for name, value in scalars.items()}
    r = hyperparameters.autocorrelation_time
    values |= {'autocorrelation_time': (float(r),) if r > 1.0 else (), 'tau': hyperparameters.tau,
               'output_scale': hyperparameters.output_scale, 'pi': hyperparameters.pi or (),
               'input_mean': input_mean, 'input_scale': input_scale}
    found: dict[str, Value] = {f'hyperparameters.{name}': value for name, value in values.items()}
    return found | ({'features.count': hyperparameters.features} if hyperparameters.features else {})


def declared_effects(settings: Table) -> Sequence[Effect]:
    """The effects of the parameter ``effects``, in its order, with the reference model beside them."""
    if not settings.effects:
        return []
    from semiparam_ros.effects import effect_from_text  # only who declares an effect pays for loading them

    return [effect_from_text(text, settings.effects_reference) for text in settings.effects]
