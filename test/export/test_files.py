"""Forms of controllers whose numbers can be checked, and what a node writes."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
import yaml

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.effects import effect_from_text
from semiparam_ros.errors import SemiparamError
from semiparam_ros.export.controllers import crisp_friction, gravity_filter
from semiparam_ros.export.estimate import Estimate
from semiparam_ros.export.files import export_to
from semiparam_ros.export.identified import identify
from semiparam_ros.export.urdf import described_links, identified_urdf
from support.arms import ICUB_JOINTS, ICUB_OWN

URDF = ICUB_OWN.read_text()
SPEED = 1.5


@pytest.fixture
def estimate():
    """A robot that is as described, is known to be, and rubs."""
    from semiparam_ros.core.robot.rigid_body import RigidBody

    columns = CoupledColumns(RigidBody.from_urdf(URDF, ICUB_JOINTS, 'effort'), (), True, True)
    mean = columns.expected
    friction = columns.blocks['friction']
    mean[friction] = [0.5, 0.5, 0.0, -0.1, 0.2, 0.0, 0.0, 0.1, 0.1, 0.4, 0.0, 0.1]
    return Estimate(columns, mean, 1e4 * np.eye(len(mean)), 'a table', np.full(4, SPEED))


def test_friction_curves_are_those_of_the_joints(estimate):
    found = identify(estimate, described_links(URDF))
    vectors = yaml.safe_load(crisp_friction(found, 'how'))['friction']
    velocity = np.linspace(0.1, SPEED, 20)[:, None]
    fp1, fp2, fp3 = (np.array(vectors[name]) for name in ('fp1', 'fp2', 'fp3'))
    curve = fp1 / (1 + np.exp(-fp2 * (velocity + fp3))) - fp1 / (1 + np.exp(-fp2 * fp3))
    wanted = velocity * [0.5, 0.5, 0.0, 0.0] + [0.3, 0.4, 0.0, 0.2]
    assert np.sum((curve - wanted) ** 2) < 0.03 * np.sum(wanted**2)
    assert np.allclose(curve[:, [2]], 0.0)
    assert np.allclose(curve[:, 3], 0.2, atol=0.02)


@pytest.mark.parametrize('damping', [1e-3, 1e-7])
def test_a_joint_with_damping_alone_has_a_curve_that_is_a_line(estimate, damping):
    estimate.mean[estimate.columns.blocks['friction']] = [0.5, damping, 0.0, 0.0, *[0.0] * 8]
    vectors = yaml.safe_load(crisp_friction(identify(estimate, described_links(URDF)), ''))['friction']
    fp1, fp2 = (np.array(vectors[name])[:2] for name in ('fp1', 'fp2'))
    velocity = np.linspace(0.1, SPEED, 20)[:, None]
    np.testing.assert_allclose(0.5 * fp1 * np.tanh(0.5 * fp2 * velocity), velocity * [0.5, damping], rtol=3e-3)


def test_friction_of_some_joints_stands_at_their_places(estimate):
    """A controller takes as many values as it has joints, whatever the vectors hold."""
    effects = [effect_from_text(f'viscous_friction@{ICUB_JOINTS[joint]}') for joint in (3, 1)]
    columns = CoupledColumns(estimate.columns.body, effects, False, True)
    mean = columns.expected
    mean[[columns.blocks[name].start for name in '01']] = 0.3, 0.1
    known = Estimate(columns, mean, 1e4 * np.eye(len(mean)), 'a table', np.full(4, SPEED))
    text = crisp_friction(identify(known, described_links(URDF)), 'how')
    fp1, fp2 = (np.array(yaml.safe_load(text)['friction'][name]) for name in ('fp1', 'fp2'))
    np.testing.assert_allclose(0.25 * fp1 * fp2, [0.0, 0.1, 0.0, 0.3], rtol=3e-2)
    assert f'Joints: {", ".join(ICUB_JOINTS)}' in text


def test_friction_that_is_over_is_in_no_file(estimate):
    """It was added to what the joint rubs with now."""
    texts = [f'viscous_friction@{ICUB_JOINTS[1]}{{"{name}": 20.0}}' for name in ('end_s', 'start_s')]
    columns = CoupledColumns(estimate.columns.body, [effect_from_text(text) for text in texts], False, True)
    mean = columns.expected
    mean[[columns.blocks[name].start for name in '01']] = 5.0, 1.0
    known = Estimate(columns, mean, 1e8 * np.eye(len(mean)), 'a table', np.full(4, SPEED))
    (found,) = identify(known, described_links(URDF)).joints
    assert (found.joint, found.name, found.value) == (ICUB_JOINTS[1], 'damping', pytest.approx(1.0, abs=1e-3))


def test_a_lighter_tool_is_no_load_that_is_not_there(estimate):
    """Declared among the effects it was left out, and the files held the tool of before."""
    columns = CoupledColumns(estimate.columns.body, [effect_from_text('tool_exchange@r_hand')], True, True)
    mean = columns.expected
    mean[columns.blocks['0']] = [-0.1, 0.0, 0.0, 0.0, -1e-3, 0.0, -1e-3, 0.0, 0.0, -1e-3]
    known = Estimate(columns, mean, 1e8 * np.eye(len(mean)), 'a table', np.full(4, SPEED))
    with pytest.raises(SemiparamError, match=r'tool_exchange@r_hand.* takes away what no load can'):
        identify(known, described_links(URDF))


def test_a_joint_that_stood_still_has_no_friction_whatever_rounding_left(estimate):
    """Divided by its largest velocity, 1e-17 N m of friction ended the export as an internal error."""
    estimate.mean[estimate.columns.blocks['friction']] = [0.5, 0.0, 0.0, 0.0, 0.0, 1e-17, *[0.0] * 6]
    still = estimate._replace(top_speed=np.array([SPEED, 0.0, SPEED, SPEED]))
    vectors = yaml.safe_load(crisp_friction(identify(still, described_links(URDF)), ''))['friction']
    assert vectors['fp1'][0] > 0.0 and vectors['fp1'][1] == vectors['fp2'][1] == 0.0


def test_a_link_of_any_name_carries_a_load(estimate):
    odd, columns = URDF.replace('r_hand', 'h &lt;&quot;&amp;'), estimate.columns
    body = type(columns.body).from_urdf(odd, ICUB_JOINTS, 'effort')
    load = effect_from_text('payload@r_hand')
    columns = CoupledColumns(body, [replace(load, where='h <"&')], True, True)
    mean = columns.expected
    mean[columns.blocks['0']] = [0.5, 0.0, 0.0, 0.0, 1e-3, 0.0, 1e-3, 0.0, 0.0, 1e-3]
    known = Estimate(columns, mean, 1e6 * np.eye(len(mean)), 'a table', np.full(4, SPEED))
    urdf = identified_urdf(odd, identify(known, described_links(odd)), 'how')
    assert described_links(urdf)['payload_h <"&'][0] == pytest.approx(0.5, rel=1e-3)


def test_a_recording_of_any_name_is_told_of_in_one_line(estimate, tmp_path):
    """A byte that is no UTF-8, a control character, and a line that a controller would run."""
    named = estimate._replace(how='samples of arm\udce9\x1b\nset_payload(99).mcap')
    export_to(tmp_path, 'arm', URDF, named)
    text = (tmp_path / 'arm.urdf').read_text()
    assert described_links(text).keys() == described_links(URDF).keys()
    assert 'samples of arm???set_payload(99).mcap. -->' in text


def test_what_drives_a_joint_is_no_damping(estimate):
    found = identify(estimate, described_links(URDF))
    damping = {each.joint: each.value for each in found.joints if each.name == 'damping'}
    assert damping[ICUB_JOINTS[0]] == pytest.approx(0.5, abs=1e-6)
    assert damping[ICUB_JOINTS[3]] == 0.0


def test_efforts_say_nothing_of_the_weight_on_a_sensor(estimate):
    found = identify(estimate, described_links(URDF))
    with pytest.raises(SemiparamError, match='expected outputs: wrench'):
        gravity_filter(estimate.columns.body, found, '')


def test_a_node_writes_both_files_and_replaces_its_own_alone(estimate, tmp_path):
    sentence = export_to(tmp_path / 'states', 'arm', URDF, estimate)
    assert sentence.endswith('arm.urdf and arm.json are written, from a table.')
    assert json.loads((tmp_path / 'states/arm.json').read_text())['made'].startswith('Identified')
    export_to(tmp_path / 'states', 'arm', URDF, estimate)
    (tmp_path / 'states/arm.json').write_text('{}')
    before = (tmp_path / 'states/arm.urdf').read_text()
    with pytest.raises(SemiparamError, match=r'arm\.json is no export, so it is not replaced'):
        export_to(tmp_path / 'states', 'arm', URDF.replace('<robot', '<robot '), estimate)
    assert (tmp_path / 'states/arm.urdf').read_text() == before
    (tmp_path / 'states/link.urdf').symlink_to(tmp_path / 'else')
    with pytest.raises(SemiparamError, match=r'link\.urdf is a link, which is not followed'):
        export_to(tmp_path / 'states', 'link', URDF, estimate)


def test_where_no_file_can_be_a_node_says_so(estimate, tmp_path):
    """It was an internal error, or a pipe was waited for."""
    (tmp_path / 'arm.json').mkdir()
    os.mkfifo(tmp_path / 'pipe.urdf')
    for name in ('arm', 'pipe'):
        with pytest.raises(SemiparamError, match=rf'{name}\.(urdf|json) is no export, so it is not replaced'):
            export_to(tmp_path, name, URDF, estimate)
    (tmp_path / 'file').touch()
    with pytest.raises(SemiparamError, match=r'there is no folder .*file/states and none can be made: Not a directory'):
        export_to(tmp_path / 'file' / 'states', 'arm', URDF, estimate)
