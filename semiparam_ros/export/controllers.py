"""Forms that robots' controllers take, of what was identified.

Loads are told in the axes of a flange, with the inertia about the centre of mass:

- Universal Robots: ``set_target_payload`` of the script manual, for the tool flange.
- Franka: the file of an end effector in Desk (``mass``, ``centerOfMass``, ``transformation``,
  ``inertia``), and ``franka::Robot::setLoad`` of libfranka; matrices column by column.
- ros2_control: the filter ``control_filters/GravityCompensationWrench`` of control_toolbox.
- crisp_controllers: friction fp1 / (1 + exp(-fp2 (v + fp3))) - fp1 / (1 + exp(-fp2 fp3)).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin
import yaml
from scipy.optimize import curve_fit

from semiparam_ros.core.robot.frames import load_seen_from, observed_links
from semiparam_ros.core.robot.rigid_body import GRAVITY, RigidBody
from semiparam_ros.core.robot.tools import tool_from_text
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError, listed
from semiparam_ros.export.identified import CarriedBody, Identified
from semiparam_ros.export.xml_edit import number

SHALLOWEST, STEEPNESS, STEEPEST = 0.2, 10.0, 1000.0
"""Product of fp2 and the largest velocity: at least, so that a straight line has a curve within a
thousandth; at the start of the fit; at most."""
SPEEDS = 200


def require_possible(form: str, body: RigidBody) -> None:
    """Refuse a form that no estimate of this robot can fill, before anything is estimated."""
    if form == 'crisp-friction' and body.outputs == 'wrench':
        raise _no_friction()
    if form != 'gravity-filter':
        return
    if body.distal is None:
        raise SemiparamError('a gravity compensation filter takes the weight off a wrench; '
                             'expected outputs: wrench.')
    if len(body.bodies) > 1:
        raise SemiparamError(f'{len(body.bodies)} bodies hang on the sensor and move against each '
                             f'other ({", ".join(body.bodies)}); the filter takes the weight '
                             'of one.')


def load_at(body: RigidBody, found: Identified, flange: str | None) -> CarriedBody:
    """Sum of all loads in the frame of ``flange``; None: of the link of the first one.

    Raises SemiparamError when there is none, or when one moves against the flange.
    """
    if not found.loads and found.not_shown:
        raise SemiparamError(f'the samples show no load at {listed(found.not_shown, 3)}: there is none to write.')
    if not found.loads:
        raise SemiparamError('no load is known; expected a payload among the effects, as semiparam '
                             'diagnose -o writes it, or --load LINK.')
    return _as_one(body, found.loads, flange or found.loads[0].link)


def _as_one(body: RigidBody, loads: Sequence[CarriedBody], flange: str) -> CarriedBody:
    total = np.zeros(10)
    for load in loads:
        there = load_seen_from(body, flange, load.link)
        if there is None:
            raise SemiparamError(f"what is carried at '{load.link}' moves against '{flange}'; "
                                 'expected a link that is fixed to it.')
        total += there @ load.parameters
    return CarriedBody(flange, total, float(np.linalg.norm([load.mass_std for load in loads])))


def ur_script(load: CarriedBody, remark: str) -> str:
    """A line of URScript."""
    inertia = load.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]  # xx, yy, zz, xy, xz, yz
    return (f'# {remark}\n# In the frame of {load.link}: expected to be the tool flange.\n'
            f'set_target_payload({number(load.mass)}, {_row(load.centre)}, {_row(inertia)})\n')


def franka_desk(load: CarriedBody) -> str:
    """JSON for the settings of an end effector, whose frame is the flange's."""
    document = {'mass': load.mass, 'centerOfMass': load.centre.tolist(),
                'transformation': np.eye(4).ravel().tolist(),
                'inertia': load.inertia.ravel(order='F').tolist()}
    return json.dumps(document) + '\n'


def libfranka(load: CarriedBody, remark: str) -> str:
    """A line of C++."""
    centre, inertia = (', '.join(map(number, values))
                       for values in (load.centre, load.inertia.ravel(order='F')))
    return (f'// {remark}\n// In the frame of {load.link}: expected to be the flange.\n'
            f'robot.setLoad({number(load.mass)}, {{{{{centre}}}}}, {{{{{inertia}}}}});\n')


def gravity_filter(body: RigidBody, found: Identified, remark: str, tools: Sequence[str] = ()) -> str:
    """Parameters of the filter, for everything that hangs on the sensor. Its world is the root of the
    robot description, along whose z axis gravity acts: no other frame is known to be there.

    :param tools: texts of known ones, which nothing that was found holds, but the sensor feels.

    Raises SemiparamError unless a wrench is measured, and what hangs on the sensor is one body.
    """
    require_possible('gravity-filter', body)
    links = [CarriedBody(name, values, 0.0) for name, values in found.links.items()
             if name in observed_links(body)]
    frame, known = _sensor_link(body), map(tool_from_text, tools)
    tool = _as_one(body, [*links, *found.loads, *(CarriedBody(*each, 0.0) for each in known)], frame)
    root = next(each.name for each in body.arm.frames if each.type == pin.FrameType.BODY)
    parameters = {'world_frame': root, 'sensor_frame': frame, 'tool': {
        'CoG': tool.centre.tolist(), 'mass': tool.mass,
        'gravity_field': (body.sign * -GRAVITY + 0.0).tolist()}}
    document = {'sensor_filter_chain': {'filter1': {
        'name': 'gravity_compensation', 'type': 'control_filters/GravityCompensationWrench',
        'params': parameters}}}
    return f'# {remark}\n' + yaml.safe_dump(document, sort_keys=False)


def _sensor_link(body: RigidBody) -> str:
    """The link that has the sensor's frame."""
    assert body.distal is not None
    return next(frame.name for frame in body.distal.frames if frame.parentJoint == 1
                and frame.placement.isIdentity(1e-9) and frame.name in observed_links(body))


def crisp_friction(found: Identified, remark: str) -> str:
    """Parameters of three vectors, a value for each joint in their order, 0 without friction: the
    curves next to what was identified, up to the largest velocity of each joint.

    Raises SemiparamError when no friction was identified.
    """
    rows: dict[str, dict[str, float]] = {joint: {} for joint in found.top_speed}
    for each in found.joints:
        rows[each.joint][each.name] = each.value
    if not found.joints:
        raise _no_friction()
    curves = [_curve(values, found.top_speed[joint]) for joint, values in rows.items()]
    fp1, fp2 = ([float(number(curve[index])) for curve in curves] for index in (0, 1))
    document = {'friction': {'fp1': fp1, 'fp2': fp2, 'fp3': [0.0] * len(curves)}}
    return f'# {remark}\n# Joints: {", ".join(rows)}\n' + yaml.safe_dump(document, sort_keys=False,
                                                                         default_flow_style=None)


def _no_friction() -> SemiparamError:
    return SemiparamError('no friction is known; expected outputs: effort with joint_friction: true.')


def _curve(values: Mapping[str, float], top_speed: float) -> Array:
    """fp1 and fp2: half of fp1 is what the friction comes to at speed. A joint that stood still has none."""
    speed = np.linspace(0.0, top_speed, SPEEDS)[1:]
    friction = values.get('friction', 0.0) + values.get('damping', 0.0) * speed
    if top_speed == 0.0 or not friction.any():
        return np.zeros(2)

    def logistic(share: Array, height: float, steepness: float) -> Array:
        return 0.5 * height * np.tanh(0.5 * steepness * share)

    # In units of the largest: the fit stops at absolute tolerances, at once where efforts are small.
    found, _ = curve_fit(logistic, speed / top_speed, friction / friction[-1], p0=(2.0, STEEPNESS),
                         bounds=([0.0, SHALLOWEST], [np.inf, STEEPEST]))
    return np.asarray(found * (friction[-1], 1.0 / top_speed))


def _row(values: Sequence[float] | Array) -> str:
    return '[' + ', '.join(map(number, values)) + ']'
