"""Tools of known mass, centre and inertia: what they add to the outputs needs no learning.

A body at a link adds psi(x) pi to the outputs, with the regressor psi of the robot (``rigid_body``) and base parameters
pi that follow from its mass, first moment and inertia. So a tool that is mounted, or taken off, at some moment is a
vector that the learner takes off the outputs from then on; the model never sees the tool. Effects that are declared
correct psi and shape it for a tool as for the links: the wrench of a turned sensor is turned whatever hangs on it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from semiparam_ros.core import json_text
from semiparam_ros.core.columns import ColumnBlock, CoupledColumns, Memories, Memory
from semiparam_ros.core.robot import urdf as urdf_tree
from semiparam_ros.core.robot.frames import load_in_arm, load_in_base, load_regressor
from semiparam_ros.core.robot.rigid_body import RigidBody, build
from semiparam_ros.core.samples import Sample, Samples
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError

OFF = '-'
KEYS = {'mass': 1, 'centre': 3, 'inertia': 6}
HEAVIEST = 1e4
"""[kg] and, for its other numbers, [m] and [kg m^2]."""
SLACK = 1e-9
"""Of the largest principal moment, by which moments of rods and plates may miss that they can be."""


class Tool(NamedTuple):
    """A body at ``link``: (10,) mass, first moment and inertia about the link's origin, xx xy yy xz yz zz; all negative
    of one that is taken off."""

    link: str
    parameters: Array


class _Carried(ColumnBlock):
    """Tools as one column, whose coefficient is 1."""

    def __init__(self, tools: Sequence[Tool]) -> None:
        self._tools = tuple(tools)

    def on_links(self, body: RigidBody) -> bool:
        return True

    def prior_scale(self, body: RigidBody) -> Array:
        """(1,) of a coefficient that nothing learns."""
        return np.ones(1)

    def columns(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        """(N, n, 1) what all of them add."""
        added = sum(load_regressor(body, samples, tool.link) @ tool.parameters for tool in self._tools)
        return np.asarray(added)[:, :, None], None


class Tools:
    """All that are declared on a robot, by their texts; see :func:`tool_from_text`.

    ``parameters`` (p,) is what they add to the base parameters.
    """

    def __init__(self, body: RigidBody, texts: Sequence[str] = ()) -> None:
        """Raises SemiparamError for a text that is no tool, or a link that the outputs do not feel."""
        self._body, self.texts = body, tuple(texts)
        self.parameters: Array = np.zeros(body.n_parameters)
        self._in_arm: Array = np.zeros(10 * (body.arm.njoints - 1))
        self._tools = tuple(tool_from_text(text) for text in texts)
        self._declared: Sequence[ColumnBlock] = ()
        self._shaped: CoupledColumns | None = None
        """Their column as declared effects correct and shape it; None where these do neither."""
        for tool in self._tools:
            self.parameters += load_in_base(body, tool.link, tool.parameters)
            self._in_arm = self._in_arm + load_in_arm(body, tool.link, tool.parameters)

    def shaped_by(self, declared: Sequence[ColumnBlock]) -> None:
        """Let what they add be corrected and shaped by these effects, as the columns of the model are."""
        if declared is self._declared:
            return
        shaping = [effect for effect in declared if not effect.only_adds]
        self._declared = declared
        self._shaped = CoupledColumns(self._body, [*shaping, _Carried(self._tools)]) \
            if shaping and self._tools else None

    def taken_off(self, sample: Sample, remembered: Memories = None) -> tuple[Sample, Array | None]:
        """The sample without what they add to its outputs (n,), and that; None where there are none.

        :param remembered: what the declared effects remember of the samples before it.
        """
        if not self.texts:
            return sample, None
        if self._shaped is None:
            added = self.outputs(sample.position, sample.velocity, sample.acceleration)
        else:
            past = None if remembered is None else [
                entry for effect, entry in zip(self._declared, remembered, strict=True) if not effect.only_adds]
            columns, _ = self._shaped.one(sample, 0, past and [*past, (None, None)])
            added = columns[:, -1]
        return sample._replace(outputs=sample.outputs - added), added

    def outputs_of(self, samples: Samples) -> Array:
        """(N, n) what they add to a recording."""
        if self._shaped is None:
            return self._body.outputs_of(samples, self.parameters)
        return self._shaped.batch(samples)[0][:, :, -1]

    def desired(self, position: Array, velocity: Array, acceleration: Array) -> tuple[Array, Array]:
        """(n,) what they add to a desired state (n_joints,), as the sensor shows it, and as the arm needs it."""
        if self._shaped is None:
            added = self.outputs(position, velocity, acceleration)
            return added, added
        shown, needed = self._shaped.desired(position, velocity, acceleration, now=0, origin=0)
        return shown[:, -1], needed[:, -1]

    def outputs(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """(n,) what they add at a true state (n_joints,), where nothing shapes it."""
        return np.asarray(self._body.regressor(position, velocity, acceleration) @ self.parameters)

    def beyond_sensor(self, position: Array, velocity: Array, acceleration: Array) -> Array | None:
        """(n_joints,) torques that they take of joints beyond a wrench sensor, at a state (n_joints,), and zero for all
        others; None where there are none. The wrench tells nothing of these joints, but a known body does."""
        body = self._body
        if not self.texts or not len(body.beyond_sensor):
            return None
        motion, moved = (position, velocity, acceleration), np.eye(body.n_joints)
        true = None if self._shaped is None else self._shaped.as_it_is(motion)
        if true is not None:
            body, motion, moved = true
        vectors = (body.arm_vector(values) for values in motion)
        rows = pin.computeJointTorqueRegressor(body.arm, body.arm.createData(), *vectors)
        whole = np.atleast_1d(rows @ self._in_arm)  # of one joint it is a vector
        torques = np.zeros(body.n_joints)
        torques[body.beyond_sensor] = whole[body.arm_columns[body.beyond_sensor]]
        return np.asarray(moved @ torques)


def tool_from_text(text: str) -> Tool:
    """Read ``LINK {"mass": kg, "centre": [x, y, z], "inertia": [ixx, ixy, ixz, iyy, iyz, izz]}``, or a piece of URDF.

    Centre [m] in the link's frame and inertia [kg m^2] about the centre are zero unless given. The URDF is a ``<link>``
    with the name of the link that carries it, or a ``<robot>`` of links and fixed joints that begins with that. A minus
    before either takes the tool off.

    Raises SemiparamError for anything else, and for a body that cannot be.
    """
    rest = text.strip()
    sign, rest = (-1.0, rest[1:].lstrip()) if rest.startswith(OFF) else (1.0, rest)
    link, inertia = _from_urdf(rest) if rest.startswith('<') else _from_json(rest)
    _check(text, inertia)
    return Tool(link, sign * np.asarray(inertia.toDynamicParameters()))


def _from_urdf(text: str) -> tuple[str, pin.Inertia]:
    if not text.startswith('<robot'):
        text = f'<robot name="tool">{text}</robot>'
    robot = urdf_tree.parse(text)
    if any(kind != 'fixed' for kind in urdf_tree.joint_types(robot).values()):
        raise SemiparamError('a tool has joints that move; expected links and fixed joints alone.')
    children = {child.get('link') for child in robot.iterfind('joint/child')}
    root = next(str(link.get('name')) for link in robot.findall('link') if link.get('name') not in children)
    return root, build(robot, pin.JointModelFreeFlyer()).inertias[1]


def _from_json(text: str) -> tuple[str, pin.Inertia]:
    link, brace, tail = text.partition('{')
    try:
        values: Any = json_text.parse(brace + tail)
    except (ValueError, RecursionError):
        values = None
    if not link.strip() or not isinstance(values, dict) or 'mass' not in values or not set(values) <= set(KEYS):
        raise SemiparamError(f"tool '{text[:80]}' cannot be read; expected LINK {{\"mass\": kg, \"centre\": [x, y, z], "
                             '"inertia": [ixx, ixy, ixz, iyy, iyz, izz]}, or a piece of URDF.')
    mass, centre, (xx, xy, xz, yy, yz, zz) = (_numbers(text, name, values) for name in KEYS)
    return link.strip(), pin.Inertia(mass[0], centre, np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))


def _numbers(text: str, name: str, values: dict[str, Any]) -> Array:
    count = KEYS[name]
    given = values.get(name, [0.0] * count)
    items = given if isinstance(given, list) else [given]
    real = all(isinstance(item, (int, float)) and not isinstance(item, bool) and abs(item) <= HEAVIEST
               for item in items)
    if len(items) != count or not real:
        raise SemiparamError(f"tool '{text[:80]}' has {name} {json.dumps(given)[:80]}; expected {count} finite "
                             f'number{"s" * (count > 1)} of at most {HEAVIEST:g}.')
    return np.array(items, dtype=float)


def _check(text: str, inertia: pin.Inertia) -> None:
    moments = np.linalg.eigvalsh(inertia.inertia)
    sum_of_two = moments[0] + moments[1] + SLACK * moments[2]
    if not (inertia.mass > 0.0 and moments[0] >= -SLACK * moments[2] and sum_of_two >= moments[2]):
        raise SemiparamError(f"tool '{text[:80]}' has mass {inertia.mass:g} kg and principal moments "
                             f'{", ".join(f"{moment:.3g}" for moment in moments)} kg m^2; expected those of a body: a '
                             'positive mass, and no moment larger than the sum of the two others.')
