"""Joint states, wrenches and accelerations of different topics, put together into samples.

A sample belongs to a wrench (with ``outputs='effort'`` to a joint state): the joint state of the same header stamp,
or the one interpolated between its two neighbours. It is complete as soon as every topic that takes part has reached
its stamp. The samples depend only on the order inside each topic, never on how the topics interleave; so a node that
listens gets the same samples, bit for bit, as a command that reads the recording.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Sequence
from math import isfinite, nan
from typing import TYPE_CHECKING

import numpy as np

from semiparam_ros.core.samples import NO_TEMPERATURE, Sample
from semiparam_ros.core.stamps import NANOSECONDS, in_seconds
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError, listed, shortened

if TYPE_CHECKING:
    from semiparam_ros.core.signals.differentiation import CausalDifferentiator

CAPACITY = 20_000
LARGEST = 1e9
"""Largest angle [rad], speed, acceleration, force [N] or torque [N m] believed: memory that was
never written holds more, and one such value would leave nothing of a model."""
TURN = 2.0 * np.pi
FASTEST = 30.0
"""[rad/s, m/s] No joint goes to and fro so fast: of several publishers, who says so tells of another robot."""
HARDLY = 0.2
"""Of ``FASTEST``: no faster is a joint that others' positions lie between, while one in degrees is where it turns."""
END_OF_TIME_NS = 2**31 * NANOSECONDS
"""The seconds of a header have 32 bits. One with more nanoseconds than a second has can be beyond that."""
WITHOUT_VELOCITIES = 4
"""Joint states in a row without velocities, after some that held them, from which on they are estimated: one alone is
another publisher's."""
HELD_FROM_NS = 1_000_000_000
"""Time after its stamp from which a temperature counts. It comes too seldom to be waited for; by
then it has come, however the topics interleave, and none changes so fast."""


class Track:
    """Rows (n,) at strictly increasing stamps [ns], interpolated linearly.

    Rows are read at strictly increasing stamps too, so that those behind the last reading can be forgotten.
    """

    def __init__(self, longest_gap_ns: int, angles: int = 0) -> None:
        """Make an empty track that interpolates over gaps of at most ``longest_gap_ns``; the first ``angles`` values of
        a row [rad] go on past a whole turn, as those of a joint that turns without end and comes within one turn."""
        self._longest_gap, self._angles = longest_gap_ns, angles
        self._stamps: deque[int] = deque()
        self._rows: deque[Array] = deque()

    def __len__(self) -> int:
        return len(self._stamps)

    def append(self, stamp: int, row: Array) -> None:
        """Add the row that follows."""
        self._stamps.append(stamp)
        self._rows.append(row)

    def forget_oldest(self) -> None:
        """Drop one row."""
        self._stamps.popleft()
        self._rows.popleft()

    def clear(self) -> None:
        """Drop all rows."""
        self._stamps.clear()
        self._rows.clear()

    def decided(self, stamp: int) -> bool:
        """Tell whether no later row can change :meth:`at` for ``stamp``; forget rows before it."""
        stamps = self._stamps
        while len(stamps) > 1 and stamps[1] <= stamp:
            self.forget_oldest()
        return bool(stamps) and (stamps[0] >= stamp or len(stamps) > 1)

    def at(self, stamp: int) -> Array | None:
        """The row at ``stamp``, once that is decided; None before the first row and inside a gap that is too long."""
        first = self._stamps[0]
        if first == stamp:
            return self._rows[0]
        if first > stamp:
            return None
        second = self._stamps[1]
        if second - first > self._longest_gap:
            return None
        row = self._rows[0]
        way = self._rows[1] - row
        turns = TURN * np.round(way[:self._angles] / TURN)
        if turns.any():
            way[:self._angles] -= turns * (np.abs(way[:self._angles] - turns) < FASTEST * 1e-9 * (second - first))
        return row + (stamp - first) / (second - first) * way


class ZeroOrderHold:
    """A value that comes seldom: it counts from ``HELD_FROM_NS`` after its stamp on, until the next one does."""

    def __init__(self) -> None:
        self._value = nan
        self._coming: deque[tuple[int, float]] = deque()

    def append(self, stamp: int, value: float) -> None:
        """The value at a later stamp [ns]."""
        self._coming.append((stamp, value))
        if len(self._coming) > CAPACITY:
            self._value = self._coming.popleft()[1]

    def at(self, stamp: int) -> float:
        """The value that counts at ``stamp`` [ns], NaN before the first; stamps must not decrease."""
        while self._coming and self._coming[0][0] + HELD_FROM_NS <= stamp:
            self._value = self._coming.popleft()[1]
        return self._value

    def reset(self) -> None:
        """Stamps begin anew; the newest value stays."""
        if self._coming:
            self._value = self._coming[-1][1]
        self._coming.clear()


class Whereabouts:
    """Positions of the last two joint states, by which one is noticed that the joints cannot have reached."""

    def __init__(self) -> None:
        self.latest: tuple[int, list[float]] | None = None
        self._before: tuple[int, list[float]] | None = None
        """Stamps and positions of the last joint state, and of the last but one."""
        self._jumps = self._returns = 0

    def forget(self) -> None:
        """Stamps begin anew; the counts stay."""
        self.latest = self._before = None

    def move(self, stamp: int, position: list[float]) -> None:
        """Add the joint state that follows."""
        self._before, self.latest = self.latest, (stamp, position)

    def out_of_reach(self, stamp: int, position: Sequence[float]) -> int | None:
        """Number of the first joint that cannot have come here since the last joint state, None: all can."""
        if self.latest is None or stamp <= self.latest[0]:
            return None
        return _too_far(position, self.latest[1], (stamp - self.latest[0]) * 1e-9)

    def count(self, stamp: int, position: Sequence[float]) -> None:
        """Count a joint state out of reach: where the last one was so too, and this is about where the one before was,
        it comes back."""
        self._jumps += 1
        if self.latest is not None and self._before is not None:
            (before, start), (latest, between) = self._before, self.latest
            self._returns += (_too_far(between, start, (latest - before) * 1e-9) is not None
                              and _too_far(position, start, HARDLY * (stamp - before) * 1e-9) is None)

    @property
    def alternate(self) -> bool:
        """Tell whether joint states go to and fro, as those of several robots do: of a second one that comes seldom
        every other jump comes back; of positions in degrees hardly any. A single one may be a fault of a sensor."""
        return self._returns > 1 and 3 * self._returns > self._jumps


def _too_far(position: Sequence[float], start: Sequence[float], seconds: float) -> int | None:
    """Number of the first joint that cannot have come so far in this time, None: all can; a whole turn is no way."""
    farthest = FASTEST * seconds
    for joint, (here, there) in enumerate(zip(position, start, strict=True)):
        away = abs(here - there)
        if away > farthest and abs(away - TURN) > farthest:
            return joint
    return None


def _check(outputs: str, accelerations_known: bool) -> None:
    if outputs not in ('wrench', 'effort'):
        raise SemiparamError(f"outputs is {outputs!r}; expected 'wrench' or 'effort'.")
    if not accelerations_known:
        raise SemiparamError('accelerations are neither measured nor is there a filter that estimates them.')


class SampleStream:
    """Turns messages into samples, one message at a time.

    A message that cannot be used is refused: it is counted in ``faults`` by its reason, ``last_fault`` says in one
    sentence what was wrong, and everything else stays as if it had never come. Reasons: 'missing_joint',
    'wrong_length', 'not_finite', 'out_of_range', 'duplicate_stamp', 'backward_stamp', 'wrong_frame', 'elsewhere'
    (positions that jump, where several publish them); 'unmatched' counts wrenches without a joint state (or
    acceleration) near enough, 'overflow' messages given up because another topic stays silent.
    A message that names joints, but none of ours (a gripper's own), is ignored: ``ignored`` counts these, and
    ``last_ignored`` says what the last one named.

    :param joints: names in the order of the samples' columns; messages may order theirs in any way.
    :param outputs: 'wrench' or 'effort'. :param sensor_frame: frame_id that wrenches must have; '' takes any.
    :param tolerance_s: largest distance [s] from a wrench to the nearer of the joint states it lies between.
    :param differentiator: gives the accelerations, unless ``measured_accelerations`` come on their own topic.
    :param capacity: messages of a topic kept while another is silent; None keeps all.
    :param velocity_filter: gives the velocities of joint states that leave them empty; None refuses such.
    :param output_joints: those of the joints whose efforts are the outputs; all of them unless given.
    :param temperatures: joints whose temperatures are measured; with a wrench, its sensor's frame_id.
    """

    def __init__(self, joints: Sequence[str], outputs: str = 'wrench', sensor_frame: str = '',
                 tolerance_s: float = 0.02, differentiator: CausalDifferentiator | None = None,
                 measured_accelerations: bool = False, capacity: int | None = CAPACITY,
                 velocity_filter: CausalDifferentiator | None = None, output_joints: Collection[str] = (),
                 temperatures: Collection[str] = ()) -> None:
        """Make a stream without messages; SemiparamError where nothing gives accelerations."""
        _check(outputs, measured_accelerations or differentiator is not None)
        self.joints = tuple(joints)
        self.faults: Counter[str] = Counter()
        self.last_fault = self.last_ignored = ''
        self.sentences: dict[str, str] = {}
        """The last fault of each reason."""
        self.ignored = self.accepted = 0
        """Messages of others, and those of ours that were not refused."""
        self._effort = outputs == 'effort'
        self._outputs = [index for index, name in enumerate(joints) if name in (output_joints or joints)]
        self._frame = sensor_frame.lstrip('/')
        self._differentiator = None if measured_accelerations else differentiator
        self._velocity_filter = velocity_filter
        self.velocities_measured = velocity_filter is None
        """Whether the joint states hold velocities now."""
        self.shared: bool | None = None
        """Whether several publish joint states; None: nobody counts these, as of a recording, and positions tell."""
        self.whereabouts = Whereabouts()
        self._without = 0
        self._measured: tuple[int, Array] | None = None
        """Stamp and row of the last joint state that held velocities."""
        self._capacity = capacity
        sources = self.joints if self._effort else tuple(temperatures)
        self._temperatures = {name: ZeroOrderHold() for name in sources if name in temperatures}
        self._of_sources = [self._temperatures.get(name, ZeroOrderHold()) for name in sources if temperatures]
        gap = round(2e9 * tolerance_s)
        self._states, self._accelerations = Track(gap, angles=len(self.joints)), Track(gap)
        self._followers = [*([] if self._effort else [(self._states, 'joint state')]),
                           *([(self._accelerations, 'acceleration')] if measured_accelerations else [])]
        # Stamps, output and (for efforts) joint state of the samples that wait for the topics they follow.
        self._waiting: deque[tuple[int, Array, Array | None]] = deque()
        self._last: dict[str, int] = {}
        self._orders: dict[str, tuple[Sequence[str], list[int]]] = {}
        self._named: set[str] = set()
        """Joints of ours in messages that did not name all of them."""

    @property
    def apart(self) -> bool:
        """Tell whether all joints come, but in several messages."""
        return self._named.issuperset(self.joints)

    @property
    def pending(self) -> int:
        """Outputs that still wait for their joint state or acceleration."""
        return len(self._waiting)

    @property
    def takes_accelerations(self) -> bool:
        """Tell whether samples wait for measured accelerations."""
        return self._differentiator is None

    def reset(self) -> None:
        """Forget everything that waits and all stamps, as after a jump of the clock; the counts stay."""
        self._states.clear()
        self._accelerations.clear()
        self._waiting.clear()
        self._last.clear()
        self._measured = None
        self.whereabouts.forget()
        for rates in (self._differentiator, self._velocity_filter, *self._temperatures.values()):
            if rates is not None:
                rates.reset()

    def joint_state(self, stamp: int, names: Sequence[str], position: Sequence[float], velocity: Sequence[float],
                    effort: Sequence[float] = ()) -> list[Sample]:
        """A sensor_msgs/JointState with header stamp [ns]; returns the samples that became complete.

        Messages may leave their velocities empty: they are estimated from the positions. Where others held them before,
        the first three in a row are refused.
        """
        order = self._order('joint state', stamp, names)
        columns = {'position': position, 'velocity': velocity, 'effort': effort}
        if not self._effort:
            del columns['effort']
        if order is not None and not len(velocity) and self._estimates_velocities():
            del columns['velocity']
        if order is None or not self._right_length(stamp, names, columns):
            return []
        values = [column[index] for name, column in columns.items() if name != 'effort' for index in order]
        if self._effort:
            values += [effort[order[index]] for index in self._outputs]
        n = len(order)
        if self._is_elsewhere(stamp, values[:n]):
            return []
        if not self._acceptable('joint state', stamp, values):
            return []
        row = np.array(values, dtype=float)
        self.whereabouts.move(stamp, values[:n])
        if 'velocity' in columns:
            self.velocities_measured, self._without, self._measured = True, 0, (stamp, row)
        else:
            row = self._with_velocities(stamp, row, n)
        state = row[:2 * n]
        if self._differentiator is not None:
            state = np.concatenate((state, self._differentiator.update(stamp, row[n:2 * n])))
        if self._effort:
            return self._await(stamp, row[2 * n:], state)
        self._append(self._states, stamp, state, 'joint states')
        return self._completed()

    def _with_velocities(self, stamp: int, row: Array, n: int) -> Array:
        """The row of a joint state without velocities, with those of its n joints estimated from the positions."""
        rates = self._velocity_filter
        assert rates is not None
        if self._measured is not None:
            before, known = self._measured
            rates.begin(before, known[:n], known[n:2 * n])
        self.velocities_measured, self._measured = False, None
        knew = rates.knows_rates
        row = np.concatenate((row[:n], rates.update(stamp, row[:n]), row[n:]))
        if self._differentiator is not None and not (knew and rates.knows_rates):
            self._differentiator.reset()  # zeros that stand for velocities are none to go on from
        return row

    def _is_elsewhere(self, stamp: int, position: Sequence[float]) -> bool:
        """Refuse positions that the joints cannot have reached since the last joint state, where several publish."""
        if self.shared is False:
            return False
        joint, latest = self.whereabouts.out_of_reach(stamp, position), self.whereabouts.latest
        if joint is None or latest is None:
            return False
        if not self.shared:
            self.whereabouts.count(stamp, position)
            return False
        seconds, away = (stamp - latest[0]) * 1e-9, np.abs(np.array(position) - latest[1])
        if not away.max() < LARGEST:
            return False
        self._refuse('elsewhere', f'joint state at {in_seconds(stamp)} s has {self.joints[joint]!r} '
                                  f'{away[joint]:.3g} rad or m from where it was {seconds:.3g} s before: several '
                                  'publish joint states, and this one is of another robot.')
        return True

    def _estimates_velocities(self) -> bool:
        """Tell whether a joint state without velocities is one to estimate them of."""
        self._without += 1
        return self._velocity_filter is not None and (not self.velocities_measured
                                                      or self._without >= WITHOUT_VELOCITIES)

    def wrench(self, stamp: int, frame_id: str, values: Sequence[float]) -> list[Sample]:
        """A geometry_msgs/WrenchStamped: force [N] and torque [N m], (6,); returns the samples now complete."""
        if self._frame and frame_id.lstrip('/') != self._frame:
            return self._refuse('wrong_frame', f'wrench at {in_seconds(stamp)} s is in frame {frame_id!r}; expected '
                                               f'{self._frame!r}.')
        if len(values) != 6:
            return self._refuse('wrong_length',
                                f'wrench at {in_seconds(stamp)} s has {len(values)} values; expected 6.')
        if not self._acceptable('wrench', stamp, values):
            return []
        return [] if self._effort else self._await(stamp, np.array(values, dtype=float), None)

    def accelerations(self, stamp: int, names: Sequence[str], values: Sequence[float]) -> list[Sample]:
        """Measured accelerations [rad/s^2] with header stamp [ns]; returns the samples that became complete."""
        order = self._order('acceleration', stamp, names)
        if order is None or not self._right_length(stamp, names, {'acceleration': values}):
            return []
        chosen = [values[index] for index in order]
        if not self._acceptable('acceleration', stamp, chosen) or self._differentiator is not None:
            return []
        self._append(self._accelerations, stamp, np.array(chosen, dtype=float), 'accelerations')
        return self._completed()

    def temperature(self, stamp: int, frame_id: str, value: float) -> list[Sample]:
        """A sensor_msgs/Temperature [deg C]: ``frame_id`` names whose. No sample waits for one."""
        source = frame_id.lstrip('/')
        if source not in self._temperatures:
            self.ignored += 1
            self.last_ignored = (f'temperature at {in_seconds(stamp)} s is of {frame_id!r}; expected '
                                  f'{listed(tuple(self._temperatures))}.')
        elif self._acceptable(f'temperature of {source}', stamp, (value,)):
            self._temperatures[source].append(stamp, value)
        return []

    def _order(self, what: str, stamp: int, names: Sequence[str]) -> list[int] | None:
        """Indices of our joints in ``names``; the last answer is kept, for names hardly change."""
        known = self._orders.get(what)
        if known is not None and known[0] == names:
            return known[1]
        if names and not set(self.joints).intersection(names):
            self.ignored += 1
            self.last_ignored = (f'{what} at {in_seconds(stamp)} s names {listed(names)}; expected '
                                  f'{listed(self.joints)}.')
            return None
        missing = [joint for joint in self.joints if list(names).count(joint) != 1]
        if missing:
            self._named.update(set(self.joints).intersection(names))
            elsewhere = self.apart and missing[0] not in names
            end = '; others name the rest: publish all in one message.' if elsewhere else '.'
            self._refuse('missing_joint', f'{what} at {in_seconds(stamp)} s must name joint {missing[0]!r} once; it '
                                          f'names {listed(names)}{end}')
            return None
        order = [list(names).index(joint) for joint in self.joints]
        self._orders[what] = (names[:], order)
        return order

    def _right_length(self, stamp: int, names: Sequence[str], columns: dict[str, Sequence[float]]) -> bool:
        for column, values in columns.items():
            if len(values) != len(names):
                remedy = '; a wrench is predicted where sensor_frame is given' if column == 'effort' else ''
                if column == 'velocity' and not len(values) and self._velocity_filter is not None:
                    remedy = (f', but messages before it held velocities; from the {WITHOUT_VELOCITIES}th in a row on '
                              'they are estimated from the positions')
                self._refuse('wrong_length', f'{column} at {in_seconds(stamp)} s has {len(values)} values for '
                                             f'{len(names)} joints{remedy}.')
                return False
        return True

    def _acceptable(self, what: str, stamp: int, values: Sequence[float]) -> bool:
        """Tell whether values are possible and the stamp the topic's latest, which it becomes."""
        # One NaN or infinity makes the sum one too: four times faster than asking each value.
        if not isfinite(sum(values)):
            self._refuse('not_finite', f'{what} at {in_seconds(stamp)} s holds a value that is not finite.')
            return False
        if values and not (min(values) >= -LARGEST and max(values) <= LARGEST):
            self._refuse('out_of_range', f'{what} at {in_seconds(stamp)} s holds {max(values, key=abs):g}; expected '
                                         f'values within {LARGEST:g}.')
            return False
        if not -END_OF_TIME_NS <= stamp < END_OF_TIME_NS:
            self._refuse('out_of_range', f'{what} has the stamp {in_seconds(stamp)} s; expected one that a header can '
                                         'hold, with less than 1e9 ns beside its seconds.')
            return False
        last = self._last.get(what)
        if last is not None and stamp <= last:
            kind = 'duplicate' if stamp == last else 'backward'
            self._refuse(f'{kind}_stamp',
                         f'{what} has the {kind} stamp {in_seconds(stamp)} s after {in_seconds(last)} s.')
            return False
        self._last[what] = stamp
        self.accepted += 1
        return True

    def _refuse(self, reason: str, sentence: str) -> list[Sample]:
        self.faults[reason] += 1
        self.last_fault = self.sentences[reason] = shortened(sentence)
        return []

    def _append(self, track: Track, stamp: int, row: Array, what: str) -> None:
        track.append(stamp, row)
        if self._capacity is not None and len(track) > self._capacity:
            track.forget_oldest()
            self._refuse('overflow', f'{self._capacity} {what} wait for other topics, the last at {in_seconds(stamp)} '
                                     's: the oldest is given up.')

    def _await(self, stamp: int, output: Array, state: Array | None) -> list[Sample]:
        self._waiting.append((stamp, output, state))
        done = self._completed()
        if self._capacity is not None and len(self._waiting) > self._capacity:
            self._waiting.popleft()
            self._refuse('overflow', f'{self._capacity} measured outputs wait for the {self._followers[0][1]}s that '
                                     f'belong to them, the last at {in_seconds(stamp)} s: the oldest is given up.')
        return done

    def _completed(self) -> list[Sample]:
        """Samples of the waiting outputs, in order, as far as every other topic has come."""
        done: list[Sample] = []
        while self._waiting and all(track.decided(self._waiting[0][0]) for track, _ in self._followers):
            stamp, output, state = self._waiting.popleft()
            sample = self._sample(stamp, output, state)
            if sample is not None:
                done.append(sample)
        return done

    def _sample(self, stamp: int, output: Array, state: Array | None) -> Sample | None:
        parts = [] if state is None else [state]
        for track, what in self._followers:
            row = track.at(stamp)
            if row is None:
                self._refuse('unmatched', f'output at {in_seconds(stamp)} s has no {what} within the tolerance.')
                return None
            parts.append(row)
        joined = parts[0] if len(parts) == 1 else np.concatenate(parts)
        n = len(self.joints)
        temperature = np.array([held.at(stamp) for held in self._of_sources]) if self._of_sources else NO_TEMPERATURE
        return Sample(stamp, joined[:n], joined[n:2 * n], joined[2 * n:], output, temperature)
