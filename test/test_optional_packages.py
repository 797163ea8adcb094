"""Without rosbags, or without any package that only pip installs, whatever needs none of them still works."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

from semiparam_ros.bags import schemas

BLOCK = '''
import sys

class Absent:
    """An import finder that hides installed packages."""

    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in {hidden}:
            raise ModuleNotFoundError(f'No module named {{name!r}}', name=name.partition('.')[0])

sys.meta_path.insert(0, Absent())
'''
PIP_ALONE = ('mcap', 'mcap_ros2', 'rosbags')


def without(hidden: tuple[str, ...], code: str, *arguments: object) -> subprocess.CompletedProcess:
    """Run code in a new process that finds none of the ``hidden`` packages."""
    return subprocess.run([sys.executable, '-c', BLOCK.format(hidden=hidden) + code, *map(str, arguments)],
                          capture_output=True, text=True, check=False)


def semiparam(hidden: tuple[str, ...], *arguments: object) -> subprocess.CompletedProcess:
    return without(hidden, 'from semiparam_ros.cli.main import main\nsys.exit(main())', *arguments)


@pytest.fixture
def sqlite_bag(tmp_path) -> Path:
    with Rosbag2Writer(tmp_path / 'sqlite', version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        writer.add_connection('/text', 'std_msgs/msg/String', typestore=get_typestore(Stores.ROS2_JAZZY))
    return tmp_path / 'sqlite'


@pytest.fixture
def ros1_bag(tmp_path) -> Path:
    with Rosbag1Writer(tmp_path / 'old.bag') as writer:
        writer.add_connection('/text', 'std_msgs/msg/String', typestore=get_typestore(Stores.ROS1_NOETIC))
    return tmp_path / 'old.bag'


@pytest.mark.parametrize('bag, kind', [('sqlite_bag', 'rosbag2 bag'), ('ros1_bag', 'ROS 1 bag')])
def test_a_bag_that_only_rosbags_reads_is_refused_with_one_sentence(bag, kind, request, repository):
    path = request.getfixturevalue(bag)
    result = semiparam(('rosbags',), 'evaluate', path, '--params', repository / 'config/icub_right_arm.yaml')
    assert (result.returncode, result.stdout) == (2, '')
    assert result.stderr == (f"semiparam: {str(path)!r} is a {kind} that only the Python package 'rosbags' reads, "
                             'which is not installed: pip install rosbags.\n')


def test_mcap_is_read_and_written_without_rosbags(repository, tmp_path):
    code = '''
from semiparam_ros.bags.reader import open_bag
from semiparam_ros.bags.writer import BagWriter
with open_bag(sys.argv[1]) as bag, BagWriter(sys.argv[2]) as copy:
    for message in bag.messages():
        copy.write(message.topic, message.type, message.data, message.log_time)
print(bag.message_count)
'''
    source, copy = repository / 'bags/icub_xy.mcap', tmp_path / 'copy.mcap'
    result = without(('rosbags',), code, source, copy)
    assert result.returncode == 0, result.stderr
    with AnyReader([copy], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        assert reader.message_count == int(result.stdout)


def test_the_node_loads_without_the_packages_that_only_pip_installs():
    result = without(PIP_ALONE, 'import semiparam_ros.ros.estimator.node')
    assert result.returncode == 0, result.stderr


def test_a_command_names_the_package_that_it_lacks(repository):
    result = semiparam(PIP_ALONE, 'evaluate', repository / 'bags/icub_xy.mcap', '--params',
                       repository / 'config/icub_right_arm.yaml')
    assert (result.returncode, result.stdout) == (2, '')
    assert result.stderr == ("semiparam: this command needs the Python package 'mcap-ros2-support', which is not "
                             'installed: pip install mcap-ros2-support.\n')


def test_the_peers_name_the_package_that_they_lack():
    result = semiparam(('river',), 'bench', '--peers')
    assert (result.returncode, result.stdout) == (2, '')
    assert result.stderr == ("semiparam: this command needs the Python package 'river', which is not installed: "
                             'pip install river.\n')


def test_a_missing_module_of_our_own_is_an_internal_error(repository):
    code = "from semiparam_ros.cli.main import main\nsys.modules['semiparam_ros.cli.evaluate'] = None\nsys.exit(main())"
    result = without((), code, 'evaluate', repository / 'bags/icub_xy.mcap')
    assert result.returncode == 1 and 'internal error' in result.stderr


def jazzy_types_of_rosbags() -> dict[str, dict[str, str]]:
    store = get_typestore(Stores.ROS2_JAZZY)
    return {name: {'definition': store.generate_msgdef(name, ros_version=2)[0], 'hash': store.hash_rihs01(name)}
            for name in sorted(store.fielddefs)}


def test_the_bundled_definitions_are_those_of_jazzy():
    """An independent source of the same definitions; run this file as a program to write them anew."""
    assert {name: each._asdict() for name, each in schemas.jazzy_types().items()} == jazzy_types_of_rosbags()


if __name__ == '__main__':
    Path(schemas.__file__).with_name('jazzy_types.json').write_text(
        json.dumps(jazzy_types_of_rosbags(), indent=1) + '\n', encoding='utf-8')
