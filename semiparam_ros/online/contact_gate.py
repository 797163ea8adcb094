"""Contact is not dynamics: which samples must not be learnt.

The gate judges the innovations (measured minus predicted) by what they are in free motion, not by
the standard deviation that the model gives them. For each output:

1. *Scale.* Time is cut into blocks of half a second. The usual peak of an output is the median, over the last twenty
   blocks, of the largest innovation in a block. Peaks of blocks contain the colour of the innovations: however long one
   lasts, it counts once. Every band of speed has its own usual peaks, rest among them. At rest the slow mean is taken
   off first: stiction holds an arm with efforts that differ from stop to stop, and a push changes them.
2. *Tail.* The ratio of a block's peak to the usual one has a tail, in free motion and at rest, that decides how large
   a ratio comes by chance only so often.
3. *Plausibility.* A push is a force at a link: three numbers decide what all outputs feel. Friction that the model does
   not know is felt by one joint alone. What no force at any link brings about counts half.

Blocks in which the gate is closed belong to neither, unless it closes again and again on what is
not far beyond: then they belong to both. An arm that sets out is held by friction that the model
does not know well. So at rest the scale is at least a fifth of that of motion, and for the first
second of motion it is at least that of motion at a usual speed. The effort of a joint that turns
round has a scale of its own, for the same reason; that of one which moves for the first time has
none yet, and is not judged. Motors that are off behind brakes are not judged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from math import exp, sqrt
from typing import NamedTuple, cast

import numpy as np

from semiparam_ros.core.columns import Memory
from semiparam_ros.core.compiled import Vector, compiled
from semiparam_ros.core.prediction import Prediction
from semiparam_ros.core.robot.contact_place import ContactPlace
from semiparam_ros.core.robot.frames import force_maps
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import push_force
from semiparam_ros.core.stamps import NANOSECONDS, observed_s
from semiparam_ros.core.types import Array, Indices
from semiparam_ros.online.usual_peaks import (
    FEWEST_BLOCKS,
    REST_MEMORY_S,
    SAVED_OF_TURNS,
    SCALE_BLOCKS,
    SPEED_MEMORY_S,
    SPEEDS,
    Band,
    Tail,
    TurnPeaks,
)
from semiparam_ros.settings.parameter_table import Table

BEYOND, UNSEEN_FACTOR = 0.1, 4.0
"""A position, velocity or acceleration so far outside of those learnt, as a share of their range,
is unseen motion: for a time after it, and until hyperparameters follow it, thresholds are so many
times as high."""
JUST_BEYOND, NEW_FACTOR = 0.03, 1.5
"""The same at the edge of what was learnt, which widens with each sample: a joint that creeps to
where it never was is never far outside. So many times as high too at a speed that is new, where
they come down with the blocks that are known; and again so many times while the model is
provisional."""
UNSEEN_S = 2.0
"""[s] That time."""
FASTER = 2.5
"""A faster band that was not seen yet has usual peaks at most so many times those of the next
slower one."""
SLOWER_SHARE = 0.5
"""Usual peaks in motion are at least this share of those of the next faster band: fast motion slows
down at times, and still has its accelerations then."""
START_S = 1.0
"""So long after rest the friction of a joint may have either sign."""
REST_SHARE = 0.2
"""Usual peaks at rest are at least this share of those in motion: efforts change before a joint
begins to move."""
SMALLEST_SCALE = 0.25
"""Usual peaks count as at least so many predicted standard deviations: silence is not exactness."""
AGAIN, AGAIN_S, OWN = 3, 10.0, 4.0
"""So many closures within so many seconds are the robot's own, where none of their outputs is
beyond so many times its threshold: who taps a robot is felt far beyond."""
PEAK = 2.5
"""[standard deviations] Usual peaks of coloured noise."""
IMPLAUSIBLE = 0.5
"""So much counts an innovation that no force at a link's origin or centre of mass brings about, as
pushes elsewhere do not quite."""


class BesideUsual(NamedTuple):
    """Innovations of one sample beside what is usual of them."""

    change: Array  # (n,) innovations; at rest without their slow mean
    scale: Array | None  # (n,) usual peaks; None where none are known
    ratio: Array  # (n,) of the two, 0 where nothing is known to judge by


class ContactGate:
    """Closes on an innovation that free motion brings about less often than
    ``gate.false_alarms_per_hour``.

    It opens when all outputs have been as usual for ``gate.hold`` seconds. A gate closed for longer
    than ``gate.timeout`` opens too: a robot that is touched is let go again, so the robot itself
    has changed, the model must follow, and the innovations that were refused are usual from then
    on.
    """

    def __init__(self, n_outputs: int, joints: Indices | None = None,
                 forces: Callable[[Array], Array] | None = None, place: ContactPlace | None = None) -> None:
        """:param joints: (n_outputs,) numbers of the joints whose efforts are the outputs; None of a wrench.
        :param forces: (n_places, n, 3) outputs that a push causes at places on the links, at positions (n_joints,);
            every innovation is plausible without it.
        :param place: told of every sample that feels a contact; it begins anew with each of them.
        """
        self._joints, self._forces, self.place = joints, forces, place
        self.closed = False
        self._closed_since = self._closed_at = 0
        self.refused = self.contacts = self.changes = 0
        self.level: Array = np.zeros(n_outputs)
        """(n,) innovations over their thresholds, of the last sample; 0 where nothing is known to
        judge it by."""
        self._n_outputs = n_outputs
        self._free = np.ones(n_outputs), np.ones(n_outputs)
        self._calm_since: int | None = None
        self.forget()

    @classmethod
    def of(cls, body: RigidBody) -> ContactGate:
        """The gate of a robot's outputs."""
        return cls(body.n_outputs, body.output_index if body.outputs == 'effort' else None, partial(push_maps, body),
                   ContactPlace(body))

    def forget(self) -> None:
        """Open it, and learn anew what is usual; the counts stay."""
        self._tails = (Tail(self._n_outputs), Tail(self._n_outputs))
        self._bands = [Band(self._n_outputs) for _ in range(len(SPEEDS) + 1)]
        self._meanwhile = Band(self._n_outputs)
        self._turns = TurnPeaks(self._n_outputs) if self._joints is not None else None
        self._mean: Array = np.zeros(self._n_outputs)
        self._closures: tuple[int, ...] = ()
        self._closed_ratio: Array = np.zeros(self._n_outputs)
        self.changed = False
        """Whether there was a change that lasted, of which nothing is learnt yet."""
        if self.place is not None:
            self.place.forget()
        self.reset()

    def reset(self) -> None:
        """Open it, as after a jump of the clock; what is usual stays."""
        self._open()
        self.level = np.zeros(self._n_outputs)
        self._newest: int | None = None
        self._speed = self._awake = 0.0
        self._familiar = self._within = UNSEEN_S
        for band in self._bands:
            band.clear()
        if self._turns is not None:
            self._turns.reset()

    def begin_rest(self) -> None:
        """Begin the slow mean of the innovations at rest anew, as where something else predicts or is taken off them
        from the next sample on; beside a contact it stays what it was before that."""
        self._resting = 0

    def judge(self, prediction: Prediction, settings: Table, unseen: bool = False) -> bool:
        """True when a predicted sample must not be learnt.

        :param unseen: it belongs to motion that the model has not seen, whatever its range.
        """
        closed = self._judge(prediction, settings, unseen)
        if not closed:
            self._free = prediction.std, prediction.model_std
        return closed

    @property
    def widening(self) -> Array:
        """(n,) how much wider than the model's own the bands were at the last sample without a
        contact: those of a contact hold what pushes."""
        return self._free[0] / self._free[1]

    def _judge(self, prediction: Prediction, settings: Table, unseen: bool) -> bool:
        if prediction.off or not settings.gate_enabled:
            if self._newest is not None:
                self.reset()
            return False
        stamp = prediction.sample.stamp
        seconds = observed_s(stamp, self._newest)
        self._pass_over(stamp, seconds)
        self._newest = stamp
        moving, at = self._follow_speed(prediction, seconds)
        innovation = prediction.sample.outputs - prediction.model_mean
        seen = self._beside_usual(prediction, innovation, at, seconds)
        familiar, caution = self._caution(prediction, unseen, at, seconds)
        per_hour = settings.gate_false_alarms_per_hour
        usual_thresholds, usual_large = self._tails[at > 0].thresholds(per_hour)
        thresholds = usual_thresholds * caution
        self.level = self._plausible(prediction, seen, thresholds) / thresholds
        if self.closed:
            calm = bool((seen.ratio <= np.maximum(0.5 * thresholds, usual_large)).all())
            own = bool((self._closed_ratio <= OWN * thresholds).all())
            self._perhaps_open(stamp, calm, own, settings)
        elif self.level.max() > 1.0:
            self._close(stamp, at)
        if self.closed:
            self._refuse(prediction, seen, seconds)
            return True
        self._rest(innovation, seconds, moving)
        self._learn_usual(seen, at, familiar, seconds)
        return False

    def _pass_over(self, stamp: int, seconds: float) -> None:
        """Time in which nothing was observed, as before a restart, is none that a contact lasts."""
        if self._newest is None or not self.closed:
            return
        unobserved = max(stamp - self._newest - round(seconds * NANOSECONDS), 0)
        self._closed_since += unobserved
        if self._calm_since is not None:
            self._calm_since += unobserved

    def _beside_usual(self, prediction: Prediction, innovation: Array, at: int,
                      seconds: float) -> BesideUsual:
        """Innovations (n,) of a sample in a band of speed, beside their usual peaks there."""
        if at == 0 and not self._resting and not self.closed:
            self._mean = innovation  # as where brakes have let go: how the arm is held now is not known from before
        change = innovation - self._mean if at == 0 else innovation
        usual, turns = self._usual(at), self._turns
        if turns is not None:
            own, sample = self._joints, prediction.sample
            turning = turns.follow(sample.position[own], sample.velocity[own], seconds)
            if at > 0:
                turns.add(np.abs(change), turning)
                if usual is not None:
                    usual = np.maximum(usual, np.where(turning, turns.usual, 0.0))
        if usual is None:
            return BesideUsual(change, None, np.zeros(self._n_outputs))
        scale = np.maximum(usual, SMALLEST_SCALE * prediction.model_std)
        ratio = np.abs(change) / scale
        if turns is not None:
            ratio[turns.new] = 0.0
        return BesideUsual(change, scale, ratio)

    def _caution(self, prediction: Prediction, unseen: bool, at: int,
                 seconds: float) -> tuple[bool, float]:
        """Tell whether the motion is familiar, and by how much thresholds are higher."""
        unseen = unseen or prediction.beyond > BEYOND
        self._familiar = 0.0 if unseen else min(self._familiar + seconds, UNSEEN_S)
        at_edge = unseen or prediction.beyond > JUST_BEYOND
        self._within = 0.0 if at_edge else min(self._within + seconds, UNSEEN_S)
        if self._familiar < UNSEEN_S:
            return False, UNSEEN_FACTOR
        new = 1.0 if self._within < UNSEEN_S else 1.0 - self._bands[at].known
        factor = 1.0 + (NEW_FACTOR - 1.0) * new
        return True, factor if prediction.ready else factor * NEW_FACTOR

    def _plausible(self, prediction: Prediction, seen: BesideUsual, thresholds: Array) -> Array:
        """(n,) ratios, where one is beyond its threshold as far as a push explains them."""
        if seen.scale is None or self._forces is None or not (seen.ratio > thresholds).any():
            return seen.ratio
        forces = self._forces(prediction.sample.position) / seen.scale[:, None]
        pushed = explained(seen.change / seen.scale, forces)
        return np.clip(pushed, IMPLAUSIBLE * seen.ratio, seen.ratio)

    def _close(self, stamp: int, at: int) -> None:
        self.closed, self._closed_since, self._closed_at = True, stamp, at
        self._calm_since = None
        self.contacts += 1
        self._bands[at].clear()
        self._meanwhile, self._closed_ratio = Band(self._n_outputs), np.zeros(self._n_outputs)
        self._closures = (*self._closures, stamp)[-AGAIN:]
        if self.place is not None:
            self.place.forget()

    def _refuse(self, prediction: Prediction, seen: BesideUsual, seconds: float) -> None:
        """Keep what a sample of a contact shows."""
        self.refused += 1
        if self.place is not None and seen.scale is not None and self.level.max() > 1.0:
            self.place.see(prediction.sample.position, seen.change, seen.scale / PEAK, seconds)
        self._closed_ratio = np.maximum(self._closed_ratio, seen.ratio)
        self._meanwhile.add(np.abs(seen.change), seen.ratio, seconds)

    def _learn_usual(self, seen: BesideUsual, at: int, familiar: bool, seconds: float) -> None:
        """Learn what is usual from a sample of free motion."""
        ratios = self._bands[at].add(np.abs(seen.change), seen.ratio, seconds)
        if at and self._bands[at].blocks == SCALE_BLOCKS:
            self._drop_stale()
        if ratios is not None and familiar:
            self._tails[at > 0].add(ratios)

    def places(self) -> tuple[Array, float]:
        """Probabilities (n_links,) of the present contact at each of the links of :attr:`place`,
        and since when [s] it lasts; zeros where there is none."""
        if self.place is None or not self.closed:
            return np.zeros(0 if self.place is None else len(self.place.links)), 0.0
        newest = self._closed_since if self._newest is None else self._newest
        return self.place.probabilities, 1e-9 * (newest - self._closed_since)

    def touched(self) -> list[int]:
        """Outputs that feel the contact now, the strongest first; those of the last sample that
        felt any."""
        order = np.argsort(-self.level)
        return [int(index) for index in order if self.level[index] > 1.0]

    def state(self) -> Memory:
        """For a file; :meth:`restore` takes it back bit for bit."""
        return {'closed': self.closed, 'changed': self.changed,
                'counts': (self.refused, self.contacts, self.changes), 'level': self.level,
                'closed_since': self._closed_since, 'closed_at': self._closed_at, 'calm_since': self._calm_since,
                'newest': self._newest, 'speed': self._speed, 'mean': self._mean, 'resting': self._resting,
                'awake': self._awake, 'familiar': self._familiar, 'within': self._within,
                'closures': self._closures,
                'closed_ratio': self._closed_ratio,
                'turns': None if self._turns is None else self._turns.state(),
                'tails': tuple(tail.ratios for tail in self._tails),
                'bands': tuple((band.peaks, band.peak.copy(), band.ratio.copy(), band.seconds, band.blocks)
                               for band in (*self._bands, self._meanwhile)),
                'free': self._free}

    def restore(self, state: Memory) -> None:
        """Go on as the gate that was saved; raises LookupError, TypeError or ValueError for what is
        no state."""
        if not isinstance(state, dict):
            raise TypeError('the state of the gate is no mapping')
        self.forget()
        self.closed, self._closed_at = state['closed'], state['closed_at']
        self._closed_since, *closures = _stamps([state['closed_since'], *state['closures']])
        self.changed = state['changed']
        self.refused, self.contacts, self.changes = state['counts']
        self._closures = tuple(closures)
        self._calm_since, self._newest = (None if stamp is None else _stamps([stamp])[0]
                                          for stamp in (state['calm_since'], state['newest']))
        self._resting, self._awake, self._speed = state['resting'], state['awake'], state['speed']
        self._familiar, self._within = float(state['familiar']), float(state['within'])
        self._closed_ratio = self._sized(state['closed_ratio'], 1)
        self.level, self._mean = self._sized(state['level'], 1), self._sized(state['mean'], 1)
        std, model_std = (self._sized(values, 1) for values in state['free'])
        self._free = std, model_std
        for tail, ratios in zip(self._tails, state['tails'], strict=True):
            tail.ratios = self._sized(ratios, 2)
        for band, (peaks, peak, ratio, seconds, blocks) in zip((*self._bands, self._meanwhile), state['bands'],
                                                               strict=True):
            band.restore(self._sized(peaks, 2))
            band.peak, band.ratio, band.seconds = self._sized(peak, 1), self._sized(ratio, 1), seconds
            band.blocks = blocks
        if self._turns is not None:
            turns = state['turns']
            self._turns.restore({name: self._sized(turns[name], 2 if name == 'peaks' else 1)
                                 for name in SAVED_OF_TURNS})

    def _sized(self, values: Array, dimensions: int) -> Array:
        if values.ndim != dimensions or values.shape[-1] != self._n_outputs:
            raise ValueError(f'the gate holds an array of shape {values.shape}')
        return np.array(values)

    def _open(self) -> None:
        self.closed = False
        self._closed_since = self._closed_at = 0
        self._calm_since = None
        self._resting = 0

    def _follow_speed(self, prediction: Prediction, seconds: float) -> tuple[bool, int]:
        """Tell whether the robot moves now, and the band of its speed over the last second; while
        the gate is closed at least that in which it closed."""
        speed = float(np.abs(prediction.sample.velocity).max())
        self._speed = max(speed, self._speed * exp(-seconds / SPEED_MEMORY_S))
        band = sum(self._speed > edge for edge in SPEEDS)
        self._awake = 0.0 if band == 0 else self._awake + seconds
        return speed > SPEEDS[0], max(band, self._closed_at)

    def _usual(self, at: int) -> Array | None:
        """Usual peaks (n,) in a band; of a neighbour while its own are unknown, but never rest's
        for motion."""
        own = self._bands[at].usual
        moving = {band: usual for band in range(1, len(self._bands))
                  if (usual := self._bands[band].usual) is not None}
        if not moving:
            return own
        if own is None:
            nearest = min(moving, key=lambda band: abs(band - at))
            own = moving[nearest] * max(1.0, FASTER ** (at - nearest))
        faster = self._bands[at + 1].usual if 0 < at < len(SPEEDS) else None
        if faster is not None:
            own = np.maximum(own, SLOWER_SHARE * faster)
        if at and self._awake >= START_S:
            return own
        typical = np.median(list(moving.values()), axis=0)
        return np.maximum(own, typical if at else REST_SHARE * typical)

    def _rest(self, innovation: Array, seconds: float, moving: bool) -> None:
        """Follow the slow mean of the innovations at rest; it begins anew with every stop."""
        self._resting = 0 if moving else self._resting + 1
        if self._resting:
            self._mean = self._mean + max(1.0 / self._resting, seconds / REST_MEMORY_S) * (innovation - self._mean)

    def _perhaps_open(self, stamp: int, calm: bool, own: bool, settings: Table) -> None:
        self._calm_since = (stamp if self._calm_since is None else self._calm_since) if calm else None
        if self._calm_since is not None and stamp - self._calm_since >= settings.gate_hold * NANOSECONDS:
            if own and len(self._closures) == AGAIN and 0 <= stamp - self._closures[0] <= AGAIN_S * NANOSECONDS:
                self._learn_closure()
            self._open()
        elif settings.gate_timeout and stamp - self._closed_since > settings.gate_timeout * NANOSECONDS:
            self._follow_change()
            self._open()
            self.changes += 1
            self.changed = True

    def _learn_closure(self) -> None:
        """Count what was refused as free motion."""
        band, tail = self._bands[self._closed_at], self._tails[self._closed_at > 0]
        band.restore(np.vstack([band.peaks, self._meanwhile.peaks, self._meanwhile.peak])[-SCALE_BLOCKS:])
        tail.add(self._closed_ratio)

    def _follow_change(self) -> None:
        """Take what was refused for usual from now on, at rest or at every speed; nothing becomes
        smaller by it.

        A robot that meanwhile stops shows in some outputs nothing but noise.
        """
        refused = self._meanwhile.peaks
        if len(refused) < FEWEST_BLOCKS:  # from too few, nothing would be usual
            refused = np.resize(np.vstack([refused, self._meanwhile.peak]), (FEWEST_BLOCKS, self._n_outputs))
        for band in self._bands[1:] if self._closed_at else self._bands[:1]:
            usual = 0.0 if band.usual is None else band.usual
            band.restore(np.maximum(refused, usual))
            band.blocks = 0

    def _drop_stale(self) -> None:
        """At some speed the robot is known again after a change: those at which it was not since
        follow that."""
        for band in self._bands[1:]:
            if band.blocks < min(len(band.peaks), FEWEST_BLOCKS):
                band.restore(band.peaks[:0])


def push_maps(body: RigidBody, position: Array) -> Array:
    """(2 n_links, n, 3) outputs caused by the forces of a push, as :func:`force_maps` has them of unit forces."""
    return push_force(body) * force_maps(body, position)


def explained(ratio: Array, maps: Array) -> Array:
    """(n,) how much of innovations (n,), in units of their usual peaks, a push explains: a force at
    one of the links.

    :param maps: (n_places, n, 3) the same caused by the forces of a push.

    It is the posterior mean of what a Gaussian force brings about, beside noise of unit variance,
    of whichever place explains most of an output.
    """
    # By the singular values: the covariance may be singular to rounding.
    left, stretch, _ = np.linalg.svd(maps, full_matrices=False)
    along = np.swapaxes(left, 1, 2) @ ratio
    shares = stretch**2 / (stretch**2 + 1.0)
    return np.asarray(np.abs((left @ (shares * along)[:, :, None])[:, :, 0]).max(axis=0))


def standardised_innovation(prediction: Prediction) -> float:
    """Root mean square over the outputs of (y - mean) / std, both of the model alone; 0 while it is
    provisional.

    Calibrated bands widen, and a wandering offset follows, when the outputs are not as predicted:
    this must not.
    """
    if not prediction.ready:
        return 0.0
    return _root_mean_square(prediction.sample.outputs, prediction.model_mean, prediction.model_std)


@compiled
def _root_mean_square(outputs: Vector, mean: Vector, std: Vector) -> float:
    """Root mean square of (outputs - mean) / std, all (n,)."""
    squares = 0.0
    for k in range(len(mean)):
        squares += ((outputs[k] - mean[k]) / std[k]) ** 2
    return sqrt(squares / len(mean))


def _stamps(values: Sequence[object]) -> list[int]:
    """Values that are times [ns] which messages can have; raises ValueError for others."""
    wrong = [value for value in values if not (type(value) is int and abs(value) < 2**62)]
    if wrong:
        raise ValueError(f'the gate holds {wrong[0]!r}; expected a stamp in ns')
    return cast('list[int]', list(values))
