"""Bags of other formats, and damaged ones, made into MCAP: topics chosen and renamed, joints renamed, signs turned."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path

from semiparam_ros.bags import recording_layout as layout
from semiparam_ros.bags.base import BagReader, Message, TopicInfo
from semiparam_ros.bags.header_stamp import with_stamp
from semiparam_ros.bags.schemas import is_jazzy_type
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.core.robot.urdf import parse
from semiparam_ros.core.stamps import stamp_fields
from semiparam_ros.errors import SemiparamError, listed

TOPIC_NAME = re.compile(r'(/[A-Za-z_][A-Za-z0-9_]*)+')
_JOINT_STATE, _WRENCH = layout.TYPES[layout.JOINT_STATES], layout.TYPES[layout.WRENCH]
_TRAJECTORY, _TEMPERATURE = layout.TYPES[layout.JOINT_ACCELERATIONS], layout.TYPES[layout.TEMPERATURE]


@dataclass(frozen=True)
class Edits:
    """Changes to messages on the way into a new bag.

    ``topics``: old name -> new name, and only these are taken; empty takes all. ``joints``: old
    name -> new name, where one * in both stands for any text. ``effort_factors``: new name of a
    joint -> factor. ``stamps_from_log`` puts the log time into every header.
    """

    topics: Mapping[str, str] = field(default_factory=dict)
    joints: Mapping[str, str] = field(default_factory=dict)
    effort_sign: float = 1.0
    effort_factors: Mapping[str, float] = field(default_factory=dict)
    wrench_sign: float = 1.0
    wrench_frame: str = ''
    stamps_from_log: bool = False

    def concern(self, type_name: str) -> bool:
        """Tell whether messages of this type change; others are copied byte by byte, but for their stamps."""
        named = bool(self.joints) or self.stamps_from_log
        turned = self.wrench_sign != 1.0 or bool(self.wrench_frame) or self.stamps_from_log
        scaled = self.effort_sign != 1.0 or bool(self.effort_factors)
        concerned = {_JOINT_STATE: named or scaled, _TRAJECTORY: named, _TEMPERATURE: named, _WRENCH: turned}
        return concerned.get(type_name, False)

    def apply(self, message: Message) -> object:
        """The message's data, changed in place."""
        data = message.data
        if self.stamps_from_log:
            data.header.stamp = stamp_fields(message.log_time)
        if message.type == _JOINT_STATE:
            before, data.name = data.name, [renamed(name, self.joints) for name in data.name]
            if len(set(data.name)) < len(set(before)):
                raise SemiparamError(f'the joints {listed(before)} would become {listed(data.name)}; expected another '
                                     'name for each.')
            # Efforts beyond the names stay, for a message that is wrong must not become one that fits.
            data.effort = [self.effort_sign * self.effort_factors.get(name or '', 1.0) * value for name, value in
                           zip_longest(data.name[:len(data.effort)], data.effort)]
        elif message.type == _TRAJECTORY:
            data.joint_names = [renamed(name, self.joints) for name in data.joint_names]
        elif message.type == _TEMPERATURE:
            data.header.frame_id = renamed(data.header.frame_id, self.joints)
        elif message.type == _WRENCH:
            data.header.frame_id = self.wrench_frame or data.header.frame_id
            for vector in (data.wrench.force, data.wrench.torque):
                vector.x, vector.y, vector.z = (self.wrench_sign * value for value in (vector.x, vector.y, vector.z))
        return data

    def check_types(self, path: str, types: Collection[str]) -> None:
        """Raise SemiparamError where what is to change is on none of the topics that are taken, whose types these are.
        """
        wrenches = self.wrench_sign != 1.0 or bool(self.wrench_frame)
        efforts = self.effort_sign != 1.0 and not self.effort_factors  # whose joints are looked for in the end
        for wanted, type_name, what in ((wrenches, _WRENCH, 'wrenches'), (efforts, _JOINT_STATE, 'efforts')):
            if wanted and type_name not in types:
                raise SemiparamError(f'{path!r}: {what} are to change, but no topic that is taken holds {type_name}.')

    def check_joints(self, path: str, names: Sequence[str], driven: Sequence[str]) -> None:
        """Raise SemiparamError where a joint is to change that is not among those of the bag, or an effort that is not.

        :param driven: names of those joints that have efforts.
        """
        for old in self.joints:
            if not any(name == old or _starred(name, old) is not None for name in names):
                raise SemiparamError(f'{path!r} has no joint {old!r} to rename; it has {listed(names)}.')
        if self.effort_sign != 1.0 and not driven:
            raise SemiparamError(f'{path!r}: efforts are to change, but its joint states hold none.')
        known = [renamed(name, self.joints) for name in driven]
        for name in self.effort_factors:
            if name not in known:
                raise SemiparamError(f'effort_factors names {name!r}, of which there is no effort; expected some of '
                                     f'the joints in {path!r}: {listed(known)}.')


def renamed(name: str, names: Mapping[str, str]) -> str:
    """The new name of a joint: that of its own entry, else of the first pattern that fits; without one it keeps its
    own."""
    if name in names:
        return names[name]
    fitting = ((new, text) for old, new in names.items() if (text := _starred(name, old)) is not None)
    return next((new.replace('*', text) for new, text in fitting), name)


def _starred(name: str, pattern: str) -> str | None:
    """Text that the first * of a pattern stands for in a name, all else being literal; None where it does not fit."""
    before, star, after = pattern.partition('*')
    fits = star and name.startswith(before) and name[len(before):].endswith(after)
    return name[len(before):len(name) - len(after)] if fits else None


def obstacle(info: TopicInfo) -> str:
    """Why the messages of a topic cannot be written into a new bag, '' where they can."""
    if info.encoding != 'cdr':
        return f'its messages are encoded as {info.encoding!r}, not cdr'
    if not info.type or not (info.schema.text or is_jazzy_type(info.type)):
        return f'neither the bag nor ROS 2 Jazzy defines its type {info.type or "(unknown)"}'
    return ''


def convert_bag(source: BagReader, edits: Edits, bag: BagWriter, robot_description: str | None = None,
                progress: Callable[[int], None] = lambda done: None) -> dict[str, int]:
    """Copy the messages of ``source`` in order of log time; returns how many came from each topic.

    :param robot_description: a URDF that takes the place of the one in the bag, if there is one.
    :param progress: called with the number of messages so far. A topic or a joint that is not there raises
        SemiparamError.
    """
    chosen = dict(edits.topics) or {topic: topic for topic, info in source.topics.items() if not obstacle(info)}
    if robot_description is not None:
        chosen = {old: new for old, new in chosen.items() if new != layout.ROBOT_DESCRIPTION}
        write_description(bag, robot_description, source.start_ns)
    _add_topics(source, edits, chosen, bag)
    copied, changed = ({topic for topic in chosen if edits.concern(source.topics[topic].type) is concern}
                       for concern in (False, True))
    counts = dict.fromkeys(chosen, 0)
    joints, driven = set[str](), set[str]()
    # What is copied need not decode.
    messages = source.messages(chosen.keys(), decode=changed)
    for number, message in enumerate(messages, 1):
        counts[message.topic] += 1
        topic = chosen[message.topic]
        if message.topic in copied:
            stamped = edits.stamps_from_log and source.has_header(message)
            raw = with_stamp(message.raw, message.log_time) if stamped else message.raw
            bag.write_raw(topic, raw, message.log_time, message.publish_time)
        else:
            bag.write(topic, message.type, _edited(source, edits, message, joints, driven), message.log_time,
                      message.publish_time)
        if number % 1000 == 0:
            progress(number)
    if chosen and not any(counts.values()) and source.losses and any(source.topics[old].count for old in chosen):
        raise SemiparamError(source.losses.sentence)
    edits.check_joints(str(source.path), sorted(joints), sorted(driven))
    return counts


def _add_topics(source: BagReader, edits: Edits, chosen: Mapping[str, str], bag: BagWriter) -> None:
    """The topics that are taken, by their new names; raises SemiparamError where one cannot be, or none is changed."""
    for old, new in chosen.items():
        if old not in source.topics:
            raise SemiparamError(f'{str(source.path)!r} has no topic {old}; it has {", ".join(source.topics)}.')
        if new != old and not TOPIC_NAME.fullmatch(new):
            raise SemiparamError(f'{old} is to become {new!r}, which is no name of a topic; expected one such as '
                                 f'{layout.JOINT_STATES}, of letters, digits, _ and /.')
        info = source.topics[old]
        if obstacle(info):
            raise SemiparamError(f'{str(source.path)!r}: topic {old} holds {info.type or "no known type"}, encoded as '
                                 f'{info.encoding!r}; expected a type of ROS 2, as cdr, that the bag or ROS 2 defines.')
        bag.add_topic(new, info.type, info.qos, info.schema)
    edits.check_types(str(source.path), {source.topics[topic].type for topic in chosen})


def _edited(source: BagReader, edits: Edits, message: Message, joints: set[str], driven: set[str]) -> object:
    """The changed data of a message; ``joints`` receives the names that it had, ``driven`` those with an effort."""
    data = message.data
    try:
        if message.type == _JOINT_STATE:
            joints.update(data.name)
            driven.update(data.name[:len(data.effort)])
        elif message.type == _TRAJECTORY:
            joints.update(data.joint_names)
        elif message.type == _TEMPERATURE:
            joints.add(data.header.frame_id)
        return edits.apply(message)
    except (AttributeError, TypeError) as error:
        raise SemiparamError(f'{str(source.path)!r}: the bag defines {message.type} in a way of its own, without what '
                             f'is to change in it ({error}).') from error


def read_description(path: str | os.PathLike[str]) -> str:
    """The text of a URDF file; one that cannot be read, or is no URDF, raises SemiparamError."""
    try:
        text = Path(path).read_text(encoding='utf-8')
    except OSError as error:
        raise SemiparamError(f'robot description {str(path)!r} cannot be read: {error.strerror}.') from error
    except UnicodeDecodeError as error:
        raise SemiparamError(f'robot description {str(path)!r} is not UTF-8 text.') from error
    try:
        parse(text)
    except SemiparamError as error:
        raise SemiparamError(f'{str(path)!r}: {error}') from error
    return text


def write_description(bag: BagWriter, text: str, stamp: int) -> None:
    """Put a URDF into the bag as the latched /robot_description."""
    bag.write(layout.ROBOT_DESCRIPTION, layout.TYPES[layout.ROBOT_DESCRIPTION], {'data': text}, stamp)
