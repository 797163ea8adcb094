"""A whole recording as samples: what the node would have received, without a node."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from semiparam_ros.bags import readings
from semiparam_ros.bags import recording_layout as layout
from semiparam_ros.bags.alignment import SampleStream
from semiparam_ros.core.samples import Sample, Samples
from semiparam_ros.core.signals.differentiation import CausalDifferentiator
from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings.parameter_table import Table
from semiparam_ros.settings.robot_description import moving_joints, output_joints, robot_description

if TYPE_CHECKING:
    from semiparam_ros.bags.base import BagReader, Losses


KINDS = {layout.JOINT_STATES: readings.JOINT_STATE, layout.WRENCH: readings.WRENCH,
         layout.JOINT_ACCELERATIONS: readings.ACCELERATIONS,
         layout.TEMPERATURE: readings.TEMPERATURE}
"""How each topic is read."""


class LoadedBag(NamedTuple):
    """Samples of a bag, the URDF it carries (None: none), refused messages by reason.

    ``frame_id`` is that of the wrenches, '' for efforts; ``losses`` tells what of a damaged bag could not be read.
    """

    samples: Samples
    robot_description: str | None
    faults: Counter[str]
    joints: tuple[str, ...]
    frame_id: str
    losses: Losses
    stretches: tuple[int, ...]
    """Number of samples of each stretch that was read; one stretch where all was read."""
    shared: str = ''
    """A sentence where several publish joint states; '' where one does."""


STRETCHES = 24
WARM_UP_NS = 1_000_000_000
"""Time [ns] of each stretch that filters have before its first sample counts."""


def load_samples(path: str | os.PathLike[str], settings: Table,
                 most: Callable[[float], int] | None = None) -> LoadedBag:
    """Read the samples of a bag, equal to those that the node makes from the same messages.

    :param most: how many samples to read at most, given their rate [Hz]; of a longer bag
        ``STRETCHES`` equally long stretches are read, evenly spread over it, and the rest is passed
        over.

    Where joint states tell that several publish them, those of another robot are left out, as in the node.
    A bag without a topic that ``settings`` need, or with no sample at all, raises SemiparamError.
    """
    loaded, alternates = _load(path, settings, most)
    if alternates:
        loaded, _ = _load(path, settings, most, shared=True)
    return loaded


def _load(path: str | os.PathLike[str], settings: Table, most: Callable[[float], int] | None,
          shared: bool | None = None) -> tuple[LoadedBag, bool]:
    """Load the samples of a bag, and tell whether joint states alternate. :param shared: see SampleStream."""
    from semiparam_ros.bags.reader import open_bag  # the node, which shares this module, reads no bags

    with open_bag(path) as bag:
        published = bag.topics.get(layout.JOINT_ACCELERATIONS)
        measured = measured_accelerations(settings, published is not None and published.count > 0)
        needed = [layout.JOINT_STATES, *[layout.WRENCH] * (settings.outputs == 'wrench'),
                  *[layout.JOINT_ACCELERATIONS] * measured]
        if settings.temperatures and layout.TEMPERATURE in bag.topics:
            needed.append(layout.TEMPERATURE)
        _require(bag, needed)
        description = recorded_description(bag)
        joints = _joints(settings, description, bag)
        stream = sample_stream(settings, joints, measured, capacity=None)
        stream.shared = shared
        outputs = layout.WRENCH if settings.outputs == 'wrench' else layout.JOINT_STATES
        windows = _windows(bag, bag.topics[outputs].count, most)
        frame_id, stretches = _read_windows(bag, stream, needed, windows)
        samples = [sample for stretch in stretches for sample in stretch]
        if not samples:
            raise SemiparamError(_nothing_matched(bag, stream, needed, bool(settings.joints)))
        return LoadedBag(Samples.from_list(samples), description, stream.faults, joints, frame_id, bag.losses,
                         tuple(map(len, stretches)), _of_others(bag, stream)), stream.whereabouts.alternate


def require_same_robot(settings: Table, bags: Sequence[LoadedBag]) -> None:
    """Raise SemiparamError where recordings are of robots that differ: joints, frames of wrenches, or the descriptions
    that they carry, where the settings give none."""
    first = bags[0]
    for other in bags[1:]:
        if other.joints != first.joints:
            raise SemiparamError(f'the recordings are of different robots: one has the joints '
                                 f'{", ".join(first.joints)}, the other {", ".join(other.joints)}.')
        if other.frame_id != first.frame_id:
            raise SemiparamError(f"the wrenches of the recordings are in different frames: '{first.frame_id}' and "
                                 f"'{other.frame_id}'.")
    described = {bag.robot_description for bag in bags if bag.robot_description}
    if len(described) > 1 and not (settings.robot_description_file or settings.robot_description):
        raise SemiparamError('the recordings carry different robot descriptions; expected those of the same robot, or '
                             'the parameter robot_description_file.')


def description_in(bags: Iterable[LoadedBag]) -> str | None:
    """The first robot description that recordings of one robot carry; None where none has one."""
    return next((bag.robot_description for bag in bags if bag.robot_description), None)


def measured_accelerations(settings: Table, published: bool) -> bool:
    """Tell whether accelerations come from their topic, by ``acceleration.source`` and what is
    published."""
    return settings.acceleration_source == 'measured' or (settings.acceleration_source == 'auto' and published)


def sample_stream(settings: Table, joints: tuple[str, ...], measured: bool,
                  capacity: int | None = None) -> SampleStream:
    """The stream that these settings ask for; the node and :func:`load_samples` both get theirs here."""
    accelerations, velocities = (CausalDifferentiator(len(joints), settings.acceleration_cutoff, angles=of_positions)
                                 for of_positions in (False, True))
    return SampleStream(joints, settings.outputs, settings.sensor_frame, settings.alignment_tolerance,
                        None if measured else accelerations, measured, capacity, velocities,
                        output_joints(settings, joints), settings.temperatures)


def recorded_description(bag: BagReader) -> str | None:
    """The last robot description of a bag, None where there is none, or the topic holds no texts."""
    text = None
    for message in bag.messages([layout.ROBOT_DESCRIPTION]):
        found = getattr(message.data, 'data', None)
        text = found if isinstance(found, str) and found else text
    return text


def _require(bag: BagReader, needed: Sequence[str]) -> None:
    """Raise SemiparamError where a topic that takes part is missing, or of another type."""
    for topic in needed:
        type_name = layout.TYPES[topic]
        if topic not in bag.topics:
            raise SemiparamError(f'{str(bag.path)!r} has no topic {topic}; it has {", ".join(bag.topics) or "none"}'
                                 f'{_renaming(bag, needed)}.')
        if bag.topics[topic].type != type_name:
            raise SemiparamError(f'{str(bag.path)!r}: topic {topic} holds {bag.topics[topic].type or "no known type"}; '
                                 f'expected {type_name}.')
        if not bag.decodes(topic):
            raise SemiparamError(f'{str(bag.path)!r}: messages on {topic} are encoded as '
                                 f'{bag.topics[topic].encoding!r}; expected cdr, as ROS 2 records them.')


def _renaming(bag: BagReader, needed: Sequence[str]) -> str:
    """The command that gives all topics needed their names, '' where it is not clear which of the bag they are."""
    words = list[str]()
    for topic in (*needed, layout.ROBOT_DESCRIPTION):
        alike = [name for name, info in bag.topics.items()
                 if info.type == layout.TYPES[topic] and (topic in needed or name.endswith(topic))]
        if topic in bag.topics:
            words.append(f' --topic {topic}')
        elif len(alike) == 1:
            words.append(f' --topic {alike[0]}={topic}')
        elif topic in needed:
            return ''
    renamed = 'one' if sum('=' in word for word in words) == 1 else 'them'
    return f' (semiparam convert{"".join(words)} renames {renamed})'


def _joints(settings: Table, description: str | None, bag: BagReader) -> tuple[str, ...]:
    """The moving joints; where neither the settings nor a URDF name them the sentence has to name the bag."""
    if settings.joints:
        return settings.joints
    try:
        return moving_joints(settings, robot_description(settings, description))
    except SemiparamError as error:
        raise SemiparamError(f'{str(bag.path)!r}: {error}') from error


def _windows(bag: BagReader, count: int, most: Callable[[float], int] | None) -> list[tuple[int, int] | None]:
    """Log times [ns], from and before which to read, with what filters need first; None for all. ``count``: samples of
    the whole bag, about."""
    limit = most(count / max(1e-9 * bag.duration_ns, 1e-9)) if most else count
    if count <= limit:
        return [None]
    length = int(bag.duration_ns * limit / count) // STRETCHES
    starts = [bag.start_ns + (bag.duration_ns - length) * index // (STRETCHES - 1) for index in range(STRETCHES)]
    return [(start - WARM_UP_NS, start + length) for start in starts]


def _read_windows(bag: BagReader, stream: SampleStream, needed: Collection[str],
                  windows: Iterable[tuple[int, int] | None]) -> tuple[str, list[list[Sample]]]:
    """Read (frame of the wrenches, samples of each window), without those that filters had first."""
    frame_id, stretches, read_until = '', list[list[Sample]](), bag.start_ns
    for window in windows:
        if window is not None:
            stream.reset()
            if layout.TEMPERATURE in needed:  # it holds from before the stretch on
                _read(bag, stream, [layout.TEMPERATURE], read_until, window[0])
            read_until = window[1]
        frame, stretch = _read(bag, stream, needed, *(window or (None, None)))
        if window is not None and window[0] + WARM_UP_NS > bag.start_ns and stretch:
            counts = stretch[0].stamp + WARM_UP_NS
            stretch = [sample for sample in stretch if sample.stamp >= counts]
        frame_id = frame_id or frame
        stretches.append(stretch)
    return frame_id, stretches


def _read(bag: BagReader, stream: SampleStream, needed: Collection[str], start: int | None,
          end: int | None) -> tuple[str, list[Sample]]:
    """Read (frame of the wrenches that are taken, samples) from the messages of some topics in the order recorded,
    from one log time [ns] on and before another; None: all."""
    samples: list[Sample] = []
    frame_id = ''
    for message in bag.messages(needed, start_ns=start, end_ns=end):
        kind = KINDS[message.topic]
        try:
            reading, accepted = kind.read(message.data), stream.accepted
            samples += kind.feed(stream, reading.stamp, *reading.fields)
        except (AttributeError, TypeError, ValueError) as error:
            raise SemiparamError(f'{str(bag.path)!r}: the bag defines {message.type} in a way of its own, without what '
                                 f'{message.topic} is read for ({error}).') from error
        if not frame_id and message.topic == layout.WRENCH and stream.accepted > accepted:
            frame_id = reading.frame_id.lstrip('/')
    return frame_id, samples


def _of_others(bag: BagReader, stream: SampleStream) -> str:
    """A sentence about joint states that were left out as another robot's; '' without any."""
    count = stream.faults['elsewhere']
    return (f'{str(bag.path)!r}: positions on {layout.JOINT_STATES} go to and fro faster than joints can, so several '
            f'publish there. {count} messages are left out as another robot\'s. Record each robot on a topic of its '
            'own.') if count else ''


def _nothing_matched(bag: BagReader, stream: SampleStream, needed: Iterable[str],
                     joints_given: bool) -> str:
    counts = ', '.join(f'{bag.topics[topic].count} on {topic}' for topic in needed)
    reason = stream.last_fault or stream.last_ignored or _silence(bag, stream.pending, needed)
    renamed = (stream.faults['missing_joint'] or stream.ignored) and not stream.apart
    remedy = ' semiparam convert --joint NAME=NEW renames joints.' if renamed else ''
    if renamed and not joints_given:  # those of the description count, all of them
        remedy = ' The parameter joints is not given, so every moving joint of the robot description is expected; ' \
                 'name in it those that the recording has.'
    return f'{str(bag.path)!r} holds no complete sample ({counts} messages): {reason}{remedy}'


def _silence(bag: BagReader, pending: int, needed: Iterable[str]) -> str:
    """Why nothing came together although no message was refused."""
    losses = bag.losses
    lost = ', '.join(f'{losses.undecodable[topic]} on {topic}' for topic in needed if topic in losses.undecodable)
    if lost:
        return f'{lost} do not decode.'
    empty = [topic for topic in needed if not bag.topics[topic].count]
    if empty:
        return f'there are none on {", ".join(empty)}.'
    return losses.sentence or f'{pending} outputs have no joint state at or after their stamps.'
