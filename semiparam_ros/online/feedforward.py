"""Feedforward that can be trusted with an arm: withheld until there is a model, within limits, and marked."""

from __future__ import annotations

from collections import Counter

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError, listed
from semiparam_ros.online.desired_state import Desired, described, desired
from semiparam_ros.online.learner import Learner

FARTHEST_VALID = 2.0
"""Distance from what was learnt, over the largest in it. Of 23 pairs of motions states below have .5 % of errors beyond
three standard deviations at most; where an arm learns its friction wrongly, for it moves in one way, it is four."""

MARKS = {'described': 'answered by the robot description alone',
         'limited': 'cut to the effort limits of the robot description',
         'doubtful': 'outside of what was learnt'}
"""What there may be to say of a desired state."""


class WithheldError(SemiparamError):
    """There is no model yet to answer desired states."""


class Feedforward:
    """Answers desired states by a learner's model, and counts what it had to say of them.

    ``counts``: states that were answered, described, limited and doubtful, and trajectories
    withheld.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.last = ''
        """What was last to be said of an answer."""
        self.withheld = ''
        """Why the latest trajectory was withheld; '' when it was answered."""

    def answer(self, learner: Learner, position: Array, velocity: Array, acceleration: Array) -> Desired:
        """One desired state (n_joints,) each.

        Raises WithheldError when there is no model yet, and SemiparamError for values that are not finite.
        """
        row, ready = (position, velocity, acceleration), learner.estimator.ready
        if not ready and learner.settings.feedforward_before_ready == 'withhold':
            self.counts['withheld'] += 1
            self.withheld = (f'feedforward is withheld until {learner.estimator.model_comes}; with '
                             'feedforward.before_ready description the robot description answers meanwhile.')
            raise WithheldError(self.withheld)
        self.withheld = ''
        answer = desired if ready else described
        found = answer(learner.estimator, *row, added=learner.added_to_desired(*row),
                       beyond=learner.tools.beyond_sensor(*row))
        doubtful = ready and is_doubtful(found)
        for name, holds in (('answered', True), ('described', found.described),
                            ('limited', bool(found.limited.any())), ('doubtful', doubtful)):
            self.counts[name] += holds
        if found.described:
            self.last = 'no model yet'
        if doubtful:
            self.last = listed(found.outside) if found.outside else 'the state is unlike those learnt'
        if found.limited.any():
            self.last = listed([f'effort of {joint} cut' for joint, cut in
                                zip(learner.body.effort_joints, found.limited, strict=True) if cut])
        return found

    def sentence(self, before: Counter[str]) -> str:
        """Sentence on the states since some counts; '' for nothing."""
        new = self.counts - before
        parts = [f'{new[name]} {what}' for name, what in MARKS.items() if new[name]]
        return (f'of {new["answered"]} desired states {", ".join(parts)} '
                f'({self.last}).' if parts else '')


def is_doubtful(found: Desired) -> bool:
    """Tell whether the model has learnt too little about the state to be followed without a check: it is far from
    what was learnt, or the answer more than twice as uncertain as the noise."""
    return found.distance > FARTHEST_VALID or found.variance_ratio > 1.0


FARTHEST = 1e9
"""Stands for an infinite distance."""
STATUS = ('valid', 'described', 'limited', 'outside', 'variance_ratio', 'distance')
"""Names of :func:`status`."""


def status(found: Desired) -> list[float]:
    """Numbers that mark an answer: valid (1: by the model, within what it learnt, not cut), by the description (1),
    how many efforts were cut, how many inputs lie outside of those learnt, the ratio of variances, and the
    distance from the inputs learnt, taken together, over the largest of these."""
    cut = float(found.limited.sum())
    valid = not (found.described or cut or is_doubtful(found))
    return [float(valid), float(found.described), cut, float(len(found.outside)), found.variance_ratio,
            min(found.distance, FARTHEST)]
