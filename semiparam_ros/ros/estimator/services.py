"""The services of the node; each answers in a sentence, also when it cannot do what it was asked.

Those that take long answer later, while the executor goes on with other callbacks. rclpy's coroutines would do, but the
executor of the node does not await those of services.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import place
from semiparam_ros.errors import SemiparamError, listed
from semiparam_ros.export.files import export_to
from semiparam_ros.online import state_file
from semiparam_ros.online.file_thread import FileThread
from semiparam_ros.online.folder_lock import FolderLock
from semiparam_ros.online.learner import Learner
from semiparam_ros.online.state_file import SavedState
from semiparam_ros.online.worker import Background, Scheduler, Urgency
from semiparam_ros.ros.estimator.consistent import learnt
from semiparam_ros.ros.estimator.diagnostics import InternalErrors
from semiparam_ros.ros.estimator.parameters import Parameters

Result = TypeVar('Result')

DISTURBED = ('The robot is touched or has changed, and the bias holds that now: as it should where the sensor was '
             'zeroed; else tare again when that is over.')


NOT_APPLIED = ('The robot is touched or has changed: links and friction hold that as far as it is learnt. '
               'A load is one of its own with diagnosis.auto: apply, or declared among the effects.')

ENDS = 'the node ends, and waits for this no longer.'


class Reply:
    """Answer that a request waits for: call it once, with the sentence and whether it went well,
    from the same thread."""

    def __init__(self) -> None:
        self._header: object = None
        self._send: Callable[[Trigger.Response, object], None] | None = None
        self._response: Trigger.Response | None = None

    def __call__(self, message: str, success: bool = True) -> None:
        """Answer the request."""
        self._response = Trigger.Response(success=success, message=message)
        self._deliver()

    @property
    def called(self) -> bool:
        """Tell whether there is an answer."""
        return self._response is not None

    def expect(self, header: object, send: Callable[[Trigger.Response, object], None]) -> None:
        """Send the answer there."""
        self._header, self._send = header, send
        self._deliver()

    def _deliver(self) -> None:
        if self._response is not None and self._send is not None:
            self._send(self._response, self._header)
            self._send = None


def create_deferred_trigger(node: Node, name: str, action: Callable[[Reply], None]) -> Callable[[], None]:
    """A std_srvs/Trigger service; ``action`` starts the work and sees to it that the reply is called, or raises.

    Returns what answers those who still wait when the node ends.
    """
    waiting: list[Reply] = []

    def begin(_request: Trigger.Request, _response: Trigger.Response) -> Reply:
        reply = Reply()
        action(reply)
        waiting[:] = [*(each for each in waiting if not each.called), reply]
        return reply

    def end() -> None:
        for reply in waiting:
            if not reply.called:
                reply(ENDS, success=False)

    service = node.create_service(Trigger, name, begin)
    send = service.send_response

    def send_or_wait(reply: Reply | Trigger.Response, header: object) -> None:
        if isinstance(reply, Reply):
            reply.expect(header, send)
        else:
            send(reply, header)

    service.send_response = send_or_wait  # type: ignore[method-assign, assignment]
    return end


def create_trigger(node: Node, name: str, action: Callable[[], str]) -> None:
    """A std_srvs/Trigger service from a function that returns a sentence, or raises."""
    def callback(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message, response.success = action(), True
        node.get_logger().info(f'{name}: {response.message}')
        return response

    node.create_service(Trigger, name, callback)


def reason(name: str, error: Exception, errors: InternalErrors) -> str:
    """Why a service cannot do what it was asked: our own sentences as they are, anything else is an internal error."""
    return str(error) if isinstance(error, SemiparamError) else errors.add(name, error)


def _written(path: Path, left_out: Sequence[Effect], moved: str) -> str:
    """Sentence on a state that is written, with the effects that are not in it, and where the one before is."""
    names = listed([place(effect.kind, effect.where) for effect in left_out])
    without = f' Not in it, as it is not applied yet: {names}; save again then.' if left_out else ''
    return f'{path} is written.{moved and f" The one before: {moved}"}{without}'


class Services:
    """``~/reset``, ``~/pause_learning``, ``~/tare``, ``~/save_state``, ``~/load_state`` and
    ``~/export_model``.

    States are written and read in a thread, and the process beside the node exports: samples are
    answered meanwhile.

    :param learner: gives the learner, or raises SemiparamError before the robot is known.
    :param description: gives the robot description. :param background: the process beside the node.
    :param folder: where states lie. :param lock: the right to write there.
    :param schedule: see :data:`Scheduler`.
    :param errors: counts what goes wrong unexpectedly.
    :param forgotten: called when the models that were being built are built no more.
    """

    def __init__(self, node: Node, parameters: Parameters, learner: Callable[[], Learner],
                 description: Callable[[], str], background: Background, folder: Path,
                 lock: FolderLock, schedule: Scheduler, errors: InternalErrors, forgotten: Callable[[], None]) -> None:
        self._node, self._parameters, self._learner, self._schedule = node, parameters, learner, schedule
        self._description, self._background = description, background
        self._folder, self._lock, self._errors, self._forgotten = folder, lock, errors, forgotten
        self._files, self._closed = FileThread('states'), False
        self._done: deque[Callable[[], None]] = deque()
        """What follows work in the thread for files, in its order."""
        create_trigger(node, '~/reset', self.reset)
        create_trigger(node, '~/tare', self.tare)
        self._ends = [create_deferred_trigger(node, name, action) for name, action in (
            ('~/save_state', self.save_state), ('~/load_state', self.load_state),
            ('~/export_model', self.export_model))]
        node.create_service(SetBool, '~/pause_learning', self._pause)

    def close(self) -> None:
        """Return when every state is written, and everybody who waits is answered."""
        self._closed = True
        self._files.wait()
        while self._done:
            self._go_on()
        for end in self._ends:
            end()

    def reset(self) -> str:
        """Forget everything learnt."""
        learner = self._learner()
        learner.reset()
        self._forgotten()
        if learner.estimator.ready:
            return 'all is forgotten; learning begins anew, with the hyperparameters that were given.'
        return f'all is forgotten; a new initial window of {learner.built.initial_samples} samples of motion begins.'

    def tare(self) -> str:
        """Take the present bias off the measured outputs."""
        learner = self._learner()
        count = learner.take_tare()
        values = np.array2string(learner.tare.bias, precision=4, separator=', ', max_line_width=10_000)
        told = f'the bias is now {values} ({", ".join(learner.body.output_units)}), from {count} samples.'
        return f'{told} {DISTURBED}' if learner.disturbed else told

    def save_state(self, reply: Reply) -> None:
        """Write what is learnt now to ``state_file``."""
        self._lock.take()
        path = self._folder / self._parameters.settings.state_file
        learner = self._learner()
        state = state_file.snapshot(learner.state())
        written = partial(_written, path, learner.changes.applied.unsaved)
        self._aside('~/save_state', partial(state_file.write, path, state), written, reply)

    def load_state(self, reply: Reply) -> None:
        """Go on from what ``state_file`` holds, once it is read, between two samples."""
        settings = self._parameters.settings
        path, learner = self._folder / settings.state_file, self._learner()

        def loaded(saved: SavedState) -> str:
            if self._closed:  # its last checkpoint is written
                raise SemiparamError(ENDS)
            current = self._learner()
            saved = saved.adopted_by(self._parameters.settings)
            current.restore(saved)
            self._parameters.write(current.settings)
            self._forgotten()
            return f'{path} is loaded: {saved.sentence}.'

        self._aside('~/load_state', partial(state_file.load, path, settings, learner.body), loaded, reply)

    def export_model(self, reply: Reply) -> None:
        """Write what is learnt now to files beside the states."""
        self._lock.take()
        learner = self._learner()
        estimate = learnt(learner, self._node.get_fully_qualified_name())
        unknown = learner.disturbed and not learner.changes.applied.acts

        def written(sentence: str) -> str:
            return f'{sentence} {NOT_APPLIED}' if unknown else sentence

        stem = Path(self._parameters.settings.state_file).stem
        self._background.submit(export_to, self._folder, stem, self._description(), estimate,
                                done=partial(self._finish, '~/export_model', reply, written),
                                urgency=Urgency.ASKED)

    def _aside(self, name: str, work: Callable[[], Result], then: Callable[[Result], str], reply: Reply) -> None:
        """Do the work in the thread for files, what follows in the node's own."""
        def done(result: Any, error: Exception | None) -> None:
            self._done.append(partial(self._finish, name, reply, then, result, error))
            self._schedule(self._go_on)

        self._files.submit(work, done)

    def _go_on(self) -> None:
        """The next one, unless the node has ended meanwhile and went on itself."""
        if self._done:
            self._done.popleft()()

    def _finish(self, name: str, reply: Reply, then: Callable[[Result], str], result: Result,
                error: BaseException | None) -> None:
        """Answer with the sentence on a result, or why there is none."""
        try:
            if error is not None:
                raise error
            sentence = then(result)
        except Exception as failure:
            reply(reason(name, failure, self._errors), success=False)
        else:
            self._node.get_logger().info(f'{name}: {sentence}')
            reply(sentence)

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """``data`` true: predict without learning."""
        result = self._node.set_parameters_atomically([self._parameters.ros_parameter('learning', not request.data)])
        response.success = result.successful
        response.message = result.reason or ('learning is paused.' if request.data else 'learning goes on.')
        return response
