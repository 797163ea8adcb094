"""Flow control without ROS: the window, its answers, silence, and the account at the end."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from semiparam_ros.playback.flow_control import FlowControl, FollowerSilent
from semiparam_ros.playback.player import Item, Player


def stamp_of(raw):
    return int.from_bytes(raw, 'big')


def request(stamp, topic='/wrench'):
    return Item(stamp, topic, stamp.to_bytes(8, 'big'))


def outstanding(flow):
    return flow.requests - flow.answers - len(flow.unanswered_stamps)


class Hands:
    ns = 0

    def __call__(self):
        return self.ns


def flow_control(window=3, timeout_s=5.0, keeps_all=False, is_gone=lambda: False):
    hands = Hands()
    flow = FlowControl('/wrench', window, timeout_s, stamp_of, is_gone, hands)
    flow.fit_queue(0 if keeps_all else None)
    return flow, hands


def test_the_window_holds_requests_back_and_an_answer_opens_it():
    flow, _ = flow_control()
    for stamp in (1, 2, 3):
        assert flow.patience(request(stamp)) == 0.0
        flow.sent(request(stamp))
    assert flow.patience(request(4)) == 1.0
    flow.answered(1)
    assert flow.patience(request(4)) == 0.0
    assert (flow.requests, flow.answers, outstanding(flow)) == (3, 1, 2)


def test_other_topics_pass():
    flow, _ = flow_control(window=1)
    flow.sent(request(1))
    flow.sent(request(2, '/joint_states'))
    assert flow.patience(request(2, '/joint_states')) == 0.0 and flow.requests == 1


def test_silence_ends_the_playback_with_a_sentence_that_counts():
    flow, hands = flow_control()
    for stamp in (1, 2, 3, 4):
        flow.sent(request(stamp))
    flow.answered(1)
    assert flow.patience(request(5)) == 1.0
    hands.ns = int(4.5 * 10**9)
    assert flow.patience(request(5)) == pytest.approx(0.5)
    hands.ns = 5 * 10**9
    with pytest.raises(FollowerSilent, match=r'silent for 5\.0 s while 3 messages on /wrench .* answered 1 of 4'):
        flow.patience(request(5))


def test_a_follower_that_leaves_is_not_waited_for():
    flow, _ = flow_control(window=1, is_gone=lambda: True)
    flow.sent(request(1))
    with pytest.raises(FollowerSilent, match='has left while 1 messages on /wrench'):
        flow.patience(request(2))


def test_a_pause_before_a_request_is_no_silence():
    flow, hands = flow_control(window=1)
    hands.ns = 100 * 10**9
    flow.sent(request(1))
    assert flow.patience(request(2)) == 1.0


def test_a_pause_of_the_bag_is_no_silence_of_the_follower():
    """The last request before a pause is answered after it, by the joint state that completes it."""
    flow, hands = flow_control(window=1)
    flow.sent(request(1))
    hands.ns = 100 * 10**9
    for item in (request(2, '/joint_states'), request(2)):
        assert flow.patience(item) == (item.topic == '/wrench')
        flow.sent(item)
    hands.ns = 104 * 10**9
    assert flow.patience(request(3)) == 1.0
    hands.ns = 109 * 10**9
    with pytest.raises(FollowerSilent, match=r'silent for 109\.0 s'):
        flow.patience(request(3))


def test_requests_after_the_end_of_what_completes_them_are_not_waited_for_long():
    """The last wrenches of a recording have no joint state after them: a playback waited for a minute, and blamed the
    follower alone."""
    hands = Hands()
    flow = FlowControl('/wrench', 3, 60.0, stamp_of, monotonic=hands, beside=['/joint_states', '/never'])
    for item in (request(1, '/joint_states'), request(1), request(2, '/joint_states'), request(2)):
        flow.sent(item)
    hands.ns = 30 * 10**9
    assert flow.drain_patience() == 1.0, 'all that it needs has been played'
    flow.answered(1)
    flow.sent(request(3, '/camera'))
    flow.sent(request(3))
    hands.ns = 39 * 10**9
    assert flow.drain_patience() == pytest.approx(1.0)
    hands.ns = 40 * 10**9
    with pytest.raises(FollowerSilent, match=r'silent for 10\.0 s while 2 messages on /wrench wait for it; it answered '
                                             r'1 of 3\. /joint_states ended before the last of them\.'):
        flow.drain_patience()
    assert flow.patience(request(4)) == 0.0


def test_a_refused_request_is_settled_by_the_next_answer_and_told():
    flow, _ = flow_control()
    for stamp in (1, 2, 3):
        flow.sent(request(stamp))
    flow.answered(3)
    assert (flow.answers, flow.unanswered_stamps, outstanding(flow)) == (1, [1, 2], 0)


def test_a_follower_that_keeps_all_is_sent_more_after_a_silence():
    flow, hands = flow_control(window=1, timeout_s=100.0, keeps_all=True)
    flow.sent(request(1))
    hands.ns = 10**9
    assert flow.patience(request(2)) == pytest.approx(1.0)
    hands.ns = 2 * 10**9
    assert flow.patience(request(2)) == 0.0
    flow.sent(request(2))
    assert flow.patience(request(3)) == pytest.approx(1.0)
    flow.answered(1)
    flow.sent(request(3))
    assert flow.patience(request(4)) == pytest.approx(1.0) and outstanding(flow) == 2


def test_the_window_is_no_larger_than_the_followers_queue():
    flow, _ = flow_control(window=10)
    flow.fit_queue(4)
    assert flow.window == 4
    flow.fit_queue(100)
    assert flow.window == 4


def test_answers_to_nothing_are_counted():
    flow, _ = flow_control()
    flow.sent(request(1))
    flow.answered(9)
    flow.answered(1)
    flow.answered(1)
    assert (flow.answers, flow.unexpected, flow.unanswered_stamps) == (1, 2, [])


def test_answers_without_stamps_settle_the_oldest_request():
    flow, _ = flow_control()
    flow.sent(request(1))
    flow.sent(request(2))
    flow.answered(None)
    assert (flow.answers, outstanding(flow)) == (1, 1)


def test_what_still_waits_at_the_end_is_unanswered():
    flow, _ = flow_control()
    flow.sent(request(1))
    flow.sent(request(2))
    flow.answered(1)
    assert flow.drain_patience() > 0.0
    flow.give_up()
    assert flow.unanswered_stamps == [2] and flow.drain_patience() == 0.0


@given(st.lists(st.integers(1, 5), min_size=1, max_size=60), st.integers(1, 8), st.randoms())
def test_every_request_is_answered_or_told_and_never_more_than_the_window_waits(steps, window, random):
    """Stamps that repeat and jump back, as a looped bag gives them; a follower that refuses some."""
    flow, _ = flow_control(window)
    queue = []
    for stamp in (100 - step for step in steps):
        while flow.patience(request(stamp)) > 0.0:
            # A window of refused requests alone would wait for the timeout: the last one is answered here.
            flow.answered(queue.pop(0) if len(queue) > 1 else queue.pop())
        flow.sent(request(stamp))
        queue.append(stamp)
        assert outstanding(flow) <= window
        if len(queue) > 1 and queue[-1] != queue[-2] and random.random() < 0.3:
            queue.pop(-2)
    while queue:
        flow.answered(queue.pop(0))
    # Where a stamp came twice and the first was refused, the answer to the second cannot be told from one to the first:
    # what lies between them waits until it is given up.
    assert outstanding(flow) == 0 or len(set(steps)) < len(steps)
    flow.give_up()
    assert flow.answers + len(flow.unanswered_stamps) == flow.requests == len(steps)


def test_a_player_publishes_no_faster_than_its_follower_answers():
    flow, _ = flow_control(window=2)
    log = []

    def publish(item):
        log.append(outstanding(flow))
        # The follower answers the oldest request once two wait for it.
        if outstanding(flow) == 2:
            flow.answered(item.time - 1)

    class Timeline:
        start_ns, end_ns = 1, 50

        def play(self, from_ns):
            return (request(stamp) for stamp in range(from_ns, 51))

    Player(Timeline(), publish, rate=None, gate=flow).run()
    assert max(log) == 2 and flow.requests == 50 and flow.answers == 49
