"""Message classes by the name that bags and the ROS graph give them."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

from semiparam_ros.errors import SemiparamError


@cache
def message_class(type_name: str) -> Any:
    """The Python class of e.g. ``sensor_msgs/msg/JointState``.

    Raises SemiparamError when the name is malformed or the package that defines it is not installed.
    """
    parts = type_name.split('/')
    if len(parts) != 3 or parts[1] != 'msg':
        raise SemiparamError(f"'{type_name}' is not the name of a message type: expected package/msg/Name.")
    try:
        return getattr(import_module(f'{parts[0]}.msg'), parts[2])
    except (ImportError, AttributeError):
        raise SemiparamError(f"the message type '{type_name}' is not installed: expected the package "
                             f"'{parts[0]}' of this ROS distribution.") from None


def is_installed(type_name: str) -> bool:
    """Tell whether :func:`message_class` knows the type."""
    try:
        message_class(type_name)
    except SemiparamError:
        return False
    return True
