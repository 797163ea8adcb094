"""Messages of a sample, put into bags that are made of tables and of simulations.

Each is on its topic of :mod:`semiparam_ros.bags.recording_layout`, and its time is the stamp [ns] of its header.
"""

from __future__ import annotations

from collections.abc import Sequence

from semiparam_ros.bags import recording_layout as layout
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.core.stamps import stamp_fields


def joint_state(bag: BagWriter, stamp: int, joints: Sequence[str], position: Sequence[float],
                velocity: Sequence[float], effort: Sequence[float] = ()) -> None:
    """Joint state of positions, velocities and perhaps efforts, (n_joints,) each."""
    _put(bag, layout.JOINT_STATES, stamp, name=list(joints), position=list(position), velocity=list(velocity),
         effort=list(effort))


def accelerations(bag: BagWriter, stamp: int, joints: Sequence[str], **point: Sequence[float]) -> None:
    """Trajectory of one point: ``accelerations`` (n_joints,), perhaps positions and velocities."""
    _put(bag, layout.JOINT_ACCELERATIONS, stamp, joint_names=list(joints), points=[point])


def wrench(bag: BagWriter, stamp: int, frame: str, values: Sequence[float]) -> None:
    """Wrench (6,), force [N] before torque [N m], in a frame."""
    force, torque = (dict(zip('xyz', part, strict=True)) for part in (values[:3], values[3:]))
    _put(bag, layout.WRENCH, stamp, frame, wrench={'force': force, 'torque': torque})


def temperature(bag: BagWriter, stamp: int, frame: str, value: float) -> None:
    """Temperature [deg C] of a joint or a sensor, which ``frame`` names."""
    _put(bag, layout.TEMPERATURE, stamp, frame, temperature=value)


def _put(bag: BagWriter, topic: str, stamp: int, frame: str = '', **fields: object) -> None:
    header = {'stamp': stamp_fields(stamp), 'frame_id': frame}
    bag.write(topic, layout.TYPES[topic], {'header': header, **fields}, stamp)
