"""The same tree installs with pip and builds with colcon, and says the same of itself everywhere."""

import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import xml.etree.ElementTree as ElementTree
import zipfile
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import yaml

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

import semiparam_ros
from semiparam_ros.cli.main import COMMANDS

REPOSITORY = Path(__file__).resolve().parents[1]
PROGRAMS = ('semiparam', 'estimator', 'bag_replay')
SKIPPED = ('.*', '__pycache__', '*.egg-info', 'build', '_build', 'install', 'log', 'output')
"""Hidden files, and what tools leave behind."""

# rosdep's name for each Python package; None where rosdep has none, or only one that installs with pip, on which a
# package that is released into a ROS distribution must not depend.
ROSDEP = {
    'ros-jazzy-rclpy': ('rclpy', 'rmw_fastrtps_cpp'),
    'ros-jazzy-common-interfaces': ('sensor_msgs', 'geometry_msgs', 'std_msgs', 'std_srvs', 'trajectory_msgs',
                                    'diagnostic_msgs'),
    'numpy': 'python3-numpy',
    'scipy': 'python3-scipy', 'numba': 'python3-numba', 'scikit-learn': 'python3-sklearn',
    'pin': 'pinocchio',
    'mcap': None,  # pip alone
    'zstandard': None,  # comes with mcap
    'lz4': None,  # comes with mcap
    'mcap-ros2-support': None,  # pip alone
    'rosbags': None,  # pip alone
    'river': None,  # pip alone; its tests skip without it
    'rich': 'python3-rich',
    'matplotlib': 'python3-matplotlib',
    'joblib': 'python3-joblib',
    'pyyaml': 'python3-yaml',
    'jinja2': 'python3-jinja2',
    'markupsafe': None,  # comes with jinja2
    'markdown-it-py': None,  # comes with rich
    'pytest': 'python3-pytest',
    'pytest-xdist': 'python3-pytest-xdist',
    'pytest-timeout': 'python3-pytest-timeout',
    'hypothesis': 'python3-hypothesis',
    'pytest-cov': None,  # `make coverage` alone
    'ruff': None,  # pip alone
    'mypy': 'python3-mypy',
    'types-pyyaml': 'python3-types-pyyaml',
    'idyntree': None,  # not released into Jazzy: its tests skip there
    'mujoco': None,  # likewise
    'covertable': None,  # likewise
    'cyclonedds': None,  # Jazzy has the C library alone; its tests skip without the wheel
    'colcon-common-extensions': 'python3-colcon-common-extensions',
    'setuptools': 'python3-setuptools',
    'tomli': None,  # Jazzy's Python reads TOML itself
}


def declared() -> dict[str, list[str]]:
    """The dependencies under '', and the extras by name, as pyproject.toml states them."""
    project = pyproject()['project']
    return {'': project['dependencies'], **project['optional-dependencies']}


def pyproject() -> dict:
    return tomllib.loads((REPOSITORY / 'pyproject.toml').read_text())


def plain(requirement: str) -> str:
    """The package's name without its extras and versions."""
    return re.match(r'[\w.-]+', requirement)[0].lower()


def manifest() -> ElementTree.Element:
    return ElementTree.parse(REPOSITORY / 'package.xml').getroot()


def keys(*tags: str) -> set[str]:
    return {element.text for tag in tags for element in manifest().findall(tag)}


def wanted_keys(requirements: list[str]) -> set[str]:
    found = [ROSDEP[plain(requirement)] for requirement in requirements if plain(requirement) != 'semiparam_ros']
    return {key for entry in found if entry for key in ([entry] if isinstance(entry, str) else entry)}


def test_package_xml_declares_what_pyproject_requires():
    assert wanted_keys(declared()['']) <= keys('exec_depend')
    assert wanted_keys(declared()['test']) <= keys('exec_depend', 'test_depend')


def test_package_xml_declares_no_python_package_that_pyproject_lacks():
    python = {key for key in keys('exec_depend', 'test_depend') if key.startswith('python3-')}
    assert python <= wanted_keys([*declared()[''], *declared()['test']])


def test_package_xml_depends_on_no_key_that_installs_with_pip():
    every = {element.text for element in manifest() if element.tag.endswith('depend')}
    assert not [key for key in every if key.endswith('-pip') or key == 'mcap-ros2-support']


def test_every_dependency_has_a_lower_bound():
    """An old numpy would otherwise let pip choose pin 2.7, with which nothing works."""
    extras = ('', 'rosbags', 'dask', 'peers', 'mujoco')
    unbounded = [each for extra in extras for each in declared()[extra] if '>=' not in each]
    assert unbounded == []


def test_the_installation_page_asks_for_the_declared_versions():
    page = (REPOSITORY / 'docs/how-to/install.md').read_text()
    named = re.findall(r"'([\w-]+>=[^']+)'", page)
    assert named and set(named) <= {*declared()[''], *declared()['rosbags']}


def test_the_address_of_the_repository_stands_on_one_line_of_the_installation_page():
    """A fork changes package.xml and that line."""
    address = next(url.text for url in manifest().findall('url') if url.get('type') == 'repository')
    page = (REPOSITORY / 'docs/how-to/install.md').read_text()
    assert page.count(f'export SEMIPARAM_REPOSITORY={address}\n') == page.count(address) == 1
    assert 'git clone "$SEMIPARAM_REPOSITORY"' in page and 'git clone <' not in page


def test_analyzers_group_every_status_of_the_node_once():
    """They are those of the reference, which a test of the live node compares with what it says."""
    page = (REPOSITORY / 'docs/ros_interface.md').read_text()
    table = page.split('\n## Diagnostics\n')[1].split('\n\n')[1]
    titles = re.findall(r'^\| (\w+) \|', table, re.MULTILINE)[1:]
    document = yaml.safe_load((REPOSITORY / 'config/analyzers.yaml').read_text())
    groups = document['analyzers']['ros__parameters'].values()
    grouped = [name for group in groups if isinstance(group, dict) for name in group['contains']]
    assert sorted(grouped) == sorted(f'estimator: {title}' for title in titles)


def test_rosdoc2_builds_the_pages_of_make_docs():
    _, config = yaml.safe_load_all((REPOSITORY / 'rosdoc2.yaml').read_text())
    assert manifest().findtext('export/rosdoc2') == 'rosdoc2.yaml'
    assert (REPOSITORY / config['builders'][0]['sphinx']['sphinx_sourcedir'] / 'conf.py').is_file()


def test_versions_and_licence_agree():
    assert manifest().findtext('version') == semiparam_ros.__version__
    assert f'\n{semiparam_ros.__version__} ' in (REPOSITORY / 'CHANGELOG.rst').read_text()
    assert f'\nversion: {semiparam_ros.__version__}\n' in (REPOSITORY / 'CITATION.cff').read_text()
    assert manifest().findtext('license') == 'Apache-2.0'
    assert 'Apache License' in (REPOSITORY / 'LICENSE').read_text()[:200]


@pytest.mark.parametrize('folder, extras', [('semiparam_ros', ['', 'rosbags', 'dask', 'peers', 'mujoco']),
                                            ('test', ['', 'rosbags', 'test', 'dask', 'peers', 'mujoco'])])
def test_every_import_is_declared(folder, extras):
    """Each distribution that is imported is in pyproject.toml, or is what ros-jazzy-... stands for."""
    sources = list((REPOSITORY / folder).rglob('*.py'))
    imported = {name.split('.')[0] for path in sources for name in imports(path)}
    outside = imported - {'semiparam_ros', *sys.stdlib_module_names, 'support', 'live_benchmark',
                          *(path.stem for path in sources)}
    mentioned = {plain(requirement) for extra in extras for requirement in declared()[extra]}
    installed = packages_distributions()
    owners = {name: {owner.lower() for owner in installed.get(name, [name])} for name in outside}
    undeclared = {name for name, found in owners.items()
                  if not found & mentioned and not from_ros(name) and name not in optional()}
    assert undeclared == set()


def imports(path: Path) -> set[str]:
    tree = list(ast.walk(ast.parse(path.read_text(encoding='utf-8'))))
    plainly = {alias.name for node in tree if isinstance(node, ast.Import) for alias in node.names}
    return plainly | {node.module for node in tree if isinstance(node, ast.ImportFrom)}


def from_ros(name: str) -> bool:
    """rclpy and the message packages, which package.xml names one by one."""
    return name in keys('exec_depend', 'test_depend')


def optional() -> set[str]:
    """Modules of the extra `dask`, absent unless asked for, and of a ROS 2 installation."""
    return {'distributed', 'dask', 'launch_ros'}


@pytest.mark.slow
def test_the_distributions_hold_every_file(tmp_path):
    """The wheel holds the whole package, and the source distribution whatever a clone holds."""
    source = copy_sources(tmp_path / 'source')
    files = {str(path.relative_to(source)) for path in source.rglob('*') if path.is_file()}
    for build in ('build_sdist', 'build_wheel'):
        run(sys.executable, '-c', f'from setuptools.build_meta import {build}; {build}({str(tmp_path)!r})', cwd=source)
    with tarfile.open(next(tmp_path.glob('*.tar.gz'))) as archive:
        assert files - {name.partition('/')[2] for name in archive.getnames()} == set()
    with zipfile.ZipFile(next(tmp_path.glob('*.whl'))) as archive:
        assert {name for name in files if name.startswith('semiparam_ros/')} - set(archive.namelist()) == set()


def copy_sources(target: Path) -> Path:
    """A clean copy of what the package is built from: building in place would leave traces in the checkout."""
    return shutil.copytree(REPOSITORY, target, symlinks=True, ignore=shutil.ignore_patterns(*SKIPPED))


def run(*command: object, **options) -> str:
    result = subprocess.run([str(word) for word in command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                            text=True, timeout=200, check=False, **options)
    assert result.returncode == 0, f'{command}\n{result.stdout}'
    return result.stdout


@pytest.fixture(scope='module')
def prefix(tmp_path_factory) -> Path:
    """A new venv into which `pip install .` put the package; its dependencies are this environment's."""
    folder = tmp_path_factory.mktemp('pip')
    source = copy_sources(folder / 'source')
    target = folder / 'venv'
    run(sys.executable, '-m', 'venv', '--without-pip', target)
    packages = next((target / 'lib').glob('python*')) / 'site-packages'
    # A plain line adds the folder without reading its .pth files, and so without the checkout installed there.
    (packages / 'dependencies.pth').write_text(sysconfig.get_path('purelib') + '\n')
    run(sys.executable, '-m', 'pip', '--python', target / 'bin/python', 'install', '--no-deps', '--no-build-isolation',
        '--disable-pip-version-check', source, cwd=folder)
    return target


@pytest.mark.slow
def test_pip_puts_the_programs_into_bin(prefix):
    for program in PROGRAMS:
        assert 'usage:' in run(prefix / 'bin' / program, '--help', env=environment())
    assert not {path.name for path in (prefix / 'bin').iterdir()} & set(COMMANDS), 'they would hide other programs'


@pytest.mark.slow
def test_pip_installs_its_own_copy_with_the_data(prefix):
    where = run(prefix / 'bin/python', '-c', 'import semiparam_ros; print(semiparam_ros.__file__)', cwd=prefix,
                env=environment())
    assert Path(where.strip()).is_relative_to(prefix)
    told = 'from importlib.metadata import metadata as m; m = m("semiparam_ros")\nprint(m["Version"], m["License"])'
    assert run(prefix / 'bin/python', '-c', told, cwd=prefix, env=environment()).split() == [
        semiparam_ros.__version__, 'Apache-2.0']
    share = prefix / 'share/semiparam_ros'
    for folder in ('config', 'launch', 'bags'):
        shipped = {path.name for path in (REPOSITORY / folder).rglob('*') if path.is_file() and path.suffix != '.pyc'}
        installed = {path.name for path in (share / folder).rglob('*') if path.is_file() and path.suffix != '.pyc'}
        assert installed == shipped
    assert (prefix / 'share/ament_index/resource_index/packages/semiparam_ros').is_file()
    assert (Path(where.strip()).parent / 'py.typed').is_file()


@pytest.fixture(scope='module', params=['copied', pytest.param('symlinked', marks=pytest.mark.long)])
def workspace(request, tmp_path_factory) -> Path:
    """A colcon workspace with the package in it, built."""
    folder = tmp_path_factory.mktemp('colcon')
    copy_sources(folder / 'src/semiparam_ros')
    options = ['--symlink-install'] if request.param == 'symlinked' else []
    run(Path(sys.executable).with_name('colcon'), 'build', '--event-handlers', 'console_cohesion+', *options,
        cwd=folder, env=environment())
    return folder


def environment() -> dict[str, str]:
    """What a user has after activating the environment. Each new copy would be compiled anew, a quarter of a minute."""
    return {**os.environ, 'PATH': f'{Path(sys.executable).parent}:{os.environ["PATH"]}', 'PYTHONPATH': '',
            'NUMBA_DISABLE_JIT': '1'}


@pytest.mark.slow
def test_make_says_what_it_installs_and_about_how_long_before_it_begins(tmp_path):
    said = subprocess.run(['make', '--dry-run', f'VENV={tmp_path / "none"}', 'demo'], cwd=REPOSITORY, text=True,
                          capture_output=True, check=True).stdout
    assert 'from the package index' in said and said.index('takes two to five minutes') < said.index('-m venv')


def test_colcon_makes_every_command_reachable_by_ros2_run(workspace):
    programs = workspace / 'install/semiparam_ros/lib/semiparam_ros'
    assert {path.name for path in programs.iterdir()} == {*PROGRAMS, *COMMANDS}
    assert all(os.access(path, os.X_OK) for path in programs.iterdir())
    for program in ('semiparam', 'estimator', 'bag_replay', 'evaluate'):
        script = f'. install/setup.sh && {programs / program} --help'
        assert f'usage: {"semiparam evaluate" if program == "evaluate" else program}' in run(
            'sh', '-c', script, cwd=workspace, env=environment())


@pytest.mark.slow
def test_colcon_installs_what_ros_looks_for(workspace):
    install = workspace / 'install/semiparam_ros'
    assert (install / 'share/ament_index/resource_index/packages/semiparam_ros').is_file()
    assert (install / 'share/semiparam_ros/package.xml').is_file()
    assert (install / 'share/semiparam_ros/launch/estimator.launch.py').is_file()
    found = run('sh', '-c', '. install/setup.sh && python -c "import semiparam_ros; print(semiparam_ros.__file__)"',
                cwd=workspace, env=environment())
    assert Path(found.strip()).resolve().is_relative_to(workspace.resolve())


LAUNCH_FILES = sorted((REPOSITORY / 'launch').glob('*.launch.py'))


@pytest.mark.parametrize('path', LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_files_start_programs_that_exist(path):
    """`launch` is no wheel, so that only what a launch file names can be checked everywhere."""
    calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    nodes = [{word.arg: word.value for word in call.keywords} for call in calls
             if isinstance(call.func, ast.Name) and call.func.id == 'Node']
    started = {(node['package'].value, node['executable'].value) for node in nodes}
    assert started or 'estimator.launch.py' in path.read_text()
    assert {package for package, _ in started} <= {'semiparam_ros', *keys('exec_depend')}
    assert {program for package, program in started if package == 'semiparam_ros'} <= set(PROGRAMS)


@pytest.mark.parametrize('path', LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_files_name_files_that_are_shipped(path):
    words = [node.value for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Constant)]
    files = re.compile(r'[\w.]+\.(yaml|mcap|urdf|launch\.py)')
    named = [word for word in words if isinstance(word, str) and files.fullmatch(word)]
    assert named
    for name in named:
        assert any((REPOSITORY / folder / name).is_file() for folder in ('config', 'bags', 'launch')), name


@pytest.mark.parametrize('path', LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_files_describe_something_to_the_real_launch(path):
    pytest.importorskip('launch_ros', reason='launch and launch_ros come with a ROS 2 installation, not from PyPI')
    namespace: dict = {}
    exec(compile(path.read_text(), str(path), 'exec'), namespace)
    assert namespace['generate_launch_description']().entities


@pytest.mark.slow
def test_colcon_test_runs_the_tests(workspace):
    """One test of the suite, found and run by colcon in the workspace's own copy, without its reports of coverage."""
    colcon = Path(sys.executable).with_name('colcon')
    run(colcon, 'test', '--pytest-args', 'test/test_packaging.py', '-k', 'test_versions', '--no-cov', cwd=workspace,
        env=environment())
    assert 'Summary: 1 test, 0 errors, 0 failures, 0 skipped' in run(
        colcon, 'test-result', '--all', cwd=workspace, env=environment())


def test_the_description_of_a_robot_may_lie_in_a_folder_with_a_blank():
    """`launch` splits the text of a Command as a shell does, and cat looked for two files."""
    tree = ast.parse((REPOSITORY / 'launch' / 'robot.launch.py').read_text())
    calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call))
    command = next(call for call in calls if ast.unparse(call.func) == 'Command')
    parts = [part.value if isinstance(part, ast.Constant) else '/my robots/arm.urdf' for part in command.args[0].elts]
    assert shlex.split(''.join(parts)) == ['cat', '/my robots/arm.urdf']
