"""Quality of service as rosbag2 keeps it: ``offered_qos_profiles``, a YAML list with one entry a publisher."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import yaml

from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.settings.yaml_file import document

INFINITE_NS = 2**63 - 1
_HISTORY = {0: 'system_default', 1: 'keep_last', 2: 'keep_all', 3: 'unknown'}
_RELIABILITY = {0: 'system_default', 1: 'reliable', 2: 'best_effort', 3: 'unknown', 4: 'best_available'}
_DURABILITY = {0: 'system_default', 1: 'transient_local', 2: 'volatile', 3: 'unknown', 4: 'best_available'}
_LIVELINESS = {0: 'system_default', 1: 'automatic', 2: 'unknown', 3: 'manual_by_topic', 4: 'unknown'}


@dataclass(frozen=True)
class Qos:
    """Quality of service that a publisher offered, with rosbag2's names for the policies; durations
    in ns (``INFINITE_NS``: none)."""

    history: str = 'keep_last'
    depth: int = 10
    reliability: str = 'reliable'
    durability: str = 'volatile'
    deadline_ns: int = INFINITE_NS
    lifespan_ns: int = INFINITE_NS
    liveliness: str = 'automatic'
    liveliness_lease_ns: int = INFINITE_NS

    @property
    def latched(self) -> bool:
        """Tell whether late subscribers receive the last message."""
        return self.durability == 'transient_local'


LATCHED = Qos(depth=1, durability='transient_local')


def parse_profiles(text: str | Sequence[object] | None) -> tuple[Qos, ...]:
    """The recorded offers, from YAML text or its parsed list; anything else that is not a profile is left out."""
    try:
        entries = document(text) if isinstance(text, str) else text
    except (yaml.YAMLError, RecursionError):
        entries = None
    if not isinstance(entries, Sequence) or isinstance(entries, str):
        return ()
    return tuple(_profile(entry) for entry in entries if isinstance(entry, Mapping))


def _profile(entry: Mapping[str, object]) -> Qos:
    depth = entry.get('depth', 10)
    return Qos(_policy(entry.get('history'), _HISTORY, 'keep_last'), depth if isinstance(depth, int) else 10,
               _policy(entry.get('reliability'), _RELIABILITY, 'reliable'),
               _policy(entry.get('durability'), _DURABILITY, 'volatile'),
               duration_ns(entry.get('deadline')), duration_ns(entry.get('lifespan')),
               _policy(entry.get('liveliness'), _LIVELINESS, 'automatic'),
               duration_ns(entry.get('liveliness_lease_duration')))


def _policy(value: object, names: Mapping[int, str], default: str) -> str:
    """Policies are numbers up to metadata version 8, then names; what tells a publisher nothing becomes the default."""
    name = names.get(value, default) if isinstance(value, int) else str(value or default).lower()
    return name if name in names.values() and name not in ('system_default', 'unknown', 'best_available') else default


def duration_ns(value: object) -> int:
    """A duration {sec, nsec}; zero stands for none, as in rmw, and so does what is no duration."""
    seconds, nanoseconds = (value.get('sec', 0), value.get('nsec', 0)) if isinstance(value, Mapping) else (0, 0)
    if not (isinstance(seconds, int) and isinstance(nanoseconds, int)):
        return INFINITE_NS
    total = seconds * NANOSECONDS + nanoseconds
    return total if 0 < total < INFINITE_NS else INFINITE_NS


def agreed(profiles: Sequence[Qos]) -> Qos:
    """One profile that stands for all recorded offers, as ``ros2 bag play`` adapts them.

    Reliability and durability are kept where all publishers agree, else the most compatible one for subscribers.
    """
    if not profiles:
        return Qos()
    reliable = any(profile.reliability == 'reliable' for profile in profiles)
    latched = all(profile.latched for profile in profiles)
    base = profiles[0]
    return Qos(base.history, max(profile.depth for profile in profiles), 'reliable' if reliable else 'best_effort',
               'transient_local' if latched else 'volatile', base.deadline_ns, base.lifespan_ns, base.liveliness,
               base.liveliness_lease_ns)


def dump_profiles(profiles: Sequence[Qos]) -> str:
    """The YAML text that rosbag2 of Jazzy (metadata version 9) writes into a channel's metadata."""
    entries = [{'history': qos.history, 'depth': qos.depth, 'reliability': qos.reliability,
                'durability': qos.durability, 'deadline': _parts(qos.deadline_ns),
                'lifespan': _parts(qos.lifespan_ns), 'liveliness': qos.liveliness,
                'liveliness_lease_duration': _parts(qos.liveliness_lease_ns),
                'avoid_ros_namespace_conventions': False} for qos in profiles]
    return str(yaml.safe_dump(entries, sort_keys=False))


def _parts(duration_ns: int) -> dict[str, int]:
    return {'sec': duration_ns // NANOSECONDS, 'nsec': duration_ns % NANOSECONDS}
