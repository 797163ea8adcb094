"""The layouts for plotting tools name topics and fields that exist."""

import json
import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.logging import LoggingSeverity, get_logger

from semiparam_ros.errors import SemiparamError
from semiparam_ros.online.checkpoint import Checkpoints
from semiparam_ros.online.folder_lock import FolderLock
from semiparam_ros.online.identified_parameters import Load, reported_load
from semiparam_ros.ros.estimator import parameters
from semiparam_ros.ros.estimator.autosave import Autosave
from semiparam_ros.ros.estimator.changing import Changing
from semiparam_ros.ros.estimator.consistent import ConsistentTopic
from semiparam_ros.ros.estimator.diagnosing import Diagnosing, Running
from semiparam_ros.ros.estimator.diagnostics import (
    OK,
    REPORTS,
    WARN,
    InputReport,
    Rejections,
    Reports,
    Tally,
    believed_load,
    learning_report,
    model_report,
    payload_sentence,
    stage_of,
)
from semiparam_ros.ros.estimator.node import EstimatorNode
from semiparam_ros.ros.estimator.parameters import FORGOTTEN, OVERTAKEN, HeldReplies
from semiparam_ros.ros.estimator.publishers import HorizonMessage, Outputs, inertia_message
from semiparam_ros.ros.estimator.robot import Robot
from semiparam_ros.ros.estimator.services import Services
from semiparam_ros.settings.build import declared_effects
from support.learner_stage import Stage
from support.node_helpers import BODY, SETTINGS, URDF, DelayedBackground, motion

AXES = ('fx', 'fy', 'fz', 'tx', 'ty', 'tz')
WRENCHES = ('/wrench', '/estimator/predicted_wrench', '/estimator/residual')


def test_the_foxglove_layout_plots_what_the_node_publishes(repository):
    layout = json.loads((repository / 'config' / 'foxglove_layout.json').read_text())
    names = HorizonMessage(AXES, wrench=True).names
    curves = [path for panel in layout['configById'].values() for path in panel.get('paths', ())]
    assert len(curves) == 22
    for curve in curves:
        wrench = re.fullmatch(r'(/[\w/]+)\.wrench\.(force|torque)\.[xyz]', curve['value'])
        horizon = re.fullmatch(r'/estimator/horizon_error\.position\[(\d+)\]', curve['value'])
        assert (wrench and wrench[1] in WRENCHES) or horizon, curve
        if horizon:
            label = curve['label'].replace(', mean removed', '_centred')
            assert names[int(horizon[1])] == label
    assert set(panels(layout['layout'])) == set(layout['configById'])


@pytest.mark.parametrize('name', ['foxglove_layout', 'foxglove_layout_efforts'])
def test_the_status_panel_names_a_robot_as_foxglove_finds_no_status_without_its_hardware_id(repository, name):
    layout = json.loads((repository / 'config' / f'{name}.json').read_text())
    panel = layout['configById']['DiagnosticStatusPanel!model']
    urdf = ElementTree.parse(repository / 'config' / 'icub_right_arm.urdf').getroot()
    assert panel['selectedName'] == 'estimator: model'
    assert panel['selectedHardwareId'] == (urdf.get('name') if name == 'foxglove_layout' else 'ur')


def panels(tree):
    return [tree] if isinstance(tree, str) else panels(tree['first']) + panels(tree['second'])


def test_the_plotjuggler_layout_plots_what_the_node_publishes(repository):
    root = ElementTree.parse(repository / 'config' / 'plotjuggler_layout.xml').getroot()
    names = HorizonMessage(AXES, wrench=True).names
    curves = [curve.get('name') for curve in root.iter('curve')]
    assert len(curves) == 22
    for curve in curves:
        horizon = re.fullmatch(r'/estimator/horizon_error/(\w+)/position', curve)
        wrench = re.fullmatch(r'(/[\w/]+)/wrench/(force|torque)/[xyz]', curve)
        assert (horizon and horizon[1] in names) or (wrench and wrench[1] in WRENCHES), curve


EFFORTS = ('/joint_states', '/estimator/predicted_effort', '/estimator/residual')
UR_JOINTS = ('shoulder_pan_joint', 'shoulder_lift_joint', 'elbow_joint', 'wrist_1_joint', 'wrist_2_joint',
             'wrist_3_joint')


def test_the_layouts_for_efforts_plot_what_the_node_publishes(repository):
    layout = json.loads((repository / 'config' / 'foxglove_layout_efforts.json').read_text())
    names = HorizonMessage(UR_JOINTS, wrench=False).names
    curves = [path for panel in layout['configById'].values() for path in panel.get('paths', ())]
    found = [re.fullmatch(r'(/[\w/]+)\.effort\[([0-5])\]', curve['value']) for curve in curves]
    assert [match[1] for match in found if match] == [*EFFORTS] * 6
    assert [match[2] for match in found if match] == [str(joint) for joint in range(6) for _ in EFFORTS]
    horizon = {curve['label']: curve['value'] for curve, match in zip(curves, found, strict=True) if not match}
    assert horizon == {'eps': f'/estimator/horizon_error.position[{names.index("eps")}]',
                       'eps, mean removed': f'/estimator/horizon_error.position[{names.index("eps_centred")}]'}
    assert set(panels(layout['layout'])) == set(layout['configById'])

    root = ElementTree.parse(repository / 'config' / 'plotjuggler_layout_efforts.xml').getroot()
    assert [curve.get('name') for curve in root.iter('curve')] == [
        *(f'{topic}/{joint}/effort' for joint in UR_JOINTS for topic in EFFORTS),
        *(f'/estimator/horizon_error/{name}/position' for name in ('eps', 'eps_centred'))]


def test_every_part_of_the_nodes_life_has_a_line():
    assert stage_of(None) == 'waiting for a robot description.'
    stage, lines = Stage(), []
    for sample in motion(120):
        stage.learner.offer(sample)
        lines.append(stage_of(stage.learner))
    stage.background.run()
    lines.append(stage_of(stage.learner))
    stage.learner.change(replace(SETTINGS, learning=False))
    lines.append(stage_of(stage.learner))
    assert list(dict.fromkeys(lines)) == [
        'gathering the initial window of 60 samples of motion.', 'estimating the hyperparameters of SPK-ML.',
        'ready: SPK-ML predicts and learns.', 'paused: predicting without learning.']


def test_the_health_of_a_model_tells_how_far_declared_effects_are_believed():
    told = []
    for effects in ((), ('sensor_drift',)):
        stage = Stage(replace(SETTINGS, effects=effects))
        told.append(model_report(stage.learner, Tally(stage.learner.body.joints)).values)
    assert 'probability of the declared effects fx' not in told[0]
    assert told[1]['probability of the declared effects fx'] == '0.500'


def test_lost_samples_are_not_said_to_have_a_cause_that_is_not_known():
    stage = Stage()
    stage.learner.lost = 2
    level, message, _ = learning_report(stage.learner, '')
    assert level == b'\2'
    assert message == '2 samples not answered: the model failed on them, see the status errors.'


def test_the_health_of_a_model_does_not_change_every_second():
    stage = Stage(SETTINGS)
    stage.offer_and_build(motion(80))
    stage.offer(motion(100)[80:])
    tally, levels = Tally(stage.learner.body.joints), []
    for innovation in (1.0, 4.0, 1.0, 5.0, *[1.0] * REPORTS):
        for answer in stage.answers:
            tally.add(answer._replace(innovation=innovation))
        levels.append(model_report(stage.learner, tally).level)
    assert levels == [OK] + [WARN] * (REPORTS + 2) + [OK]


@pytest.mark.parametrize(('mass', 'why'), [
    (-2.0, 'the arm is lighter than its description, or the outputs have the wrong sign.'),
    (0.1, 'the mass is below two standard deviations.')])
def test_a_payload_without_a_centre_says_why(mass, why):
    """A sensor of the other convention carried -2.02 +- 0.0005 kg, "below two standard deviations"."""
    load = Load('hand', np.array([mass, *np.zeros(9)]), 0.01 * np.eye(10))
    assert payload_sentence(reported_load(*load)).endswith(f'its centre and inertia are withheld: {why}')


def test_a_refusal_is_told_beside_a_silence_that_came_before_the_report_could():
    """A node that stood still for a second said of it that nothing is received, and never why messages were refused."""
    inputs = SimpleNamespace(topics=['joint_states'], needed=['joint_states'], publishers=lambda topic: 1, stream=None,
                             counts=Counter(given_up=0), arrived={'joint_states': -10.0}, has_efforts=False)
    rejections = Rejections()
    report = InputReport(inputs, rejections, print)
    rejections.add('joint_states', 'a JointState cannot be read.')
    found = [report.make().message for _ in range(2)]
    assert found == ['nothing received on joint_states for more than 1 s. 1 messages refused in the last second: a '
                     'JointState cannot be read.', 'nothing received on joint_states for more than 1 s.']


def test_a_payload_is_withheld_while_nobody_can_know_it_and_has_the_stamp_of_the_latest_answer():
    stage, samples = Stage(replace(SETTINGS, variant='P')), motion(200)
    tally = Tally(stage.learner.body.joints)
    stage.offer(samples[:30])
    assert believed_load(stage.learner, tally) == (
        None, 'withheld until the initial window is over, which has 30 of 60 samples of motion.')
    stage.offer_and_build(samples[30:190])
    stage.offer(samples[190:])
    for answer in stage.answers:
        tally.add(answer)
    load, _ = believed_load(stage.learner, tally)
    carried = reported_load(*load)
    assert payload_sentence(carried).endswith('kg at ft; its inertia is withheld: no body has the one that fits.')
    assert np.isnan(carried.inertia).all() and np.isfinite(carried.centre).all()
    for each in (carried, carried.std):
        message = inertia_message(tally.stamp, each)
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == samples[-1].stamp
    changes = SimpleNamespace(detector=None, picked=(True, None))
    picking = believed_load(SimpleNamespace(estimator=stage.learner.estimator, changes=changes), tally)
    assert picking == (None, 'withheld: something was just picked up or put down, and is being named.')
    tally.innovation()
    tally.add(stage.answers[-1]._replace(innovation=1000.0))
    tally.innovation()
    load, sentence = believed_load(stage.learner, tally)
    assert load is None and 'predicted standard deviations off' in sentence


def test_a_diagnosis_leaves_out_contacts_and_says_so():
    """It judged the pushes too, which ~/apply_diagnosis left out."""
    stage, samples = Stage(replace(SETTINGS, variant='P')), motion(500)
    stage.offer_and_build(samples)
    begin, end = samples[100].stamp, samples[200].stamp
    stage.learner.changes._contacts.over += [(0, begin - 1), (begin, end)]
    asked, told = [], []
    diagnosing = Diagnosing.__new__(Diagnosing)
    background = SimpleNamespace(submit=lambda *job, done: asked.append(job))
    node = SimpleNamespace(get_logger=lambda: SimpleNamespace(info=told.append))
    diagnosing._node, diagnosing._background, diagnosing._learner = node, background, lambda: stage.learner
    diagnosing._progress = SimpleNamespace(publish=lambda message: None)
    diagnosing._running = Running(None, stage.learner.history.span(8.0), ('taken off',), (), 0.0, None)
    diagnosing._look(1.0)
    assert asked[0][-1] == stage.learner.changes.contacts
    assert asked[0][-2] == ('taken off',), 'of the samples; a reset meanwhile has forgotten it'
    assert re.search(r'evenly spread over 8 s, but for 2\.0 s of contacts', told[0]), told


def test_a_diagnosis_that_another_call_has_applied_meanwhile_is_said_to_be_declared():
    """It said that there was another diagnosis by now."""
    settings, replies = replace(SETTINGS, effects=('sensor_drift',)), []
    found = SimpleNamespace(effects=tuple(declared_effects(settings)))
    diagnosing = Diagnosing.__new__(Diagnosing)
    diagnosing._running, diagnosing._outcome, diagnosing._examined = None, found, ()
    diagnosing._parameters = SimpleNamespace(settings=settings)
    diagnosing._declare(lambda *reply, **_: replies.append(reply), found, None, None)
    assert replies == [('the effects of the last diagnosis are declared already: sensor_drift.',)]


def test_the_first_robot_description_may_come_again_after_another_one():
    """It was taken for another one."""
    told, known = [], []
    robot = Robot(replace(SETTINGS, robot_description=''), known.append, told.append)
    for text in (URDF, f'{URDF} ', URDF):
        robot.from_topic(text)
    assert len(known) == 1 and len(told) == 1


def test_feedforward_before_the_first_wrench_has_the_sensors_frame():
    """It had none: a saved state answers before the sensor does."""
    outputs = Outputs(SimpleNamespace(create_publisher=lambda *_: None), 'wrench')
    outputs.open(BODY)
    assert outputs.frame_id == 'ft'


def test_after_a_reset_nothing_is_reported_of_the_model_before():
    """Its horizon errors were, and that joints had moved enough."""
    stage = Stage(replace(SETTINGS, variant='P'))
    stage.offer_and_build(motion(200))
    stage.offer(motion(260)[200:])
    reports = Reports.__new__(Reports)
    reports.tally, reports._history, reports._learner = Tally(BODY.joints), None, lambda: stage.learner
    reports._consistent = SimpleNamespace(stop=lambda: None)
    for answer in stage.answers:
        reports.tally.add(answer)
    reports.tally.errors = stage.errors[-1]
    assert 'horizon error fx' in reports._model().values
    stage.learner.reset()
    assert 'horizon error fx' not in reports._model().values
    still = motion(1)[0]
    for number in range(5):
        stage.learner.offer(still._replace(stamp=still.stamp + number))
        reports.tally.add(stage.answers[-1])
    assert 'joint a has moved 0.000 rad only' in reports._model().message


def test_consistent_parameters_of_the_model_before_a_state_was_loaded_are_forgotten():
    """They were told of the loaded one until its own were found, and those still to come were published then."""
    stage, published = Stage(replace(SETTINGS, variant='P', parameters_consistent=True)), []
    stage.offer_and_build(motion(70))
    node = SimpleNamespace(get_fully_qualified_name=lambda: '/arm', create_publisher=lambda *_: SimpleNamespace(
        publish=published.append))
    reports = Reports.__new__(Reports)
    reports.tally, reports._history, reports._learner = Tally(BODY.joints), None, lambda: stage.learner
    reports._published, reports._payload = None, SimpleNamespace(publish=lambda message: None)
    reports._payload_std = reports._payload
    reports._consistent = ConsistentTopic(node, lambda: URDF, stage.background, stage.failed)
    reports._parameters()
    stage.background.run()
    assert reports._parameters().values['consistent'].startswith('yes') and len(published) == 1
    reports._consistent._earliest = 0.0
    reports._parameters()
    stage.learner.restore(stage.learner.state())
    assert reports._parameters().values['consistent'] == 'no: they are being looked for.'
    stage.background.run(1)
    assert len(published) == 1, 'of the model before'


@pytest.mark.parametrize('given', [False, True])
def test_a_reset_tells_of_a_new_window_where_there_is_one(given):
    """It did also where hyperparameters were given, which need none."""
    settings = replace(SETTINGS, variant='P')
    if given:
        settings = replace(settings, hyperparameters_gamma=(1.0,), hyperparameters_sigma=(0.1,),
                           hyperparameters_output_scale=(1.0,) * 6)
    requests, stage = Services.__new__(Services), Stage(settings)
    requests._learner, requests._forgotten = lambda: stage.learner, lambda: None
    told = requests.reset()
    assert ('a new initial window of 60 samples' in told) == (not given) == (not stage.learner.estimator.ready)


@pytest.mark.parametrize(('busy', 'sentence'), [(True, 'the one before it is still being written.'),
                                                (False, 'Permission denied')])
def test_a_node_ends_and_says_why_there_is_no_checkpoint_of_the_end(busy, sentence):
    """It said nothing while a disk hung, and ended by an exception of any other error."""
    told = []

    def save(state):
        raise PermissionError('Permission denied')
    autosave = Autosave.__new__(Autosave)
    autosave._active, autosave._state, autosave._refuse = True, lambda: 'state', told.append
    autosave.checkpoints = SimpleNamespace(wait=lambda: None, busy=busy, save=save, news=[])
    autosave.close()
    assert told == [f'there is no checkpoint of the end: {sentence}']


@pytest.mark.parametrize('ends', [True, False])
def test_the_log_names_the_state_of_another_configuration_that_is_moved_aside(tmp_path, ends):
    told, before = [], Checkpoints(tmp_path, 'arm')
    before.save(Stage(SETTINGS).learner.state())
    before.lock.release()
    autosave = Autosave.__new__(Autosave)
    autosave.checkpoints, autosave._active, autosave._failed = Checkpoints(tmp_path, 'arm'), True, ''
    autosave._say, autosave._refuse, autosave._count = told.append, told.append, 0
    autosave._schedule, autosave._retry = lambda function, *arguments: function(*arguments), SimpleNamespace(
        cancel=lambda: None)
    autosave._state = Stage(replace(SETTINGS, features_count=30)).learner.state
    (autosave.close if ends else autosave._save)()
    autosave.checkpoints.wait()
    (aside,) = tmp_path.glob('*aside*')
    assert told == [f'{tmp_path}/arm.checkpoint.npz was learnt with features.count 40; this node has 30. '
                    f'It is moved to {aside}.']


@pytest.mark.parametrize('service', ['save_state', 'export_model'])
def test_a_second_node_of_the_same_name_neither_saves_nor_exports_when_asked(tmp_path, service):
    def take():
        raise SemiparamError('another node of the name arm')
    services, replies, learner = Services.__new__(Services), [], Stage(replace(SETTINGS, variant='P')).learner
    services._lock, services._learner, services._folder = SimpleNamespace(take=take), lambda: learner, tmp_path
    services._parameters = SimpleNamespace(settings=SETTINGS)
    services._aside = services._background = None  # whoever gets so far writes
    with pytest.raises(SemiparamError, match='another node of the name arm'):
        getattr(services, service)(replies.append)
    assert not replies and not list(tmp_path.iterdir())


@pytest.mark.parametrize(('then', 'told'), [('change', OVERTAKEN), ('reset', FORGOTTEN)])
def test_who_waits_for_a_model_that_is_built_no_more_is_told_so(then, told, monkeypatch):
    """He heard that another model takes over, or that his is being built, though it had been given up."""
    stage = Stage(replace(SETTINGS, variant='P', shadow_variants=('NP-ML',)))
    stage.offer_and_build(motion(200))
    sent, waits = [], []
    monkeypatch.setattr(parameters, 'steady_timer', lambda node, seconds, call: waits.append(call))
    service = SimpleNamespace(srv_name='/set_parameters_atomically', send_response=lambda reply, _: sent.append(reply))
    node = SimpleNamespace(learner=stage.learner, _awaited='')
    node._held_replies = HeldReplies(SimpleNamespace(services=[service], destroy_timer=lambda timer: None),
                                     lambda: EstimatorNode._announcement(node))
    stage.model_switched = node._held_replies.settle

    def wish(variant):
        reason = EstimatorNode._change(node, replace(SETTINGS, variant=variant, shadow_variants=('NP-ML',)))
        service.send_response(SetParametersAtomically.Response(
            result=SetParametersResult(successful=True, reason=reason)), None)

    wish('SPK-ML')
    assert not sent and len(waits) == 1
    stage.learner.reset() if then == 'reset' else wish('NP-ML')
    waits[-1]()
    assert (sent[0].result.successful, sent[0].result.reason) == (True, told)


def test_who_waits_for_a_model_when_a_state_is_loaded_that_asks_for_another_is_told_so(tmp_path):
    """He heard after a second that his was being built, or that the other one takes over."""
    stage = Stage(replace(SETTINGS, variant='P'))
    stage.offer_and_build(motion(200))
    stage.learner.change(replace(SETTINGS, variant='SPK-ML'))
    asking, told = stage.learner.state(), []
    stage.learner.change(replace(SETTINGS, variant='NP-ML'))
    services = Services.__new__(Services)
    services._learner, services._folder, services._closed = lambda: stage.learner, tmp_path, False
    services._parameters = SimpleNamespace(settings=SETTINGS, write=lambda settings: None)
    services._forgotten = lambda: told.append(stage.learner.settings.variant)
    services._aside = lambda name, work, then, reply: reply(then(asking))
    services.load_state(told.append)
    assert told[0] == 'SPK-ML' and 'the SPK-ML that was being built is built anew' in told[1]
    services.reset()
    assert told[2:] == ['SPK-ML']


def test_who_waits_for_a_service_is_answered_when_the_node_ends(tmp_path, monkeypatch):
    """What the executor had not come to was lost with it: a state was written, and nobody heard of it."""
    learner, known, sent = Stage(replace(SETTINGS, variant='P')).learner, {}, []

    def create_service(_, name, callback):
        known[name] = SimpleNamespace(call=callback, send_response=lambda reply, _: sent.append((name, reply.success)))
        return known[name]

    monkeypatch.setattr('semiparam_ros.ros.estimator.services.learnt', lambda *_: None)
    node = SimpleNamespace(create_service=create_service, get_logger=lambda: get_logger('services'),
                           get_fully_qualified_name=lambda: '/arm')
    requests = Services(node, SimpleNamespace(settings=SETTINGS), lambda: learner, lambda: URDF, DelayedBackground(),
                        tmp_path, SimpleNamespace(take=lambda: None), lambda *_: None, None, lambda: None)
    for name in ('~/save_state', '~/export_model', '~/load_state'):
        known[name].send_response(known[name].call(None, None), None)
    requests.close()
    assert (tmp_path / SETTINGS.state_file).exists()
    assert sent == [('~/save_state', True), ('~/load_state', False), ('~/export_model', False)]


def test_what_is_said_may_be_an_error_once_and_a_warning_later():
    """rclpy refuses two severities from one line: a second publisher was not told where anything had been refused."""
    reports = SimpleNamespace(_node=SimpleNamespace(get_logger=lambda: get_logger('reports')), _news='')
    for severity in (LoggingSeverity.ERROR, LoggingSeverity.WARN, LoggingSeverity.INFO, LoggingSeverity.ERROR):
        Reports.say(reports, f'a sentence of {severity.name}', severity)
        assert reports._news == f'a sentence of {severity.name}'


def test_a_line_of_changes_names_its_node_and_a_second_node_of_the_name_adds_none(tmp_path):
    refused, held, record = [], [], SimpleNamespace(sentence='The robot has changed.', as_dict=lambda: {'change': 1})
    for name in ('/left/estimator', '/right/estimator', '/left/estimator'):
        node = SimpleNamespace(create_publisher=lambda *_: None, get_fully_qualified_name=lambda name=name: name)
        changing = Changing(node, lambda: None, tmp_path, FolderLock(tmp_path, name), lambda sentence: None,
                            lambda function, *arguments: function(*arguments),
                            lambda place, error: refused.append(str(error)))
        changing.announce(record)
        changing.close()
        held.append(changing)  # each has its lock yet
    written = (tmp_path / 'changes.jsonl').read_text().splitlines()
    assert [json.loads(line) for line in written] == [{'node': '/left/estimator', 'change': 1},
                                                      {'node': '/right/estimator', 'change': 1}]
    assert len(refused) == 1 and 'so this one writes none there' in refused[0]
