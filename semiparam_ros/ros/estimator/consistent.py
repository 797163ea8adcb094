"""The topic ``~/parameters``: what was learnt, as bodies that can be (``parameters.consistent``)."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from rclpy.node import Node
from std_msgs.msg import String

from semiparam_ros.effects.loads import Payload
from semiparam_ros.errors import SemiparamError
from semiparam_ros.export.estimate import Estimate, from_estimator, with_known
from semiparam_ros.export.live import ConsistentParameters, consistent_parameters
from semiparam_ros.online.applied_effects import KnownEffect
from semiparam_ros.online.identified_parameters import (
    LearntCoefficient,
    Load,
    is_shown,
    quantities,
)
from semiparam_ros.online.learner import Learner
from semiparam_ros.online.model_switcher import sentence_of
from semiparam_ros.online.worker import Background, Job
from semiparam_ros.ros.estimator.publishers import LATCHED

LARGEST_SHARE = 0.1
"""Of a processor, which it may use."""


def learnt(learner: Learner, name: str) -> Estimate:
    """Estimate of a learner, with the changes that are applied beside its model.

    Raises SemiparamError when it has learnt no rigid body.
    """
    changes = learner.changes.applied
    known, load = changes.applied, changes.provisional
    if load is not None:
        std = np.sqrt(np.diag(load.covariance))
        known.append(KnownEffect(0, Payload(load.link), load.parameters, std))
    return with_known(from_estimator(learner.estimator, None, name), known)._replace(bias=learner.tare.bias)


class ConsistentBodies(NamedTuple):
    """Consistent parameters of the model at one time.

    :param load: what the arm carries as a body, with the covariance as it was learnt.
    :param at: [s] by the steady clock, when they were asked for.
    """

    coefficients: list[LearntCoefficient]
    load: Load | None
    stamp: int | None
    at: float


class ConsistentTopic:
    """Asks the process beside the node for bodies that can be, once it has answered before, and
    publishes its answer.

    ``found`` is the latest answer, ``trouble`` a sentence where there is none; both are empty in
    the beginning.

    :param description: gives the robot description. :param failed: told of an error that is not
        expected.
    """

    def __init__(self, node: Node, description: Callable[[], str], background: Background,
                 failed: Callable[[str, BaseException], object]) -> None:
        self._description, self._background, self._failed = description, background, failed
        self._name = node.get_fully_qualified_name()
        self._publisher = node.create_publisher(String, '~/parameters', LATCHED)
        self.found: ConsistentBodies | None = None
        self.trouble = ''
        self._job: Job | None = None
        self._earliest = 0.0

    def ask(self, learner: Learner, load: Load | None, stamp: int | None) -> None:
        """Ask for those of the model as it is now, unless an answer is still to come.

        :param load: what it carries. :param stamp: of the sample [ns] that they are told of.
        """
        try:
            estimate = learnt(learner, self._name)
        except SemiparamError as error:
            self.stop()
            self.trouble = str(error)
            return
        now = time.monotonic()
        if self._job is not None or now < self._earliest:
            return
        carried = load if load is not None and is_shown(load) else None
        estimator = learner.estimator
        asked = ConsistentBodies(quantities(estimator, estimator.rigid_body_model), load, stamp, now)
        self._job = self._background.submit(
            consistent_parameters, self._description(), estimate,
            None if carried is None else (carried.parameters, carried.covariance),
            done=partial(self._done, asked))

    def stop(self) -> None:
        """Forget what was found, and what is still to come."""
        if self._job is not None:
            self._job.cancel()
        self._job, self.found, self.trouble = None, None, ''

    def _done(self, asked: ConsistentBodies, answer: ConsistentParameters | None,
              error: BaseException | None) -> None:
        self._job = None
        if answer is None:
            if error is not None and not isinstance(error, SemiparamError):
                self._failed('~/parameters', error)
            self.found, self.trouble = None, f'{sentence_of(error)}.'
            return
        self._earliest = asked.at + answer.seconds / LARGEST_SHARE
        own = answer.theta[:len(asked.coefficients)].tolist()  # without what is applied beside it
        coefficients = [entry._replace(value=value)
                        for entry, value in zip(asked.coefficients, own, strict=True)]
        load = asked.load
        if load is not None and answer.load is not None:
            load = load._replace(parameters=answer.load)
        self.found, self.trouble = asked._replace(coefficients=coefficients, load=load), ''
        self._publisher.publish(String(data=answer.document))
