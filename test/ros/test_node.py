"""The live node in a process of its own, over real DDS on this machine."""

import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import SetParameters
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from semiparam_ros.bags.loading import load_samples
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.online import desired_state as feedforward
from semiparam_ros.settings import dump_params
from semiparam_ros.settings.build import build_estimator
from semiparam_ros.settings.parameter_table import PARAMETERS
from support.node_client import BEST_EFFORT, Client, NodeProcess, messages
from support.node_helpers import BODY, JOINTS, PERIOD_NS, SETTINGS, URDF, faster, motion, write_bag
from support.replay_peers import Tool

LIVE = replace(SETTINGS, acceleration_source='measured')
pytestmark = pytest.mark.usefixtures('module_domain')


@pytest.fixture(scope='module')
def node(tmp_path_factory):
    """One node for all tests that do not need their own; each begins with a reset."""
    folder = tmp_path_factory.mktemp('node')
    dump_params(replace(LIVE, state_file='state.npz', state_folder=str(folder / 'states')), folder / 'p.yaml')
    with NodeProcess(folder, folder / 'p.yaml') as process:
        yield process
        assert process.stop() == 0
    assert 'Traceback' not in process.output and 'internal error' not in process.output


@pytest.fixture(scope='module')
def connected(node):
    with Client() as client:
        client.connect()
        client.offer('joint_states', 'joint_accelerations', 'wrench')
        yield client


@pytest.fixture
def client(connected):
    """The client, with a node that has learnt nothing and its parameters as at the start."""
    results = connected.set(learning=True, variant=LIVE.variant, gate__enabled=False, horizon__length=5,
                            gate__hold=0.2, gate__false_alarms_per_hour=2.0)
    assert all(result.successful for result in results)
    assert connected.trigger('reset').success
    connected.forget()
    return connected


class Clock:
    """Stamps that go on from test to test, for the node refuses what lies in the past."""

    now = 10**9


def fresh(count, seed=0):
    """Samples later than all before."""
    samples = motion(count, seed)
    shift = Clock.now - samples[0].stamp
    Clock.now += count * 20_000_000 + 10**9
    return [sample._replace(stamp=sample.stamp + shift) for sample in samples]


def a_life():
    """Samples of a robot that rests, moves slowly, then fast, and is pushed; a time in its fast motion [s]."""
    moving = motion(1500)
    rest = [sample._replace(position=moving[0].position, velocity=np.zeros(2), acceleration=np.zeros(2))
            for sample in moving[:150]]
    samples = [*rest, *faster(moving[150:500], 0.15), *moving[500:]]
    for push in (slice(400, 420), slice(1300, 1320)):
        samples[push] = [sample._replace(outputs=sample.outputs + 20.0) for sample in samples[push]]
    return samples, 800.1 * PERIOD_NS * 1e-9


@pytest.mark.parametrize('bag_options', [
    pytest.param({}, marks=pytest.mark.long, id='measured accelerations'),
    pytest.param({'measured': False, 'wrench_late_ns': 4_000_000}, id='filtered, interpolated')])
def test_a_bag_through_the_node_equals_the_offline_estimator(tmp_path, bag_options):
    """Every sample answered, in order, to the last bit, with the robot's description from the bag."""
    settings = replace(SETTINGS, robot_description='', gate_enabled=True)
    samples, fast_s = a_life()
    bag = write_bag(tmp_path / 'a.mcap', samples, **bag_options)
    dump_params(settings, tmp_path / 'p.yaml')
    with NodeProcess(tmp_path, tmp_path / 'p.yaml'), Client() as client:
        client.connect()
        client.listen(JointState, 'answer')
        for part in ('--until', '--start-offset'):  # hyperparameters are estimated anew meanwhile
            with Tool(tmp_path, 'replay', bag, '--as-fast-as-followed', '--quiet', part, fast_s) as played:
                assert played.wait() == 0, played.output
            takeovers = client.take_over()
        loaded = load_samples(bag, settings)
        learner = OfflineLearner(settings, [loaded], lambda: None, takeovers)
        predictions = [learner.step(sample, True) for sample in loaded.samples]
        assert learner.learner.renewals and learner.learner.gate.refused > 20
        horizons = [each.horizon for each in predictions if each.horizon is not None]
        client.wait(lambda: len(client.heard['horizon_error']) >= len(horizons), 'the last horizon')
        for topic, wanted in (('predicted_wrench', [each.mean for each in predictions]),
                              ('predicted_wrench_std', [each.std for each in predictions]),
                              ('residual', [each.sample.outputs - each.mean for each in predictions])):
            assert client.stamps(topic) == [each.sample.stamp for each in predictions]
            np.testing.assert_array_equal(client.values(topic), wanted)
            assert {message.header.frame_id for message in client.heard[topic]} == {'ft'}
        parts = [client.values(topic) for topic in ('predicted_wrench', 'predicted_wrench_std', 'residual')]
        assert client.stamps('answer') == client.stamps('residual')
        np.testing.assert_array_equal(np.array(client.values('answer'))[:, :18], np.hstack(parts))
        assert client.heard['answer'][-1].name[5:7] == ['tz_predicted', 'fx_std']
        assert client.heard['answer'][-1].name[-1] == 'tz_contact_level' and max(client.values('answer')[-1][18:]) > 0.0
        assert client.stamps('horizon_error') == [errors.origin for errors in horizons]
        last, errors = client.heard['horizon_error'][-1], horizons[-1]
        assert list(last.name) == ['fx', 'fy', 'fz', 'tx', 'ty', 'tz', 'eps_F', 'eps_T', 'fx_centred', 'fy_centred',
                                   'fz_centred', 'tx_centred', 'ty_centred', 'tz_centred', 'eps_F_centred',
                                   'eps_T_centred']
        np.testing.assert_allclose(last.position, [
            *errors.eps, errors.eps[:3].mean(), errors.eps[3:].mean(), *errors.eps_centred,
            errors.eps_centred[:3].mean(), errors.eps_centred[3:].mean()], rtol=1e-6)


def test_every_parameter_of_the_table_is_declared(client):
    values = dict(zip([row.name for row in PARAMETERS], client.get(*[row.name for row in PARAMETERS]), strict=True))
    assert values['variant'].string_value == 'SPK-ML'
    assert values['effects'].type == ParameterType.PARAMETER_STRING_ARRAY
    assert values['hyperparameters.tau'].type == ParameterType.PARAMETER_DOUBLE_ARRAY
    for row, found in zip(PARAMETERS, client.describe(*[row.name for row in PARAMETERS]), strict=True):
        assert found.description == row.description and found.read_only == (not row.live)


def test_a_number_of_features_chosen_by_itself_and_samples_passed_over_are_told(ros_domain, tmp_path):
    settings = replace(LIVE, features_count='auto', learn_every=3)
    dump_params(settings, tmp_path / 'p.yaml')
    samples, estimator = motion(160), build_estimator(settings)
    for sample in samples:
        estimator.step(sample)
    with NodeProcess(tmp_path, tmp_path / 'p.yaml') as node, Client() as client:
        client.connect()
        client.offer('joint_states', 'joint_accelerations', 'wrench')
        client.play(client.play_window(samples, JOINTS, settings.initial_samples), JOINTS)
        _, _, values = client.wait_report('learning', lambda level, message, values: message == 'learning with SPK-ML.'
                                          and values['samples answered'] == '160')
        assert client.get('features.count')[0].string_value == 'auto'
        assert values['random features'] == str(estimator.features_count)
        assert values['samples passed over'] == str(estimator.passed_over)
        assert values['samples learnt'] == str(160 - estimator.passed_over) and values['samples not learnt'] == '0'
        code = node.stop()
    assert code == 0 and 50 <= estimator.features_count <= 500 and estimator.passed_over > 50


def test_refused_values_leave_everything_as_it_was_and_say_why(client):
    def refusal(**values):
        results = client.set(**values)
        assert not any(result.successful for result in results)
        assert not client.set_together(**values, learning=False).successful
        assert client.get('learning')[0].bool_value is True
        return results[0].reason

    assert refusal(variant='SPK') == ("variant is 'SPK'; expected one of P, NP-ML, SP-ML, SP2-ML, SPK-ML, NP-VS, "
                                      'SP2-VS, auto.')
    assert refusal(forgetting=2.0) == 'forgetting is 2.0; expected 0.5 to 1, or auto.'
    assert refusal(forgetting='fast') == "forgetting is 'fast'; expected a number, 0.5 to 1, or auto."
    assert refusal(forgetting=float('nan')).startswith('forgetting is nan')
    assert refusal(horizon__length='25') == "horizon.length is '25'; expected an integer, 1 to 1000."
    assert refusal(features__count=100) == 'features.count cannot change while the node runs; start it again with ' \
                                           'the new value.'
    assert "nearest is 'variant'" in refusal(varaint='P')
    assert "shadow_variants holds 'P' twice" in refusal(shadow_variants=['P', 'P'])
    assert 'names no known kind' in refusal(effects=['paylod'])
    assert 'nowhere' in refusal(effects=['external_force@nowhere'])
    assert client.get('variant')[0].string_value == 'SPK-ML'
    nothing = client.set_together()
    assert not nothing.successful and nothing.reason == 'no parameter is given; expected at least one.'
    assert client.set_together(gate__hold=0.5, gate__timeout=1.0).successful
    assert client.set_together(gate__hold=1, gate__timeout=5).successful, 'an integer does for a double'
    assert client.get('gate.hold')[0].double_value == 1.0
    assert client.set(effects=[])[0].successful, 'an empty list of no type'


def test_pause_tare_save_and_load(client):
    samples = fresh(300)
    assert 'no prediction of the last second' in client.trigger('tare').message
    client.play(samples[:150], JOINTS)
    client.wait_report('learning', lambda level, message, values: values['samples learnt'].isdigit()
                       and message == 'learning with SPK-ML.')
    assert client.pause(True).success
    client.play(samples[150:160], JOINTS)
    assert client.report('learning')[1] and client.get('learning')[0].bool_value is False
    assert client.pause(False).success
    saved = client.trigger('save_state')
    assert saved.success and saved.message.endswith('state.npz is written.')
    exported = client.trigger('export_model')
    assert exported.success and 'state.urdf and state.json are written, from the model of' in exported.message, \
        exported.message
    client.play(samples[160:200], JOINTS)
    first = client.values('predicted_wrench')[-40:]
    assert client.trigger('reset').success
    loaded = client.trigger('load_state')
    assert loaded.success, loaded.message
    later = [sample._replace(stamp=sample.stamp + 10**11) for sample in samples[160:200]]
    Clock.now += 2 * 10**11
    client.play(later, JOINTS)
    assert client.values('predicted_wrench')[-40:] == first, 'bit for bit'
    tared = client.trigger('tare')
    assert tared.success and 'the bias is now [' in tared.message and '\n' not in tared.message
    assert client.set(state_file='none.npz')[0].successful
    assert client.trigger('load_state').message.endswith('states/none.npz; save_state writes it.')
    refused = client.set(state_file='/none/here.npz')[0]
    assert not refused.successful and 'expected a plain name' in refused.reason


def test_contact_is_flagged_and_diagnostics_tell_the_state(client):
    samples = fresh(360)
    client.listen(JointState, 'contact_level')
    assert client.set_together(gate__enabled=True, gate__hold=0.1).successful
    client.play_window(samples[:60], JOINTS, 60)
    client.play(samples[60:300], JOINTS)
    push = np.array([30.0, 0, 0, 0, 0, 0])
    client.play([sample._replace(outputs=sample.outputs + push) for sample in samples[300:330]], JOINTS)
    level, _, values = client.wait_report('learning', lambda level, message, values: 'in contact' in message)
    assert values['samples not learnt for contact'] == '30' and values['in contact'] == 'True'
    assert values['contacts'] == '1' and values['contact felt in'] == 'fx'
    client.wait(lambda: client.stamps('contact_level')[-1:] == [samples[329].stamp], 'the level of every sample')
    levels = client.heard['contact_level']
    assert levels[-1].name == list(BODY.output_names) and levels[-1].position[0] > 1.0 > levels[-1].position[1] > 0.0
    assert max(levels[299].position) < 1.0
    exported = client.trigger('export_model')
    assert exported.success and 'The robot is touched or has changed: links and friction hold that' in exported.message
    client.play(samples[330:], JOINTS, ahead=1)  # else those that wait in the queue are as late as the machine is slow
    client.wait_report('learning', lambda level, message, values: values['in contact'] == 'False')
    _, _, timing = client.wait_report('timing', lambda level, message, values: 'latency p99 [ms]' in values)
    assert 0.0 < float(timing['latency median [ms]']) < 1000.0
    level, _, inputs = client.wait_report('inputs', lambda level, message, values: 'for more than' in message)
    assert level == b'\x01' and inputs['wrench received'].isdigit() and inputs['wrench publishers'] == '1'
    _, _, parameters = client.report('parameters')
    assert '+-' in parameters['base_parameter_0'] and parameters['offset_fx'].endswith(' N')
    statuses = [status for heard in client.heard['/diagnostics'][-5:] for status in heard.status]
    assert len({status.name for status in statuses}) == 5, 'each in its turn'
    assert all(status.hardware_id == 'two' for status in statuses)
    page = Path(__file__).parents[2] / 'docs/ros_interface.md'
    table = page.read_text(encoding='utf-8').split('\n## Diagnostics\n')[1].split('\n\n')[1]
    titles = {*re.findall(r'^\| (\w+) \|', table, re.MULTILINE)} - {'Status'}

    def told():
        return {status.name for heard in client.heard['/diagnostics'] for status in heard.status}

    client.wait(lambda: len(told()) >= len(titles), 'every status')
    assert told() == {f'estimator: {title}' for title in titles}


def test_shadow_variants_publish_their_errors(client):
    samples = fresh(200)
    client.listen(JointState, 'shadow/p/horizon_error')
    assert client.set(shadow_variants=['P'])[0].successful
    client.play(samples[:100], JOINTS)
    client.wait(lambda: client.report('learning')[2]['shadow variants'] == 'P', 'the shadow learns')
    client.play(samples[100:], JOINTS)
    client.wait(lambda: client.heard['shadow/p/horizon_error'], 'its errors')
    assert client.set(shadow_variants=[''])[0].successful


def test_feedforward_answers_a_desired_trajectory(client):
    samples = fresh(100)
    client.listen(WrenchStamped, 'feedforward')
    client.listen(JointTrajectory, 'feedforward_trajectory')
    client.play(samples, JOINTS)
    client.offer('desired_trajectory')
    client.wait_report('learning', lambda level, message, values: message == 'learning with SPK-ML.')
    estimator = build_estimator(LIVE)
    for sample in samples:
        estimator.step(sample)
    wish = JointTrajectory(joint_names=['b', 'a'])
    for sample in samples[:3]:
        wish.points.append(JointTrajectoryPoint(**{f'{name}s'.replace('ys', 'ies'): value[::-1].tolist() for name, value
                                                   in sample._asdict().items() if name.endswith(('tion', 'city'))}))
    client.outputs['desired_trajectory'].publish(JointTrajectory(joint_names=['a']))
    client.outputs['desired_trajectory'].publish(wish)
    client.wait(lambda: client.heard['feedforward_trajectory'], 'the answer')
    desired = [feedforward.desired(estimator, *sample[1:4]) for sample in samples[:3]]
    np.testing.assert_allclose(client.values('feedforward'), [each.outputs for each in desired], rtol=0, atol=1e-9)
    efforts = [list(point.effort)[::-1] for point in client.heard['feedforward_trajectory'][0].points]
    np.testing.assert_allclose(efforts, [each.efforts for each in desired], rtol=0, atol=1e-9)
    assert client.stamps('residual') == [sample.stamp for sample in samples], 'wishes are not learnt'


@pytest.fixture
def quiet(tmp_path):
    """A node of the test's own that is not started yet: a function of settings and ROS arguments."""
    opened = []

    def start(settings, *ros_arguments):
        folder = tmp_path / str(len(opened))
        folder.mkdir()
        dump_params(settings, folder / 'p.yaml', node='/**')
        opened.append(NodeProcess(folder, folder / 'p.yaml', *ros_arguments))
        return opened[-1]

    yield start
    for process in opened:
        process.__exit__()


def test_efforts_best_effort_publishers_and_a_late_description(quiet):
    """Outputs effort, of one joint; a driver that offers best effort only; samples that came before the URDF are
    answered too."""
    settings = replace(SETTINGS, outputs='effort', output_joints=('b',), robot_description='', sensor_frame='',
                       initial_samples=60)
    node = quiet(settings, '-r', '__node:=effort_estimator', '-r', '__ns:=/joints')
    samples = motion(120)
    with Client('effort_estimator', '/joints') as client:
        client.connect('effort')
        client.outputs['joint_states'] = client.node.create_publisher(JointState, 'joint_states', BEST_EFFORT)
        client.wait(client.outputs['joint_states'].get_subscription_count, 'the node asks for best effort')
        client.meet()
        efforts = [sample._replace(outputs=np.array([np.nan, sample.outputs[1]])) for sample in samples]
        for sample in efforts[:20]:
            client.state(sample, JOINTS, effort=sample.outputs.tolist())
            time.sleep(0.005)
        client.wait_report('learning', lambda level, message, values: message == 'waiting for a robot description.')
        client.offer('robot_description')
        client.outputs['robot_description'].publish(String(data='<robot'))
        client.outputs['robot_description'].publish(String(data=URDF))
        for sample in efforts[20:]:
            client.state(sample, JOINTS, effort=sample.outputs.tolist())
            time.sleep(0.005)
        client.wait(lambda: len(client.heard['residual']) >= 120, 'every joint state is answered')
        assert client.stamps('predicted_effort') == [sample.stamp for sample in samples]
        assert list(client.heard['residual'][0].name) == ['b']
        np.testing.assert_allclose(np.array(client.values('predicted_effort')) + client.values('residual'),
                                   [sample.outputs[1:] for sample in efforts], atol=1e-9)
        client.listen(JointTrajectory, 'feedforward_trajectory')
        client.offer('desired_trajectory')
        client.wait_report('learning', lambda level, message, values: message == 'learning with SPK-ML.')
        wish = JointTrajectoryPoint(positions=[0.1, 0.2], velocities=[0.0, 0.0], accelerations=[0.0, 0.0])
        client.outputs['desired_trajectory'].publish(JointTrajectory(joint_names=['a', 'b'], points=[wish]))
        client.wait(lambda: client.heard['feedforward_trajectory'], 'the efforts that follow')
        answer = client.heard['feedforward_trajectory'][0]
        assert (list(answer.joint_names), list(answer.points[0].positions)) == (['b'], [0.2])
        assert len(answer.points[0].effort) == 1
    assert node.stop(signal.SIGTERM) == 0 and 'Traceback' not in node.output


@pytest.mark.parametrize('name', ['/**', '/**/estimator', '/apart/estimator'])
def test_a_value_of_the_command_line_counts_more_than_that_of_the_file(tmp_path, name):
    """The file had the last word, and nobody said so."""
    (tmp_path / 'p.yaml').write_text(f'{name}: {{ros__parameters: {{initial.samples: 1000, horizon.length: 7}}}}')
    given = '-p', 'initial.samples:=300', '-r', '__ns:=/apart'
    with NodeProcess(tmp_path, tmp_path / 'p.yaml', *given), Client(namespace='/apart') as client:
        values = client.get('initial.samples', 'horizon.length')
        assert [value.integer_value for value in values] == [300, 7]


def test_a_file_that_ros_would_not_give_to_the_node_is_refused(tmp_path):
    """A node in a namespace started with the defaults."""
    (tmp_path / 'p.yaml').write_text('estimator: {ros__parameters: {initial.samples: 1000}}')
    command = [sys.executable, '-m', 'semiparam_ros.cli.main', 'run', '--params', tmp_path / 'p.yaml']
    result = subprocess.run([*command, '--ros-args', '-r', '__ns:=/left'], capture_output=True, text=True, timeout=60,
                            check=False)
    assert result.returncode == 2
    assert result.stderr.endswith("p.yaml: ROS gives no section to the node /left/estimator (found: estimator); "
                                  "expected '/left/estimator:' or '/**:'.\n")


@pytest.mark.parametrize(('text', 'sentence'), [
    ('estimator: {ros__parameters: {sensor_frame: ft, features.cuont: 3}}', "nearest is 'features.count'"),
    ('estimator: {ros__parameters: {outputs: wrench}}', 'sensor_frame is empty'),
    ('estimator: {ros__parameters: {sensor_frame: ft, robot_description_file: /none.urdf}}', 'cannot read /none.urdf'),
    ('estimator: [', 'not valid YAML in line 1'),
])
def test_a_start_that_cannot_succeed_ends_with_one_sentence(tmp_path, text, sentence):
    (tmp_path / 'p.yaml').write_text(text)
    result = subprocess.run([sys.executable, '-m', 'semiparam_ros.cli.main', 'run', '--params', tmp_path / 'p.yaml'],
                            capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 2
    assert sentence in result.stderr and 'Traceback' not in result.stderr
    assert result.stderr.count('\n') == 1


def test_a_recording_that_starts_again_loses_no_sample_where_the_clock_is_simulated(tmp_path, ros_domain):
    """What had come before the word of /clock was dropped, a few samples each time."""
    write_bag(tmp_path / 'a.mcap', motion(50))
    dump_params(replace(SETTINGS, variant='P', acceleration_source='measured'), tmp_path / 'p.yaml')
    with NodeProcess(tmp_path, tmp_path / 'p.yaml', '-p', 'use_sim_time:=true'), Client() as client:
        client.connect()
        with Tool(tmp_path, 'replay', tmp_path / 'a.mcap', '--follow', '/estimator/residual', '--rate', 4, '--loop',
                  '--clock', 200, '--answer-timeout', 10) as replay:
            client.wait(lambda: len(client.heard['residual']) > 500, 'ten rounds')
            client.call(SetParameters, '/bag_replay/set_parameters',
                        SetParameters.Request(parameters=messages({'loop': False})))
            assert replay.wait() == 0, replay.output  # all are answered
