"""The node `estimator`: it owns topics, parameters, services and the background process; the rest it delegates."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.parameter import Parameter

from semiparam_ros.core.horizon_error import HorizonErrors
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.errors import SemiparamError, shortened
from semiparam_ros.online.change_record import ChangeRecord
from semiparam_ros.online.folder_lock import FolderLock
from semiparam_ros.online.learner import Answer, Learner, LearnerListener
from semiparam_ros.online.model_switcher import same_model
from semiparam_ros.online.state_file import SavedState, folder_of
from semiparam_ros.online.worker import ProcessBackground, Scheduler, Worker
from semiparam_ros.ros.answering import AnsweringNode
from semiparam_ros.ros.context import DELIVER_S, destroyed_on_failure
from semiparam_ros.ros.estimator.autosave import Autosave
from semiparam_ros.ros.estimator.changing import Changing
from semiparam_ros.ros.estimator.consistent import ConsistentTopic
from semiparam_ros.ros.estimator.desired_trajectory import DesiredTrajectory
from semiparam_ros.ros.estimator.diagnosing import Diagnosing
from semiparam_ros.ros.estimator.diagnostics import (
    CHECKPOINTS,
    DESCRIPTION,
    PARAMETERS,
    InternalErrors,
    Rejections,
    Reports,
)
from semiparam_ros.ros.estimator.outside import Outside
from semiparam_ros.ros.estimator.parameters import HeldReplies, Parameters
from semiparam_ros.ros.estimator.publishers import Outputs
from semiparam_ros.ros.estimator.robot import Robot
from semiparam_ros.ros.estimator.services import Services, reason
from semiparam_ros.ros.estimator.setup_check import SetupCheck
from semiparam_ros.ros.estimator.subscriptions import InputStream
from semiparam_ros.settings.files import located
from semiparam_ros.settings.parameter_table import BY_NAME
from semiparam_ros.settings.snapshot import Settings, unknown_name

NAME = 'estimator'


class EstimatorNode(AnsweringNode, LearnerListener):
    """Learns, predicts and publishes.

    :param schedule: see :data:`Scheduler`.
    :param files: the parameter files, see :func:`located`. :param worker: the process beside it; begun if left out.
    :param last_words: of a full name of a node, see :func:`~semiparam_ros.settings.last_word.last_words`.
    Raises SemiparamError when the parameters do not describe an estimator.
    """

    _autosave: Autosave
    _diagnosing: Diagnosing
    _changing: Changing

    def __init__(self, schedule: Scheduler, files: Sequence[Path] = (), worker: Worker | None = None,
                 last_words: Callable[[str], Mapping[str, object]] = lambda _: {}) -> None:
        super().__init__(NAME)
        with destroyed_on_failure(self):
            overrides = {name: value.value for name, value in self._parameter_overrides.items()}
            self._build(schedule, files, worker, {**overrides, **last_words(self.get_fully_qualified_name())})

    def _build(self, schedule: Scheduler, files: Sequence[Path], worker: Worker | None,
               overrides: dict[str, object]) -> None:
        self.learner: Learner | None = None
        self._schedule = schedule
        self._awaited = ''
        """What was last said of a change of the model."""
        self.errors = InternalErrors(self.get_logger().error, self._complain)
        self._rejections = Rejections()
        self._live = Parameters(self, overrides, self._accept, self._change)
        settings = located(self._live.settings, files)
        self._outputs = Outputs(self, settings.outputs)
        self._outside = Outside(self, settings.outputs, self._the_learner, lambda: self._outputs.frame_id)

        guarded = partial(schedule, self._guarded, 'the background')
        self._background = ProcessBackground(guarded, first=worker)
        self._robot = Robot(settings, self._begin, partial(self._refuse, DESCRIPTION))
        self._inputs = InputStream(self, settings, self, schedule)
        trajectories = DesiredTrajectory(self, settings.outputs, self._the_learner, lambda: self._outputs.frame_id,
                                         self.message_failed, guarded)
        others = {'checkpoints': lambda: self._autosave.report(), 'diagnosis': lambda: self._diagnosing.report(),
                  'changes': lambda: self._changing.report()}
        self._reports = Reports(self, self._inputs, self._rejections, self.errors, lambda: self.learner,
                                trajectories.feedforward, others, self._outputs.duplicates,
                                self._outside.unseen,
                                ConsistentTopic(self, lambda: self._robot.description, self._background,
                                                self.errors.add),
                                SetupCheck(self._background, self.errors.add))
        self._held_replies = HeldReplies(self, self._announcement)
        lock = FolderLock(folder_of(settings), self.get_fully_qualified_name())
        self._requests = Services(self, self._live, self._the_learner,
                                  lambda: self._robot.description, self._background,
                                  folder_of(settings), lock, guarded, self.errors, self._held_replies.forget)
        self._diagnosing = Diagnosing(self, self._live, self._the_learner, guarded, self.errors)
        self._changing = Changing(self, lambda: self.learner, folder_of(settings), lock, self._reports.say, guarded,
                                  lambda place, error: self._report(error, place))
        self._autosave = Autosave(self, settings, lock,
                                  lambda: None if self.learner is None else self.learner.state(),
                                  guarded, self._reports.say, partial(self._refuse, CHECKPOINTS))
        self._robot.from_parameters()

    def failure(self, service: str, error: Exception) -> str:
        """Our own sentences as they are; anything else is counted as an internal error."""
        return reason(service, error, self.errors)

    @property
    def settings(self) -> Settings:
        """The parameters as they stand."""
        return self._live.settings

    def close(self) -> None:
        """End the background processes, let the last answers arrive, and leave the graph."""
        self._held_replies.settle(False, 'the node ends before the model is there.')
        self._autosave.close()
        self._requests.close()
        self._diagnosing.close()
        self._changing.close()
        self._background.close()
        deadline = time.monotonic() + DELIVER_S
        for publisher in self.publishers:
            publisher.wait_for_all_acked(Duration(seconds=max(deadline - time.monotonic(), 0.0)))
        self.destroy_node()

    # The robot and its learner

    def _begin(self, body: RigidBody) -> None:
        """The robot is known: what was received so far is answered first."""
        learner = Learner(self._live.settings, body, self._background, self, self._newest_checkpoint)
        self._outputs.open(body)
        self._reports.open(self._robot.name, body)
        self.learner = learner
        saved = self._autosave.resume(self._live.settings, body)
        if saved is not None:
            self.learner.restore(saved)
            self._live.write(self.learner.settings)
        self._inputs.open(body.joints)

    def _newest_checkpoint(self) -> SavedState | None:
        """State that replaces a model that broke."""
        return None if self.learner is None else self._autosave.newest(self._live.settings, self.learner.body)

    def _the_learner(self) -> Learner:
        if self.learner is None:
            raise SemiparamError('there is no model yet: the robot description has not come.')
        return self.learner

    # What the inputs tell (InputsListener)

    def sample_completed(self, sample: Sample) -> None:
        """Answer it, and learn it; whatever happens there, the samples after it come here too."""
        try:
            if self.learner is not None:
                self.learner.offer(sample)
        except Exception as error:
            self._report(error, 'a sample')

    def frame_changed(self, frame_id: str) -> None:
        """Answers have the frame of the measured outputs."""
        self._outputs.frame_id = frame_id

    def described(self, urdf: str) -> None:
        """A description on its topic."""
        self._robot.from_topic(urdf)

    def clock_jumped(self) -> None:
        """Half-finished samples are dropped already."""
        self._reports.say('the clock jumped: half-finished samples and horizons are dropped, the model stays.')
        if self.learner is not None:
            self.learner.clear_pending()

    def message_failed(self, topic: str, error: Exception) -> None:
        """A message was refused, or could not be handled."""
        self._report(error, topic, refused=True)

    # What the learner tells (LearnerListener)

    def answered(self, answer: Answer) -> None:
        """Publish it at once; a sample is learnt even where its answer cannot be sent."""
        try:
            self._outputs.publish(answer)
            self._outside.publish(answer)
            self._changing.update()
            self._inputs.stopwatch.stop()
            self._reports.tally.add(answer)
        except Exception as error:
            self._report(error, 'publishing')

    def horizon_completed(self, errors: HorizonErrors) -> None:
        """Publish those of the active model."""
        self._outputs.publish_errors(errors)
        self._reports.tally.errors = errors

    def shadow_horizon_completed(self, variant: str, errors: HorizonErrors) -> None:
        """Publish those of a shadow, on a topic of its own."""
        self._outputs.publish_shadow(variant, errors)

    def announce(self, sentence: str) -> None:
        """News for the log."""
        self._reports.say(sentence)

    def model_switched(self, success: bool, sentence: str) -> None:
        """Replies to parameter changes wait for it."""
        self._reports.say(sentence)
        self._held_replies.settle(success, sentence)

    def settings_reverted(self, settings: Settings) -> None:
        """The parameters show what holds."""
        self._live.write(settings)

    def change_reported(self, record: ChangeRecord) -> None:
        """The robot has changed, or more is known of a change."""
        self._changing.announce(record)

    def failed(self, place: str, error: BaseException) -> None:
        """An internal error; the node goes on."""
        self.errors.add(place, error)

    # Parameters

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set them as every node does, but a refusal names the nearest parameter, success tells what happens now,
        and whatever goes wrong is an answer too."""
        try:
            result = self._set_together(parameter_list)
        except Exception as error:
            return SetParametersResult(successful=False, reason=self.errors.add('the parameters', error))
        if not result.successful:
            result.reason = shortened(result.reason)
            self._rejections.add(PARAMETERS, result.reason)
        return result

    def _set_together(self, parameter_list: list[Parameter]) -> SetParametersResult:
        if not parameter_list:  # rclpy would say that a callback of the node may be at fault
            return SetParametersResult(successful=False, reason='no parameter is given; expected at least one.')
        for parameter in parameter_list:
            if parameter.name not in BY_NAME and not self.has_parameter(parameter.name):
                return SetParametersResult(successful=False, reason=unknown_name(parameter.name))
        sentence = self._live.refusal({item.name: item.value for item in parameter_list})
        if sentence is not None:
            return SetParametersResult(successful=False, reason=sentence)
        self._live.news = ''
        result = super().set_parameters_atomically(parameter_list)
        if result.successful:
            result.reason = self._live.news
        return result

    def _accept(self, settings: Settings) -> str | None:
        """Why a change that the table allows does not fit this robot."""
        if self.learner is None:
            return None
        try:
            self.learner.check(settings)
        except SemiparamError as error:
            return str(error)
        return None

    def _change(self, settings: Settings) -> str:
        if self.learner is None:
            self._schedule(self._guarded, DESCRIPTION, self._robot.retry)
            return ''
        before = self.learner.settings
        if not same_model(before, settings):
            self._held_replies.overtake()
        try:
            sentence = self.learner.change(settings)
        except Exception:
            self.learner.settings = before
            raise
        self._awaited = sentence or self._awaited
        return sentence

    def _announcement(self) -> str:
        """Sentence that the parameters said of a model, while it is being built."""
        if self.learner is None or self.learner.estimating or self.learner.switcher.successor is None:
            return ''
        return self._awaited

    # What is wrong

    def _refuse(self, where: str, sentence: str) -> None:
        self._rejections.add(where, sentence)
        self._reports.say(sentence, LoggingSeverity.ERROR)

    def _guarded(self, place: str, function: Callable[..., object], *arguments: object) -> None:
        """Call a function; nothing that goes wrong there may end the node."""
        try:
            function(*arguments)
        except Exception as error:
            self._report(error, place)

    def _report(self, error: Exception, place: str, refused: bool = False) -> None:
        """Our own sentences into the log as they are, counted where a message is refused; anything else is an internal
        error."""
        if not isinstance(error, SemiparamError):
            self.errors.add(place, error)
            return
        if refused:
            self._rejections.add(place, str(error))
        self._complain(str(error))

    def _complain(self, sentence: str) -> None:
        self.get_logger().error(sentence, throttle_duration_sec=1.0)
