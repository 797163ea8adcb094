"""Link that is touched, by what the outputs feel of it.

A touch is a force f at a point on a link. Points along the bones stand for it: the link's centre of mass, and the ways
from its joint to everything that is fixed to it. Skin lies beside the bones, which adds couples in proportion to the
force. Of each point the innovations r have the density

    N(r; 0, s^2 (A A' + l^2 B B') + R),

A and B what unit forces and couples there do to the outputs, l the usual distance from the bone, R the usual size of
the innovations, s how hard the touch is: several are as likely. A link is as likely as its points are on average.
"""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.robot.frames import frame_index, loaded_links, observed_links, unit_maps
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import push_force
from semiparam_ros.core.types import Array

BESIDE_M = 0.05
"""l"""
PUSH_SHARES = (0.05, 0.2, 0.8)
"""s, over the force of a push."""
SHARES = (0.33, 0.67, 1.0)
"""Of the ways from a joint."""
APART_M = 0.02
INDEPENDENT_S = 0.5
"""So much time of a touch tells as much as a single sample: what the model does not know stays alike for long."""


class ContactPlace:
    """The links of one robot, and how likely a touch is to be at each."""

    def __init__(self, body: RigidBody) -> None:
        self.links = tuple(loaded_links(body))
        self._body = body
        self._bodies, self._points = _points(body, self.links)
        self._forces = push_force(body) * np.array(PUSH_SHARES)
        self.forget()

    def forget(self) -> None:
        """Another touch begins."""
        self._sums: Array = np.zeros(len(self.links))
        self._count, self._seconds = 0, 0.0

    def see(self, position: Array, innovation: Array, scale: Array, seconds: float) -> None:
        """One sample of a touch: positions (n_joints,), innovations (n,) and their usual size (n,)."""
        force, couple = unit_maps(self._body, position, self._bodies.tolist(), self._points)
        force, couple = force / scale[:, None], couple * (BESIDE_M / scale[:, None])
        values, vectors = np.linalg.eigh(force @ force.swapaxes(1, 2) + couple @ couple.swapaxes(1, 2))
        seen = np.einsum('pij,i->pj', vectors, innovation / scale) ** 2
        variance = np.maximum(values, 0.0) * np.square(self._forces)[:, None, None] + 1.0
        densities = -0.5 * (seen / variance + np.log(variance)).sum(axis=2)
        each = np.logaddexp.reduce(densities, axis=0)
        starts = np.searchsorted(self._bodies, np.unique(self._bodies))
        counts = np.diff([*starts, len(each)])
        self._sums += np.logaddexp.reduceat(each, starts) - np.log(counts)
        self._count += 1
        self._seconds += seconds

    @property
    def probabilities(self) -> Array:
        """(n_links,) of :attr:`links`; all zero where no touch was seen."""
        if not self._count:
            return np.zeros(len(self.links))
        mean = self._sums / self._count * max(1.0, self._seconds / INDEPENDENT_S)
        odds = np.exp(mean - mean.max())
        return np.asarray(odds / odds.sum())


def _points(body: RigidBody, links: tuple[str, ...]) -> tuple[Array, Array]:
    """(P,) the joint of the arm that carries each point, in order, and (P, 3) the point [m] in the joint's frame."""
    model, observed = body.arm, set(observed_links(body))
    carriers: list[int] = []
    points: list[Array] = []
    for link in links:
        joint = model.frames[frame_index(body, link)].parentJoint
        start, centre = np.zeros(3), model.inertias[joint].lever
        if body.distal is not None and joint == model.frames[body.sensor_index].parentJoint:
            sensor = model.frames[body.sensor_index].placement
            start, centre = sensor.translation, sensor.act(body.distal.inertias[1].lever)
        ends = [frame.placement.translation for frame in model.frames
                if frame.parentJoint == joint and frame.name in observed]
        ends += [model.jointPlacements[child].translation for child in range(1, model.njoints)
                 if model.parents[child] == joint]
        own: list[Array] = []
        for point in [centre, *(start + share * (end - start) for end in ends for share in SHARES)]:
            if all(np.linalg.norm(point - other) > APART_M for other in own):
                own.append(np.asarray(point))
        carriers += [joint] * len(own)
        points += own
    return np.array(carriers), np.array(points)
