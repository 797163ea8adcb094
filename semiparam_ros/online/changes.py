"""Has the robot changed, is it touched, or is it as it was: told from the innovations as they come.

An innovation r (measured minus predicted, by the rigid body alone) is judged by five hypotheses:

    free       r is noise, as large as usual beside the standard deviation s that the model gave it
    touched    r = J w: a contact, a wrench w at the hand, or of each output, that wanders
    changed    r = C L theta: the coefficients of some columns of the model have become others
    known      r = k: an effect that is applied went, or one that is tried or remembered came
    learning   r = C theta: nothing changed, but the model did not know its coefficients any better

The columns of a change are those of C that one cause moves: the ten of a body at the last link (a
load was picked up or put down), the offsets (of a sensor, of one joint's effort), the friction of
one joint, or those of the whole rigid body (something else); or the derivatives of the outputs by a
turn of the base, or of one joint's zero, which stand beside C here. So products of C and r are all
that is kept of the samples, for each quarter of a second b of motion, with S = diag(s):

    A_b = sum L' C' S^-2 C L,    h_b = sum L' C' S^-2 r

*Noticing.* q = h' (A + I)^-1 h, summed over the last half, one, two, four and eight seconds, is
what a cause explains beside its prior theta ~ N(0, I). How large it is in free motion is learnt,
for innovations are coloured, and no model is exactly true. The root of q over its usual mean square
has a tail, and what stands out is a ratio that chance exceeds only so often an hour over all causes
and lengths (:class:`~semiparam_ros.online.usual_peaks.Tail`). Motion that the model has not seen
weighs less.

*Telling.* What stands out is judged by the log evidence of each hypothesis over the free one, with
noise kappa S^2. kappa is the usual mean square, and grows with what the best hypothesis leaves. What of
it is no white noise is error of the model, and grows with what the hypothesis explains beside what the model
predicts of the robot's bodies, for it is no more exact than these:

    changed    h' (kappa I + A)^-1 h / (2 kappa) - log|I + A / kappa| / 2 - price
    touched    the same of a w that goes along a line from each edge of the blocks to the next one,
               is a random walk from edge to edge, and is over after six seconds
    known      sum (r' S^-2 r - r~' S^-2 r~) / (2 kappa), r~ what a known effect leaves
    learning   as changed, with theta ~ N(0, kappa P) or N(0, P), whichever is likelier, P the
               covariance that white noise would leave of theta

kappa is large where noise is, and where the first windows were predicted badly: then P is not.
No rigid body is exactly true: how wrong it is elsewhere, white noise does not tell. So of blocks of motion unlike all
that was learnt theta ~ N(0, c kappa P) is as likely, with any c from 1 to 10^5. Where learning is likeliest, the model
goes on as it stands, and learns anew what is usual where that was of such blocks. A change is told once it has ``SURE``
nat more than all others, those of other causes for six seconds too. What acts as a contact does, but
for longer, is a change of no known kind: a cable that has caught. A change may have begun at any of
the last 32 blocks. The price is minus the log of the prior probability: robots pick up and put down,
and the rest is rare.

The model predicts with the coefficients that it had eight seconds of motion ago, for it learns a
change within a few; and, as long as anything stands out, with those from before. A change that was
told is followed: its coefficients, from all quarters since it began, are taken off, so that the
next change stands out in turn. It is over since a block where its evidence until there is larger,
by ``SURE`` nat, than until now; unless another cause, since it began, is likelier than both it and
its end, which is as rare: then it is told anew as that.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate, pairwise
from math import log

import numpy as np

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.learnt_inputs import LARGEST_DISTANCE
from semiparam_ros.core.model import Model
from semiparam_ros.core.prediction import Prediction
from semiparam_ros.core.robot.external_wrench import ExternalWrench
from semiparam_ros.core.robot.frames import last_link
from semiparam_ros.core.robot.small_turns import small_turns
from semiparam_ros.core.stamps import observed_s
from semiparam_ros.core.types import Array, Indices
from semiparam_ros.effects.loads import Payload
from semiparam_ros.online.change_causes import (
    LEARNING,
    Cause,
    CauseFit,
    Judged,
    causes_of,
    likeliest_window,
    load_scale,
    with_prior,
)
from semiparam_ros.online.contact_gate import BEYOND, JUST_BEYOND, UNSEEN_FACTOR, UNSEEN_S
from semiparam_ros.online.followed_change import JUDGED_ANEW, Change, End, Followed
from semiparam_ros.online.identified_parameters import Load
from semiparam_ros.online.motion_block import BLOCK_S, BlockSums, MotionBlock, add_sample, gained
from semiparam_ros.online.usual_noise import LENGTHS, USUAL, Usual
from semiparam_ros.online.usual_peaks import SPEEDS
from semiparam_ros.online.wandering_contact import LASTING, ContactEvidence, ContactSums, contacts, likeliest_of

SINCE = (32, 28, 24, 20, 16, 14, 12, 10, 8, 7, 6, 5, 4)
"""[blocks] How long ago a change may have begun."""
CALM = 0.5
"""Below this share of what stands out, nothing does."""
SURE = 12.0
"""[nat] Odds of 160 000 to 1, as a diagnosis asks of an effect."""
COMPARED, LEAST_COMPARED = 1.0 - 1.0 / 80.0, 40.0 * (1.0 - 1.0 / 80.0)
"""[blocks] After anything stood out, the model as it stands is compared with the one from before
over the last twenty seconds in which nothing does, ten at least."""
RELEASED = 3
"""A contact is over when nothing stands out over the first so many lengths."""
WIDER = 10.0 ** np.arange(6)
"""So many times kappa P is the covariance of what a model does not know of motion unlike all it has learnt, each as
likely."""
STEP = 2.0**0.5
"""kappa grows by this factor or a power of it: few are told apart, which costs less."""
MAPPED_S = 0.02
"""The arm counts as standing so long, for what a wrench at the hand, or a small turn, does to the
outputs."""


def _beside(fits: Sequence[CauseFit], alone: Array, rival: Array, counts: Indices) -> list[Array]:
    """(S,) evidence of each cause over that of the likeliest ``rival`` (S,) which is no change, and
    of all other causes as long as they tell little."""
    found = []
    for number, fit in enumerate(fits):
        others = np.delete(alone, number, axis=0).max(axis=0) if fit.cause.kind else np.inf
        found.append(alone[number] - np.where(counts < LASTING, np.maximum(rival, others), rival))
    return found


class ChangeDetector:
    """Notices changes of one robot; see the module.

    :param columns: of the model that predicts. :param told: so many changes were told before.
    """

    def __init__(self, columns: CoupledColumns, told: int = 0) -> None:
        self.causes, self._directions = causes_of(columns)
        self._alike = _of_equal_size(self.causes)
        self._n_own = columns.n_own
        after_load = self._directions[: self._n_own, self.causes[0].part.stop :]
        self._own_part = self.causes[0].part.stop + np.flatnonzero(after_load.any(axis=0))
        """(q,) the directions that are columns of the model, each in units of its prior."""
        self._own_columns = np.abs(self._directions[:, self._own_part]).argmax(axis=0)
        self._own_scale = self._directions[self._own_columns, self._own_part]
        body = columns.body
        self._hand = ExternalWrench(body, last_link(body))
        self._turns, self._rigid = small_turns(body), columns.blocks['rigid_body']
        self._names, self._contact = body.output_names, ContactEvidence(body)
        self._load_scale = load_scale(body, str(self.causes[0].where))
        self._joints = body.output_index if body.outputs == 'effort' else None
        self.number = told
        """That of the latest change that was told."""
        self._usual, self._former = self._unknown(), list[Usual]()
        """What is usual, and what was before it is learnt anew: the noise until that is known."""
        self._power: deque[float] = deque(maxlen=USUAL * max(LENGTHS))
        self._innovations: deque[float] = deque(maxlen=USUAL * max(LENGTHS))
        """Weighed squares of free blocks, and of their innovations."""
        self._levels: deque[float] = deque(maxlen=USUAL * max(LENGTHS))
        """Mean squares of a sample of free blocks, over those of the noise that the model has."""
        self._level = 1.0
        """Mean squares of white noise at least: those of the model's, or of a sample where it expects more."""
        self._judged = np.zeros(2)
        """Samples so far, and those that begin a step."""
        self._per_block, self._usual_size = 1, 0.0
        """Samples of the last block, and the root mean square of what is left of one, in its standard deviations."""
        self._noise_std: Array | None = None
        """(n,) of the first model: the scale of all that is usual."""
        self._model: Model | None = None
        self.reset()

    def learn_usual(self) -> None:
        """Learn anew what is usual: with what was learnt meanwhile another error is."""
        self._former = self._usual if self.knows else self._former
        self._usual, self._model = self._unknown(), None
        for squares in (self._power, self._innovations, self._levels):
            until_then = [float(np.median(squares))] if squares else []
            squares.clear()
            squares.extend(until_then)
        self.reset()

    def _unknown(self) -> list[Usual]:
        return [Usual(length, len(self.causes)) for length in LENGTHS]

    @property
    def _noise_from(self) -> list[Usual]:
        return self._former if self._former and not self.knows else self._usual

    def reset(self) -> None:
        """Drop what is half seen, as after a jump of the clock; what is usual stays."""
        self._blocks: deque[MotionBlock] = deque(maxlen=max(LENGTHS))
        self._count = 0
        self._newest: int | None = None
        self._reference: Array | None = None
        self._known_turns: Array = np.zeros(len(self._directions) - self._n_own)
        """(t,) small turns of which the robot is known beside the reference [rad]."""
        self._covariance: Array = np.zeros((0, 0))
        self._before: deque[tuple[Array, Array]] = deque(maxlen=max(LENGTHS))
        """Coefficients of the model and their covariance, when each of the last blocks ended."""
        self._familiar = UNSEEN_S
        self.followed: Followed | None = None
        self.touched = False
        self._standing, self._held, self._felt = 0, False, False
        self.touched_at = 0
        """[ns] since when it is touched."""
        self._compared: Array = np.zeros(3)
        """Weighed squares of the model from before, and as it stands, over so many blocks; none
        while they are one."""
        self.finished: MotionBlock | None = None
        """The block that the newest sample finished, None where it did not."""
        self.weighed: tuple[Array, Array] | None = None
        """(n,) innovation of the newest sample in units of its usual size, also in motion never seen, and what to weigh
        others by; None where the robot stands, or before anything is usual."""
        self._begin_block()

    @property
    def reference(self) -> Array | None:
        """(p,) coefficients of the model that outputs are compared with; None before the first."""
        return None if self._reference is None else self._reference.copy()

    def resume(self, reference: Array | None) -> None:
        """Drop what is half seen, and compare with these coefficients (p,), unless those of the
        model as it stands turn out to predict better."""
        now, covariance = self._reference, self._covariance
        self.reset()
        if reference is not None and now is not None and now.shape == reference.shape:
            self._reference, self._covariance, self._held = reference.copy(), covariance, True

    def _begin_block(self) -> None:
        p, n = len(self._directions), len(self._names)
        self._sums = BlockSums.none(n, p)
        self._map: Array | None = None
        self._turned: Array = np.zeros((n, 0))
        self._mapped_at = 0.0
        self._added, self._unlike = np.zeros((0, 2, n)), np.zeros(2)
        self._carried = 0.0
        self._seconds, self._start, self._samples = 0.0, 0, 0

    @property
    def knows(self) -> bool:
        """Return whether it has seen enough free motion to tell anything."""
        return self._usual[LENGTHS.index(8)].known

    @property
    def judges(self) -> bool:
        """Return whether it knows, or knew before, how large the noise is."""
        return self.knows or bool(self._former)

    @property
    def before(self) -> Array | None:
        """(p,) coefficients of the model from before anything stood out; None while they are those
        that it has."""
        return self._reference if self._held else None

    @property
    def stands_out(self) -> bool:
        """Return whether anything does, be it a contact, a change that is told yet, or one that is over."""
        return self.touched or bool(self._standing)

    @property
    def usual_squares(self) -> float:
        """Weighed squares that a block of free motion has."""
        return float(np.median(self._innovations))

    def see(
        self,
        prediction: Prediction,
        model: Model,
        added: Array | None = None,
        spread: Array | float = 0.0,
        distance: Callable[[Array], float] = lambda _: 0.0,
    ) -> Change | None:
        """Take one predicted sample into account; what is told with it.

        :param prediction: of a ``model`` without features. :param added: (m, n) what known effects
            add to the outputs. :param spread: (n,) standard deviation of those that were taken off.
        :param distance: of inputs (m,) from those learnt, over the largest of these.
        """
        sample, theta = prediction.sample, model.theta
        self.finished = self.weighed = None
        seconds, self._newest = observed_s(sample.stamp, self._newest), sample.stamp
        speed = np.abs(sample.velocity)
        if not prediction.ready or prediction.off or float(speed.max()) < SPEEDS[0]:
            return None
        strange = prediction.beyond > (BEYOND if self._familiar >= UNSEEN_S else JUST_BEYOND)
        self._familiar = 0.0 if strange else min(self._familiar + seconds, UNSEEN_S)
        if self._noise_std is None:
            self._noise_std = model.noise_std
        elif model is not self._model:  # its coefficients may be worse than those before
            self._held, self._compared = True, np.zeros(3)
        self._model = model
        weight = model.noise_std / (self._noise_std * np.hypot(prediction.model_std, spread))
        if self._joints is not None:  # what holds a joint that rests tells nothing
            weight = weight * (speed[self._joints] > SPEEDS[0])
        doubt = UNSEEN_FACTOR if self._familiar < UNSEEN_S else 1.0
        if self._reference is None:
            self._refer()
            self._began = model.theta.copy()
        assert self._reference is not None
        left = self._add(prediction, self._reference, weight / doubt, added, distance)
        if self._usual_size:
            self.weighed = left * weight / self._usual_size, weight / self._usual_size
        self._start = self._start or sample.stamp
        self._seconds += seconds
        return None if self._seconds < BLOCK_S - 1e-6 else self._finish_block(sample.stamp, theta)

    def _refer(self) -> None:
        """Compare with the model from before the longest window from now on."""
        assert self._model is not None
        # what noise repeats is in kappa, also where of the samples that are judged some are not learnt
        everything = self._model.recursion.theta_covariance(white=True)
        if self._model.by_steps and self._judged[0]:
            everything *= self._judged[1] / self._judged[0]
        columns = self._own_columns
        scale = np.outer(self._own_scale, self._own_scale)
        covariance = everything[np.ix_(columns, columns)] / scale
        self._before.append((self._model.theta.copy(), covariance))
        self._held, self._compared = False, np.zeros(3)
        reference, self._covariance = self._before[0]
        self._reference, self._known_turns = reference.copy(), np.zeros_like(self._known_turns)

    def _add(
        self, prediction: Prediction, reference: Array, weight: Array, added: Array | None,
        distance: Callable[[Array], float],
    ) -> Array:
        """Take a sample into the block; (n,) what the reference leaves of it, not weighed."""
        columns, sample = np.ascontiguousarray(prediction.columns), prediction.sample
        if self._map is None or self._seconds - self._mapped_at > MAPPED_S - 1e-6:
            self._map = np.ascontiguousarray(self._hand.along_base(sample.position))
            self._turned = np.ascontiguousarray(self._turns.one(
                sample.position, sample.velocity, sample.acceleration, reference[self._rigid]
            ))
            self._mapped_at = self._seconds
            self._unlike += (distance(sample.inputs) > LARGEST_DISTANCE, 1.0)
        unweighed = sample.outputs - columns @ reference - self._turned @ self._known_turns
        of_bodies = weight * (columns[:, self._rigid] @ reference[self._rigid])
        self._carried += float(of_bodies @ of_bodies)
        self._samples += 1
        self._judged += (1.0, prediction.begins_step)
        add_sample(self._sums, columns, self._turned, self._map, weight, unweighed, self._seconds / BLOCK_S)
        if added is not None:
            known, left = added * weight, unweighed * weight
            if len(self._added) != len(known):
                self._added = np.zeros((len(known), 2, len(left)))
            self._added += np.stack([known * left, known * known], axis=1)
        return np.asarray(unweighed)

    def _block(self, stamp: int, theta: Array) -> MotionBlock:
        """The block that ends at a stamp; the next one begins."""
        directions, sums = self._directions, self._sums
        before = self._learnt(self._began)
        block = MotionBlock(
            self._start,
            stamp,
            directions.T @ sums.gram @ directions,
            directions.T @ sums.moment,
            (directions.T @ (sums.moment - sums.gram @ before), self._squares_left(before)),
            self._squares_left(self._learnt(theta)),
            sums.own,
            sums.along @ directions,
            (sums.wrench_gram, sums.wrench_moment, sums.wrench_along @ directions),
            self._added,
            float(self._unlike[0] / self._unlike[1]),
            self._carried,
        )
        self._per_block = self._samples
        self._begin_block()
        self._began = theta.copy()
        return block

    def _finish_block(self, stamp: int, theta: Array) -> Change | None:
        block = self._block(stamp, theta)
        if not np.isfinite(block.own).all() or not np.isfinite(block.gram).all():
            self.reset()  # no sensor measures that
            return None
        self._blocks.append(block)
        self.finished = block
        self._count += 1
        followed = self.followed
        if followed is not None:
            followed.add(block, bool(self._standing))
            if (ended := self._end(followed)) is not None:
                if (rather := self._rather(followed, ended)) is not None:
                    followed.told_anew(self._anew(followed, rather, stamp), rather)
                    return followed.change
                self.followed, self._standing, self._compared = None, 0, np.zeros(3)
                self._blocks.clear()
                return followed.change._replace(noticed=stamp, ended=ended.since)
        ratios = self._outstanding(self._left(self.followed))
        outstanding = max(ratios, default=0.0)
        latest = max(ratios[:RELEASED], default=0.0)
        self._felt = (self.touched and self._felt) or latest >= 1.0
        if self.touched and self._felt and latest < CALM:  # it is over
            self._blocks = deque(list(self._blocks)[-LENGTHS[RELEASED - 1] :], self._blocks.maxlen)
            outstanding = 0.0
        self._standing = self._standing + 1 if outstanding >= 1.0 else 0
        if not self.touched:
            self.touched_at = block.end
        if self._standing:
            self._held = True
            return self._tell(stamp)
        if outstanding < CALM:
            self._calm(block)
        return None

    def _learnt(self, theta: Array) -> Array:
        """(p + t,) coefficients that have come to the reference."""
        assert self._reference is not None
        return np.append((theta - self._reference)[: self._n_own], -self._known_turns)

    def _squares_left(self, learnt: Array) -> float:
        """Weighed squares that a model leaves of the block, which has come so far (p + t,)."""
        sums = self._sums
        return float(sums.own[-1].sum() - learnt @ (2.0 * sums.moment - sums.gram @ learnt))

    def _calm(self, block: MotionBlock) -> None:
        """Nothing stands out: go on with the model as it stands, unless the one from before
        predicts better."""
        if self.followed is None:
            self.touched = False
            self._power.append(float(block.own[-1].sum()))
            self._usual_size = float(np.sqrt(np.median(self._power) / (self._per_block * len(self._names))))
            self._innovations.append(block.innovation[1])
            self._follow_level(block)
        if self._held:  # charge what the model from before leaves, with the change that is followed
            left = float(block.own[-1].sum() - self._gained(self.followed)[-1])
            self._compared = COMPARED * self._compared + (left, block.live, 1.0)
            if self._compared[2] < LEAST_COMPARED or self._compared[1] > self._compared[0]:
                return
            self._blocks.clear()  # they were compared with the one from before
            self._before.clear()
        self.followed = None
        self._refer()

    def _follow_level(self, block: MotionBlock) -> None:
        """Take a free block into account in what white noise is at least."""
        assert self._noise_std is not None
        expected = float(block.own[0] @ np.square(self._noise_std))
        if expected > 0.0:  # else all joints rest whose efforts are measured
            self._levels.append(float(block.own[-1].sum()) / expected)
            self._level = min(float(np.median(self._levels)), 1.0)

    def _outstanding(self, moments: Array) -> list[float]:
        """Ratio by which anything stands out of the last blocks, which have these h (B, K), over each of
        the lengths."""
        lengths = [length for length in LENGTHS if length <= len(self._blocks)]
        starts, ratios = len(self._blocks) - np.array(lengths, dtype=int), list[float]()
        if not lengths:
            return ratios
        found = self._explained(_since([block.gram for block in self._blocks], starts), _since(moments, starts))
        free = self.followed is None and not self.touched
        for length, usual, explained in zip(lengths, self._usual, found, strict=False):
            ratios.append(usual.ratio(explained, self._level))
            if free and ratios[-1] < 1.0 and self._count % length == 0:
                usual.add(explained, self._noise_of(length), self._level)
        return ratios

    def _left(self, followed: Followed | None) -> Array:
        """(B, K) h of each block, without what a change explains."""
        moments = np.array([block.moment for block in self._blocks])
        if followed is not None:
            for row, block in followed.among(self._blocks):
                moments[row] -= block.gram[:, followed.cause.part] @ followed.theta
        return moments

    def _noise_of(self, length: int) -> float:
        """Share that the whole rigid body explains of the innovations of so many blocks, over the number
        of directions that it tells of."""
        latest, part = list(self._blocks)[-length:], self.causes[-1].part
        gram = np.sum([each.gram[part, part] for each in latest], axis=0)
        moment = np.sum([each.innovation[0][part] for each in latest], axis=0)
        inverse = np.linalg.inv(with_prior(gram))
        return float(moment @ inverse @ moment / max(len(moment) - np.trace(inverse), 1.0))

    def _explained(self, grams: Array, moments: Array) -> Array:
        """(S, c) what each cause explains of windows, over the number of directions that it tells
        of."""
        found = np.empty((len(grams), len(self.causes)))
        for numbers, parts in self._alike:
            along = moments[:, parts]
            inverse = np.linalg.inv(with_prior(grams[:, parts[:, :, None], parts[:, None]]))
            told = along.shape[-1] - np.trace(inverse, axis1=-2, axis2=-1)
            squares = (along[..., None, :] @ inverse @ along[..., None])[..., 0, 0]
            found[:, numbers] = squares / np.maximum(told, 1.0)
        return found

    @property
    def load(self) -> Load | None:
        """The load that was picked up and is there, by what came since; None where no change or
        another one is followed."""
        followed = self.followed
        if followed is None or followed.cause.kind != Payload.kind:
            return None
        theta, covariance = followed.estimate(self.noise)
        if theta[0] <= 0.0:
            return None
        scale = self._load_scale
        return Load(str(followed.cause.where), scale * theta, np.outer(scale, scale) * covariance)

    @property
    def noise(self) -> float:
        """kappa: the usual mean square of what the whole rigid body explains, over the longest
        windows known."""
        return next(usual.median(self._level) for usual in reversed(self._noise_from) if usual.known)

    @property
    def innovation_noise(self) -> float:
        """The same of innovations, for what is known to have come."""
        return next(usual.noise(self._level) for usual in reversed(self._noise_from) if usual.known)

    def _tell(self, stamp: int) -> Change | None:
        """Return the hypothesis for which what stands out speaks."""
        followed = self.followed
        again = followed is not None and followed.blocks < JUDGED_ANEW
        best, learns, elsewhere = self._likeliest(None if again else followed)
        self.touched = followed is None and not learns
        if elsewhere and followed is None:
            self.learn_usual()
            return None
        if learns and followed is None:
            self._blocks.clear()
            self._before.clear()
            self._standing = 0
            self._refer()
            return None
        if best is None or best.evidence < SURE:
            return None
        unknown = self.causes[-1]
        if followed is not None and best.cause in (followed.cause, unknown) and (
            again or followed.cause is unknown
        ):
            return None  # what no known kind explains better is named all the same, and told once
        return self._change(stamp, best)

    def likeliest(self) -> Judged | None:
        """The change that is likeliest now, beside a contact and none."""
        return self._likeliest(self.followed)[0] if self._blocks else None

    def _likeliest(self, followed: Followed | None) -> tuple[Judged | None, bool, bool]:
        """The change that is likeliest beside all else; whether the model's learning is likelier than a change and
        than a contact; and whether that is of motion unlike all it had learnt.

        :param followed: what this change explains is taken off.
        """
        now, counts = len(self._blocks), self._counts()
        if not len(counts):
            return None, False, False
        starts = now - counts
        blocks, moments = np.array([block.gram for block in self._blocks]), self._left(followed)
        power = np.array([block.own[-1].sum() for block in self._blocks]) - self._gained(followed)
        grams, sums = _since(blocks, starts), _since(moments, starts)
        fits = [
            CauseFit.of(cause, grams[:, cause.part, cause.part], sums[:, cause.part])
            for cause in self.causes
        ]
        root = self._root_unlearnt()
        unchanged = self._learning(root, grams, sums)
        brief = np.maximum(starts, now - LASTING)  # what began before is no contact, if it acts yet
        contact = self._without(self._blocks, followed)
        squares = _since(power, starts), self._bodies(starts)
        kappa = self._noise_left(*squares, (unchanged, *fits), starts, brief, contact)
        familiar, elsewhere = self._learnt_better(root, unchanged, blocks, moments, starts, kappa)
        learning = np.logaddexp(familiar, elsewhere) - log(2.0)
        known = self._known(starts, power, followed) / (2.0 * kappa)
        alone = np.array([fit.evidence(kappa) - fit.cause.price for fit in fits])
        acting = self._contact(contact, kappa, [now])
        lasts = likeliest_of(acting[:, 0], starts, brief) - fits[-1].cause.price
        alone[-1] = np.maximum(alone[-1], lasts)
        late = starts + (counts + 1) // 2
        later = _since(blocks, late), _since(moments, late)
        touched = np.zeros(len(starts))
        for ends in ([now], range(1, now)):
            # what is no likelier than one of these contacts is not told
            before = acting if now in ends else self._contact(contact, kappa, ends)
            touched = np.maximum(touched, contacts(before, acting[:, 0], starts, ends))
            beside = _beside(fits, alone, np.max([learning, touched, known], axis=0), counts)
            judged = [
                likeliest_window(fit, evidence, kappa, counts, *later)
                for fit, evidence in zip(fits, beside, strict=True)
            ]
            best = max(judged, key=lambda each: each.evidence)
            learns = learning.max() >= max(float(each.max()) for each in (touched, known, alone))
            if best.evidence < SURE and not learns:
                break
        return best, bool(learns), bool(learns and elsewhere.max() > familiar.max())

    def _counts(self) -> Indices:
        """(S,) numbers of blocks ago at which a change may have begun."""
        now = len(self._blocks)
        if 0 < self._standing < min(SINCE):
            return np.array([min(self._standing, now)])
        return np.array([count for count in SINCE if count <= now], dtype=int)

    def _bodies(self, starts: Indices) -> Array:
        """(S,) squares of what the model predicts of the robot's bodies, of windows since some starts."""
        return _since(np.array([block.carried for block in self._blocks]), starts)

    def _noise_left(
        self, power: Array, carried: Array, fits: Sequence[CauseFit], starts: Indices, brief: Indices,
        contact: ContactSums,
    ) -> Array:
        """(S,) kappa of the windows since some starts, which have these squares: the usual one times
        a power of ``STEP``, by what the best of some fits leaves, or what began before ``brief``
        and acts yet.

        :param carried: (S,) squares of what the model predicts of the robot's bodies. What changed is known no better
            than these: it leaves as large a share of itself as the model, beside white noise, of what it predicts.
        """
        explained, noise = np.max([fit.explained for fit in fits], axis=0), self.noise
        if (starts < brief).any():
            acting = self._contact(contact, np.full(len(starts), noise), [len(self._blocks)])
            lasts = likeliest_of(acting[:, 0], starts, brief)
            explained = np.maximum(explained, 2.0 * noise * lasts)
        usual = np.median(self._power) * (len(self._blocks) - starts)
        size = np.divide(explained, carried, out=np.zeros(len(starts)), where=carried > 0.0)
        growth = np.maximum((power - explained) / usual, 1.0 + (1.0 - self._level / noise) * size)
        return np.asarray(noise * STEP ** np.round(np.log(growth) / log(STEP)))

    def _known(self, starts: Indices, power: Array, followed: Followed | None) -> Array:
        """(S,) the squares that the best of the known effects explains of the blocks from each of
        some on, when it came or when it went; or the change that is ``followed``, when it went.

        The first block, which has part of it, is explained whole; ``power`` (B,) of each block.
        """
        found = np.zeros((len(self._blocks) + 1, len(self._blocks[-1].added)))
        went = np.zeros((len(self._blocks) + 1, found.shape[1] + (followed is not None)))
        for row, block in enumerate(self._blocks):
            if block.added.shape[:1] == found.shape[1:]:
                found[row] = gained(block.added, True).sum(axis=1)
                went[row, : found.shape[1]] = gained(block.added, False).sum(axis=1)
        if followed is not None:
            went[:-1, -1] = -self._gained(followed)
        explained = _since(np.hstack([found, went]), starts + 1) + power[starts, None]
        return np.asarray(explained.max(axis=1, initial=0.0))

    def _gained(self, followed: Followed | None) -> Array:
        """(B,) the squares of each block that a change explains."""
        gained = np.zeros(len(self._blocks))
        if followed is not None:
            part, theta = followed.cause.part, followed.theta
            for row, block in followed.among(self._blocks):
                gained[row] = theta @ (2.0 * block.moment[part] - block.gram[part, part] @ theta)
        return gained

    def _root_unlearnt(self) -> Array:
        """(q, q) root of P, the covariance of coefficients that the model knows no better."""
        values, vectors = np.linalg.eigh(self._covariance)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

    def _learning(self, root: Array, grams: Array, sums: Array) -> CauseFit:
        """Fit with which such coefficients explain windows with these sums."""
        part = self._own_part
        return CauseFit.of(
            LEARNING, root.T @ grams[:, part[:, None], part] @ root, sums[:, part] @ root
        )

    def _learnt_better(
        self, root: Array, unchanged: CauseFit, grams: Array, moments: Array, starts: Indices, kappa: Array
    ) -> tuple[Array, Array]:
        """(S,) log evidence of what the model did not know any better, under noise kappa (S,), of windows of blocks
        (B, ...) since some starts; and the same where it knew little of those unlike all that it had learnt."""
        familiar = _knew_no_better(unchanged, kappa)
        unlike = np.array([block.unlike for block in self._blocks])
        if not unlike.any():
            return familiar, familiar
        rest, other = (
            self._learning(root, *(_since((share * values.T).T, starts) for values in (grams, moments)))
            for share in (1.0 - unlike, unlike)
        )
        unknown = [other.evidence(kappa, times * kappa[:, None]) for times in WIDER]
        return familiar, _knew_no_better(rest, kappa) + np.logaddexp.reduce(unknown) - log(len(unknown))

    def _without(self, blocks: Iterable[MotionBlock], followed: Followed | None) -> ContactSums:
        """Sums of some blocks by which contacts are judged, without what a change explains."""
        blocks = list(blocks)
        own, moments = np.array([block.own for block in blocks]), np.array([block.wrench[1] for block in blocks])
        if followed is not None:
            part, theta = followed.cause.part, followed.theta
            for row, block in followed.among(blocks):
                own[row, 3:5] -= block.along[:, :, part] @ theta
                moments[row] -= block.wrench[2][:, part] @ theta
        return ContactSums(own, np.array([block.wrench[0] for block in blocks]), moments)

    def contact_rather(self, row: int, came: bool, since: int, shares: Array) -> bool:
        """Return whether the robot is touched, or may be, rather than that a known effect ``came``, or
        went, within the first block from a stamp [ns] on.

        That block has a part of the effect, and speaks for neither. As much noise is expected as
        the effect leaves of itself, ``shares`` (n,) of each output.

        :param row: of the effect in what known effects add.
        """
        m = len(self._blocks[-1].added) if self._blocks else 0  # others were known before
        blocks = [block for block in self._blocks if block.start >= since and len(block.added) == m]
        if len(blocks) < 2:
            return True
        after = blocks[1:]
        added = np.sum([block.added[row] for block in after], axis=0)
        usual = float(np.median(self._power)) * len(after)
        kappa = self.noise * max(float((np.square(shares) * added[1]).sum()) / usual, 1.0)
        known = float(gained(added, came).sum() / (2.0 * kappa))
        ends = np.arange(1, len(after) + 1)
        acting = self._contact(self._without(after, None), np.array([kappa]), ends.tolist())
        return known <= float(contacts(acting, acting[:, -1], np.array([0]), ends)[0])

    def _end(self, followed: Followed) -> End | None:
        """Since when the change that is followed is over; None while it is there."""
        latest = list(self._blocks)[-LENGTHS[0] :]
        gram, moment = (
            np.sum([getattr(block, name) for block in latest], axis=0)
            for name in ('gram', 'moment')
        )
        if self._usual[0].ratio(self._explained(gram[None], moment[None])[0], self._level) >= 1.0:
            return None
        since = list(self._blocks)[-followed.blocks :]
        starts = np.arange(len(since))
        grams, sums, power, gained = (
            _since(np.array(values), starts)
            for values in (
                [each.gram for each in since],
                [each.moment for each in since],
                [each.own[-1].sum() for each in since],
                self._gained(followed)[-len(since) :],
            )
        )
        usual = self.usual_squares * (len(since) - starts)
        left = np.minimum(power, power - gained)  # by the likelier of both
        kappa = self.innovation_noise * np.maximum(left / usual, 1.0)
        until, whole = (
            followed.without(*values).evidence(kappa)
            for values in ((grams, sums), (np.zeros_like(grams[:1]), np.zeros_like(sums[:1])))
        )
        gains = until - whole
        at = int(gains.argmax())
        if gains[at] <= SURE:
            return None
        return End(since[at].start, float(until[at]), kappa[at : at + 1])

    def _rather(self, followed: Followed, end: End) -> Cause | None:
        """The cause of a known kind by which all that came since a change began is likelier than by that change and its
        end; None for none.

        A load is put down at any time, and what is of no known kind lets go. The rest is over as rarely as it comes:
        friction may pass for an offset as long as its joint goes one way.
        """
        if not followed.cause.kind:
            return None
        rivals = [cause for cause in self.causes if cause.kind and cause != followed.cause]
        found = [float(followed.fit(cause).evidence(end.kappa)[0]) - cause.price for cause in rivals]
        best = int(np.argmax(found))
        return rivals[best] if found[best] > end.evidence - 2.0 * followed.cause.price else None

    def _anew(self, followed: Followed, cause: Cause, stamp: int) -> Change:
        """The change that is followed, told as one of another cause."""
        evidence = float(followed.fit(cause).evidence(np.array([self.innovation_noise]))[0]) - cause.price
        return followed.change._replace(
            noticed=stamp, kind=cause.kind, where=cause.where, value=np.nan, std=np.nan, evidence=evidence
        )

    def _change(self, stamp: int, judged: Judged) -> Change:
        blocks = list(self._blocks)[-judged.blocks :]
        felt = np.sum(
            [block.own[3] ** 2 / np.maximum(block.own[0], 1e-300) for block in blocks], axis=0
        )
        order = [int(index) for index in np.argsort(-felt) if felt[index] > 0.1 * felt.max()]
        mass = std = np.nan
        if judged.cause.kind == Payload.kind:
            scale = float(self._load_scale[0])
            mass = float(judged.theta[0]) * scale
            std = float(np.sqrt(judged.covariance[0, 0])) * scale
        followed = self.followed
        again = followed is not None and followed.blocks < JUDGED_ANEW
        self.number += not again
        since = blocks[0].start
        touched = min(since, self.touched_at)
        if followed is not None and again:  # what it is, is told anew, not when it began
            since, touched = min(since, followed.change.since), min(touched, followed.change.touched)
        change = Change(
            self.number,
            since,
            stamp,
            judged.cause.kind,
            judged.cause.where,
            mass,
            std,
            judged.evidence,
            tuple(self._names[index] for index in order),
            touched=touched,
        )
        if followed is not None and not again and self._reference is not None:
            # what was told before is part of the robot now; blocks beside another one tell nothing
            known = self._directions[:, followed.cause.part] @ followed.theta
            self._reference[: self._n_own] += known[: self._n_own]
            self._known_turns += known[self._n_own :]
            self._blocks.clear()
            blocks = []
        self.touched, self.followed = False, Followed(change, judged, blocks, self._directions.shape[1])
        self._compared = np.zeros(3)
        return change


def _knew_no_better(fit: CauseFit, kappa: Array) -> Array:
    """(S,) log evidence of theta ~ N(0, P), or N(0, kappa P)."""
    return np.maximum(fit.evidence(kappa), fit.evidence(kappa, kappa[:, None]))


def _of_equal_size(causes: Sequence[Cause]) -> list[tuple[Indices, Indices]]:
    """Numbers (c,) of causes with as many directions each, and these directions (c, k)."""
    sizes = np.array([cause.part.stop - cause.part.start for cause in causes])
    starts = np.array([cause.part.start for cause in causes])
    numbers = [np.flatnonzero(sizes == size) for size in np.unique(sizes)]
    return [(alike, starts[alike, None] + np.arange(sizes[alike[0]])) for alike in numbers]


def _since(values: Sequence[Array] | Array, starts: Indices) -> Array:
    """(S, ...) sums of values (B, ...) of blocks from each of some on, the latest first or last."""
    edges = np.append(np.unique(starts), len(values))
    parts = [sum(values[start:end], np.zeros_like(values[0])) for start, end in pairwise(edges.tolist())]
    until_now = list(accumulate(reversed(parts)))[::-1]
    return np.array([until_now[place] for place in np.searchsorted(edges, starts)])
