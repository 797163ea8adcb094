"""Flow control: as fast as the subscriber follows, so that its queue never overflows and no sample is lost.

The follower answers each *request* (one message on the request topic) by one message that carries the request's
stamp. At most ``window`` requests are on the way at any time; other topics pass freely, for the order of the bag
ties them to the requests around them.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Sequence

from semiparam_ros.playback.player import Item, MonotonicClock

WIDEN_S = 2.0
# What waits in the follower is not without bound either.
WIDEN_AT_MOST = 128
LOOK_S = 1.0
UNMATCHED_S = 10.0
"""Patience at the end with requests that no played message of another topic reaches."""


class FollowerSilent(Exception):
    """The follower stopped answering: one sentence for the user."""


class FlowControl:
    """A window over the requests that wait for an answer.

    An answer settles its own request and those sent before it, which the follower must have refused: it works in
    order. So a refused sample costs no more than the patience of one window, and is accounted for as unanswered.
    Answers without a stamp settle the oldest request. Thread-safe.

    :param request_topic: the topic whose messages are answered, as the bag names it
    :param window: requests on the way at the same time, at most the follower's queue depth
    :param timeout_s: silence after which the follower counts as gone [s], while something waits to be published; it
        may rightly think for some seconds when it estimates hyperparameters
    :param stamp_of: header stamp [ns] of a serialised request
    :param is_gone: whether the follower has left
    :param beside: stamped topics that it hears besides, whose messages it may need to answer a request
    """

    def __init__(self, request_topic: str, window: int, timeout_s: float, stamp_of: Callable[[bytes], int],
                 is_gone: Callable[[], bool] = lambda: False, monotonic: MonotonicClock = time.monotonic_ns,
                 beside: Collection[str] = ()) -> None:
        self.request_topic = request_topic
        self.window = window
        self.timeout_s = timeout_s
        self._stamp_of = stamp_of
        self._keeps_all = False
        self._is_gone = is_gone
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._waiting: OrderedDict[int, int] = OrderedDict()
        self._last_sign = self._asked = monotonic()
        self._next: Item | None = None
        self._beside = beside
        self._reached: dict[str, int] = {}
        """Stamps of the last messages on those topics."""
        self.requests = self.answers = self.unexpected = 0
        self.unanswered_stamps: list[int] = []

    def fit_queue(self, depth: int | None) -> None:
        """Adapt the window to the follower's queue: ``depth`` messages, 0 for all, None for unknown.

        A follower that keeps all cannot overflow, so the window may double after each ``WIDEN_S`` of silence: a long
        run of samples that it must refuse (wrenches before the first joint state) is passed instead of waited for.
        """
        with self._lock:
            self._keeps_all = depth == 0
            self.window = min(self.window, depth or self.window)

    def patience(self, item: Item) -> float:
        """Seconds until ``item`` may be published, or 0; FollowerSilent after the timeout."""
        with self._lock:
            if item != self._next:  # a pause of the bag, or of the player, is no silence of the follower
                self._next, self._asked = item, self._monotonic()
            if item.topic != self.request_topic or len(self._waiting) < self.window:
                return 0.0
            remaining, silent = self._remaining(), self._silent()
            if not self._keeps_all:
                return remaining
            if len(self._waiting) < self.window * min(2 ** int(silent / WIDEN_S), WIDEN_AT_MOST):
                return 0.0
            return min(remaining, WIDEN_S - silent % WIDEN_S)

    def drain_patience(self) -> float:
        """Seconds to wait until every request is settled, as :meth:`patience`, at the end."""
        with self._lock:
            return self._remaining(self._unmatched()) if self._waiting else 0.0

    def _unmatched(self) -> list[str]:
        """Topics that end before the last request, which what comes there may have to complete."""
        last = next(reversed(self._waiting.values()))
        return [topic for topic, stamp in self._reached.items() if stamp < last]

    def _silent(self) -> float:
        """Seconds since the last answer, or since there was something to answer."""
        return (self._monotonic() - self._last_sign) * 1e-9

    def _remaining(self, unmatched: Sequence[str] = ()) -> float:
        """Seconds until somebody should look again; raises FollowerSilent when there is nothing to hope for."""
        timeout_s = min(self.timeout_s, UNMATCHED_S) if unmatched else self.timeout_s
        silent = self._silent()
        if self._is_gone():
            raise FollowerSilent(f'the follower has left while {len(self._waiting)} messages on {self.request_topic} '
                                 f'wait for it; it answered {self.answers} of {self.requests}.')
        waited = (self._monotonic() - max(self._last_sign, self._asked)) * 1e-9
        if waited >= timeout_s:
            ends = f' {" and ".join(unmatched)} ended before the last of them.' if unmatched else ''
            raise FollowerSilent(f'the follower has been silent for {silent:.1f} s while {len(self._waiting)} messages '
                                 f'on {self.request_topic} wait for it; it answered {self.answers} of {self.requests}.'
                                 f'{ends}')
        return min(timeout_s - waited, LOOK_S)

    def sent(self, item: Item) -> None:
        """Count a request that is about to be published."""
        if item.topic in self._beside:
            self._reached[item.topic] = self._stamp_of(item.raw)
        if item.topic != self.request_topic:
            return
        stamp = self._stamp_of(item.raw)
        with self._lock:
            if not self._waiting:
                self._last_sign = self._monotonic()
            self.requests += 1
            self._waiting[self.requests] = stamp

    def answered(self, stamp: int | None) -> None:
        """Settle the request of this stamp [ns] and those before it; without a stamp, the oldest one."""
        with self._lock:
            self._last_sign = self._monotonic()
            key = next((key for key, waiting in self._waiting.items() if stamp is None or waiting == stamp), None)
            if key is None:
                self.unexpected += 1
                return
            self.answers += 1
            while (oldest := self._waiting.popitem(last=False))[0] != key:
                self.unanswered_stamps.append(oldest[1])

    def give_up(self) -> None:
        """Count what still waits as unanswered: nothing more is expected."""
        with self._lock:
            self.unanswered_stamps.extend(self._waiting.values())
            self._waiting.clear()


class Followers:
    """The gate of a playback with any number of followers: the slowest one decides."""

    def __init__(self, flows: Sequence[FlowControl]) -> None:
        self._flows = flows

    def patience(self, item: Item) -> float:
        """Seconds to wait for the slowest follower."""
        return min((wait for flow in self._flows if (wait := flow.patience(item)) > 0.0), default=0.0)

    def sent(self, item: Item) -> None:
        """Tell every follower's flow control of a request."""
        for flow in self._flows:
            flow.sent(item)

    def answers(self) -> str:
        """Numbers of the requests that each follower answered."""
        return ', '.join(f'{flow.answers} of {flow.requests} answered' for flow in self._flows)

    def settled(self) -> bool:
        """Tell whether nothing waits for an answer; FollowerSilent when it has waited too long."""
        return all(flow.drain_patience() == 0.0 for flow in self._flows)
