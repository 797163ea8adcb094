"""A wrench without weight, inertia and bias of the tool, for force controllers, which never jumps by itself.

What the sensor shows of the bodies behind it is psi(x) pi + b, with the base parameters pi of these bodies, loads and
known tools among them, and the bias b. Here both follow what the model says of them with a time constant T,

    pi <- pi + (1 - exp(-dt / T)) (pi_model - pi),

so that a tare, a tool that is declared, another model or a forgotten one changes the compensated wrench within T, not
between two samples. While samples are not learnt, as in a contact, nothing changes.
"""

from __future__ import annotations

from math import exp

import numpy as np

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.prediction import Prediction
from semiparam_ros.core.robot.frames import load_in_base
from semiparam_ros.core.stamps import observed_s
from semiparam_ros.core.types import Array


def bodies_and_bias(estimator: Estimator, prediction: Prediction) -> tuple[Array, Array]:
    """(p,) base parameters of what hangs on the sensor, and its bias (6,), by what the model has learnt so far.

    Declared loads that act at the sample are part of the bodies, what is the sensor's own (drift, gains) of the bias. A
    model without either has those of the robot description, and no bias.
    """
    model, columns, body = estimator.rigid_body_model, estimator.columns, estimator.body
    blocks = columns.blocks
    learnt, bias = model.part(blocks['rigid_body']), model.part(blocks['offset'])
    bodies = learnt.copy() if len(learnt) else body.base_parameters.copy()
    bias = bias.copy() if len(bias) else np.zeros(body.n_outputs)
    for index, effect in enumerate(columns.effects):
        block = blocks[str(index)]
        acting = prediction.columns[:, block]
        if effect.of_sensor:
            bias += acting @ model.part(block)
        elif effect.is_load and acting.any():
            bodies += load_in_base(body, str(effect.where), model.part(block))
    return bodies, bias


class Compensation:
    """Bodies and bias as they are taken off.

    :param time_constant: T [s]; 0: at once.
    """

    def __init__(self, time_constant: float) -> None:
        self.time_constant = time_constant
        self._followed: Array | None = None
        self._newest: int | None = None

    def taken_off(self, prediction: Prediction, bodies: Array, bias: Array) -> Array:
        """(6,) what is to be taken off the measured wrench of a sample, in N and N m.

        :param bodies: (p,) that the model says. :param bias: (6,) of the measured wrench.
        """
        wanted = np.concatenate([bodies, bias])
        stamp = prediction.sample.stamp
        seconds, self._newest = observed_s(stamp, self._newest), stamp
        if self._followed is None or not self.time_constant:
            self._followed = wanted
        else:
            share = 1.0 - exp(-seconds / self.time_constant)
            self._followed = self._followed + share * (wanted - self._followed)
        followed = self._followed
        return prediction.columns[:, :len(bodies)] @ followed[:len(bodies)] + followed[len(bodies):]
