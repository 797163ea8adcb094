"""Identification: inertias of links, friction of joints and loads, from an estimate.

Base parameters alone can be identified, and links fixed to each other move as one body. So all
links with a mass are looked for together, each as near to its description as the estimate allows
(``core.robot.consistency``): what the samples do not tell apart is shared out by that distance.
Friction, damping and armature are kept from being negative; all else is as it is then most
probable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from semiparam_ros.core.columns import ColumnBlock, CoupledColumns
from semiparam_ros.core.robot.consistency import (
    FLAT,
    Body,
    ball,
    consistent_bodies,
    distance,
    is_consistent,
    made_consistent,
)
from semiparam_ros.core.robot.frames import load_transform, observed_links
from semiparam_ros.core.robot.joint_friction import NAMES
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import LEAST_LENGTH_SHARE, SHARE, reach_of, size_of
from semiparam_ros.core.types import Array
from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import spelling
from semiparam_ros.effects.drive import gains
from semiparam_ros.errors import SemiparamError
from semiparam_ros.export.estimate import Estimate

DYNAMICS = {
    'viscous_friction': {'viscous': ('damping', 1.0)},
    'coulomb_friction': {'coulomb': ('friction', 1.0)},
    'stribeck_friction': {'coulomb': ('friction', 1.0)},
    'asymmetric_friction': {
        'coulomb_forward': ('friction', 0.5), 'coulomb_backward': ('friction', 0.5),
        'viscous_forward': ('damping', 0.5), 'viscous_backward': ('damping', 0.5)},
    'rotor_inertia': {'inertia': ('armature', 1.0)},
}
"""Meaning of effects' coefficients to a simulator; of both directions it takes the mean."""
OWN_DYNAMICS = {'viscous': 'damping', 'rotor': 'armature'}
"""The same of the columns that every model of efforts has; others are dry friction."""
SURE = 2.0
"""Standard deviations above zero from which on the mass of a load is one."""
PARAMETERS = 10.0
"""Number of inertial parameters of a link."""
RANK = 1e-9
UNITS = {'damping': 'N m s/rad', 'friction': 'N m', 'armature': 'kg m^2'}


class JointDynamics(NamedTuple):
    """A quantity of a joint that cannot be negative, with its standard deviation before that."""

    joint: str
    name: str  # damping, friction or armature
    value: float
    std: float
    unit: str


class CarriedBody(NamedTuple):
    """A body that a link carries beside its own: (10,) inertial parameters in the link's frame."""

    link: str
    parameters: Array
    mass_std: float  # [kg]
    start_s: float | None = None
    """Time [s] after the start of the recording when the load appears; None: at its beginning."""

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return float(self.parameters[0])

    @property
    def centre(self) -> Array:
        """Centre (3,) of mass [m]."""
        return np.asarray(self.parameters[1:4] / self.parameters[0])

    @property
    def inertia(self) -> Array:
        """Inertia (3, 3) about the centre, in the axes of the link [kg m^2]."""
        return np.asarray(pin.Inertia.FromDynamicParameters(self.parameters).inertia)


class Price(NamedTuple):
    """Mean over the outputs of squared error over variance, on samples that took no part in the
    fit, unless it says so."""

    description: float
    unconstrained: float
    consistent: float
    held_out: bool


class Identified(NamedTuple):
    """Quantities that an export writes.

    :param links: (10,) inertial parameters in its own frame, of each link that the outputs feel,
        and of those that are mended.
    :param offsets: of each output with a constant offset.
    :param left_out: what JSON alone holds.
    """

    how: str
    links: Mapping[str, Array]
    described: Mapping[str, Array]
    mended: Sequence[str]
    """Links that the description has as bodies that cannot be."""
    joints: Sequence[JointDynamics]
    loads: Sequence[CarriedBody]
    not_shown: Sequence[str]
    """Links of declared loads whose mass may well be zero: they are left out."""
    offsets: Mapping[str, float]
    left_out: Mapping[str, float]
    top_speed: Mapping[str, float]
    """Largest velocity of each joint [rad/s, m/s]."""
    price: Price | None
    theta: Array
    """All coefficients (p,), as the bodies make them."""
    lighter: Sequence[str] = ()
    """Of ``not_shown``, those whose mass is below zero for certain: no body takes away what the samples show."""


def identify(estimate: Estimate, described: Mapping[str, Array],
             keep_inertias: bool = False) -> Identified:
    """Identify all that an estimate tells of a robot.

    :param described: (10,) inertial parameters of the links by the robot description.
    :param keep_inertias: links stay as described, so that loads alone explain what differs.

    Raises SemiparamError when no link that the outputs feel has a mass.
    """
    columns = estimate.columns
    inverse = np.asarray(np.linalg.pinv(root_of(estimate.information)), dtype=np.float64)
    covariance = inverse @ inverse.T
    solution = _Solution(estimate, described, covariance)
    solution.hold(estimate, everything=keep_inertias)
    links, loads, theta = solution.found(estimate.mean, estimate.information)
    price = None if estimate.table is None else _price(estimate, solution, theta)
    joints = [JointDynamics(joint, name, max(float(weights @ theta), 0.0),
                            float(np.sqrt(max(float(weights @ covariance @ weights), 0.0))),
                            columns.body.joint_unit(joint, UNITS[name]))
              for joint, name, weights in solution.dynamics]
    found = [CarriedBody(link, parameters, _std(covariance, block.start), estimate.starts.get(block.start))
             for (link, block), parameters in zip(solution.loads, loads, strict=True)]
    offsets = dict(zip(columns.body.output_names, _offsets(estimate, theta), strict=False))
    speeds = dict(zip(columns.body.joints, estimate.top_speed.tolist(), strict=True))
    return Identified(estimate.how, links, solution.described, solution.mended, joints, found,
                      solution.not_shown, offsets, _left_out(columns, theta), speeds, price,
                      theta, solution.lighter)


def identified_load(body: RigidBody, parameters: Array, covariance: Array) -> Array:
    """(10,) the body nearest to a load with a mass: estimated parameters (10,) and their covariance
    (10, 10), in the same frame. A load that can be stays as it is.

    Raises SemiparamError when the mass is not above 0, or the estimate is not finite.
    """
    std = np.sqrt(np.diag(covariance))
    information = np.linalg.pinv(covariance / np.outer(std, std), hermitian=True)
    near = Body(made_consistent(parameters, size_of(body).length), np.eye(10))
    return np.asarray(consistent_bodies(parameters, root_of(information) / std, [near])[0])


def _offsets(estimate: Estimate, theta: Array) -> list[float]:
    """Offsets of the outputs as they were measured; none of efforts without joint friction, unless a tare took some."""
    offset, bias = theta[estimate.columns.blocks['offset']], estimate.bias
    if bias is not None and bias.any():
        offset = offset + bias if len(offset) else bias
    return list(map(float, offset))


def _std(covariance: Array, index: int) -> float:
    return float(np.sqrt(max(covariance[index, index], 0.0)))


class _Solution:
    """The constrained fit of one robot, for one estimate or another."""

    def __init__(self, estimate: Estimate, described: Mapping[str, Array],
                 covariance: Array) -> None:
        columns, body = estimate.columns, estimate.columns.body
        observed = [name for name in observed_links(body)
                if name in described and described[name][0] > 0.0]
        if not observed:
            raise SemiparamError('the robot description gives no mass to a link that the outputs '
                                 'feel; expected inertials, which an export starts from.')
        size, count = size_of(body), columns.n_columns
        self.described = {name: values for name, values in described.items()
                          if values[0] > 0.0 and (name in observed or not is_consistent(values, FLAT))}
        self.mended = [name for name, values in self.described.items()
                       if not is_consistent(values, FLAT)]
        self._others = {name: made_consistent(values, size.length)
                        for name, values in self.described.items() if name not in observed}
        self._links, self._identifiable = observed, body.n_parameters
        self._held = np.zeros(len(self._links), dtype=bool)
        self._bodies = []
        for name in observed:
            index, transform = load_transform(body, name)
            into = np.zeros((count, 10))
            into[:body.n_parameters] = body.basis[10 * index:10 * index + 10].T @ transform
            self._bodies.append(Body(made_consistent(described[name], size.length), into))
        self.loads: list[tuple[str, slice]] = []
        self.not_shown: list[str] = []
        self.lighter: list[str] = []
        self._rigid, self._absent = np.zeros((2, count), dtype=bool)
        self._rigid[columns.blocks['rigid_body']] = True
        for index, effect in enumerate(columns.effects):
            if effect.is_load and not (isinstance(effect, Effect) and effect.ends):
                self._add_load(effect, columns.blocks[str(index)], estimate.mean, covariance)
        length = max(size.length, reach_of(body))
        usual = ball(SHARE * size.mass, LEAST_LENGTH_SHARE * length)
        self._load_bodies = [Body(usual, np.eye(count)[:, block], length)
                             for _, block in self.loads]
        self.dynamics = _dynamics(columns)

    def _add_load(self, effect: ColumnBlock, block: slice, mean: Array, covariance: Array) -> None:
        link, shown = str(effect.where), mean[block.start] > SURE * _std(covariance, block.start)
        if not shown and isinstance(effect, Effect) and not effect.is_body:
            raise SemiparamError(f"effect '{spelling(effect.kind, link)}' takes away what no load can: the other tool "
                                 'weighs less, or as much. Expected samples of that tool alone, and no such effect.')
        (self._rigid if shown else self._absent)[block] = True
        if shown:
            self.loads.append((link, block))
        else:
            self.not_shown.append(link)
            if mean[block.start] < -SURE * _std(covariance, block.start):
                self.lighter.append(link)

    def hold(self, estimate: Estimate, everything: bool) -> None:
        """Leave links as described: all, or those that need not change, first all together, then
        one after another, the nearest first.

        What they bring must be less than a nat for each of their parameters that can be identified
        (Akaike 1974). Where there are samples, parts of them must besides be predicted within one
        standard error as well as with all links free (Breiman, Friedman, Olshen and Stone 1984). So
        a model that is less sure than it could be does not keep a wrong description.
        """
        self._held[:] = everything
        if everything:
            return
        links, _, theta = self.found(estimate.mean, estimate.information)
        apart = [distance(links[name], body.reference)
                 for name, body in zip(self._links, self._bodies, strict=True)]
        best, errors = _given_up(estimate, theta), self._left_out_errors(estimate)
        possible = np.array([name not in self.mended for name in self._links])
        for chosen in (possible, *np.eye(len(possible), dtype=bool)[np.argsort(apart)]):
            before = self._held.copy()
            self._held |= chosen & possible
            brings = _given_up(estimate, self.found(estimate.mean, estimate.information)[2]) - best
            count = min(PARAMETERS * (self._held & ~before).sum(), self._identifiable)
            if brings <= count and self._no_worse(estimate, errors):
                best += brings
            else:
                self._held = before

    def _no_worse(self, estimate: Estimate, errors: Array) -> bool:
        """Tell whether parts left out are predicted within one standard error as well as with these errors (FOLDS,)."""
        worse = self._left_out_errors(estimate) - errors
        margin = np.sqrt(len(worse)) * worse.std(ddof=1) if len(worse) else 0.0
        return bool(worse.sum() <= margin)

    def _left_out_errors(self, estimate: Estimate) -> Array:
        """Normalised errors (FOLDS,) on parts of the samples, left out of the fit where it can be
        done anew; (0,) where there are no samples."""
        table = estimate.table
        if table is None:
            return np.zeros(0)
        fits = table.fold_estimates if estimate.held_out else [(estimate.mean, estimate.information)]
        thetas = [self.found(*fitted)[2] for fitted in fits] * (len(table.folds) // len(fits))
        return np.array([float(np.nanmean(table.error(theta, fold)))
                         for theta, fold in zip(thetas, table.folds, strict=True)])

    def found(self, mean: Array, information: Array) -> tuple[dict[str, Array], Array, Array]:
        """Links and loads (n, 10), and theta (p,) with all else as it then is most probable."""
        zero: list[Array] = []
        while True:
            links, loads, theta = self._with(zero, mean, information)
            negative = [weights for _, _, weights in self.dynamics
                        if weights @ theta < 0.0 and not any(weights is each for each in zero)]
            if not negative:
                return dict(zip(self._links, links, strict=True)) | self._others, loads, theta
            zero += negative

    def _with(self, zero: Sequence[Array], mean: Array,
              information: Array) -> tuple[Array, Array, Array]:
        """The same where some quantities, given by their weights (p,), are held at zero."""
        everything = np.eye(len(mean))
        fixed, free = everything[:, self._rigid], everything[:, ~self._rigid & ~self._absent]
        if zero:
            _, singular, axes = np.linalg.svd(np.array(zero) @ free)
            free = free @ axes[int(np.sum(singular > RANK)):].T
        # Elimination by rotations: differences of information would lose the digits that a sensor
        # without noise needs.
        root = root_of(information)
        parts = np.column_stack([free, fixed, mean])
        rows = np.asarray(np.linalg.qr(root @ parts, mode='r'), dtype=np.float64)
        f, r = free.shape[1], fixed.shape[1]
        inner, gain, pull = rows[:f, :f], rows[:f, f:f + r], rows[:f, f + r]
        marginal = rows[f:f + r, f:f + r]
        most_probable = np.linalg.solve(marginal, rows[f:f + r, f + r])
        links = np.array([body.reference for body in self._bodies])
        bodies = [body._replace(columns=body.columns[self._rigid])
                  for body in (*self._bodies, *self._load_bodies)]
        still = [body for body, held in zip(bodies, self._held, strict=False) if held]
        moved = [body for body in bodies if not any(body is each for each in still)]
        known = _contribution(still, [body.reference for body in still], len(marginal))
        found = consistent_bodies(most_probable - known, marginal, moved)
        rigid = known + _contribution(moved, found, len(marginal))
        links[~self._held] = found[:len(found) - len(self.loads)]
        theta = fixed @ rigid + free @ np.linalg.solve(inner, pull - gain @ rigid)
        return links, found[len(found) - len(self.loads):], theta


def root_of(information: Array) -> Array:
    """Root R (p, p) with R'R = information, or the nearest that has a root."""
    scale = np.sqrt(np.diag(information))
    values, vectors = np.linalg.eigh(0.5 * (information + information.T) / np.outer(scale, scale))
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * scale)


def _given_up(estimate: Estimate, theta: Array) -> float:
    """Log probability [nat] that theta (p,) gives up against the estimate's mean."""
    apart = theta - estimate.mean
    return float(0.5 * apart @ estimate.information @ apart)


def _contribution(bodies: Sequence[Body], parameters: Sequence[Array] | Array, count: int) -> Array:
    """Sum (count,) of what bodies with parameters (10,) each bring."""
    total = np.zeros(count)
    for body, values in zip(bodies, parameters, strict=True):
        total += body.columns @ values
    return total


def _dynamics(columns: CoupledColumns) -> list[tuple[str, str, Array]]:
    """Joint, quantity and the weights (p,) by which it follows from theta; what is over is none of a joint's.

    A declared gain multiplies bodies: theta holds friction and rotors as the efforts read them.
    """
    body, found = columns.body, dict[tuple[str, str], Array]()
    read = gains(columns.effects, body)

    def add(joint: str, name: str, place: int, weight: float) -> None:
        found.setdefault((joint, name), np.zeros(columns.n_columns))[place] += weight / read.get(joint, 1.0)

    if columns.has_friction:
        start = columns.blocks['friction'].start
        for kind, name in enumerate(NAMES):
            for number, joint in enumerate(body.output_names):
                add(joint, OWN_DYNAMICS.get(name, 'friction'), start + kind * body.n_outputs + number, 1.0)
    for index, effect in enumerate(columns.effects):
        over = isinstance(effect, Effect) and effect.ends
        roles = {} if over else DYNAMICS.get(effect.kind, {})
        block, joint = columns.blocks[str(index)], str(effect.where)
        for place, name in enumerate(_coefficients(columns, index)):
            if name in roles:
                add(joint, roles[name][0], block.start + place, roles[name][1])
    return [(joint, name, weights) for (joint, name), weights in found.items()]


def _coefficients(columns: CoupledColumns, index: int) -> list[str]:
    effect = columns.effects[index]
    return [name for name, _ in effect.coefficients(columns.body)]


def _left_out(columns: CoupledColumns, theta: Array) -> dict[str, float]:
    """Values of effects that are neither loads nor a joint's own in the files, and their calibrations: those of both
    directions of friction too, of which the files hold the mean."""
    found: dict[str, float] = {}
    for index, effect in enumerate(columns.effects):
        kind, block = effect.kind, columns.blocks[str(index)]
        head = spelling(kind, effect.where)
        if effect.is_load:
            continue
        for name, value in zip(_coefficients(columns, index), theta[block].tolist(), strict=True):
            if DYNAMICS.get(kind, {}).get(name, ('', 0.0))[1] != 1.0:
                found[f'{head}.{name}'] = value
        if isinstance(effect, Effect):
            found |= {f'{head}.{name}': effect.value(name) for name, _ in effect.calibrations}
    return found


def _price(estimate: Estimate, solution: _Solution, theta: Array) -> Price:
    """Errors of the description with friction and offset as identified, of the estimate, and of
    what is exported."""
    table = estimate.table
    assert table is not None
    tries = [(estimate.mean, estimate.information, theta, table.used)]
    if estimate.held_out:
        tries = []
        for fold, fitted in zip(table.folds, table.fold_estimates, strict=True):
            tries.append((*fitted, solution.found(*fitted)[2], fold))
    errors = []
    rigid = estimate.columns.blocks['rigid_body']
    for mean, information, constrained, rows in tries:
        as_described = _conditional(mean, information, rigid, estimate.columns.body.base_parameters)
        errors.append([table.error(each, rows) * rows.sum()
                       for each in (as_described, mean, constrained)])
    total = np.sum(errors, axis=0) / sum(rows.sum() for *_, rows in tries)
    description, unconstrained, consistent = np.nanmean(total, axis=1).tolist()
    return Price(description, unconstrained, consistent, estimate.held_out)


def _conditional(mean: Array, information: Array, part: slice, values: Array) -> Array:
    """Most probable theta (p,) where a part of it is known."""
    rest = np.ones(len(mean), dtype=bool)
    rest[part] = False
    theta = mean.copy()
    theta[part] = values
    theta[rest] -= np.linalg.solve(information[np.ix_(rest, rest)],
                                   information[np.ix_(rest, ~rest)] @ (values - mean[part]))
    return theta
