"""Fixtures for every test: the measured recordings, and a DDS domain of one's own."""

import fcntl
import gc
import os
from contextlib import ExitStack
from pathlib import Path
from unittest.mock import patch

# One linear algebra thread, set before numpy is loaded: two workers on two cores must not fight.
os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import hypothesis
import pytest

from semiparam_ros.core.signals.smoothing import _SmoothingProblem
from support.browser import browse, unavailable  # noqa: F401  (fixtures)
from support.command_fixtures import params, recording  # noqa: F401  (fixtures)
from support.commands import semiparam
from support.estimates import Estimates, remembered
from support.mcap_core import node_modules  # noqa: F401  (fixtures)

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED_DATA = REPOSITORY.parent / 'shared' / 'data'
ICUB = '''
estimator:
  ros__parameters:
    joints: [r_shoulder_pitch, r_shoulder_roll, r_shoulder_yaw, r_elbow]
    sensor_frame: r_arm_ft_sensor
    wrench_convention: reaction
    variant: P
    robot_description_file: {urdf}
'''
UR3_JOINTS = ('Base=shoulder_pan_joint,Shoulder=shoulder_lift_joint,Elbow=elbow_joint,Wrist 1=wrist_1_joint,'
              'Wrist 2=wrist_2_joint,Wrist 3=wrist_3_joint')

# A busy machine is no failure: the search is bounded by the number of examples, not by the clock. The examples are the
# same ones each time, so that what fails once fails again; the long form looks for new ones.
hypothesis.settings.register_profile('steady', deadline=None, derandomize=True)
hypothesis.settings.register_profile('long', deadline=None, max_examples=2000)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption('--long', action='store_true',
                     help='every test in its long form, as `make test-long` does: hours. What it found is printed (-s)')


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    hypothesis.settings.load_profile('long' if config.getoption('--long') else 'steady')
    if config.getoption('--long'):
        config.option.timeout = config.option.timeout or 20_000.0


@pytest.fixture(scope='session')
def long(request: pytest.FixtureRequest) -> bool:
    """Whether the long form is asked for."""
    return bool(request.config.getoption('--long'))


@pytest.fixture(scope='session', autouse=True)
def searched_once():
    """Many tests give their models the same window, and diagnose the same motion: the hyperparameters of each are
    searched once in this process.

    That another search gives the same is tested where it says so.
    """
    with (patch('semiparam_ros.core.model.estimate', Estimates()),
          patch.object(_SmoothingProblem, 'best', remembered(_SmoothingProblem.best))):
        yield


@pytest.fixture(scope='module')
def motion_as_recorded():
    """Changes are named from the motion as it was recorded: to smooth it is most of the work, and tests of the naming
    itself do."""
    with patch('semiparam_ros.diagnosis.preparation.OPTIONS', ('recorded',)):
        yield


@pytest.fixture(scope='session', autouse=True)
def own_ros_home(tmp_path_factory):
    """States and logs of nodes that are given no folder: not the user's own, where another node may be at work."""
    with patch.dict(os.environ, ROS_HOME=str(tmp_path_factory.mktemp('ros_home'))):
        yield


@pytest.fixture(scope='session')
def repository() -> Path:
    """The checkout that is being tested."""
    return REPOSITORY


@pytest.fixture(scope='session')
def shared_data() -> Path:
    """Folder of the measured recordings, which are not redistributed; where CI=true they must be there."""
    if SHARED_DATA.is_dir():
        return SHARED_DATA
    unavailable(f'the measured recordings are not beside the checkout: {SHARED_DATA} is missing')


@pytest.fixture
def ros_domain(tmp_path, monkeypatch):
    """A ROS_DOMAIN_ID that no other test uses at this moment, on loopback alone."""
    with _free_domain() as domain:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
        monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'ros_log'))
        yield domain


@pytest.fixture(scope='module')
def module_domain(tmp_path_factory):
    """The same for all tests of a module."""
    patch = pytest.MonkeyPatch()
    with _free_domain() as domain:
        patch.setenv('ROS_DOMAIN_ID', str(domain))
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        patch.setenv('ROS_LOG_DIR', str(tmp_path_factory.mktemp('ros_log')))
        yield domain
    patch.undo()


@pytest.fixture
def start_node(tmp_path, ros_domain):
    """A function of settings: starts a node, and a client that hears it; returns both, which end with the test."""
    from semiparam_ros.settings import dump_params
    from support.node_client import Client, NodeProcess

    with ExitStack() as opened:
        def start(settings):
            dump_params(settings, tmp_path / 'p.yaml')
            node = opened.enter_context(NodeProcess(tmp_path, tmp_path / 'p.yaml'))
            client = opened.enter_context(Client())
            client.connect(settings.outputs)
            return node, client

        yield start


def pytest_collection_finish() -> None:
    """Keep the collector of garbage from what is loaded for good."""
    gc.collect()
    gc.freeze()


class _free_domain:
    """Holds a lock file for a free domain, so that parallel workers and other checkouts keep apart.

    It is the one that was left longest ago: who was killed there is still taken for alive by the others for 20 s.
    """

    # Above 101 a domain's ports reach into the range that the kernel gives to outgoing connections.
    DOMAINS = range(60, 102)

    def __enter__(self) -> int:
        folder = Path('/tmp/semiparam_ros_test_domains')
        folder.mkdir(exist_ok=True)
        for path in sorted((folder / str(domain) for domain in self.DOMAINS), key=_last_used):
            self.lock = path.open('w')
            try:
                fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return int(path.name)
            except BlockingIOError:
                self.lock.close()
        raise RuntimeError('no free ROS domain: more than forty tests are running')

    def __exit__(self, *_: object) -> None:
        os.utime(self.lock.name)
        self.lock.close()


def _last_used(path: Path) -> float:
    return path.stat().st_mtime if path.exists() else 0.0


@pytest.fixture(scope='session')
def measured_icub(shared_data, repository, tmp_path_factory) -> Path:
    """A folder with both tables of the measured iCub arm, `train.mcap` and `test.mcap`, and its `icub.yaml`."""
    folder, source = tmp_path_factory.mktemp('icub'), shared_data / 'icub_arm'
    for name in ('train', 'test'):
        assert semiparam('convert', source / f'icubdyn_{name}.dat', folder / f'{name}.mcap',
                         '--columns', repository / 'config/icub_table.yaml') == 0
    (folder / 'icub.yaml').write_text(ICUB.format(urdf=source / 'iCubGenova01.urdf'))
    return folder


@pytest.fixture(scope='session')
def measured_ur3(shared_data, tmp_path_factory) -> Path:
    """A folder with the two recordings of the measured UR3 arm, `id1.mcap` and `id2.mcap`, its description in each."""
    folder, source = tmp_path_factory.mktemp('ur3'), shared_data / 'ur3_arm'
    for name in ('id1', 'id2'):
        assert semiparam('convert', source / f'{name}.bag', folder / f'{name}.mcap', '--topic', '/arm=/joint_states',
                         '--joint', UR3_JOINTS, '--effort-sign', -1, '--robot-description', source / 'ur3.urdf') == 0
    return folder


LONGEST = ('test_docs.py', 'test_diagnosis.py', 'test_outside_faults.py', 'test_node_switching.py',
           'test_matrix.py', 'test_setup_checks.py', 'test_replay.py', 'test_record.py',
           'test_other_simulator.py', 'test_compare.py', 'test_structure.py', 'test_node.py',
           'test_temperature_kinds.py', 'test_estimator.py', 'test_learner.py', 'test_node_fuzz.py',
           'test_state_file.py', 'test_identified.py', 'test_rounds.py', 'test_carries_over.py',
           'test_node_diagnosis.py', 'test_packaging.py', 'test_diagnosis_page.py', 'test_node_temperature.py',
           'test_node_change.py', 'test_outside_client.py', 'test_evaluate.py', 'test_checkpoints.py',
           'test_examples.py', 'test_spans.py', 'test_new_kinds.py')
"""Files of a quarter of a minute and more, by what they took."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests of live nodes, and put these files and those with slow tests first: begun last, one of them would
    keep one worker busy while the others have nothing."""
    for item in items:
        if {'ros_domain', 'module_domain'} & set(getattr(item, 'fixturenames', ())):
            item.add_marker(pytest.mark.live)
    if not config.getoption('--long'):
        items[:] = [item for item in items if not item.get_closest_marker('long')]
    slow = {item.path for item in items if item.get_closest_marker('slow')}
    first = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: (first.get(item.path.name, len(LONGEST)), item.path not in slow))
