"""Options of a playback, checked before anything is opened."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path

from semiparam_ros.bags.base import ORDERS
from semiparam_ros.errors import SemiparamError
from semiparam_ros.playback.player import checked_rate
from semiparam_ros.playback.timeline import Cut, Selection

DEFAULT_FOLLOW = '/estimator/residual'
FASTEST_CLOCK_HZ = 1e4


@dataclass(frozen=True)
class FollowOptions:
    """The flow control: who answers, and how far ahead the playback may run.

    :param answers: answer topic -> the played topic that it answers (None: the one of equal type)
    :param window: requests on the way at the same time
    :param timeout_s: silence of a follower that ends the playback [s]
    """

    answers: Mapping[str, str | None]
    window: int = 100
    timeout_s: float = 60.0

    def __post_init__(self) -> None:
        if self.window < 1:
            raise SemiparamError(f'the window must be at least 1 message, got {self.window}.')
        _at_least_zero('the answer timeout', self.timeout_s)


@dataclass(frozen=True)
class ReplayOptions:
    """Options of `bag_replay`; times in seconds.

    :param rate: bag seconds a second; None plays as fast as the followers answer, which needs
        ``follow``
    :param clock_hz: publish /clock that often; None does not
    :param wait_for_subscribers: how many subscribing nodes to wait for
    :param wait_s: how long to wait for subscribers and followers
    """

    bags: tuple[Path, ...]
    rate: float | None = 1.0
    loop: bool = False
    delay_s: float = 0.0
    cut: Cut = field(default_factory=Cut)
    selection: Selection = field(default_factory=Selection)
    remap: Mapping[str, str] = field(default_factory=dict)
    order: str = 'log'
    restamp: bool = False
    clock_hz: float | None = None
    clock_before_each: bool = False
    paused: bool = False
    keyboard: bool = True
    progress: bool = True
    qos_overrides: Path | None = None
    wait_for_subscribers: int = 0
    wait_s: float = 30.0
    wait_for_all_acked_s: float = 0.0
    follow: FollowOptions | None = None

    def __post_init__(self) -> None:
        if not self.bags:
            raise SemiparamError('no bag was named: expected at least one.')
        if self.rate is not None:
            checked_rate(self.rate)
        elif self.follow is None:
            raise SemiparamError('a playback as fast as it is followed needs a follower.')
        if self.restamp and self.follow is not None:
            raise SemiparamError('restamped messages cannot be followed: answers are told by the stamps of the bag.')
        if self.clock_hz is not None and not 0.0 < self.clock_hz <= FASTEST_CLOCK_HZ:
            raise SemiparamError(f'the clock rate must be above 0 Hz and at most {FASTEST_CLOCK_HZ:g} Hz, got '
                                 f'{self.clock_hz:g}.')
        if self.order not in ORDERS:
            raise SemiparamError(f"the order '{self.order}' is unknown: expected one of {', '.join(ORDERS)}.")
        for what in ('delay_s', 'wait_s', 'wait_for_all_acked_s', 'wait_for_subscribers'):
            _at_least_zero(what.removesuffix('_s').replace('_', ' '), getattr(self, what))


def parse_remap(text: str) -> tuple[str, str]:
    """Parse ``/old:=/new``; anything else raises SemiparamError."""
    old, separator, new = text.partition(':=')
    if not (old and separator and new):
        raise SemiparamError(f"'{text}' is no remapping: expected /old:=/new.")
    return old, new


def parse_follow(text: str) -> tuple[str, str | None]:
    """Parse ``ANSWERS`` or ``ANSWERS=REQUESTS``."""
    answers, _, requests = text.partition('=')
    return answers, requests or None


def _at_least_zero(what: str, value: float) -> None:
    if not (isfinite(value) and value >= 0.0):
        raise SemiparamError(f'{what} must not be negative or endless, got {value:g}.')
