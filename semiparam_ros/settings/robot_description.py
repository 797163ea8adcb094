"""Robot description: where the URDF comes from, and which of its joints move."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from semiparam_ros.core.robot import urdf as urdf_tree
from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings.parameter_table import Table
from semiparam_ros.settings.text_file import read_text

PACKAGE_URI = 'package://'
SOURCE_TREE = Path(__file__).resolve().parents[2]


def robot_description(settings: Table, given: str | None = None) -> str:
    """URDF text: the file, else the parameter, else what was ``given`` (by the topic or the bag).

    Raises SemiparamError when there is none, or the file cannot be read.
    """
    if settings.robot_description_file:
        path = resolved(settings.robot_description_file)
        try:
            return read_text(path)
        except (OSError, ValueError) as error:  # of no UTF-8, or of a null character in the name
            reason = 'not UTF-8 text' if isinstance(error, UnicodeDecodeError) else \
                getattr(error, 'strerror', None) or error
            raise SemiparamError(f'robot_description_file: cannot read {path}: {reason}.') from error
    text = settings.robot_description or given
    if not text:
        raise SemiparamError('no robot description: expected the parameter robot_description_file, or a '
                             'robot_description as a parameter, on its topic or in the bag.')
    return text


def moving_joints(settings: Table, urdf: str) -> tuple[str, ...]:
    """The joints of the inputs, in order: the parameter, or all that the URDF lets move and nobody locks."""
    if settings.joints:
        return settings.joints
    types = urdf_tree.joint_types(urdf_tree.parse(urdf))
    joints = tuple(name for name, kind in types.items()
                   if kind in urdf_tree.MOVING and name not in settings.locked_joints_names)
    if not joints:
        raise SemiparamError('the robot description has no moving joint that is not locked; expected at least one.')
    return joints


def output_joints(settings: Table, joints: Sequence[str]) -> tuple[str, ...]:
    """Joints whose efforts are the outputs, in their order.

    Raises SemiparamError when one is named that is none of the joints.
    """
    urdf_tree.check_output_joints(joints, settings.output_joints)
    return tuple(name for name in joints if name in (settings.output_joints or joints))


def check_temperatures(settings: Table, joints: Sequence[str]) -> None:
    """Raise SemiparamError when ``temperatures`` names what is none of the joints, where efforts are predicted."""
    for name in settings.temperatures if settings.outputs == 'effort' else ():
        if name not in joints:
            raise SemiparamError(f"temperatures names '{name}'; expected some of the joints {', '.join(joints)}.")


def resolved(name: str) -> Path:
    """A path from ``package://PACKAGE/PATH``, or from a plain one (with ~).

    Raises SemiparamError for a package that is not installed, and for the home of a user who does not exist.
    """
    if not name.startswith(PACKAGE_URI):
        try:
            return Path(name).expanduser()
        except RuntimeError as error:
            raise SemiparamError(f"'{name}' cannot be found: {error}") from error
    package, _, inside = name.removeprefix(PACKAGE_URI).partition('/')
    candidates = [folder / inside for folder in _share_folders(package)]
    if not candidates:
        raise SemiparamError(f"'{name}' names the package '{package}', which is not in AMENT_PREFIX_PATH.")
    return next((path for path in candidates if path.exists()), candidates[0])


def _share_folders(package: str) -> list[Path]:
    """Folders of a package's files, installed by colcon or pip, or (ours) the source tree."""
    prefixes = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix]
    folders = [Path(prefix, 'share', package) for prefix in prefixes if prefix]
    found = [folder for folder in folders if folder.is_dir()]
    return [SOURCE_TREE, *found] if package == 'semiparam_ros' and (SOURCE_TREE / 'config').is_dir() else found
