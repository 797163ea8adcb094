"""Exported descriptions of measured arms: a UR3, a Franka and the iCub."""

import numpy as np
import pinocchio as pin
import pytest

from semiparam_ros.bags.loading import load_samples
from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.robot.consistency import pseudo_inertia
from semiparam_ros.core.signals.smoothing import smoothed
from semiparam_ros.export.estimate import from_recording
from semiparam_ros.export.urdf import described_links
from semiparam_ros.settings import load_params
from semiparam_ros.settings.build import build_rigid_body
from support.commands import document, semiparam

pytestmark = pytest.mark.slow
EFFORTS = '/**:\n  ros__parameters:\n    outputs: effort\n'
FRANKA = ', '.join(f'panda_joint{number}' for number in range(1, 8))


@pytest.fixture(scope='module',
                params=['ur3', 'icub', pytest.param('franka', marks=pytest.mark.long)])
def exported(request, shared_data, measured_icub, measured_ur3, tmp_path_factory):
    """Parameters, recording, recording that judges, if there is one, URDF text and document."""
    folder, source = tmp_path_factory.mktemp(request.param), shared_data / 'panda_arm'
    (folder / 'ur3.yaml').write_text(EFFORTS)
    (folder / 'franka.yaml').write_text(EFFORTS + f'    joints: [{FRANKA}]\n')
    params, recording, judge = {
        'ur3': (folder / 'ur3.yaml', measured_ur3 / 'id1.mcap', measured_ur3 / 'id2.mcap'),
        'icub': tuple(measured_icub / name for name in ('icub.yaml', 'train.mcap', 'test.mcap')),
        'franka': (folder / 'franka.yaml', folder / 'panda.mcap', None)}[request.param]
    if request.param == 'franka':
        assert semiparam('convert', source / 'panda_exciting_trajectory.db3', recording, '--joint',
                         'fer_*=panda_*', '--robot-description', source / 'panda.urdf') == 0
    found = document(folder / 'x.json', 'export', recording, '--params', params,
                     '--urdf', folder / 'x.urdf')
    return params, recording, judge, (folder / 'x.urdf').read_text(), found


def test_every_link_that_was_looked_for_can_be(exported):
    *_, urdf, found = exported
    links = described_links(urdf)
    for name in found['links']:
        assert np.linalg.eigvalsh(pseudo_inertia(links[name])).min() > 0.0, name


def test_pinocchio_reads_it(exported):
    *_, urdf, found = exported
    model = pin.buildModelFromXML(urdf)
    assert all(model.existBodyName(name) for name in found['links'])


def test_mujoco_reads_it(exported):
    mujoco = pytest.importorskip('mujoco', reason='MuJoCo is not installed')
    from semiparam_ros.export.mjcf import without_geometry

    *_, urdf, found = exported
    model = mujoco.MjModel.from_xml_string(without_geometry(urdf))
    for name, values in found['links'].items():
        assert model.body(name).mass[0] == pytest.approx(values['mass'], rel=1e-6)


def test_idyntree_reads_it(exported):
    idyn = pytest.importorskip('idyntree.bindings', reason='iDynTree is not installed')
    *_, urdf, found = exported
    loader = idyn.ModelLoader()
    assert loader.loadModelFromString(urdf)
    for name, values in found['links'].items():
        inertia = loader.model().getLink(loader.model().getLinkIndex(name)).getInertia()
        assert inertia.isPhysicallyConsistent(), name
        assert inertia.getMass() == pytest.approx(values['mass'], rel=1e-6)


def test_it_predicts_as_well_as_the_fit_without_constraints(exported):
    """Within 5 % on another recording, of the Franka on parts left out of the fit."""
    params, recording, judge, urdf, found = exported
    if judge is None:
        assert found['errors']['consistent'] < 1.05 * found['errors']['unconstrained']
        return
    settings = load_params(params)
    bag, other = load_samples(recording, settings), smoothed(load_samples(judge, settings).samples)
    body = build_rigid_body(settings, bag.robot_description)
    estimate = from_recording(body, [], bag.samples, True, False, 'it')
    identified = build_rigid_body(settings.changed({'robot_description_file': '', 'robot_description': urdf}))
    columns = CoupledColumns(body, (), True, physical=True).batch(other)[0]
    rest = slice(body.n_parameters, None)
    beside = estimate.mean[rest] - np.linalg.solve(
        estimate.information[rest, rest], estimate.information[rest, :body.n_parameters]
        @ (identified.base_parameters - estimate.mean[:rest.start]))
    errors = [np.mean(np.mean((other.outputs - columns @ theta) ** 2, axis=0) / other.outputs.var(axis=0))
              for theta in (estimate.mean, np.concatenate([identified.base_parameters, beside]))]
    assert errors[1] < 1.05 * errors[0]
