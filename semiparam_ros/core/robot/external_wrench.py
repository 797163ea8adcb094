"""Wrench that acts on the robot from outside: the outputs minus everything that the model knows, as
a force and a couple.

A wrench F = (f, m) from outside at a frame of a link changes the outputs by A F. At the wrench sensor itself A is the
identity but for the sign of the convention; at another frame it moves the wrench there; of joint efforts it is the
frame's Jacobian, -J(q)'. Then

    r = y - mean = A F + e,     e ~ N(0, R),     F ~ N(0, L)

    F = L A' (A L A' + R)^-1 r,     covariance = L - L A' (A L A' + R)^-1 A L

damped least squares with the forces L that people and tables bring about, and the covariance R of the prediction.
Without a contact gate R holds b b' too: what the offset b that wanders took may be a push. Declared effects correct and
shape A as they do the columns of a load: where too little of an effort is measured, so it is of a push. A direction
that the outputs do not feel, as of a singular or a short arm, is zero and keeps the deviation of L.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from semiparam_ros.core.columns import ColumnBlock, CoupledColumns, Memory
from semiparam_ros.core.prediction import Prediction
from semiparam_ros.core.robot.frames import as_matrix, frame_index, last_link, observed_links, unfelt
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import push_force
from semiparam_ros.core.samples import Sample, Samples
from semiparam_ros.core.types import Array

LEVER_M = 0.1
"""[m] How far from a frame, or beside a link's axis, a push acts: what a lever of micrometres needs is none."""
UNSEEN_SHARE = 0.5
"""Of a direction whose deviation is more than this share of that before, nothing was measured."""
NAMES = ('force x', 'force y', 'force z', 'couple x', 'couple y', 'couple z')


def push_wrench(body: RigidBody) -> Array:
    """[N, N m] (6,) standard deviation of the wrench that a push brings about at a frame."""
    return push_force(body) * np.repeat([1.0, LEVER_M], 3)


class External(NamedTuple):
    """A wrench that acts on the robot, [N] and [N m], about the frame's origin and along its axes."""

    wrench: Array  # (6,)
    covariance: Array  # (6, 6)

    @property
    def std(self) -> Array:
        """(6,)"""
        return np.sqrt(np.maximum(self.covariance.diagonal(), 0.0))


class _Pushed(ColumnBlock):
    """Unit forces and couples as six columns.

    :param maps: (n, 6) of them at positions (n_joints,).
    """

    def __init__(self, maps: Callable[[Array], Array]) -> None:
        self._maps = maps

    def on_links(self, body: RigidBody) -> bool:
        return True

    def prior_scale(self, body: RigidBody) -> Array:
        """(6,) of coefficients that nothing learns."""
        return np.ones(6)

    def columns(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        """(N, n, 6)"""
        return np.array([self._maps(position) for position in samples.position]), None


class ExternalWrench:
    """Outside wrench on one robot, at one frame.

    :param frame: a link of the robot; ``''`` for the sensor, or without one for the last link that the outputs feel.
    """

    def __init__(self, body: RigidBody, frame: str = '') -> None:
        """Raises SemiparamError when the robot has no such link, or efforts feel no push there."""
        self._body, self._data = body, body.arm.createData()
        at_sensor = not frame and body.outputs == 'wrench'
        self.frame = frame or (str(body.sensor_frame) if at_sensor else last_link(body))
        self._index = body.sensor_index if at_sensor else frame_index(body, self.frame)
        if body.outputs == 'effort' and self.frame not in observed_links(body):
            raise unfelt(self.frame, body)
        self._at_sensor = at_sensor
        self._expected = push_wrench(body) ** 2
        self._declared: Sequence[ColumnBlock] = ()
        self._shaped: CoupledColumns | None = None
        """A as declared effects correct and shape it; None where these do neither."""

    def shaped_by(self, declared: Sequence[ColumnBlock]) -> None:
        """Let A be corrected and shaped by these effects, as the columns of the model are."""
        if declared is self._declared:
            return
        shaping = [effect for effect in declared if not effect.only_adds]
        self._declared = declared
        self._shaped = CoupledColumns(self._body, [*shaping, _Pushed(self.outputs_of)]) if shaping else None

    def outputs_of(self, position: Array) -> Array:
        """(n, 6) A: outputs caused by unit forces and couples along the frame's axes, at positions (n_joints,)."""
        body, model, data = self._body, self._body.arm, self._data
        q = body.arm_vector(position)
        if body.outputs == 'effort':
            jacobian = as_matrix(pin.computeFrameJacobian(model, data, q, self._index, pin.LOCAL))
            return -np.asarray(jacobian)[:, body.output_rows].T
        if self._at_sensor:
            return -body.sign * np.eye(6)
        pin.forwardKinematics(model, data, q)
        places = [pin.updateFramePlacement(model, data, index).copy() for index in (body.sensor_index, self._index)]
        return -body.sign * np.asarray(places[0].actInv(places[1]).toDualActionMatrix())

    def along_base(self, position: Array) -> Array:
        """(n, 6) the same along the base's axes."""
        model, data = self._body.arm, self._data
        maps = self.outputs_of(position)
        pin.forwardKinematics(model, data, self._body.arm_vector(position))
        to_frame = pin.updateFramePlacement(model, data, self._index).rotation.T
        return np.hstack([maps[:, :3] @ to_frame, maps[:, 3:] @ to_frame])

    def of(self, prediction: Prediction, residual: Array, widening: Array, followed: Array | float = 0.0) -> External:
        """Wrench at a sample of which the model leaves ``residual`` (n,) of what was measured.

        :param widening: (n,) how much wider than the model's own its bands are in free motion.
        :param followed: (n,) what the wandering offset took that may be a push.
        """
        noise = prediction.model_covariance * np.outer(widening, widening) + np.outer(followed, followed)
        if self._at_sensor and self._shaped is None:
            return External(-self._body.sign * residual, noise)
        maps = self._maps_at(prediction.sample)
        if self._at_sensor:
            true = np.linalg.pinv(maps)
            return External(true @ residual, true @ noise @ true.T)
        spread = maps * self._expected
        whole = spread @ maps.T + noise
        try:
            gain = np.linalg.solve(whole, spread).T
        except np.linalg.LinAlgError:  # beside a glitch of 1e9 N doubles hold nothing else
            gain = spread.T @ np.linalg.pinv(whole, hermitian=True)
        return External(gain @ residual, np.diag(self._expected) - gain @ spread)

    def _maps_at(self, sample: Sample) -> Array:
        """(n, 6) A at a sample."""
        if self._shaped is None:
            return self.outputs_of(sample.position)
        return self._shaped.one(sample, 0)[0][:, -6:]

    def unseen(self, external: External) -> str:
        """The direction of which least was measured, in words; '' where all were."""
        scale = np.sqrt(self._expected)
        values, vectors = np.linalg.eigh(external.covariance / np.outer(scale, scale))
        if values[-1] < UNSEEN_SHARE**2:
            return ''
        direction = vectors[:, -1] * np.sign(vectors[np.abs(vectors[:, -1]).argmax(), -1])
        parts = [f'{share:.1f} {name}' for name, share in zip(NAMES, direction, strict=True) if abs(share) > 0.1]
        return f'{" + ".join(parts).replace("+ -", "- ")} at {self.frame}'
