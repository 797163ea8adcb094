"""Quality of service: the overrides file, conversion to rclpy and back, and subscriptions that match."""

import pytest
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSCompatibility,
    ReliabilityPolicy,
    qos_check_compatible,
)

from semiparam_ros.bags.qos import LATCHED, Qos, parse_profiles
from semiparam_ros.errors import SemiparamError
from semiparam_ros.playback.keyboard import split_keys
from semiparam_ros.ros.recorded_qos import from_rclpy, load_overrides, lossless, overridden, subscription_qos, to_rclpy

BEST_EFFORT = Qos(reliability='best_effort')


def test_the_example_of_rosbag2s_documentation_is_read(tmp_path):
    path = tmp_path / 'overrides.yaml'
    path.write_text('/talker:\n  history: keep_all\n/scan:\n  depth: 3\n  reliability: best_effort\n'
                    '  durability: transient_local\n  deadline: {sec: 0, nsec: 10}\n'
                    '  avoid_ros_namespace_conventions: false\n')
    entries = load_overrides(path)
    assert overridden(Qos(), entries['/talker'], '') == Qos(history='keep_all')
    assert overridden(Qos(), entries['/scan'], '') == Qos(depth=3, reliability='best_effort', deadline_ns=10,
                                                         durability='transient_local')


@pytest.mark.parametrize(('text', 'sentence'), [
    ('/t: {reliability: sometimes}', "/t: reliability is 'sometimes', expected reliable or best_effort"),
    ('/t: {depth: 0}', '/t: depth is 0, expected a whole number'),
    ('/t: {depht: 1}', "/t: 'depht' is no QoS policy"),
    ('/t: {deadline: 1.0}', r'/t: deadline is 1\.0, expected \{sec'),
    ('/t: reliable', "/t: expected a mapping of QoS policies, got 'reliable'"),
    ('- a', 'holds no QoS overrides'),
    ('{', 'the QoS overrides .* in line 1: expected'),
])
def test_a_mistake_in_the_overrides_names_file_topic_and_policy(tmp_path, text, sentence):
    path = tmp_path / 'overrides.yaml'
    path.write_text(text)
    with pytest.raises(SemiparamError, match=sentence) as error:
        load_overrides(path)
    assert str(path) in str(error.value)


def test_a_missing_overrides_file_is_one_sentence(tmp_path):
    with pytest.raises(SemiparamError, match='cannot read the QoS overrides'):
        load_overrides(tmp_path / 'none.yaml')


def test_what_rclpy_gets():
    profile = to_rclpy(Qos(history='keep_all', depth=7, durability='transient_local'))
    assert (profile.history, profile.depth) == (HistoryPolicy.KEEP_ALL, 7)
    assert profile.reliability == ReliabilityPolicy.RELIABLE
    assert profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert from_rclpy(to_rclpy(LATCHED)) == Qos(durability='transient_local')
    assert to_rclpy(Qos(depth=0)).depth == 10  # as a recorder writes that did not know it; rclpy warned
    largest = to_rclpy(Qos(depth=2**64 - 1))
    assert largest.get_c_qos_profile() and largest.depth == 2**31 - 1, 'rclpy raised a TypeError'
    assert to_rclpy(*parse_profiles('- liveliness: 2')).liveliness == LivelinessPolicy.AUTOMATIC  # not of rclpy


def test_lossless_is_reliable_and_keeps_everything_but_a_latched_topic_only_its_last():
    assert lossless(BEST_EFFORT) == Qos(history='keep_all')
    assert lossless(LATCHED) == LATCHED


@pytest.mark.parametrize('offers', [[Qos()], [BEST_EFFORT], [Qos(), BEST_EFFORT], [LATCHED], [LATCHED, Qos()], []])
def test_a_subscription_matches_every_publisher(offers):
    wanted = to_rclpy(subscription_qos(offers))
    assert wanted.history == HistoryPolicy.KEEP_ALL
    for offer in offers:
        assert qos_check_compatible(to_rclpy(offer), wanted)[0] == QoSCompatibility.OK
    assert subscription_qos([LATCHED]).latched and subscription_qos([Qos()]).reliability == 'reliable'


def test_keys_that_arrive_together_are_told_apart():
    assert split_keys(b' \x1b[A\x1b[Bq\x1bOC') == [b' ', b'\x1b[A', b'\x1b[B', b'q', b'\x1bOC']
    assert split_keys(b'\x1b') == [b'\x1b']
