"""A node says by itself that a sign is wrong, and forgets it with the samples that said so."""

from dataclasses import replace

from diagnostic_msgs.msg import DiagnosticStatus

from support.node_helpers import JOINTS, SETTINGS, motion

SENTENCE = 'set the parameter wrench_convention to'


def test_a_wrong_sign_is_told_before_anybody_asks(start_node):
    """Links of less than no mass were learnt without a word."""
    node, client = start_node(replace(SETTINGS, variant='P', acceleration_source='measured'))
    client.offer('joint_states', 'joint_accelerations', 'wrench')
    samples = motion(2400)

    def two_looks(some):
        """Reports of learning after one look at the samples, and after another one."""
        found, checked = [], 0
        for part in (some[:800], some[800:]):
            client.play(part, JOINTS)
            found.append(client.wait_report('learning', lambda level, message, values, before=checked: before < int(
                values['samples that the set-up was checked with'])))
            checked = int(found[-1][2]['samples that the set-up was checked with'])
        return found

    first, second = two_looks([sample._replace(outputs=-sample.outputs) for sample in samples])
    assert SENTENCE not in first[1], 'one look may err'
    assert second[0] == DiagnosticStatus.WARN and 'The wrench has the opposite sign' in second[1]
    client.wait(lambda: SENTENCE in node.output, 'it is in the log')
    assert client.trigger('reset').success
    client.wait_report('learning', lambda level, message, values: values[
        'samples that the set-up was checked with'] == '0')
    _, second = two_looks([sample._replace(stamp=sample.stamp + 60 * 10**9) for sample in samples])
    assert second[:2] == (DiagnosticStatus.OK, 'learning with P.')
    assert node.output.count(SENTENCE) == 1
