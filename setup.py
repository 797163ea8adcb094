"""Build description, read by both `colcon build` (ament_python) and `pip install .`."""

import re
from pathlib import Path

from setuptools import find_packages, setup

HERE = Path(__file__).parent
NAME = 'semiparam_ros'
SHARE = f'share/{NAME}'

REQUIRES = [
    'ros-jazzy-rclpy[fastrtps]',
    'ros-jazzy-common-interfaces',
    'numpy',
    'scipy',
    'scikit-learn',
    'pin',
    'mcap',
    'mcap-ros2-support',
    'zstandard',
    'lz4',
    'rosbags',
    'rich',
    'matplotlib',
    'joblib',
    'pyyaml',
    'jinja2',
    'markupsafe',
]
EXTRAS = {
    'test': [
        'pytest',
        'pytest-xdist',
        'pytest-timeout',
        'hypothesis',
        'ruff',
        'mypy',
        'types-PyYAML',
        'idyntree',
        'mujoco',
        'cyclonedds',
        'colcon-common-extensions',
        'setuptools<80',
    ],
    'dask': ['distributed'],
}


def version() -> str:
    """The one place that states the version is the package's `__version__`."""
    text = (HERE / NAME / '__init__.py').read_text()
    return re.search(r"__version__ = '([^']+)'", text)[1]


def shared(folder: str) -> list:
    """(install folder, files) pairs for every file below one folder of the source tree."""
    found = sorted(path for path in (HERE / folder).rglob('*') if path.is_file() and path.suffix != '.pyc')
    files = [path.relative_to(HERE) for path in found]
    parents = sorted({path.parent for path in files})
    return [(f'{SHARE}/{parent}', [str(path) for path in files if path.parent == parent]) for parent in parents]


setup(
    name=NAME,
    version=version(),
    description="Learns a robot's inverse dynamics while it moves: online semi-parametric learning for ROS 2.",
    license='Apache-2.0',
    maintainer='semiparam_ros maintainers',
    maintainer_email='maintainers@users.noreply.semiparam-ros.example',
    python_requires='>=3.10',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={'': ['py.typed', '*.html', '*.j2', '*.css', '*.js', '*.json', '*.yaml', '*.urdf']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (SHARE, ['package.xml']),
        # What `ros2 run semiparam_ros evaluate` starts; kept out of bin, where names such as `convert` are taken.
        (f'lib/{NAME}', [str(path.relative_to(HERE)) for path in sorted((HERE / 'scripts').iterdir())]),
        *shared('config'),
        *shared('launch'),
        *shared('bags'),
    ],
    zip_safe=False,
    install_requires=REQUIRES,
    extras_require=EXTRAS,
    entry_points={
        'console_scripts': [
            'semiparam = semiparam_ros.cli.main:main',
            'estimator = semiparam_ros.cli.main:estimator',
            'bag_replay = semiparam_ros.cli.main:bag_replay',
        ],
        # Reserved for users: `name = module:Effect` here declares a kind of effect of their own.
        'semiparam_ros.effects': [],
    },
)
