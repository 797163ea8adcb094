"""How every process of this package lets its executor work."""

from __future__ import annotations

from rclpy.executors import Executor
from rclpy.task import Future


def spin_for(executor: Executor, seconds: float) -> None:
    """Handle whatever comes within so many seconds.

    The EventsExecutor's spin() never sleeps without a timeout, and spin_once() returns after each message, which costs
    a fifth of taking it; waiting for a future that nobody completes does neither.
    """
    executor.spin_until_future_complete(Future(), timeout_sec=seconds)
