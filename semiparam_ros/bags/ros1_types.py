"""Messages of ROS 1 as messages of ROS 2: their definitions, and the way from the one wire format to the other."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rosbags.convert.converter import STATIC_MSGTYPE_RENAMES, is_same_wireformat, migrate_bytes
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from semiparam_ros.bags import schemas
from semiparam_ros.bags.schemas import UNKNOWN, Schema


class Ros1Types:
    """The types of one bag. A type that Jazzy has too is migrated to it, others keep their own definition."""

    def __init__(self, definitions: dict[str, str]) -> None:
        """:param definitions: type name (in ROS 2 form) -> text, as the bag's connections hold them."""
        self._source = get_typestore(Stores.EMPTY)
        for type_name, text in definitions.items():
            self._source.register(get_types_from_msg(text, type_name))
        self._target = get_typestore(Stores.ROS2_JAZZY)
        self._target.register({name: self._source.fielddefs[name]
                               for name in self._source.fielddefs.keys() - self._target.fielddefs.keys()})
        self._cache: dict[str, object] = {}
        self._to_cdr: dict[str, Callable[[bytes], Any]] = {}

    def ros2_name(self, type_name: str) -> str:
        """Most names stay; a few types moved to another package."""
        return str(STATIC_MSGTYPE_RENAMES.get(type_name, type_name))

    def schema(self, type_name: str) -> Schema:
        """The definition of the type in ROS 2, UNKNOWN where there is none."""
        name = self.ros2_name(type_name)
        if schemas.is_jazzy_type(name):
            return schemas.jazzy_schema(name)
        try:
            return Schema('ros2msg', self._target.generate_msgdef(name, ros_version=2)[0])
        except Exception:  # a definition that cannot be told in ROS 2 leaves the topic without one
            return UNKNOWN

    def cdr(self, type_name: str, raw: bytes) -> bytes:
        """CDR of ROS 2 from the bytes of ROS 1."""
        if type_name not in self._to_cdr:
            self._to_cdr[type_name] = self._converter(type_name, self.ros2_name(type_name))
        return bytes(self._to_cdr[type_name](raw))

    def _converter(self, source: str, target: str) -> Callable[[bytes], Any]:
        """Byte by byte where the fields are the same (but for the header's ``seq``), else field by field."""
        if is_same_wireformat(self._source, self._target, source, target):
            return partial(self._target.ros1_to_cdr, typename=target)
        return partial(migrate_bytes, self._source, self._target, source, target, self._cache, src_is2=False,
                       dst_is2=True)
