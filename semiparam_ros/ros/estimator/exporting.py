"""The service ``~/export_model``: what was learnt as files beside the states."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from rclpy.node import Node

from semiparam_ros.errors import SemiparamError
from semiparam_ros.export.estimate import from_estimator
from semiparam_ros.export.files import export_to
from semiparam_ros.online.folder_lock import FolderLock
from semiparam_ros.online.learner import Learner
from semiparam_ros.online.model_switcher import sentence_of
from semiparam_ros.online.worker import Background, Urgency
from semiparam_ros.ros.estimator.diagnostics import InternalErrors
from semiparam_ros.ros.estimator.parameters import Parameters
from semiparam_ros.ros.estimator.services import Reply, create_deferred_trigger


class Exporting:
    """Takes the estimate as it is at the call; the rest is done in the process beside the node.

    :param learner: gives the learner, or raises SemiparamError before the robot is known.
    :param description: gives the robot description. :param folder: where the files go.
    :param lock: the right to write there. :param errors: counts what goes wrong unexpectedly.
    """

    def __init__(self, node: Node, parameters: Parameters, learner: Callable[[], Learner],
                 description: Callable[[], str], background: Background, folder: Path,
                 lock: FolderLock, errors: InternalErrors) -> None:
        self._node, self._parameters, self._learner = node, parameters, learner
        self._description, self._background = description, background
        self._folder, self._lock, self._errors = folder, lock, errors
        create_deferred_trigger(node, '~/export_model', self._export, errors)

    def _export(self, reply: Reply) -> None:
        self._lock.take()
        name = self._node.get_fully_qualified_name()
        estimate = from_estimator(self._learner().estimator, None, name)
        stem = Path(self._parameters.settings.state_file).stem
        self._background.submit(export_to, self._folder, stem, self._description(), estimate,
                                done=partial(self._done, reply), urgency=Urgency.ASKED)

    def _done(self, reply: Reply, sentence: str | None, error: BaseException | None) -> None:
        if sentence is None:
            if error is not None and not isinstance(error, SemiparamError):
                self._errors.add('~/export_model', error)
            reply(f'{sentence_of(error)}.', success=False)
            return
        self._node.get_logger().info(f'~/export_model: {sentence}')
        reply(sentence)
