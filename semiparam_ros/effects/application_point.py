"""Effects that act on a link at a point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from semiparam_ros.core.robot.frames import (
    FrameMotion,
    frame_motion,
    links_beside,
    loaded_links,
    observed_links,
)
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import reach_of
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.effects.base import Effect

POINT: Mapping[str, str] = {'x': 'm', 'y': 'm', 'z': 'm'}


class AtPoint(Effect):
    """Effect at a point of a link: the origin of its frame, or x, y and z [m] in that frame."""

    parameter_units: ClassVar[Mapping[str, str]] = POINT

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        return [link for tip in loaded_links(body) for link in links_beside(body, tip)]

    @classmethod
    def permitted(cls, body: RigidBody) -> Sequence[str | None]:
        return observed_links(body)

    def at_joint(self, body: RigidBody) -> bool:
        return False

    def on_links(self, body: RigidBody) -> bool:
        return not self.at_joint(body)

    def conceivable(self, body: RigidBody, coefficients: Array) -> bool:
        """Tell whether it may be so, the point no farther from the link than the arm is long."""
        lever = float(np.linalg.norm([self.value(axis) for axis in POINT]))
        return lever <= reach_of(body) and super().conceivable(body, coefficients)

    def motion(self, body: RigidBody, samples: Samples) -> FrameMotion:
        """Motion of the point along the samples, with the map from a force there to the outputs."""
        point = np.array([self.value(axis) for axis in POINT])
        motion = frame_motion(body, samples, str(self.where))
        return motion.at(point) if point.any() else motion
