"""Samples from topics that arrive in any interleaving: matching, interpolation, refusals."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semiparam_ros.bags.alignment import SampleStream
from semiparam_ros.core.signals.differentiation import CausalDifferentiator
from semiparam_ros.errors import SemiparamError

MS = 1_000_000
JOINTS = ('hip', 'knee')


def stream(**options) -> SampleStream:
    options.setdefault('differentiator', CausalDifferentiator(2, 5.0))
    return SampleStream(JOINTS, **{'sensor_frame': 'sensor', 'tolerance_s': 0.02, **options})


def state(stamp, a=1.0, b=2.0, names=JOINTS):
    return ('joint_state', stamp, names, (a, b), (10 * a, 10 * b), (100 * a, 100 * b))


def wrench(stamp, value=0.0, frame='sensor'):
    return ('wrench', stamp, frame, (value,) * 6)


def acceleration(stamp, a=5.0, b=6.0):
    return ('accelerations', stamp, JOINTS, (a, b))


def feed(samples: SampleStream, *messages):
    return [sample for name, *arguments in messages for sample in getattr(samples, name)(*arguments)]


def same(left, right) -> bool:
    return len(left) == len(right) and all(
        a.stamp == b.stamp and all(np.array_equal(x, y) for x, y in zip(a[1:], b[1:], strict=True))
        for a, b in zip(left, right, strict=True))


def test_equal_stamps_match_without_waiting():
    samples = stream()
    feed(samples, state(0))
    sample, = feed(samples, wrench(0, 3.0))
    assert sample.stamp == 0
    np.testing.assert_array_equal(sample.outputs, np.full(6, 3.0))
    np.testing.assert_array_equal(sample.position, [1.0, 2.0])
    np.testing.assert_array_equal(sample.velocity, [10.0, 20.0])
    assert sample.acceleration.shape == (2,)
    late, = feed(samples, wrench(MS), state(MS))
    assert late.stamp == MS


def test_efforts_of_joints_that_are_inputs_only_need_be_no_numbers():
    samples = stream(outputs='effort', output_joints=['knee'])
    one, = samples.joint_state(0, ('knee', 'hip'), (1.0, 2.0), (0.1, 0.2), (7.0, math.nan))
    assert one.outputs.tolist() == [7.0] and one.position.tolist() == [2.0, 1.0]
    assert samples.joint_state(MS, JOINTS, (1.0, 2.0), (0.1, 0.2), (7.0, math.nan)) == []
    assert samples.faults == {'not_finite': 1}


def test_a_wrench_between_joint_states_gets_the_interpolated_one():
    samples = stream()
    assert feed(samples, state(0, 0.0, 1.0), wrench(3 * MS)) == []
    sample, = feed(samples, state(10 * MS, 10.0, 2.0))
    np.testing.assert_allclose(sample.position, [3.0, 1.3], rtol=1e-14)
    np.testing.assert_allclose(sample.velocity, [30.0, 13.0], rtol=1e-14)


def test_several_wrenches_between_two_joint_states_come_in_order():
    samples = stream()
    feed(samples, state(0), *(wrench(stamp * MS) for stamp in range(1, 10)))
    assert [sample.stamp // MS for sample in feed(samples, state(10 * MS))] == list(range(1, 10))


@pytest.mark.parametrize(('gap_ms', 'matched'), [(40, 1), (41, 0)])
def test_a_gap_beyond_twice_the_tolerance_is_not_bridged(gap_ms, matched):
    samples = stream(tolerance_s=0.02)
    done = feed(samples, state(0), wrench(MS), state(gap_ms * MS))
    assert len(done) == matched
    assert samples.faults == ({} if matched else {'unmatched': 1})


def test_a_wrench_before_the_first_joint_state_is_unmatched():
    samples = stream()
    assert feed(samples, wrench(0), state(MS), wrench(MS))[0].stamp == MS
    assert samples.faults == {'unmatched': 1}
    assert samples.last_fault == 'output at 0.000000000 s has no joint state within the tolerance.'


def test_accelerations_come_from_the_filter_on_the_joint_states_alone():
    samples, reference = stream(), CausalDifferentiator(2, 5.0)
    for step in range(50):
        expected = reference.update(step * MS, np.array([0.0, 10.0 * step]))
        # Wrenches come at a third of the rate: the filter must see the joint states between them all the same.
        done = feed(samples, state(step * MS, 0.0, float(step)), *([wrench(step * MS)] if step % 3 == 0 else []))
        if done:
            np.testing.assert_array_equal(done[0].acceleration, expected)


def moving(stamp, outputs, velocity=True):
    """A joint state of a smooth motion, its velocities left empty on request, with the rates in the joints' order."""
    time = stamp * 1e-9
    position, rate = (np.sin(time), time), (np.cos(time), 1.0)
    return ('joint_state', stamp, JOINTS, position, rate if velocity else (), (1.0, 2.0) if outputs == 'effort' else ())


@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_velocities_that_a_message_leaves_empty_come_from_the_positions(outputs):
    samples = stream(outputs=outputs, velocity_filter=CausalDifferentiator(2, 5.0))
    done = []
    for stamp in range(0, 1000 * MS, 5 * MS):
        done += feed(samples, moving(stamp, outputs, velocity=False), *([wrench(stamp)] if outputs == 'wrench' else []))
    assert len(done) == 200 and not samples.faults
    for sample in done[100:]:
        np.testing.assert_allclose(sample.velocity, [np.cos(sample.stamp * 1e-9), 1.0], atol=5e-3)
        np.testing.assert_allclose(sample.acceleration, [-np.sin(sample.stamp * 1e-9), 0.0], atol=2e-2)
    assert outputs == 'wrench' or done[-1].outputs.tolist() == [1.0, 2.0]


def test_a_motion_that_begins_without_velocities_has_no_acceleration_from_standstill():
    """The first velocity after a start or a gap, which nobody knows, was zero: 1 rad/s at 1 kHz became 1000 rad/s^2."""
    samples, done = stream(outputs='effort', velocity_filter=CausalDifferentiator(2, 5.0)), []
    for step in [*range(100), *range(600, 700)]:
        done += feed(samples, moving(step * MS, 'effort', velocity=False))
    errors = [sample.acceleration - [-np.sin(sample.stamp * 1e-9), 0.0] for sample in done]
    assert len(done) == 200 and np.abs(errors).max() < 1.0


@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_a_joint_that_turns_without_end_may_come_within_one_turn(outputs):
    """Where positions went from pi to -pi, a velocity was 600 rad/s, and a position between two half a turn off."""
    found = []
    for wrapped in (False, True):
        samples, done = stream(outputs=outputs, velocity_filter=CausalDifferentiator(2, 5.0, angles=True)), []
        for stamp in range(0, 3000 * MS, 10 * MS):
            turned = 2.0 + 3e-9 * stamp
            position = (np.angle(np.exp(1j * turned)) if wrapped else turned, 0.1)
            done += feed(samples, ('joint_state', stamp, JOINTS, position, (), (1.0, 2.0)[:2 * (outputs == 'effort')]))
            done += feed(samples, *([wrench(stamp + 5 * MS)] if outputs == 'wrench' else []))
        found.append(done[20:])
    for plain, sample in zip(*found, strict=True):
        assert abs(plain.velocity[0] - 3.0) < 1e-6
        np.testing.assert_allclose(sample.velocity, plain.velocity, atol=1e-9)
        np.testing.assert_allclose(np.exp(1j * sample.position), np.exp(1j * plain.position), atol=1e-9)


def test_a_refused_message_leaves_the_velocity_filter_as_it_was():
    bad = ('joint_state', 20 * MS, JOINTS, (math.nan, 1.0), (), ())
    samples, spared = (stream(velocity_filter=CausalDifferentiator(2, 5.0)) for _ in range(2))
    for each in (samples, spared):
        feed(each, *(moving(step * MS, 'wrench', velocity=False) for step in (0, 5, 10)))
    feed(samples, bad, moving(5 * MS, 'wrench', velocity=False))
    after = [moving(15 * MS, 'wrench', velocity=False), wrench(15 * MS)]
    assert same(feed(samples, *after), feed(spared, *after))
    assert samples.faults == {'not_finite': 1, 'backward_stamp': 1}


def test_a_message_without_velocities_among_others_with_them_is_refused():
    samples = stream(velocity_filter=CausalDifferentiator(2, 5.0))
    feed(samples, moving(0, 'wrench'), moving(5 * MS, 'wrench', velocity=False))
    assert samples.last_fault == (
        'velocity at 0.005000000 s has 0 values for 2 joints, but messages before it held velocities; from the 4th in '
        'a row on they are estimated from the positions.')
    samples.reset()
    feed(samples, moving(0, 'wrench', velocity=False))
    assert samples.faults == {'wrong_length': 2}


@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_a_driver_that_leaves_velocities_empty_from_some_time_on_is_followed_and_one_that_returns(outputs):
    """It was refused until the node was started again."""
    samples, done, other = stream(outputs=outputs, velocity_filter=CausalDifferentiator(2, 5.0)), [], ['gripper']
    for step in range(300):
        stamp = 5 * MS * step
        feed(samples, ('joint_state', stamp + 1, other, [0.0], [], []))
        done += feed(samples, moving(stamp, outputs, velocity=not 100 <= step < 200),
                     *([wrench(stamp)] if outputs == 'wrench' else []))
    assert samples.faults['wrong_length'] == 3 and samples.velocities_measured
    assert samples.faults['unmatched'] == 0 and len(done) == (300 if outputs == 'wrench' else 297)
    for sample in done[5:]:
        np.testing.assert_allclose(sample.velocity, [np.cos(sample.stamp * 1e-9), 1.0], atol=5e-3)
        np.testing.assert_allclose(sample.acceleration, [-np.sin(sample.stamp * 1e-9), 0.0], atol=0.2)


def test_another_publisher_without_velocities_is_refused_for_good():
    samples = stream(outputs='effort', velocity_filter=CausalDifferentiator(2, 5.0))
    spared = stream(outputs='effort', velocity_filter=CausalDifferentiator(2, 5.0))
    for step in range(100):
        good = moving(5 * MS * step, 'effort')
        assert same(feed(samples, good), feed(spared, good))
        feed(samples, ('joint_state', 5 * MS * step + 1, JOINTS, (0.0, 0.0), (), (0.0, 0.0)))
    assert samples.faults == {'wrong_length': 100}


def test_some_velocities_are_not_taken_for_none():
    samples = stream(velocity_filter=CausalDifferentiator(2, 5.0))
    assert feed(samples, ('joint_state', 0, JOINTS, (1.0, 2.0), (1.0,), ())) == []
    assert samples.last_fault == 'velocity at 0.000000000 s has 1 values for 2 joints.'


def test_measured_accelerations_are_matched_like_joint_states():
    samples = stream(measured_accelerations=True, differentiator=None)
    assert feed(samples, state(0), acceleration(0, 0.0), wrench(0))[0].acceleration.tolist() == [0.0, 6.0]
    assert feed(samples, state(4 * MS), wrench(4 * MS)) == []
    sample, = feed(samples, acceleration(8 * MS, 8.0))
    np.testing.assert_allclose(sample.acceleration, [4.0, 6.0], rtol=1e-14)


def test_efforts_come_from_the_joint_state_alone():
    sample, = feed(stream(outputs='effort'), state(0, 1.0, 2.0, names=JOINTS))
    np.testing.assert_array_equal(sample.outputs, [100.0, 200.0])


def test_efforts_wait_for_measured_accelerations():
    samples = stream(outputs='effort', measured_accelerations=True)
    assert feed(samples, acceleration(0), state(MS)) == []
    sample, = feed(samples, acceleration(2 * MS, 7.0))
    np.testing.assert_allclose(sample.acceleration, [6.0, 6.0])


def test_joints_in_another_order_and_further_joints_are_sorted_by_name():
    samples = stream(outputs='effort')
    names = ['gripper', 'knee', 'hip']
    sample, = samples.joint_state(0, names, [9.0, 2.0, 1.0], [9.0, 4.0, 3.0], [9.0, 6.0, 5.0])
    assert sample.position.tolist() == [1.0, 2.0] and sample.outputs.tolist() == [5.0, 6.0]
    names.reverse()  # the same list object with other contents must not be taken for the old one
    sample, = samples.joint_state(1, names, [1.0, 2.0, 9.0], [3.0, 4.0, 9.0], [5.0, 6.0, 9.0])
    assert sample.position.tolist() == [1.0, 2.0]


GOOD = [state(0), wrench(0), state(MS, 1.5), wrench(MS, 1.0), state(2 * MS, 1.7), wrench(2 * MS, 2.0)]
BAD = {
    'not_finite': ('joint_state', 2 * MS, JOINTS, (math.nan, 0.0), (0.0, 0.0)),
    'not_finite of a wrench': ('wrench', 2 * MS, 'sensor', (0.0, math.inf, 0.0, 0.0, 0.0, 0.0)),
    'out_of_range': ('joint_state', 2 * MS, JOINTS, (0.0, 0.0), (0.0, -1e160)),
    'out_of_range of a wrench': ('wrench', 2 * MS, 'sensor', (0.0, 1e300, 0.0, 0.0, 0.0, 0.0)),
    'not_finite of opposite infinities': ('wrench', 2 * MS, 'sensor', (math.inf, -math.inf, 0.0, 0.0, 0.0, 0.0)),
    'out_of_range of a stamp': state(2**31 * 10**9, 7.0),
    'missing_joint': ('joint_state', 2 * MS, ('hip', 'ankle'), (0.0, 0.0), (0.0, 0.0)),
    'missing_joint named twice': ('joint_state', 2 * MS, ('hip', 'knee', 'hip'), (0.0,) * 3, (0.0,) * 3),
    'missing_joint of an empty message': ('joint_state', 2 * MS, (), (), ()),
    'wrong_length': ('joint_state', 2 * MS, JOINTS, (0.0, 0.0), ()),
    'wrong_length of a wrench': ('wrench', 2 * MS, 'sensor', (0.0,) * 5),
    'duplicate_stamp': state(MS, 7.0),
    'duplicate_stamp of a wrench': wrench(MS, 7.0),
    'backward_stamp': state(0, 7.0),
    'backward_stamp of a wrench': wrench(0, 7.0),
    'wrong_frame': wrench(2 * MS, 7.0, frame='elsewhere'),
}


@pytest.mark.parametrize('case', BAD)
def test_a_bad_message_is_refused_in_one_sentence_and_changes_nothing_else(case):
    clean, disturbed = stream(), stream()
    expected = feed(clean, *GOOD)
    got = feed(disturbed, *GOOD[:4], BAD[case], *GOOD[4:])
    assert same(got, expected)
    assert disturbed.faults == {case.split()[0]: 1}
    assert disturbed.last_fault.endswith('.') and disturbed.last_fault.count('. ') == 0
    assert clean.faults == {} and clean.last_fault == ''


def test_sentences_name_what_and_where():
    samples = stream()
    feed(samples, BAD['missing_joint'])
    assert samples.last_fault == "joint state at 0.002000000 s must name joint 'knee' once; it names hip, ankle."
    feed(samples, BAD['wrong_frame'])
    assert samples.last_fault == "wrench at 0.002000000 s is in frame 'elsewhere'; expected 'sensor'."


def test_joints_that_come_in_several_messages_are_said_to():
    samples = stream()
    for names in (['hip', 'ankle'], ['knee']):
        samples.joint_state(2_000_000, names, [0.0] * len(names), [0.0] * len(names))
    assert samples.apart
    assert samples.last_fault.endswith('it names knee; others name the rest: publish all in one message.')


def test_any_frame_is_taken_when_none_is_named():
    assert feed(stream(sensor_frame=''), state(0), wrench(0, frame='elsewhere'))


def test_a_reset_admits_earlier_stamps_and_drops_what_waits():
    samples = stream()
    feed(samples, state(50 * MS), wrench(55 * MS))
    samples.reset()
    assert samples.pending == 0
    assert same(feed(samples, *GOOD), feed(stream(), *GOOD))


def test_a_silent_topic_does_not_fill_the_memory():
    samples = stream(capacity=10)
    feed(samples, *(state(step * MS) for step in range(25)))
    assert samples.faults == {'overflow': 15}
    samples = stream(capacity=10)
    feed(samples, *(wrench(step * MS) for step in range(25)))
    assert samples.faults == {'overflow': 15} and samples.pending == 10


def test_nonsense_options_are_refused():
    with pytest.raises(SemiparamError, match="outputs is 'torque'; expected 'wrench' or 'effort'"):
        stream(outputs='torque')
    with pytest.raises(SemiparamError, match='neither measured'):
        stream(differentiator=None)


def shuffled(draw, topics):
    """The messages of all topics in a random interleaving that keeps each topic's own order."""
    order = draw(st.permutations([number for number, topic in enumerate(topics) for _ in topic]))
    sources = [iter(topic) for topic in topics]
    return [next(sources[number]) for number in order]


@st.composite
def two_interleavings(draw):
    """Three topics of different rates with gaps, repeated and backward stamps, NaN, in two interleavings."""
    number = st.sampled_from([*np.linspace(-3.0, 3.0, 30), math.nan])
    steps = st.lists(st.sampled_from([1, 2, 1, 3, 2, 1, 0, -3, 30]), min_size=6, max_size=16)

    def stamps():
        return (np.cumsum(draw(steps)) * MS).tolist()

    topics = [[state(stamp, draw(number), draw(number)) for stamp in stamps()],
              [wrench(stamp, draw(number)) for stamp in stamps()],
              [acceleration(stamp, draw(number)) for stamp in stamps()]]
    return shuffled(draw, topics), shuffled(draw, topics)


@settings(max_examples=300)
@given(two_interleavings(), st.booleans(), st.sampled_from(['wrench', 'effort']))
def test_samples_do_not_depend_on_how_the_topics_interleave(orders, measured, outputs):
    left, right = (stream(measured_accelerations=measured, outputs=outputs, tolerance_s=0.003) for _ in range(2))
    assert same(feed(left, *orders[0]), feed(right, *orders[1]))
    assert left.faults == right.faults
    assert left.pending == right.pending


def test_messages_of_other_joints_are_ignored_and_counted_apart():
    """A gripper publishes its own joint states on the same topic."""
    clean, disturbed = stream(), stream()
    expected = feed(clean, *GOOD)
    gripper = ('joint_state', 2 * MS, ('left_finger', 'right_finger'), (0.0, 0.0), (0.0, 0.0))
    assert same(feed(disturbed, *GOOD[:4], gripper, *GOOD[4:]), expected)
    assert disturbed.faults == {} and disturbed.last_fault == ''
    assert disturbed.ignored == 1 and clean.ignored == 0
    assert disturbed.last_ignored == ('joint state at 0.002000000 s names left_finger, right_finger; expected '
                                       f'{", ".join(disturbed.joints)}.')


def test_a_sentence_stays_readable_whatever_a_stranger_sent():
    samples = stream()
    names = [samples.joints[0], *(f'joint_{index}' * 1000 for index in range(10_000))]
    feed(samples, ('joint_state', 2 * MS, names, (0.0,), (0.0,)))
    assert len(samples.last_fault) < 700 and '9993 more' in samples.last_fault and samples.last_fault.endswith('.')
    feed(samples, wrench(2 * MS, 7.0, frame='elsewhere' * 10_000))
    assert len(samples.last_fault) < 700 and samples.last_fault.endswith("expected 'sensor'.")


def test_of_several_publishers_one_that_tells_of_another_place_is_refused():
    """Seconds of a stranger's zeros were learnt, and spoilt what changes were named for a minute."""
    samples, spared = (stream(outputs='effort') for _ in range(2))
    samples.shared = True
    for step in range(100, 200):
        good = moving(10 * MS * step, 'effort')
        assert same(feed(samples, good), feed(spared, good))
        for position in ((0.0, 0.0), (good[3][0] + 2 * math.pi, 0.0)):
            assert not feed(samples, ('joint_state', good[1] + 5 * MS, JOINTS, position, (0.0, 0.0), (0.0, 0.0)))
    assert samples.faults == {'elsewhere': 200}
    assert samples.last_fault == (
        "joint state at 1.995000000 s has 'knee' 1.99 rad or m from where it was 0.005 s before: several publish joint "
        'states, and this one is of another robot.')
    turned = good[3][0] - 2 * math.pi, good[3][1] + 0.01
    assert feed(samples, ('joint_state', good[1] + 10 * MS, JOINTS, turned, (0.0, 0.0), (0.0, 0.0)))
    feed(samples, ('joint_state', good[1] + 15 * MS, JOINTS, (0.0, math.inf), (0.0, 0.0), (0.0, 0.0)))
    feed(samples, ('joint_state', good[1] + 15 * MS, JOINTS, (0.0, 1e160), (0.0, 0.0), (0.0, 0.0)))
    assert samples.faults == {'elsewhere': 200, 'not_finite': 1, 'out_of_range': 1}
    assert len(feed(samples, ('joint_state', good[1] + 200 * MS, JOINTS, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)))) == 1


@pytest.mark.parametrize(('shared', 'told'), [(None, True), (False, False)])
def test_positions_tell_of_several_publishers_where_nobody_counts_them(shared, told):
    samples = stream(outputs='effort')
    samples.shared = shared
    for step in range(10):
        for late, position in ((0, (1.0, 1.0)), (5, (0.0, 0.0))):
            stamp = (10 * step + 10 + late) * MS
            feed(samples, ('joint_state', stamp, JOINTS, position, (0.0, 0.0), (0.0, 0.0)))
    assert samples.whereabouts.alternate == told and not samples.faults
