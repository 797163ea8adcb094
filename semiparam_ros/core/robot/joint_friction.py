"""Friction, rotor and offset of the joints whose efforts are the outputs: what every identification of an arm holds.

Of output k, with the velocity v and the acceleration a of its joint,

    y_k = ... + b_k v + sum_s c_ks tanh(v / v_s) + j_k a + o_k

viscous friction b [N m s/rad], dry friction as the sum of the c [N m], the inertia j [kg m^2] of a rotor seen through
its gear, an offset o [N m]. The speed within which dry friction turns over differs between robots by a factor of ten.
Two speeds v_s span it: the shares of the two columns, which are linear, say where between them it lies.

A joint slides one way or the other: its dry friction is +c or -c, with c = sum_s c_s, and its mean f is what the
columns say. While the joint turns back, how it sticks, bends and lags decides, which no column tells. So c^2 - f^2 is
noise of its effort.
"""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.compiled import Integers, Matrix, Part, Strided, Vector, compiled
from semiparam_ros.core.robot.rigid_body import RigidBody, remembered
from semiparam_ros.core.robot.size import output_scale, radians
from semiparam_ros.core.types import Array

TURN_SPEEDS = np.array([0.005, 0.03])
"""[rad/s] v_s. Measured arms turn over within 0.3 to 3 % of their top speed. A joint that slides has
:func:`turn_speeds`."""
SHARE_OF_LIMIT = 0.2
"""Of the largest effort that a joint may give, what its friction may be."""
OFFSET_SHARE = 0.1
"""Of friction, what an offset may be. Where a joint goes one way no sample tells the two apart, and gears rub more than
zeros of sensors err."""
TOP_SPEED = 3.0
"""[rad/s] at which viscous friction is as large as that; arms move as fast at most, and are learnt far slower. A
joint that slides is as fast where what it carries, stretched out, would be at its end."""
REACHED_WITHIN = 0.25
"""[rad] In which an arm reaches its top speed."""
KINDS = 1 + len(TURN_SPEEDS)
"""Columns of friction of each output; those of one kind stand together."""
NAMES = ('viscous', *(f'dry_{speed:g}' for speed in TURN_SPEEDS), 'rotor')
UNITS = ('N m s/rad', *('N m' for _ in TURN_SPEEDS), 'kg m^2')
"""Those of friction, and of the rotor, which stands after it."""


@remembered
def turn_speeds(body: RigidBody) -> Array:
    """(S, n) [rad/s, m/s] v_s of each output. One that slides is as much slower as its strokes are shorter than turns.
    """
    return np.outer(TURN_SPEEDS, radians(body)[body.output_index])


def fill_joints(body: RigidBody, velocity: Array, acceleration: Array, columns: Array) -> None:
    """Friction and rotors of one sample, with velocities and accelerations (n_joints,), into the columns.

    Their (n, (KINDS + 1) n) part is the one after the rigid body's columns; it is zero elsewhere.
    """
    _fill(velocity, acceleration, body.output_index, turn_speeds(body), columns[:, body.n_parameters:])


def joint_columns(body: RigidBody, velocity: Array, acceleration: Array) -> Array:
    """(N, n, (KINDS + 1) n) columns of friction and rotors, of velocities and accelerations (N, n_joints)."""
    own = velocity[:, body.output_index]
    kinds = [own, *(np.tanh(own / speeds) for speeds in turn_speeds(body)), acceleration[:, body.output_index]]
    return np.concatenate([each[:, :, None] * np.eye(body.n_outputs) for each in kinds], axis=2)


def friction_scale(body: RigidBody) -> Array:
    """(n,) [N m, N] what the friction of each output may be: a share of the torque that holds what the joint
    carries stretched out (of its weight where the joint slides), or of the largest effort that the robot description
    permits, whichever is larger."""
    limits = np.where(np.isfinite(body.effort_limits), body.effort_limits, 0.0)
    return np.asarray(np.maximum(output_scale(body), SHARE_OF_LIMIT * limits))


def friction_prior(body: RigidBody) -> Array:
    """(KINDS n,) prior standard deviations of the columns' coefficients, in the order of the columns."""
    scale = friction_scale(body)
    top_speeds = TOP_SPEED * radians(body)[body.output_index]
    return np.concatenate([scale / top_speeds, np.tile(scale, len(TURN_SPEEDS))])


def rotor_prior(body: RigidBody) -> Array:
    """(n,) [kg m^2, kg] prior standard deviations of the rotors' inertias: friction's, at the acceleration that reaches
    top speed within a quarter of a radian.

    It goes by the torque for which a joint is geared, not by what it carries: a rotor counts by the square of its gear,
    and so for many times the links of a small arm.
    """
    return friction_scale(body) / (TOP_SPEED**2 / (2.0 * REACHED_WITHIN) * radians(body)[body.output_index])


def offset_prior(body: RigidBody) -> Array:
    """(n,) [N m, N] prior standard deviations of the offsets."""
    return OFFSET_SHARE * friction_scale(body)


@compiled
def turning_variance(directions: Integers, theta: Vector, columns: Part) -> Vector:
    """(n,) c^2 - f^2 [(N m)^2] of one sample with columns (n, p) and coefficients (p,).

    :param directions: (S n,) columns of dry friction, those of each v_s together, output by output.
    """
    n = len(columns)
    variance = np.zeros(n)
    for k in range(n):
        size = mean = 0.0
        for place in directions[k::n]:
            size += theta[place]
            mean += theta[place] * columns[k, place]
        variance[k] = max(size * size - mean * mean, 0.0)
    return variance


@compiled
def _fill(velocity: Strided, acceleration: Strided, index: Integers, speeds: Matrix, columns: Part) -> None:
    """See :func:`fill_joints`."""
    n = len(index)
    for k in range(n):
        v = velocity[index[k]]
        columns[k, k] = v
        for s in range(len(speeds)):
            columns[k, (1 + s) * n + k] = np.tanh(v / speeds[s, k])
        columns[k, (1 + len(speeds)) * n + k] = acceleration[index[k]]
