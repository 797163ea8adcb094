"""What the node makes of its input messages, without a graph."""

from collections import deque
from dataclasses import replace
from math import inf, nan
from types import SimpleNamespace

import pytest
from rclpy.logging import LoggingSeverity
from rclpy.qos import QoSHistoryPolicy, QoSReliabilityPolicy

from semiparam_ros.bags.readings import Reading
from semiparam_ros.ros.cdr import MOST_BYTES, joint_state_layout
from semiparam_ros.ros.estimator import diagnostics, subscriptions
from semiparam_ros.ros.estimator.diagnostics import OK, InputReport, Rejections
from semiparam_ros.ros.estimator.subscriptions import ACCELERATIONS, JOINT_STATES, InputStream
from semiparam_ros.settings.build import build_rigid_body
from support.node_helpers import JOINTS, SETTINGS, URDF

EFFORTS = replace(SETTINGS, outputs='effort', sensor_frame='', acceleration_source='filter')
PERIOD_NS = 5_000_000


@pytest.fixture(autouse=True)
def nothing_is_silent(monkeypatch):
    """Where this process stands still for a second between a message and the report on it, no topic has gone silent."""
    monkeypatch.setattr(diagnostics, 'SILENCE_S', inf)


class Inputs:
    """An input stream of efforts, and what it told."""

    def __init__(self, settings=EFFORTS, publishers=1, schedule=lambda work: work(), known=True):
        self.samples, self.frames, self.warned, self.jumps = [], [], [], 0
        subscription = SimpleNamespace(get_publisher_count=lambda: publishers)
        self.callbacks, self.failures = {}, []

        def subscribe(_, topic, callback, *__, **___):
            self.callbacks[topic] = callback
            return subscription

        self.stream = InputStream(SimpleNamespace(create_subscription=subscribe), settings, self, schedule)
        if known:
            self.stream.open(JOINTS)
        self.rejections = Rejections()
        self.report = InputReport(self.stream, self.rejections, self.warned.append)

    def sample_completed(self, sample):
        self.samples.append(sample)

    def frame_changed(self, frame_id):
        self.frames.append(frame_id)

    def clock_jumped(self):
        self.jumps += 1

    def message_failed(self, topic, error):
        self.failures.append((topic, str(error)))

    def take(self, stamp, frame_id='arm', names=JOINTS, value=0.1):
        row = [value] * len(names)
        self.stream.turns.add(JOINT_STATES, Reading(stamp, frame_id, (list(names), row, row, row)))


@pytest.mark.parametrize('other', [{'value': nan}, {'names': ('a', 'gripper')}])
def test_a_clock_that_went_back_is_followed_though_some_messages_are_refused(other):
    """One of four that was refused for another reason said that the clock was as before: no sample came any more."""
    inputs = Inputs()
    for start in (10**12, 10**11):
        for number in range(40):
            inputs.take(start + number * PERIOD_NS, **(other if number % 4 == 3 else {}))
    assert inputs.jumps == 1 and len(inputs.samples) == 60
    assert inputs.stream.stream.faults['backward_stamp'] == 0


def test_what_came_before_the_robot_was_known_is_worked_on_in_turns(monkeypatch):
    """All of it was, before anything else: of half a minute at 200 Hz a node answered no call for 12 s."""
    monkeypatch.setattr(subscriptions, 'TURN_S', 0.0)
    calls = deque()
    inputs = Inputs(schedule=calls.append, known=False)
    for number in range(1, 21):
        inputs.take(number * PERIOD_NS)
    while calls:
        calls.popleft()()
    inputs.take(21 * PERIOD_NS)
    inputs.stream.open(JOINTS)
    assert not inputs.samples and len(inputs.stream.turns) == 21
    calls.append(lambda: inputs.samples.append('a call'))
    while calls:
        calls.popleft()()
    assert inputs.samples.index('a call') < 3
    assert [each.stamp for each in inputs.samples if each != 'a call'] == [k * PERIOD_NS for k in range(1, 22)]


def test_messages_are_read_in_turns_too_but_those_that_are_refused_unread(monkeypatch):
    """Trajectories of thousands of points, each read as it came, kept a node from every call for 7 s."""
    monkeypatch.setattr(subscriptions, 'TURN_S', 0.0)
    calls = deque()
    inputs = Inputs(schedule=calls.append)
    layout = joint_state_layout('arm', JOINTS, 2, 2, 2)
    for number in range(1, 5):
        inputs.callbacks[JOINT_STATES](layout.write(number * PERIOD_NS, *[[0.1, 0.1]] * 3))
        inputs.callbacks[JOINT_STATES](b'no message')
    assert not inputs.samples and not inputs.failures and len(inputs.stream.turns) == 8
    inputs.callbacks[JOINT_STATES](bytes(MOST_BYTES + 1))
    assert [sentence for _, sentence in inputs.failures] == [
        f'a JointState of {MOST_BYTES + 1} bytes is too long; expected at most {MOST_BYTES}.']
    calls.append(lambda: inputs.samples.append('a call'))
    while calls:
        calls.popleft()()
    assert inputs.samples.index('a call') < 3
    assert [each.stamp for each in inputs.samples if each != 'a call'] == [k * PERIOD_NS for k in range(1, 5)]
    assert inputs.failures[1:] == 4 * [(JOINT_STATES, 'a message of 10 bytes is no JointState (RMWError).')]


def test_answers_have_the_frame_of_messages_that_were_not_refused():
    inputs = Inputs()
    inputs.take(10**9)
    inputs.take(2 * 10**9, 'another arm', ('a', 'gripper'))
    assert inputs.frames == ['arm']


def test_the_log_says_nothing_of_refusals_that_turned_out_to_be_none():
    """It warned once a second, for ever, of stamps that had gone back with the clock."""
    inputs = Inputs()
    for start in (10**12, 10**11):
        for number in range(10):
            inputs.take(start + number * PERIOD_NS)
        inputs.report.make()
    assert inputs.jumps == 1 and not inputs.warned
    for value in (1, nan, nan):
        inputs.take(2 * 10**12, value=value)
        inputs.report.make()
    assert len(inputs.warned) == 1 and 'not finite' in inputs.warned[0]


def test_a_topic_that_is_asked_anew_as_best_effort_keeps_what_parameters_have_overridden():
    """qos_overrides of its depth were lost."""
    profiles = []

    def create_subscription(kind, topic, receive, profile, **options):
        profiles.append(profile)
        if options.get('qos_overriding_options'):  # as rclpy does
            profile.history, profile.depth = QoSHistoryPolicy.KEEP_LAST, 5
        return SimpleNamespace(qos_profile=profile, get_publisher_count=lambda: 0)
    offer = SimpleNamespace(qos_profile=SimpleNamespace(reliability=QoSReliabilityPolicy.BEST_EFFORT))
    node = SimpleNamespace(create_subscription=create_subscription, destroy_subscription=lambda each: None,
                           resolve_topic_name=str, get_publishers_info_by_topic=lambda name: [offer])
    stream = InputStream(node, EFFORTS, None, None)
    assert stream.follow_reliability() == [JOINT_STATES]
    asked = profiles[-1]
    assert (asked.depth, asked.history, asked.reliability) == (
        5, QoSHistoryPolicy.KEEP_LAST, QoSReliabilityPolicy.BEST_EFFORT)


def test_accelerations_that_come_too_late_are_told():
    """Their rate was shown, and not that nobody used them."""
    inputs = Inputs(replace(EFFORTS, acceleration_source='auto'), publishers=0)
    inputs.take(10**9)
    assert inputs.report.make().message == 'receiving.'
    inputs.stream.turns.add(ACCELERATIONS, Reading(10**9, '', (list(JOINTS), [0.0] * len(JOINTS))))
    assert inputs.report.make().message == (
        'receiving; joint_accelerations came after the first joint state, and are not used.')


def test_a_checkpoint_that_cannot_be_written_is_no_message_that_was_refused():
    inputs = Inputs()
    inputs.take(10**9)
    inputs.rejections.add('checkpoints', 'a.checkpoint.npz was not written: No space left on device.')
    level, message, values = inputs.report.make()
    assert (level, message, values['refused: checkpoints'], values['last refusal']) == (OK, 'receiving.', 1, '')


@pytest.mark.parametrize('kind', ['floating', 'planar', 'fixed'])
def test_a_base_that_is_held_still_is_warned_of_at_start(kind):
    """It was locked at zero without a word."""
    on_it = f'<link name="world"/><joint name="root" type="{kind}"><parent link="world"/><child link="base"/></joint>'
    body = build_rigid_body(replace(SETTINGS, robot_description=URDF.replace('</robot>', f'{on_it}</robot>')))
    said = []
    diagnostics.Reports.open(SimpleNamespace(say=lambda *words: said.append(words)), 'two', body)
    assert said[1:] == ([] if kind == 'fixed' else [
        ('the robot description has joints that are floating or planar, root, which are held at zero, for no joint '
         'state follows them. Where they move, what is predicted and found is wrong.', LoggingSeverity.WARN)])
