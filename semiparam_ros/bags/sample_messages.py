"""Messages of a sample, as topic and fields, for bags made of tables and of simulations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from semiparam_ros.bags import recording_layout as layout
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.core.stamps import stamp_fields


class SampleMessage(NamedTuple):
    """Message with a header, on its topic of :mod:`semiparam_ros.bags.recording_layout`."""

    topic: str
    stamp: int  # [ns]
    fields: dict[str, Any]

    def put(self, bag: BagWriter) -> None:
        """Append the message to a bag; its header's stamp is its time."""
        bag.write(self.topic, layout.TYPES[self.topic], self.fields, self.stamp)


def joint_state(stamp: int, joints: Sequence[str], position: Sequence[float],
                velocity: Sequence[float], effort: Sequence[float] = ()) -> SampleMessage:
    """Joint state of positions, velocities and perhaps efforts, (n_joints,) each."""
    return SampleMessage(layout.JOINT_STATES, stamp, {
        'header': _header(stamp), 'name': list(joints), 'position': list(position),
        'velocity': list(velocity), 'effort': list(effort)})


def accelerations(stamp: int, joints: Sequence[str], **point: Sequence[float]) -> SampleMessage:
    """Trajectory of one point: ``accelerations`` (n_joints,), perhaps positions and velocities."""
    return SampleMessage(layout.JOINT_ACCELERATIONS, stamp, {
        'header': _header(stamp), 'joint_names': list(joints), 'points': [point]})


def wrench(stamp: int, frame: str, values: Sequence[float]) -> SampleMessage:
    """Wrench (6,), force [N] before torque [N m], in a frame."""
    force, torque = (dict(zip('xyz', part, strict=True)) for part in (values[:3], values[3:]))
    return SampleMessage(layout.WRENCH, stamp, {
        'header': _header(stamp, frame), 'wrench': {'force': force, 'torque': torque}})


def temperature(stamp: int, frame: str, value: float) -> SampleMessage:
    """Temperature [deg C] of a joint or a sensor, which ``frame`` names."""
    return SampleMessage(layout.TEMPERATURE, stamp, {
        'header': _header(stamp, frame), 'temperature': value})


def _header(stamp: int, frame: str = '') -> dict[str, Any]:
    return {'stamp': stamp_fields(stamp), 'frame_id': frame}
