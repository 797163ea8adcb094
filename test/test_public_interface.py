"""What `import semiparam_ros` offers to Python programs, and what it costs."""

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import semiparam_ros
from semiparam_ros.settings import dump_params


def loaded_modules(code: str) -> set[str]:
    """Names of every module that a new process has loaded after running the code."""
    program = f'{code}\nimport sys\nprint(*sys.modules, sep="\\n")'
    return set(subprocess.run([sys.executable, '-c', program], capture_output=True, text=True,
                              check=True).stdout.split())


def top_level(modules: set[str]) -> set[str]:
    return {name.partition('.')[0] for name in modules}


def test_importing_the_package_loads_nothing_else():
    assert not top_level(loaded_modules('import semiparam_ros')) & {'numpy', 'scipy', 'pinocchio', 'yaml', 'rclpy'}


def test_no_public_name_needs_ros():
    modules = top_level(loaded_modules('from semiparam_ros import *'))
    assert {'numpy', 'pinocchio'} <= modules
    assert not modules & {'rclpy', 'sensor_msgs', 'matplotlib', 'rich'}


def test_who_plays_records_or_converts_waits_for_no_numerics():
    modules = top_level(loaded_modules('import semiparam_ros.ros.replay.session, semiparam_ros.ros.record.session, '
                                       'semiparam_ros.cli.convert, semiparam_ros.bags.text_tables'))
    assert {'rclpy', 'mcap'} <= modules
    assert not modules & {'numba', 'scipy', 'pinocchio'}


@pytest.mark.parametrize('name', semiparam_ros.__all__)
def test_every_public_name_is_there_and_explained(name):
    value = getattr(semiparam_ros, name)
    assert name in dir(semiparam_ros)
    if name != '__version__':
        assert value.__name__ == name and value.__doc__


def test_type_checkers_see_every_name_where_it_is_loaded_from():
    tree = ast.parse(Path(semiparam_ros.__file__).read_text(encoding='utf-8'))
    seen = {alias.name: node.module for guard in tree.body if isinstance(guard, ast.If)
            for node in guard.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert seen == semiparam_ros._MODULES
    assert {*seen, 'SemiparamError', '__version__'} == set(semiparam_ros.__all__)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'semiparam_ros' has no attribute 'Estimater'"):
        _ = semiparam_ros.Estimater


def test_the_example_of_the_package_learns_the_bundled_recording(repository, tmp_path, monkeypatch):
    example = semiparam_ros.__doc__.partition('::\n\n')[2]
    code = '\n'.join(line.removeprefix('    ') for line in example.splitlines())
    settings = semiparam_ros.load_params(repository / 'config/icub_right_arm.yaml')
    dump_params(settings.changed({'variant': 'P'}), tmp_path / 'estimator.yaml')
    (tmp_path / 'recording.mcap').symlink_to(repository / 'bags/icub_xy.mcap')
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(code, names)
    assert names['prediction'].ready and np.isfinite(names['prediction'].mean).all()
