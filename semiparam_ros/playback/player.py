"""The player: publishes a timeline in its order and at its pace, while another thread pauses, steps or seeks it.

It has never heard of ROS: what it plays comes from a :class:`Timeline`, where it goes is a function.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator
from contextlib import closing
from enum import Enum
from itertools import chain
from typing import NamedTuple, Protocol

from semiparam_ros.errors import SemiparamError

MonotonicClock = Callable[[], int]
LOOK_S = 3600.0
"""Nobody waits for longer without looking again: Python refuses to wait for centuries, as at a rate near 0."""
END_OF_TIME_NS = 2**62


def checked_rate(rate: float) -> float:
    """The rate, or SemiparamError unless it is a finite number above zero."""
    if not 0.0 < rate < float('inf'):
        raise SemiparamError(f'the rate must be a finite number above 0, got {rate:g}.')
    return float(rate)


class PlayClock:
    """Clock: bag_time(t) = bag_anchor + rate (t - wall_anchor) [ns], constant while paused.

    Every change re-anchors at the present instant, so changing the rate never makes the bag time
    jump, and because due times are computed from the anchor and not from the previous message, a
    late wake-up does not add up.
    """

    def __init__(self, bag_time: int, rate: float = 1.0, paused: bool = False,
                 monotonic: MonotonicClock = time.monotonic_ns) -> None:
        self._monotonic = monotonic
        self.rate, self.paused = checked_rate(rate), paused
        """Bag seconds in one second of this machine; whether the bag time stands still."""
        self._bag_anchor = bag_time
        self._wall_anchor = monotonic()

    def now(self) -> int:
        """The present bag time [ns]."""
        if self.paused:
            return self._bag_anchor
        passed = (self._monotonic() - self._wall_anchor) * self.rate
        return self._bag_anchor + int(min(passed, float(END_OF_TIME_NS)))

    def seconds_until(self, bag_time: int) -> float:
        """Seconds of this machine until ``bag_time`` [ns] is due; zero or less when it is due, for a running clock."""
        due = self._wall_anchor + (bag_time - self._bag_anchor) / self.rate
        return (due - self._monotonic()) * 1e-9

    def jump(self, bag_time: int) -> None:
        """Let the bag time be ``bag_time`` [ns] now."""
        self._bag_anchor, self._wall_anchor = bag_time, self._monotonic()

    def set_rate(self, rate: float) -> None:
        """Run at another rate from here on. Raises SemiparamError for a rate that is not above zero."""
        rate = checked_rate(rate)
        self.jump(self.now())
        self.rate = rate

    def set_paused(self, paused: bool) -> None:
        """Stop or start the bag time."""
        self.jump(self.now())
        self.paused = paused


class Item(NamedTuple):
    """One serialised message and the bag time [ns] at which it is due."""

    time: int
    topic: str
    raw: bytes


class Timeline(Protocol):
    """Timeline to play: messages between two bag times, readable from any as often as wanted."""

    @property
    def start_ns(self) -> int:
        """Bag time where the playback begins [ns]."""

    @property
    def end_ns(self) -> int:
        """Bag time of its last message [ns]."""

    def play(self, from_ns: int) -> Generator[Item, None, None]:
        """Generate every item due at or after ``from_ns``, in order."""


class Gate(Protocol):
    """Gate that holds messages back until enough of the earlier ones are answered."""

    def patience(self, item: Item) -> float:
        """Seconds to wait before asking again, 0 when ``item`` may go; raises when it gave up."""

    def sent(self, item: Item) -> None:
        """Take note that ``item`` is about to be published."""


class Ending(Enum):
    """Reason why a playback ended."""

    FINISHED = 'finished'
    STOPPED = 'stopped'


class _Next(Enum):
    GO = 'go'
    SEEK = 'seek'
    STOP = 'stop'


class Player:
    """Plays a timeline at ``rate`` bag seconds a second, or unpaced (``rate=None``: as fast as the gate admits).

    :meth:`run` publishes in the thread that calls it; every other method may be called from any thread.
    """

    def __init__(self, timeline: Timeline, publish: Callable[[Item], None], *, rate: float | None = 1.0,
                 loop: bool = False, paused: bool = False, gate: Gate | None = None,
                 monotonic: MonotonicClock = time.monotonic_ns) -> None:
        self._timeline = timeline
        self._publish = publish
        self._gate = gate
        self._paced = rate is not None
        self.loop = loop
        self._clock = PlayClock(timeline.start_ns, 1.0 if rate is None else rate, True, monotonic)
        self._held = paused
        self._changed = threading.Condition()
        self._steps = 0
        self._target: int | None = None
        self._stopped = False
        self.published = 0
        """Messages so far, every round of a loop counted."""

    def run(self) -> Ending:
        """Play to the end, for ever when looping, or until stopped. Errors of the gate pass through."""
        position = self._timeline.start_ns
        while True:
            done = self._play_from(position)
            with self._changed:
                if done is _Next.STOP:
                    return Ending.STOPPED
                if done is _Next.GO and not self.loop:
                    return Ending.FINISHED
                position = self._timeline.start_ns if self._target is None else self._target
                self._target = None

    def _play_from(self, position: int) -> _Next:
        """Publish from one bag time on; GO when the timeline ends, else what interrupted it."""
        with closing(self._timeline.play(position)) as items:
            first = next(items, None)
            if first is None:
                if self.loop and position <= self._timeline.start_ns:
                    raise SemiparamError('there is nothing to loop: no message is left between the '
                                         'start and the end.')
                return _Next.GO
            with self._changed:  # after the first read, which takes longest: till then the bag time stands still
                self._clock.jump(position)
                if self._paced:
                    self._clock.set_paused(self._held)
            for item in chain([first], items):
                verdict = self._wait_for(item)
                if verdict is not _Next.GO:
                    return verdict
                self._send(item)
        return _Next.GO

    def _send(self, item: Item) -> None:
        if self._gate is not None:
            self._gate.sent(item)
        self._publish(item)
        self.published += 1

    def _wait_for(self, item: Item) -> _Next:
        """Block until the item is due and admitted, or until a seek or a stop."""
        with self._changed:
            while True:
                if self._stopped:
                    return _Next.STOP
                if self._target is not None:
                    return _Next.SEEK
                delay = self._delay(item)
                if delay == 0.0:
                    if not self._paced or self._clock.paused:
                        self._clock.jump(item.time)
                    return _Next.GO
                self._changed.wait(None if delay is None else min(delay, LOOK_S))

    def _delay(self, item: Item) -> float | None:
        """Seconds to wait before looking again: 0 when the item may go, None until somebody calls."""
        if self._held and not self._steps:
            return None
        if self._paced and not self._held:
            due = self._clock.seconds_until(item.time)
            if due > 0.0:
                return due
        patience = 0.0 if self._gate is None else self._gate.patience(item)
        if patience == 0.0 and self._held:
            self._steps -= 1
        return patience

    def wake(self) -> None:
        """Look again at the gate: an answer has arrived."""
        with self._changed:
            self._changed.notify_all()

    def stop(self) -> None:
        """End the playback before the next message."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def set_paused(self, paused: bool) -> None:
        """Hold the playback, or let it go on from where it stands."""
        with self._changed:
            self._held, self._steps = paused, 0
            if self._paced:
                self._clock.set_paused(paused)
            self._changed.notify_all()

    def step(self) -> None:
        """Publish the next message at once and stay paused. Raises SemiparamError when not paused."""
        with self._changed:
            if not self._held:
                raise SemiparamError('only a paused playback can be stepped: pause it first.')
            self._steps += 1
            self._changed.notify_all()

    def seek(self, bag_time: int) -> None:
        """Go on from ``bag_time`` [ns]; raises SemiparamError outside the timeline."""
        self.check_seek(bag_time)
        with self._changed:
            self._target = bag_time
            self._changed.notify_all()

    def set_rate(self, rate: float) -> None:
        """Play at another rate from here on; raises SemiparamError for one that is not above zero, or unpaced."""
        self.check_rate(rate)
        with self._changed:
            self._clock.set_rate(rate)
            self._changed.notify_all()

    def check_seek(self, bag_time: int) -> None:
        """Raise SemiparamError when ``bag_time`` [ns] lies outside the timeline."""
        start, end = self._timeline.start_ns, self._timeline.end_ns
        if not start <= bag_time <= end:
            raise SemiparamError(f'cannot seek to {(bag_time - start) * 1e-9:.3f} s: '
                                 f'the playback lasts from 0 to {(end - start) * 1e-9:.3f} s.')

    def check_rate(self, rate: float) -> None:
        """Raise SemiparamError when the playback cannot run at ``rate``."""
        checked_rate(rate)
        if not self._paced:
            raise SemiparamError('the playback goes as fast as its follower answers: it has no rate to set.')

    @property
    def rate(self) -> float | None:
        """Bag seconds a second, None when unpaced."""
        return self._clock.rate if self._paced else None

    @property
    def paused(self) -> bool:
        """Tell whether the playback is held."""
        return self._held

    def now(self) -> int:
        """The present bag time [ns], never beyond the end of the timeline."""
        with self._changed:
            return min(self._clock.now(), self._timeline.end_ns)
