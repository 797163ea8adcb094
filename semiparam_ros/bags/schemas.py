"""Message definitions of ROS 2 Jazzy by type name, and the CDR codec that they give.

``jazzy_types.json`` holds the definitions; ``mcap-ros2-support`` encodes and decodes for every kind of bag, so that
a message looks the same whichever file it came from.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from mcap_ros2._dynamic import _for_each_msgdef, generate_dynamic, serialize_dynamic

from semiparam_ros.errors import SemiparamError

Decoder = Callable[[bytes], Any]
Encoder = Callable[[Any], bytes]
Layout = tuple[tuple[str, tuple[str, ...]], ...]


class Schema(NamedTuple):
    """A message definition: ``encoding`` is 'ros2msg', 'ros2idl' or '' (unknown), ``text`` its full text."""

    encoding: str
    text: str


UNKNOWN = Schema('', '')


class JazzyType(NamedTuple):
    """The full definition of a type, those it is made of included, and its RIHS01 hash."""

    definition: str
    hash: str


@cache
def jazzy_types() -> dict[str, JazzyType]:
    """The message types of ROS 2 Jazzy by name."""
    text = Path(__file__).with_name('jazzy_types.json').read_text(encoding='utf-8')
    return {name: JazzyType(**entry) for name, entry in json.loads(text).items()}


def full_type(name: str) -> str:
    """Name of a type in its long form, 'sensor_msgs/msg/JointState'; a short one, of package and type, is completed."""
    package, _, rest = name.partition('/')
    return name if '/' in rest or not rest else f'{package}/msg/{rest}'


def is_jazzy_type(type_name: str) -> bool:
    """Tell whether ROS 2 Jazzy's common interfaces define ``type_name``."""
    return full_type(type_name) in jazzy_types()


@cache
def jazzy_schema(type_name: str) -> Schema:
    """The definition of ``type_name``; a type that Jazzy does not have raises SemiparamError."""
    if not is_jazzy_type(type_name):
        raise SemiparamError(f'message type {type_name!r} is unknown: expected one of ROS 2 Jazzy, '
                             "for example 'sensor_msgs/msg/JointState'.")
    return Schema('ros2msg', jazzy_types()[full_type(type_name)].definition)


@cache
def type_hash(type_name: str) -> str:
    """The RIHS01 hash of a Jazzy type, '' for other types."""
    return jazzy_types()[full_type(type_name)].hash if is_jazzy_type(type_name) else ''


@cache
def message_text(type_name: str, schema: Schema) -> str | None:
    """The definition as .msg text: the bag's own, else Jazzy's, else None. IDL needs ``rosbags``."""
    if schema.encoding == 'ros2msg' and schema.text:
        return schema.text
    if schema.encoding == 'ros2idl' and schema.text and find_spec('rosbags'):
        return _text_from_idl(type_name, schema.text)
    return jazzy_schema(type_name).text if is_jazzy_type(type_name) else None


def _text_from_idl(type_name: str, text: str) -> str:
    from rosbags.typesys import Stores, get_types_from_idl, get_typestore

    store = get_typestore(Stores.EMPTY)
    parts = [part.split('\n', 1)[-1] if part.startswith('IDL: ') else part for part in text.split('=' * 80 + '\n')]
    for part in filter(str.strip, parts):
        store.register(get_types_from_idl(part))
    return store.generate_msgdef(full_type(type_name), ros_version=2)[0]


@cache
def decoder(type_name: str, schema: Schema = UNKNOWN) -> Decoder | None:
    """The function that turns CDR bytes into an object with the message's fields; None when nothing defines it."""
    for known in (schema, UNKNOWN):
        try:
            text = message_text(type_name, known)
            if text is not None:
                return generate_dynamic(type_name, text)[type_name]
        except Exception:  # a definition that its parser refuses, in whatever way, is one we do not have
            continue
    return None


@cache
def layout(type_name: str, schema: Schema = UNKNOWN) -> Layout | None:
    """The fields of a type and of those that it is made of, without what says nothing of the bytes of its messages,
    such as comments; None when nothing defines it."""
    found = dict[str, tuple[str, ...]]()

    def take(_: str, name: str, definition: Any) -> None:
        if not name.startswith('builtin_interfaces/'):  # some recorders leave them out
            found[name] = tuple(f'{field.type} {field.name}' for field in definition.fields)

    for known in (schema, UNKNOWN):
        try:
            text = message_text(type_name, known)
            if text is not None:
                found.clear()
                _for_each_msgdef(type_name, text, take)
                return tuple(sorted(found.items()))
        except Exception:  # as above
            continue
    return None


@cache
def encoder(type_name: str, schema: Schema = UNKNOWN) -> Encoder:
    """The function that turns a dict or an object into CDR bytes; an unknown type raises SemiparamError."""
    text = message_text(type_name, schema) or jazzy_schema(type_name).text
    return serialize_dynamic(type_name, text)[type_name]


@cache
def has_header(type_name: str, schema: Schema = UNKNOWN) -> bool:
    """Tell whether messages begin with a std_msgs/Header, whose stamp is then bytes 4 to 12."""
    lines = (line.partition('#')[0].split() for line in (message_text(type_name, schema) or '').splitlines())
    # A constant is NAME=VALUE or NAME = VALUE; the type of a field may hold the sign, too: string<=10.
    first = next((words for words in lines if len(words) > 1 and '=' not in words[1] + ''.join(words[2:])[:1]), [''])
    return first[0] in ('std_msgs/Header', 'std_msgs/msg/Header', 'Header')
