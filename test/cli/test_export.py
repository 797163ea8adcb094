"""`semiparam export`: from recordings and states to files."""

import json
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import yaml

from semiparam_ros.bags.loading import load_samples
from semiparam_ros.cli.evaluate import load_bags
from semiparam_ros.core.robot.consistency import is_consistent
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.effects import effect_from_text
from semiparam_ros.export.urdf import described_links
from semiparam_ros.online import state_file
from semiparam_ros.online.tare import Tare
from semiparam_ros.ros.estimator.consistent import learnt
from semiparam_ros.settings import load_params
from semiparam_ros.settings.build import build_rigid_body
from support.arms import smooth_motion
from support.commands import document, refusal, semiparam
from support.learner_stage import Stage
from support.node_helpers import InlineBackground
from support.recordings import FRAME, JOINTS, URDF, write_arm

PARAMS = f"""
/**:
  ros__parameters:
    joints: [{', '.join(JOINTS)}]
    sensor_frame: {FRAME}
"""


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """`arm.mcap`, whose inertias are 1.2 times the description's, with its `p.yaml`."""
    folder = tmp_path_factory.mktemp('export')
    write_arm(folder / 'arm.mcap', 600)
    (folder / 'p.yaml').write_text(PARAMS)
    return folder


def export(folder, *options, source='arm.mcap', params='p.yaml'):
    return semiparam('export', folder / source, '--params', folder / params, *options)


def test_a_recording_becomes_a_urdf_and_a_document(folder, capsys):
    found = document(folder / 'a.json', 'export', folder / 'arm.mcap', '--params', folder / 'p.yaml',
                     '--urdf', folder / 'a.urdf')
    told = capsys.readouterr().out
    assert 'r_upper_arm: 0.729 kg to 0.' in told and f'written: {folder / "a.urdf"}' in told
    text = (folder / 'a.urdf').read_text()
    assert text.startswith(URDF.read_text()[:200]) and 'Identified by semiparam_ros' in text
    body, before = (RigidBody.from_urdf(urdf, JOINTS, 'wrench', FRAME)
                    for urdf in (text, URDF.read_text()))
    assert np.allclose(body.base_parameters, 1.2 * before.base_parameters, atol=0.02)
    assert found['schema'] == 1 and found['command'] == 'export'
    assert found['offsets']['fz'] == pytest.approx(1.0, abs=0.05)
    assert found['links']['r_upper_arm']['changed'] is True
    assert found['errors']['consistent'] < 1.05 * found['errors']['unconstrained']


def test_comments_and_all_other_elements_stay(folder):
    assert export(folder, '--urdf', folder / 'b.urdf') == 0
    touched = ('<origin', '<mass', '<inertia ', 'Identified by')
    before, after = ([line for line in path.read_text().splitlines()
                      if not any(word in line for word in touched)] for path in (URDF, folder / 'b.urdf'))
    assert after == before


def test_a_load_is_told_in_the_forms_of_controllers(folder):
    files = {form: folder / f'load.{form}' for form in ('ur-payload', 'franka-desk', 'libfranka')}
    options = [part for form, path in files.items() for part in (f'--{form}', path)]
    assert export(folder, '--load', 'r_hand', '--keep-inertias', '--flange', 'r_gripper',
                  '--urdf', folder / 'l.urdf', *options) == 0
    model = pin.buildModelFromXML((folder / 'l.urdf').read_text())
    desk = json.loads(files['franka-desk'].read_text())
    assert set(desk) == {'mass', 'centerOfMass', 'transformation', 'inertia'}
    assert (len(desk['transformation']), len(desk['inertia'])) == (16, 9)
    load = described_links((folder / 'l.urdf').read_text())['payload_r_hand']
    assert model.existBodyName('payload_r_hand') and load[0] == pytest.approx(desk['mass'])
    script = files['ur-payload'].read_text().splitlines()[-1]
    assert script.startswith(f'set_target_payload({desk["mass"]:.10g}, [')
    mass, centre, inertia = eval(script.removeprefix('set_target_payload'))
    xx, yy, zz, xy, xz, yz = inertia
    assert np.allclose(centre, desk['centerOfMass'])
    assert np.allclose([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]],
                       np.array(desk['inertia']).reshape(3, 3))
    assert is_consistent(load) and mass > 0.0
    assert f'robot.setLoad({desk["mass"]:.10g}, {{{{' in files['libfranka'].read_text()


def test_known_tools_are_taken_off_a_recording(folder):
    """As the node does: a tool that the parameters declare was found once more, as a load and in the links."""
    known = '    tools: [\'{}r_hand {{"mass": 0.4, "centre": [0.0, 0.02, 0.05]}}\']\n'
    masses = []
    for text in ('', known.format('-'), known.format('')):  # taken off, then carried
        (folder / 'tool.yaml').write_text(PARAMS + text)
        found = document(folder / 'tool.json', 'export', folder / 'arm.mcap', '--params', folder / 'tool.yaml',
                         '--load', 'r_hand', '--keep-inertias')
        masses.append(found['loads'][0]['mass'] if found['loads'] else 0.0)
    assert masses[1] == pytest.approx(masses[0] + 0.4, abs=0.005) and masses[2] == 0.0
    settings = load_params(folder / 'tool.yaml')
    recorded = load_samples(folder / 'arm.mcap', settings).samples.outputs
    kept, bare = (load_bags([folder / 'arm.mcap'], settings, with_tools=with_tools)[0].samples.outputs
                  for with_tools in (True, False))
    np.testing.assert_array_equal(kept, recorded)
    assert np.abs(bare - recorded).max() > 4.0


def test_the_weight_on_a_sensor_is_that_of_one_body(folder, tmp_path, capsys):
    path = tmp_path / 'f.yaml'
    assert 'bodies hang on the sensor and move against each other' in refusal(
        capsys, 'export', folder / 'arm.mcap', '--params', folder / 'p.yaml', '--gravity-filter', path)
    (folder / 'locked.yaml').write_text(
        PARAMS.replace(', r_elbow', '')
        + '    locked_joints.names: [r_elbow]\n    locked_joints.positions: [1.0]\n')
    assert export(folder, '--gravity-filter', path, params='locked.yaml') == 0
    parameters = yaml.safe_load(path.read_text())['sensor_filter_chain']['filter1']['params']
    assert parameters['sensor_frame'] == 'r_upper_arm'
    # the sensor tells the action on the tool
    assert parameters['tool']['gravity_field'] == [0.0, 0.0, 9.81]
    assert parameters['world_frame'] == 'root_link'  # a frame "world" there need not be
    described = sum(values[0] for name, values in described_links(URDF.read_text()).items()
                    if name in ('r_upper_arm', 'r_elbow_1', 'r_forearm', 'r_hand'))
    assert parameters['tool']['mass'] == pytest.approx(1.2 * described, rel=0.1)


def test_known_tools_are_part_of_the_weight_on_a_sensor(folder, tmp_path):
    """They are taken off the samples, but no filter of a raw wrench does so."""
    locked = (PARAMS.replace(', r_elbow', '')
              + '    locked_joints.names: [r_elbow]\n    locked_joints.positions: [1.0]\n')
    known = '    tools: [\'r_hand {"mass": 0.2, "centre": [0.0, 0.02, 0.05]}\']\n'
    found = []
    for text in ('', known):
        (folder / 'weight.yaml').write_text(locked + text)
        assert export(folder, '--gravity-filter', tmp_path / 'f.yaml', params='weight.yaml') == 0
        found.append(yaml.safe_load((tmp_path / 'f.yaml').read_text())['sensor_filter_chain']['filter1']['params'])
    bare, with_tool = (each['tool'] for each in found)
    assert with_tool['mass'] == pytest.approx(bare['mass'], rel=0.02)
    assert with_tool['CoG'] == pytest.approx(bare['CoG'], abs=0.01)


@pytest.mark.parametrize('source, options, sentence', [
    ('arm.mcap', '--ur-payload x', 'no load is known; expected a payload among the effects'),
    ('arm.mcap', '--load r_hand --ur-payload x', 'the samples show no load at r_hand: there is none to write.'),
    ('arm.mcap', '--crisp-friction x', 'no friction is known; expected outputs: effort'),
    ('arm.mcap', '--load r_hand --keep-inertias --flange r_upper_arm --libfranka x',
     "what is carried at 'r_hand' moves against 'r_upper_arm'; expected a link that is"),
    ('arm.mcap', '--load r_hand --keep-inertias --flange nothing --libfranka x',
     "link 'nothing' is not a link of the robot description"),
    ('arm.mcap', '--flange nothing --urdf x', '--flange nothing tells where a load is told to a controller, but no '
     'file for one is asked for; expected --ur-payload, --franka-desk, --libfranka FILE.'),
    ('arm.mcap', '--load nothing', "effect 'payload' cannot act at 'nothing'; expected payload@PLACE"),
    ('arm.mcap', '--urdf nowhere/x', 'cannot write nowhere/x: there is no folder'),
    ('p.yaml', '', 'says what there is, not how much of it; expected a recording or a saved state'),
])
def test_a_mistake_is_one_sentence_and_no_file(folder, tmp_path, monkeypatch, capsys, source, options,
                                               sentence):
    monkeypatch.chdir(tmp_path)
    assert sentence in refusal(capsys, 'export', folder / source, '--params', folder / 'p.yaml',
                               *options.split(), '--json', tmp_path / 'x.json')
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('option, sentence', [
    ('--gravity-filter', 'bodies hang on the sensor and move against each other'),
    ('--crisp-friction', 'no friction is known; expected outputs: effort')])
def test_a_form_that_the_robot_cannot_fill_is_refused_before_the_fit(folder, tmp_path, monkeypatch, capsys, option,
                                                                     sentence):
    monkeypatch.setattr('semiparam_ros.export.estimate.from_recording', lambda *args: pytest.fail('it was fitted'))
    assert sentence in refusal(capsys, 'export', folder / 'arm.mcap', '--params', folder / 'p.yaml', option,
                               tmp_path / 'x')
    assert not (tmp_path / 'x').exists()


def test_the_description_that_the_parameters_name_is_not_replaced(folder, tmp_path, capsys):
    (tmp_path / 'arm.urdf').write_text(URDF.read_text())
    (tmp_path / 'p.yaml').write_text(PARAMS + '    robot_description_file: arm.urdf\n')
    for option in ('--urdf', '--json'):
        assert 'arm.urdf is read, too; expected another name for the output' in refusal(
            capsys, 'export', folder / 'arm.mcap', '--params', tmp_path / 'p.yaml', option, tmp_path / 'arm.urdf')
    assert (tmp_path / 'arm.urdf').read_text() == URDF.read_text()


def test_what_a_wrong_sign_explains_is_no_robot(folder, tmp_path, monkeypatch, capsys):
    """Bodies were written that no inertia explains, of a recording that a diagnosis refuses."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'p.yaml').write_text(PARAMS + '    wrench_convention: reaction\n')
    assert f'{folder / "arm.mcap"}: The wrench has the opposite sign of what the robot description predicts' in refusal(
        capsys, 'export', folder / 'arm.mcap', '--params', 'p.yaml', '--urdf', 'a.urdf', '--json', 'a.json')
    assert [path.name for path in tmp_path.iterdir()] == ['p.yaml']


def staged(params, variant='SPK-ML'):
    """Write a parameter file of a small model; return its settings and a learner of them."""
    params.write_text(PARAMS + f'    robot_description_file: {URDF}\n    initial.samples: 200\n'
                      f'    variant: {variant}\n    features.count: 20\n')
    settings = load_params(params)
    return settings, Stage(settings, InlineBackground(), build_rigid_body(settings))


def test_a_saved_state_is_exported_as_it_was_learnt(folder, tmp_path, capsys):
    settings, stage = staged(tmp_path / 'p.yaml')
    stage.offer(load_samples(folder / 'arm.mcap', settings).samples)
    state_file.save(tmp_path / 's.npz', stage.learner.state())
    arguments = 'export', tmp_path / 's.npz', '--params', tmp_path / 'p.yaml'
    assert semiparam(*arguments, '--urdf', tmp_path / 's.urdf') == 0
    assert 'On the samples that the state keeps the normalised error is' in capsys.readouterr().out
    body, before = (RigidBody.from_urdf(path.read_text(), JOINTS, 'wrench', FRAME)
                    for path in (tmp_path / 's.urdf', URDF))
    assert np.allclose(body.base_parameters, 1.2 * before.base_parameters, atol=0.05)
    assert 'is a saved state; expected --kept-samples too' in refusal(capsys, *arguments, '--load', 'r_hand')
    assert 'is a recording; --kept-samples expects' in refusal(
        capsys, 'export', folder / 'arm.mcap', '--params', tmp_path / 'p.yaml', '--kept-samples')
    models = [document(tmp_path / 's.json', *arguments, *options)
              for options in ((), ('--kept-samples',), ('--kept-samples', '--load', 'r_hand', '--keep-inertias'))]
    recorded = document(tmp_path / 's.json', 'export', folder / 'arm.mcap', '--params', tmp_path / 'p.yaml')
    learnt, kept, _ = (model['errors'] for model in models)
    assert kept['held_out'] and not learnt['held_out']
    assert kept['consistent'] == pytest.approx(recorded['errors']['consistent'], rel=0.02)
    assert models[2]['loads'] and not any(link['changed'] for link in models[2]['links'].values())


@pytest.mark.parametrize('options', [(), ('--kept-samples',)])
def test_offsets_are_those_of_the_sensor_whatever_a_tare_took_of_them(folder, tmp_path, options):
    """The model of a node that was tared holds what is left: 2 N less than nothing."""
    settings, stage = staged(tmp_path / 'p.yaml')
    stage.learner.tare = Tare(6, np.full(6, 3.0))
    stage.offer(load_samples(folder / 'arm.mcap', settings).samples)
    state_file.save(tmp_path / 's.npz', stage.learner.state())
    found = document(tmp_path / 's.json', 'export', tmp_path / 's.npz', '--params', tmp_path / 'p.yaml', *options)
    assert list(found['offsets'].values()) == pytest.approx([1.0] * 6, abs=0.3)
    assert learnt(stage.learner, 'a node').bias == pytest.approx([3.0] * 6)


def test_kept_samples_are_fitted_with_the_friction_that_their_state_has(tmp_path):
    """The state brings its model along, but the friction of that was asked of the parameter file."""
    params = tmp_path / 'p.yaml'
    text = (f'/**:\n  ros__parameters:\n    joints: [{", ".join(JOINTS)}]\n    outputs: effort\n'
            f'    robot_description_file: {URDF}\n    variant: P\n    initial.samples: 200\n')
    params.write_text(f'{text}    joint_friction: false\n')
    settings, body = load_params(params), RigidBody.from_urdf(URDF.read_text(), JOINTS, 'effort')
    motion = smooth_motion(4, 400)
    efforts = body.outputs_of(motion, body.base_parameters)
    stage = Stage(settings, InlineBackground(), body)
    stage.offer(list(replace(motion, outputs=efforts + 0.01 * np.random.default_rng(0).standard_normal(efforts.shape))))
    state_file.save(tmp_path / 's.npz', stage.learner.state())
    params.write_text(text)
    for options in ((), ('--kept-samples',)):
        assert document(tmp_path / 's.json', 'export', tmp_path / 's.npz', '--params', params, *options)['joints'] == {}


def test_changes_that_are_applied_beside_the_model_are_exported_with_it(folder, tmp_path, capsys):
    settings, stage = staged(tmp_path / 'p.yaml')
    stage.offer(load_samples(folder / 'arm.mcap', settings).samples)
    arguments = 'export', tmp_path / 's.npz', '--params', tmp_path / 'p.yaml', '--urdf', tmp_path / 's.urdf'
    load = np.array([0.5, 0.01, 0.0, 0.05, 2e-3, 0.0, 2e-3, 0.0, 0.0, 1e-3])
    weights = []
    for number, text in enumerate(('', 'payload@r_hand', 'tool_exchange@r_hand', 'sensor_offset')):
        if text:
            effect = effect_from_text(text)
            values = load if effect.is_load else np.arange(6.0)
            stage.learner.changes.applied.offer(number, effect, values, 0.01 * np.ones(len(values)), 0)
            stage.learner.changes.applied.switch(stage.learner.changes.applied.of_change(number), 0)
        state_file.save(tmp_path / 's.npz', stage.learner.state())
        assert semiparam(*arguments) == 0
        urdf = (tmp_path / 's.urdf').read_text()
        assert ('payload_r_hand' in described_links(urdf)) == (number > 0)
        weights.append(sum(values[0] for values in described_links(urdf).values()))
    assert np.allclose(np.diff(weights), [0.5, 0.5, 0.0], atol=0.02), 'another tool is a part of its link'
    told = capsys.readouterr().out
    assert 'load at r_hand: 0.5004 +- 0.01 kg' in told and 'offset@tz 0.999, sensor_offset.fx 0, ' in told
    errors = [line for line in told.splitlines() if line.startswith('On the samples')]
    assert errors[:2] == errors[:1] * 2 and errors[2:] == errors[2:3] * 2, 'samples are without them'


def test_a_state_without_a_rigid_body_tells_nothing(folder, tmp_path, capsys):
    settings, stage = staged(tmp_path / 'p.yaml', 'NP-ML')
    for count, sentence in ((0, 'there is none until the initial window is over, which has 0 of 200 samples'),
                            (300, 'its variant is NP-ML; expected P, SPK-ML or auto')):
        stage.offer(load_samples(folder / 'arm.mcap', settings).samples[:count])
        state_file.save(tmp_path / 's.npz', stage.learner.state())
        assert sentence in refusal(capsys, 'export', tmp_path / 's.npz', '--params', tmp_path / 'p.yaml')
