"""Quality of service between rclpy, bags and the overrides file of ``ros2 bag play`` and ``ros2 bag record``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rclpy.duration import Duration, Infinite
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

from semiparam_ros.bags.qos import INFINITE_NS, Qos, duration_ns
from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings.yaml_file import read_yaml

_CHOICES = {'history': ('keep_last', 'keep_all'), 'reliability': ('reliable', 'best_effort'),
            'durability': ('volatile', 'transient_local'),
            'liveliness': ('automatic', 'manual_by_topic')}
_DURATIONS = {'deadline': 'deadline_ns', 'lifespan': 'lifespan_ns', 'liveliness_lease_duration': 'liveliness_lease_ns'}
LARGEST_DEPTH = 2**31 - 1
"""That rclpy takes."""
_IGNORED = ('avoid_ros_namespace_conventions',)


def lossless(qos: Qos) -> Qos:
    """The same profile, reliable and keeping every message until all subscribers have it."""
    return replace(qos, history='keep_last' if qos.latched else 'keep_all', reliability='reliable')


def to_rclpy(qos: Qos) -> QoSProfile:
    """The profile that rclpy takes; the usual depth where a recorder did not know it and wrote 0."""
    return QoSProfile(history=HistoryPolicy[qos.history.upper()],
                      depth=min(qos.depth, LARGEST_DEPTH) if qos.depth > 0 else Qos().depth,
                      reliability=ReliabilityPolicy[qos.reliability.upper()],
                      durability=DurabilityPolicy[qos.durability.upper()],
                      deadline=_duration(qos.deadline_ns), lifespan=_duration(qos.lifespan_ns),
                      liveliness=LivelinessPolicy[qos.liveliness.upper()],
                      liveliness_lease_duration=_duration(qos.liveliness_lease_ns))


def from_rclpy(profile: QoSProfile) -> Qos:
    """Quality of service of an endpoint; its history is not announced and becomes the default."""
    return Qos(reliability='best_effort' if profile.reliability == ReliabilityPolicy.BEST_EFFORT else 'reliable',
               durability='transient_local' if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL else 'volatile',
               deadline_ns=_nanoseconds(profile.deadline), lifespan_ns=_nanoseconds(profile.lifespan))


def subscription_qos(offers: Sequence[Qos]) -> Qos:
    """A subscription that every one of these publishers matches, as strong as they allow, and never overflows."""
    reliable = all(offer.reliability == 'reliable' for offer in offers)
    latched = bool(offers) and all(offer.latched for offer in offers)
    return Qos(history='keep_all', reliability='reliable' if reliable else 'best_effort',
               durability='transient_local' if latched else 'volatile')


def load_overrides(path: Path) -> dict[str, Mapping[str, object]]:
    """Topic -> policies to change, from a YAML file. Raises SemiparamError naming file, topic and policy."""
    document = read_yaml(path, 'the QoS overrides')
    if not isinstance(document, Mapping):
        raise SemiparamError(f'{path} holds no QoS overrides: expected a mapping of topic to policies.')
    for topic, entry in document.items():
        overridden(Qos(), entry, f'{path}, {topic}')
    return {str(topic): entry for topic, entry in document.items()}


def overridden(qos: Qos, entry: object, where: str) -> Qos:
    """Override policies of ``qos`` by one entry; SemiparamError says ``where`` it is wrong."""
    if not isinstance(entry, Mapping):
        raise SemiparamError(f'{where}: expected a mapping of QoS policies, got {entry!r}.')
    changes: dict[str, Any] = dict(_change(str(name), value, where) for name, value in entry.items()
                                   if name not in _IGNORED)
    return replace(qos, **changes)


def _change(name: str, value: object, where: str) -> tuple[str, object]:
    if name == 'depth':
        if isinstance(value, int) and not isinstance(value, bool) and value >= 1:
            return name, value
        raise SemiparamError(f'{where}: depth is {value!r}, expected a whole number of at least 1.')
    if name in _DURATIONS:
        return _DURATIONS[name], _seconds(name, value, where)
    if name not in _CHOICES:
        known = ', '.join([*_CHOICES, 'depth', *_DURATIONS])
        raise SemiparamError(f"{where}: '{name}' is no QoS policy, expected one of {known}.")
    if value not in _CHOICES[name]:
        raise SemiparamError(f'{where}: {name} is {value!r}, expected {" or ".join(_CHOICES[name])}.')
    return name, value


def _seconds(name: str, value: object, where: str) -> int:
    """A duration {sec, nsec} in ns."""
    if not isinstance(value, Mapping) or not set(value) <= {'sec', 'nsec'} \
            or not all(isinstance(part, int) and part >= 0 for part in value.values()):
        raise SemiparamError(f'{where}: {name} is {value!r}, expected {{sec: ..., nsec: ...}}.')
    return duration_ns(value)


def _duration(nanoseconds: int) -> Duration:
    return Infinite if nanoseconds == INFINITE_NS else Duration(nanoseconds=nanoseconds)


def _nanoseconds(duration: Duration) -> int:
    return int(duration.nanoseconds) if 0 < duration.nanoseconds < INFINITE_NS else INFINITE_NS
