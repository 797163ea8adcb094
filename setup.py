"""What pyproject.toml cannot say: files beside the code, for `colcon build` (ament_python) and for pip alike."""

from pathlib import Path

from setuptools import setup

HERE = Path(__file__).parent
NAME = 'semiparam_ros'
SHARE = f'share/{NAME}'


def shared(folder: str) -> list:
    """(install folder, files) pairs for every file below one folder of the source tree."""
    found = sorted(path for path in (HERE / folder).rglob('*') if path.is_file() and path.suffix != '.pyc')
    files = [path.relative_to(HERE) for path in found]
    parents = sorted({path.parent for path in files})
    return [(f'{SHARE}/{parent}', [str(path) for path in files if path.parent == parent]) for parent in parents]


setup(
    license='Apache-2.0',
    python_requires='>=3.10',
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        # `colcon build --symlink-install` builds in a folder with this file, the package and what is named here.
        (SHARE, ['package.xml', 'pyproject.toml', 'README.md']),
        # What `ros2 run semiparam_ros evaluate` starts; kept out of bin, where names such as `convert` are taken.
        (f'lib/{NAME}', [str(path.relative_to(HERE)) for path in sorted((HERE / 'scripts').iterdir())]),
        *shared('config'),
        *shared('launch'),
        *shared('bags'),
    ],
)
