"""Messages that come faster than they are answered: everything else has its turn, and what is given up is counted."""

from collections import deque
from dataclasses import replace

from diagnostic_msgs.msg import DiagnosticStatus

from semiparam_ros.ros.estimator import diagnostics, subscriptions
from semiparam_ros.ros.estimator.subscriptions import MessageTurns
from support.node_helpers import JOINTS, SETTINGS, motion
from support.parameter_ends import EVERY_KIND


class Line:
    """What an executor is to call, one after the other."""

    def __init__(self):
        self.calls = deque()

    def later(self, function):
        self.calls.append(function)

    def run(self):
        while self.calls:
            self.calls.popleft()()


def test_what_comes_after_many_messages_waits_for_one_turn_only(monkeypatch):
    monkeypatch.setattr(subscriptions, 'TURN_S', 0.0)
    line, seen = Line(), []
    turns = MessageTurns(line.later, lambda message: seen.append(message.reading), most=10)
    for number in range(4):
        turns.add('states', number)
    line.later(lambda: seen.append('a service'))
    assert len(turns) == 4 and not seen
    line.run()
    assert seen == [0, 'a service', 1, 2, 3] and not len(turns) and turns.late_s == 0.0
    turns.add('states', 4)
    line.run()
    assert seen[-1] == 4 and not turns.lost


def test_the_oldest_of_a_topic_are_lost_to_newer_ones_and_no_other_topic_suffers():
    line, seen = Line(), []
    turns = MessageTurns(line.later, lambda message: seen.append((message.topic, message.reading)), most=3)
    turns.add('wrench', 0)
    for number in range(8):
        turns.add('states', number)
    assert len(turns) == 4 and turns.lost == 5
    line.run()
    assert seen == [('wrench', 0), ('states', 5), ('states', 6), ('states', 7)] and not len(turns)
    for number in range(8, 11):
        turns.add('states', number)
    line.run()
    assert seen[-3:] == [('states', 8), ('states', 9), ('states', 10)] and turns.lost == 5


class InputStream:
    def __init__(self, turns):
        self.turns, self.stopwatch = turns, subscriptions.Stopwatch()


def test_what_is_late_or_lost_is_told_with_its_cause_once(monkeypatch):
    monkeypatch.setattr(diagnostics, 'LATE_S', 0.0)
    line, news = Line(), []
    turns = MessageTurns(line.later, lambda message: None, most=3)
    report = diagnostics.TimingReport(InputStream(turns), news.append)
    assert report.make().message == 'no answer yet.'
    for number in range(3):
        turns.add('states', number)
    late = report.make()
    assert late.level == DiagnosticStatus.WARN and late.values['messages waiting'] == 3
    assert late.message.endswith('s late: messages come faster than they are answered, and 3 wait.')
    turns.add('states', 3)
    lost = report.make()
    assert lost.level == DiagnosticStatus.ERROR and lost.values['messages lost'] == 1
    assert lost.message == '1 messages lost: they come faster than they are answered, and 3 wait already.'
    line.run()
    assert report.make().level == DiagnosticStatus.OK
    assert len(news) == 2 and news[1] == 'answers are in time again.'


def test_a_node_that_cannot_follow_answers_calls_and_goes_back_to_what_it_can(start_node):
    """The largest horizon and every kind of effect: a sample takes longer than publishing the
    next one."""
    settings = replace(SETTINGS, variant='P', acceleration_source='measured', initial_samples=60)
    _, client = start_node(settings)
    client.offer('joint_states', 'joint_accelerations', 'wrench')
    samples = motion(3000)
    rest = client.play_window(samples, JOINTS, 100)
    assert client.set_together(horizon__length=1000, effects=EVERY_KIND).successful
    client.wait_report('learning', lambda level, message, values: message == 'learning with P.')
    client.get('variant')  # a client that is known already
    client.forget()
    for sample in rest:
        client.state(sample, JOINTS)
        client.accelerations(sample, JOINTS)
        client.wrench(sample)
    answer = client.set_together(horizon__length=5, effects=[''])
    answered = len(client.heard['residual'])
    assert answer.successful and answered < len(rest)
    client.wait(lambda: len(client.heard['residual']) == len(rest), 'every sample is answered')
    assert client.stamps('residual') == [sample.stamp for sample in rest]
