"""The coupled columns C = [psi | friction | rotors | offset | effects]: everything of the output that is
linear in theta."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np

from semiparam_ros.core.robot.joint_friction import (
    KINDS,
    fill_joints,
    friction_prior,
    joint_columns,
    offset_prior,
    rotor_prior,
)
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import base_scale, bias_scale
from semiparam_ros.core.samples import NO_TEMPERATURE, Sample, Samples
from semiparam_ros.core.types import Array, Indices
from semiparam_ros.errors import SemiparamError

Memory: TypeAlias = object
"""What an effect remembers of earlier samples: None, numbers, texts, arrays, or tuples, lists and
dicts of them, never changed in place; a saved state holds it."""
Memories: TypeAlias = Sequence[tuple[Memory, Memory]] | None
"""Of all effects: what each remembers for its corrections, and for its columns. None at the
start."""

Motions: TypeAlias = tuple[Array, Array, Array]
"""Position, velocity and acceleration (n_joints,) each."""

APPROACH_NS = 100_000_000
"""How long a desired state has moved on at its own velocity, for what remembers the way
travelled."""


class JointColumns(NamedTuple):
    """Columns of J blocks alike: each acts on one joint's effort, by that joint's motion alone."""

    joints: Indices  # (J,)
    outputs: Indices  # (J,) which outputs their efforts are
    functions: Callable[[Array, Array, Array], Array]
    """(J, c) columns of positions, velocities and accelerations (J,)."""


class ColumnBlock:
    """A physical cause with its nonlinear parameters set: it may move the inputs, shape psi, and
    add columns. One of this class does none of these.

    Each method takes what the effect remembered of earlier samples (None at the start) where it
    needs a past.
    """

    kind: ClassVar[str] = ''
    where: str | None = None
    of_sensor: ClassVar[bool] = False
    """Mark of a cause that changes only what the sensor shows, not what the arm needs."""
    is_load: ClassVar[bool] = False
    """Mark of a carried body: its coefficients are ten inertial parameters in the link's frame."""

    def check(self, body: RigidBody) -> None:
        """Raise SemiparamError when the effect cannot be declared on this robot."""

    @property
    def only_adds(self) -> bool:
        """Tell whether the effect leaves inputs and regressors as they are."""
        own = type(self)
        return own.correct is ColumnBlock.correct and own.transform is ColumnBlock.transform

    def joint_columns(self, body: RigidBody, blocks: Sequence[ColumnBlock]) -> JointColumns | None:
        """Columns that :meth:`columns` of ``blocks``, itself among them, give of one sample; None
        where that is not to be had at once."""
        return None

    def coefficients(self, body: RigidBody) -> Sequence[tuple[str, str]]:
        """Names and units of the columns' coefficients, in order."""
        return ()

    def prior_scale(self, body: RigidBody) -> Array:
        """(c,) prior standard deviation of each coefficient over gamma, in its unit; as many as
        there are columns."""
        return np.zeros(0)

    def prior_mean(self, body: RigidBody) -> Array:
        """(c,) prior mean of each coefficient, in its unit; zero for what is not known."""
        return np.zeros(len(self.prior_scale(body)))

    def correct(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[RigidBody, Samples, Memory]:
        """The body and the inputs as they really are (a joint's zero, the direction of gravity, a
        delay)."""
        return body, samples, None

    def transform(self, body: RigidBody, regressors: Array) -> Array:
        """The regressors (N, n, p) as the sensor reports them (a gain, a rotation)."""
        return regressors

    def columns(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        """(N, n, c) further columns."""
        return np.zeros((len(samples), body.n_outputs, len(self.prior_scale(body)))), None

    def on_links(self, body: RigidBody) -> bool:
        """Tell whether it acts on the links, as a carried body and a force do: what shapes psi shapes
        its columns too."""
        return self.is_load

    def acts(self, stamp: int, origin: int) -> bool:
        """Tell whether it acts at a stamp [ns], by its start and its end; ``origin`` [ns] is where
        its time starts."""
        return True

    def desired(self) -> ColumnBlock:
        """The effect as it acts on a desired state; as on any other, unless a kind says otherwise.

        Such a state is exact, has no past, and is taken as of now: a start or an end that was
        reached counts, and a drift stands where it stands. A kind that concerns the time of a
        measurement, or a phase that nobody knows beforehand, is :class:`Absent`.
        """
        return self


def shaping_order(effects: Sequence[ColumnBlock]) -> list[ColumnBlock]:
    """Effects in the order in which they shape columns. Those that move joints by others carry the torques of these
    back, the last one first, for they moved joints one after another; gains are of the motors that carry them."""
    moving, others = list[ColumnBlock](), list[ColumnBlock]()
    for effect in effects:
        own = type(effect)
        one_way = own.correct is ColumnBlock.correct or own.transform is ColumnBlock.transform
        (others if one_way else moving).append(effect)
    return [*moving[::-1], *others]


class Absent(ColumnBlock):
    """Stands for an effect that does not act, with as many columns."""

    def __init__(self, effect: ColumnBlock) -> None:
        self._effect = effect

    def prior_scale(self, body: RigidBody) -> Array:
        """(c,) that of the effect."""
        return self._effect.prior_scale(body)

    def prior_mean(self, body: RigidBody) -> Array:
        """(c,) that of the effect."""
        return self._effect.prior_mean(body)


class CoupledColumns:
    """Assembles C for a rigid body and its declared effects; a wrench always has a constant offset.

    :param joint_friction: with joint efforts, friction, rotor and offset of every output
        (``robot.joint_friction``).
    :param physical: the prior of theta is as wide as the robot is large, about its description;
        False: gamma^2 I about zero, as in the paper.
    """

    def __init__(self, body: RigidBody, effects: Sequence[ColumnBlock] = (), joint_friction: bool = False,
                 physical: bool = False) -> None:
        """Raises SemiparamError when an effect cannot be declared on this robot."""
        self.body, self.effects, self.physical = body, tuple(effects), physical
        self._shaping = shaping_order(self.effects)
        for effect in self.effects:
            effect.check(body)
        self._effect_scales = [effect.prior_scale(body) for effect in self.effects]
        self.has_friction = joint_friction and body.outputs == 'effort'
        self.has_offset = body.outputs == 'wrench' or self.has_friction
        n = body.n_outputs
        self._offset = np.eye(n)[:, :n * self.has_offset]
        self._constant = np.zeros((n, self.n_columns))
        self._constant[:, self.blocks['offset']] = self._offset
        self._no_memories: list[tuple[Memory, Memory]] = [(None, None)] * len(self.effects)

    def without_effects(self) -> CoupledColumns:
        """The same without any effect."""
        return CoupledColumns(self.body, (), self.has_friction, self.physical)

    @property
    def n_columns(self) -> int:
        """p, all blocks together."""
        return self.n_own + self.n_effects

    @property
    def n_effects(self) -> int:
        """Columns of the effects, which stand last."""
        return sum(map(len, self._effect_scales))

    @property
    def n_own(self) -> int:
        """Columns of the rigid body, friction, rotors and the offset, before those of the effects."""
        return self.body.n_parameters + (KINDS + 1) * self._n_joints + self._offset.shape[1]

    @property
    def _n_joints(self) -> int:
        """Outputs that have friction and a rotor."""
        return self.body.n_outputs * self.has_friction

    @property
    def blocks(self) -> dict[str, slice]:
        """Places of the rigid body, friction, rotors and the offset in theta, each effect under its
        place in the list."""
        sizes = {'rigid_body': self.body.n_parameters, 'friction': KINDS * self._n_joints,
                 'rotor': self._n_joints, 'offset': self._offset.shape[1]}
        sizes |= {str(index): len(scale) for index, scale in enumerate(self._effect_scales)}
        ends = np.cumsum(list(sizes.values())).tolist()
        return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}

    @property
    def directions(self) -> Indices:
        """(S n,) columns of dry friction, output by output: each is the mean direction in which its joint slides."""
        n = self.body.n_outputs
        return self.body.n_parameters + np.arange(n, KINDS * n if self.has_friction else n)

    @property
    def prior_scale(self) -> Array:
        """(p,) prior standard deviation of theta over gamma: 1 for inertial parameters unless
        ``physical``, wide for the offset of a wrench, of the joint's size for friction and rotor, a share of that
        for the offset of an effort."""
        rigid = base_scale(self.body) if self.physical else np.ones(self.body.n_parameters)
        joints = list[Array]()
        if self.has_friction:
            joints = [friction_prior(self.body), rotor_prior(self.body), offset_prior(self.body)]
        elif self.has_offset:
            joints = [bias_scale(self.body)]
        return np.concatenate([rigid, *joints, *self._effect_scales])

    @property
    def prior_mean(self) -> Array:
        """(p,) the inertias of the robot description, no offset, and of the effects what was
        declared."""
        mean = np.zeros(self.n_columns)
        mean[:self.body.n_parameters] = self.body.base_parameters
        mean[self.n_own:] = self.known
        return mean

    @property
    def known(self) -> Array:
        """(n_effects,) prior mean of the effects' coefficients."""
        return np.concatenate([np.zeros(0), *(effect.prior_mean(self.body) for effect in self.effects)])

    @property
    def expected(self) -> Array:
        """(p,) prior mean of the model after the initial window: of the effects as declared, and of
        inertial parameters those of the robot description where the prior is physical."""
        mean = self.prior_mean
        mean[:self.n_own] *= self.physical
        return mean

    def one(self, sample: Sample, origin: int, memory: Memories = None) -> tuple[Array, Memories]:
        """(n, p) columns of one sample and what the effects remember after it. ``origin`` [ns]:
        where time starts."""
        columns, past = self._constant.copy(), memory or self._no_memories
        if self.only_add:
            self.body.regressor(sample.position, sample.velocity, sample.acceleration, out=columns)
            self._fill_joints(sample, columns)
            if self._by_themselves:
                past = self._fill_others(self.body, _alone(sample, origin), past, columns)
            return columns, past if self.effects else None
        body, rows, corrected = self.corrected(_alone(sample, origin), [entry[0] for entry in past])
        columns[:, :body.n_parameters] = self.rigid(body, rows)[0]
        self._fill_joints(rows[0], columns)
        past = self._fill_others(body, rows, past, columns)
        return columns, [(moved, entry[1]) for moved, entry in zip(corrected, past, strict=True)]

    def _fill_joints(self, sample: Sample, columns: Array) -> None:
        """Friction, rotors, and effects that are computed at once, into the columns (n, p) of a sample."""
        if self.has_friction:
            fill_joints(self.body, sample.velocity, sample.acceleration, columns)
        for (joints, _, functions), places in self._at_once:
            motion = sample.position[joints], sample.velocity[joints], sample.acceleration[joints]
            columns.reshape(-1)[places] = functions(*motion)

    def _fill_others(self, body: RigidBody, rows: Samples, past: Sequence[tuple[Memory, Memory]],
                     columns: Array) -> list[tuple[Memory, Memory]]:
        """Fill in the columns of all other effects, from one corrected sample; return what is
        remembered of it."""
        after = list(past)
        for index, block in self._by_themselves:
            found, remembered = self._of_effect(index, body, rows, past[index][1])
            columns[:, block], after[index] = found[0], (past[index][0], remembered)
        return after

    @cached_property
    def only_add(self) -> bool:
        """Tell whether no effect moves the inputs or shapes other columns, which then stand
        first."""
        return all(effect.only_adds for effect in self.effects)

    @cached_property
    def _groups(self) -> list[list[int]]:
        """Effects whose columns of a sample can be computed at once, by their numbers."""
        groups: list[list[int]] = []
        for index in range(len(self.effects)):
            group = next((group for group in groups if self._joint_columns([*group, index])), None)
            if group is not None:
                group.append(index)
            elif self._joint_columns([index]):
                groups.append([index])
        return groups

    @cached_property
    def _at_once(self) -> list[tuple[JointColumns, Indices]]:
        """Columns of each group, and where (J, c) these stand in all of a sample by rows."""
        found = []
        for members in self._groups:
            joint_columns = self._joint_columns(members)
            assert joint_columns is not None
            starts = joint_columns.outputs * self.n_columns
            starts += [self.blocks[str(index)].start for index in members]
            count = len(self._effect_scales[members[0]])
            found.append((joint_columns, starts[:, None] + np.arange(count)))
        return found

    @cached_property
    def _by_themselves(self) -> list[tuple[int, slice]]:
        """All other effects, and where their columns stand."""
        grouped = {index for members in self._groups for index in members}
        alone = [index for index in range(len(self.effects)) if index not in grouped]
        return [(index, self.blocks[str(index)]) for index in alone]

    def _joint_columns(self, members: Sequence[int]) -> JointColumns | None:
        """See :meth:`ColumnBlock.joint_columns`; a wrong shape is left to :meth:`_of_effect`."""
        shape = len(members), len(self._effect_scales[members[0]])
        blocks = [self.effects[index] for index in members]
        found = blocks[0].joint_columns(self.body, blocks)
        if found is None or found.functions(*np.zeros((3, len(members)))).shape != shape:
            return None
        return found

    def batch(self, samples: Samples, memory: Memories = None) -> tuple[Array, Memories]:
        """(N, n, p) columns of consecutive samples and what the effects remember after the last
        one."""
        past = memory or [(None, None)] * len(self.effects)
        body, inputs, corrected = self.corrected(samples, [entry[0] for entry in past])
        columns, added = self.of_corrected(body, inputs, [entry[1] for entry in past])
        return columns, list(zip(corrected, added, strict=True))

    def of_corrected(self, body: RigidBody, inputs: Samples,
                     past: Sequence[Memory] = ()) -> tuple[Array, list[Memory]]:
        """(N, n, p) columns from what :meth:`corrected` gives, and what the effects remember of
        them."""
        parts, added = [self.rigid(body, inputs), self.joints(inputs), self.offset(len(inputs))], []
        for index, memory in enumerate(past or [None] * len(self.effects)):
            columns, remembered = self._of_effect(index, body, inputs, memory)
            parts.append(columns)
            added.append(remembered)
        return np.concatenate(parts, axis=2), added

    def rigid(self, body: RigidBody, inputs: Samples) -> Array:
        """(N, n, n_parameters) those of the rigid body, as the effects shape them; to read
        alone."""
        return self._shaped(body, body.regressors(inputs))

    def joints(self, inputs: Samples) -> Array:
        """(N, n, f) those of the joints' friction and rotors; f = 0 where there is none."""
        if self.has_friction:
            return joint_columns(self.body, inputs.velocity, inputs.acceleration)
        return np.zeros((len(inputs), self.body.n_outputs, 0))

    def offset(self, count: int) -> Array:
        """(count, n, n) those of the offset, (count, n, 0) of efforts without joint friction; to
        read alone."""
        return np.broadcast_to(self._offset, (count, *self._offset.shape))

    def of_effect(self, index: int, body: RigidBody, inputs: Samples) -> Array:
        """(N, n, c) those of one effect, from the start of a recording on; to read alone."""
        return self._of_effect(index, body, inputs, None)[0]

    def _of_effect(self, index: int, body: RigidBody, inputs: Samples, memory: Memory) -> tuple[Array, Memory]:
        effect, count = self.effects[index], len(self._effect_scales[index])
        columns, remembered = self.beside(effect, body, inputs, memory)
        if columns.shape[1:] != (body.n_outputs, count):
            raise SemiparamError(f"effect '{effect.kind}' gives columns of shape "
                                 f'{columns.shape[1:]}; expected {(body.n_outputs, count)}, one for each of '
                                 'its coefficients.')
        return columns, remembered

    def beside(self, effect: ColumnBlock, body: RigidBody, inputs: Samples, memory: Memory) -> tuple[Array, Memory]:
        """(N, n, c) columns of an effect, declared or not, as those that are declared shape them, and what it remembers
        after them."""
        columns, remembered = effect.columns(body, inputs, memory)
        return self._shaped(body, columns) if effect.on_links(body) else columns, remembered

    def _shaped(self, body: RigidBody, columns: Array) -> Array:
        """Columns (N, n, c) of bodies and of forces on them as the effects shape them: a gain of the
        efforts multiplies all of these."""
        for effect in self._shaping:
            columns = effect.transform(body, columns)
        return columns

    def desired(self, position: Array, velocity: Array, acceleration: Array, now: int, origin: int,
                temperature: Array = NO_TEMPERATURE) -> tuple[Array, Array]:
        """(n, p) columns of a desired state (n_joints,) as of ``now`` [ns]: as the sensor shows it,
        and of that what the arm needs, without the sensor's offset and effects.

        :param temperature: that of a :class:`Sample` as of now.

        The state has no past. What remembers the way travelled (hysteresis, play, presliding)
        starts at rest and follows a straight way at the state's own velocity, so nothing measured
        mixes with it and it stays bounded.
        """
        unknown = np.full(self.body.n_outputs, np.nan)
        state = Sample(now, position, velocity, acceleration, unknown, temperature)
        start = position - APPROACH_NS * 1e-9 * velocity
        before = state._replace(stamp=now - APPROACH_NS, position=start)
        acting, own = self._desired
        shown = acting._after(before, state, origin)
        needed = shown if own is None else own._after(before, state, origin)
        if self.body.outputs == 'wrench':  # that of an effort is needed to hold the joint
            needed = needed.copy()
            needed[:, self.blocks['offset']] = 0.0
        return shown, needed

    def as_it_is(self, motion: Motions) -> tuple[RigidBody, Motions, Array] | None:
        """Robot and desired motion as the effects correct them, and (n_joints, n_joints) true velocities for unit ones
        of each motor, by which torques of the joints reach the motors; None where no effect corrects anything."""
        acting, n = self._desired[0], self.body.n_joints
        if acting.only_add:
            return None
        position, velocity, acceleration = (np.tile(values, (n + 2, 1)) for values in motion)
        velocity[1:] = np.vstack([np.zeros(n), np.eye(n)])
        stamps, unknown = np.zeros(n + 2, dtype=np.int64), np.full((n + 2, self.body.n_outputs), np.nan)
        body, found, _ = acting.corrected(Samples(stamps, position, velocity, acceleration, unknown, 0))
        own = found.position[0], found.velocity[0], found.acceleration[0]
        return body, own, found.velocity[2:] - found.velocity[1]

    def _after(self, before: Sample, state: Sample, origin: int) -> Array:
        """(n, p) columns of a state; what effects remember begins with the one before it."""
        memory = None
        if self._by_themselves or not self.only_add:
            _, memory = self.one(before, origin)
        return self.one(state, origin, memory)[0]

    @cached_property
    def _desired(self) -> tuple[CoupledColumns, CoupledColumns | None]:
        """Form in which the effects act on a desired state, without those of the sensor if any are."""
        acting, own = [effect.desired() for effect in self.effects], None
        if any(effect.of_sensor for effect in self.effects):
            needed = [Absent(effect) if effect.of_sensor else effect for effect in acting]
            own = CoupledColumns(self.body, needed, self.has_friction)
        return CoupledColumns(self.body, acting, self.has_friction), own

    def corrected(self, samples: Samples, past: Sequence[Memory] = ()) -> tuple[RigidBody, Samples, list[Memory]]:
        """Body and inputs after the corrections of every effect, and what they remember of them."""
        body, inputs, future = self.body, samples, []
        for effect, memory in zip(self.effects, past or [None] * len(self.effects), strict=True):
            body, inputs, remembered = effect.correct(body, inputs, memory)
            future.append(remembered)
        return body, inputs, future


def _alone(sample: Sample, origin: int) -> Samples:
    """One sample as samples; ``origin`` [ns]: where time starts."""
    position, velocity, acceleration, outputs, temperature = (values[None] for values in sample[1:])
    return Samples(np.array([sample.stamp]), position, velocity, acceleration, outputs, origin,
                   temperature=temperature)
