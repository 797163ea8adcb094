"""Temperatures on their way from messages and tables to samples: held, never awaited, never from the future."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semiparam_ros.bags import loading
from semiparam_ros.bags import recording_layout as layout
from semiparam_ros.bags.alignment import HELD_FROM_NS, SampleStream
from semiparam_ros.bags.loading import load_samples
from semiparam_ros.bags.reader import open_bag
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.core.signals.differentiation import CausalDifferentiator
from semiparam_ros.core.stamps import stamp_fields
from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_rigid_body
from support.commands import refusal, semiparam
from support.node_helpers import JOINTS, SETTINGS, URDF, motion, write_bag

MS = 1_000_000
STEP, COUNT = 100 * MS, 60


def stream(outputs='effort', temperatures=JOINTS) -> SampleStream:
    return SampleStream(JOINTS, outputs, differentiator=CausalDifferentiator(2, 5.0), temperatures=temperatures)


def states() -> list[tuple[int, str, tuple]]:
    """(time of arrival, what, arguments) of a joint state each 0.1 s."""
    return [(stamp, 'joint_state', (stamp, JOINTS, (0.1, 0.2), (0.0, 0.0), (1.0, 2.0)))
            for stamp in range(0, COUNT * STEP, STEP)]


def fed(messages, outputs='effort', temperatures=JOINTS):
    """Samples of messages in order of arrival."""
    samples = stream(outputs, temperatures)
    done = [sample for _, what, arguments in sorted(messages, key=lambda message: message[0])
            for sample in getattr(samples, what)(*arguments)]
    assert not samples.faults
    return done


STAMPS = st.lists(st.integers(0, COUNT * STEP), max_size=8, unique=True).map(sorted)


@given(st.tuples(STAMPS, STAMPS), st.lists(st.integers(0, HELD_FROM_NS - STEP), min_size=16, max_size=16))
def test_samples_hold_the_newest_temperature_however_the_topics_interleave(stamps, delays):
    """As long as one comes within the second after which it counts; and none counts before."""
    told = [(stamp, joint, 20.0 + 1e-9 * stamp) for joint, those in zip(JOINTS, stamps, strict=True) for stamp in those]
    late = iter(delays)
    arriving = [(stamp + next(late), 'temperature', (stamp, joint, value)) for joint in JOINTS
                for stamp, name, value in told if name == joint]
    in_order = all(one[0] <= other[0] for one, other in pairwise(arriving)
                   if one[2][1] == other[2][1])
    found = fed([*states(), *(arriving if in_order else [(each[2][0], *each[1:]) for each in arriving])])
    assert len(found) == COUNT
    for sample in found:
        for joint, value in zip(JOINTS, sample.temperature, strict=True):
            known = [each for stamp, name, each in told if name == joint and stamp + HELD_FROM_NS <= sample.stamp]
            assert value == known[-1] if known else math.isnan(value)


def test_without_the_parameter_samples_have_none_and_with_it_only_what_it_names():
    heard = [(0, 'temperature', (0, JOINTS[1], 31.0))]
    assert fed(states(), temperatures=())[-1].temperature.shape == (0,)
    samples = fed([*states(), *heard], temperatures=JOINTS[1:])
    assert np.isnan(samples[-1].temperature[0]) and samples[-1].temperature[1] == 31.0
    assert np.isnan(samples[9].temperature).all() and samples[10].temperature[1] == 31.0


def test_a_wrench_has_the_temperature_of_its_sensor():
    samples = stream('wrench', ('ft_board',))
    samples.temperature(0, '/ft_board', 40.0)
    samples.joint_state(2 * HELD_FROM_NS, JOINTS, (0.1, 0.2), (0.0, 0.0))
    sample, = samples.wrench(2 * HELD_FROM_NS, 'ft', (1.0,) * 6)
    assert sample.temperature.tolist() == [40.0]


@pytest.mark.parametrize(('message', 'reason'), [
    ((1, 'a', math.nan), 'not_finite'), ((1, 'a', math.inf), 'not_finite'), ((1, 'a', -1e12), 'out_of_range'),
    ((0, 'a', 20.0), 'duplicate_stamp'), ((-1, 'a', 20.0), 'backward_stamp')])
def test_a_temperature_that_cannot_be_used_is_refused(message, reason):
    samples = stream()
    samples.temperature(0, 'a', 20.0)
    samples.temperature(0, 'b', 20.0)  # each source has stamps of its own
    assert samples.temperature(*message) == [] and samples.faults == {reason: 1}
    assert samples.last_fault.startswith('temperature of a ')
    assert [sample.temperature.tolist() for sample in samples.joint_state(*states()[-1][2])] == [[20.0, 20.0]]


def test_temperatures_of_others_are_ignored():
    samples = stream()
    samples.temperature(0, 'gripper', 20.0)
    assert samples.ignored == 1 and not samples.faults
    assert samples.last_ignored == "temperature at 0.000000000 s is of 'gripper'; expected a, b."


def test_a_jump_of_the_clock_keeps_the_newest():
    samples = stream()
    for stamp, value in ((10**12, 20.0), (10**12 + 1, 21.0)):
        samples.temperature(stamp, 'a', value)
    samples.reset()
    sample, = samples.joint_state(0, JOINTS, (0.1, 0.2), (0.0, 0.0), (1.0, 2.0))
    assert sample.temperature[0] == 21.0 and np.isnan(sample.temperature[1])
    samples.temperature(1, 'a', 22.0)
    assert samples.joint_state(2 * HELD_FROM_NS, *states()[0][2][1:])[0].temperature[0] == 22.0


def test_names_are_checked_against_the_robot():
    with pytest.raises(SemiparamError, match="temperatures holds 'a' twice"):
        Settings.from_mapping({'temperatures': ['a', 'a'], 'outputs': 'effort'})
    with pytest.raises(SemiparamError, match='temperatures holds 2 names; with outputs wrench expected one'):
        Settings.from_mapping({'temperatures': ['a', 'b'], 'sensor_frame': 'ft'})
    with pytest.raises(SemiparamError, match="temperatures names 'c'; expected some of the joints a, b"):
        build_rigid_body(Settings(robot_description=URDF, outputs='effort', temperatures=('a', 'c')))


def warm_bag(path, warmth, every=50):
    """A recording of the small arm with a temperature each second: ``warmth(stamp)``."""
    samples = motion(1500)
    plain = write_bag(path.with_suffix('.plain.mcap'), samples)
    with open_bag(plain) as source, BagWriter(path) as bag:
        told = {sample.stamp for sample in samples[::every]}
        for topic, info in source.topics.items():
            bag.add_topic(topic, info.type, info.qos, info.schema)
        for message in source.messages(decode=False):
            bag.write_raw(message.topic, message.raw, message.log_time)
            if message.topic == layout.WRENCH and message.log_time in told:
                bag.write(layout.TEMPERATURE, layout.TYPES[layout.TEMPERATURE], {
                    'header': {'stamp': stamp_fields(message.log_time), 'frame_id': 'ft'},
                    'temperature': warmth(message.log_time)}, message.log_time)
    return path


WARM = replace(SETTINGS, temperatures=('ft',))


def test_a_bag_gives_them_and_one_without_the_topic_none(tmp_path):
    bag = warm_bag(tmp_path / 'a.mcap', lambda stamp: 20.0 + 1e-9 * stamp)
    found = load_samples(bag, WARM).samples
    seconds = (found.stamps - HELD_FROM_NS) * 1e-9
    known = ~np.isnan(found.temperature[:, 0])
    assert not known[:50].any() and known[50:].all()
    behind = seconds[known] - (found.temperature[known, 0] - 20.0)
    assert (behind >= -1e-9).all() and (behind < 1.0).all()
    plain = load_samples(bag.with_suffix('.plain.mcap'), WARM).samples
    assert plain.temperature.shape == (1500, 1) and np.isnan(plain.temperature).all()
    assert load_samples(bag, SETTINGS).samples.temperature.shape == (1500, 0)


def test_of_a_long_bag_each_stretch_begins_with_the_temperature_from_before_it(tmp_path, monkeypatch):
    """Told once in five seconds, while a stretch takes one."""
    monkeypatch.setattr(loading, 'STRETCHES', 4)
    bag = warm_bag(tmp_path / 'a.mcap', lambda stamp: 20.0 + 1e-9 * stamp, every=250)
    whole, few = (load_samples(bag, WARM, most=most).samples for most in (None, lambda rate: 200))
    assert len(few) < 300
    at = np.searchsorted(whole.stamps, few.stamps)
    np.testing.assert_array_equal(few.temperature, whole.temperature[at])
    assert len(np.unique(few.temperature[~np.isnan(few.temperature)])) >= 3


def test_columns_of_a_table_become_messages_when_they_change(tmp_path, capsys):
    path = tmp_path / 'table.csv'
    values = ['30', '30', 'nan', '31.5', '31.5']
    path.write_text('t,q1,q2,tau1,tau2,warm\n' + ''.join(
        f'{index},0.1,0.2,1.0,2.0,{value}\n' for index, value in enumerate(values)))
    options = ('--joints', 'a,b', '--time', 't', '--position', 'q1,q2', '--effort', 'tau1,tau2')
    bag = tmp_path / 'a.mcap'
    assert semiparam('convert', path, bag, *options, '--temperature', 'warm', '--temperatures', 'b') == 0
    assert 'not finite' not in capsys.readouterr().err
    settings = Settings(joints=JOINTS, outputs='effort', temperatures=('b',))
    found = load_samples(bag, settings).samples
    np.testing.assert_array_equal(found.temperature[:, 1], [math.nan, 30.0, 30.0, 30.0, 31.5])
    assert 'temperature has 1 columns; expected 0, one for each of --temperatures' in refusal(
        capsys, 'convert', path, bag, *options, '--temperature', 'warm')


def test_a_conversion_renames_whose_temperature_it_is_and_stamps_it(tmp_path):
    """Joints alone got new names and stamps, so that no temperature belonged to any of them."""
    source, target = tmp_path / 'a.mcap', tmp_path / 'b.mcap'
    with BagWriter(source) as bag:
        for seconds in (5, 6):
            header = {'stamp': stamp_fields(0), 'frame_id': 'fer_joint1'}
            bag.write(layout.TEMPERATURE, layout.TYPES[layout.TEMPERATURE], {'header': header, 'temperature': 31.0},
                      10**9 * seconds)
            bag.write(layout.JOINT_STATES, layout.TYPES[layout.JOINT_STATES], {'name': ['fer_joint1']}, 10**9 * seconds)
    assert semiparam('convert', source, target, '--joint', 'fer_*=panda_*', '--stamps-from-log') == 0
    with open_bag(target) as bag:
        told = [(message.data.header.stamp.sec, message.data.header.frame_id)
                for message in bag.messages([layout.TEMPERATURE])]
    assert told == [(5, 'panda_joint1'), (6, 'panda_joint1')]
