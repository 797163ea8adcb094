"""A realtime priority for the node, as controllers have one."""

from __future__ import annotations

import os


def take_priority(priority: int) -> str:
    """Let every thread of this process, but no process it starts, run by SCHED_FIFO; a sentence when that is refused.

    :param priority: 1 to 99, or 0 to leave everything as it is.
    """
    if not priority:
        return ''
    policy, parameter = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority)
    try:
        for thread in os.listdir('/proc/self/task'):
            os.sched_setscheduler(int(thread), policy, parameter)
    except OSError as error:
        return (f'realtime_priority {priority} is refused by the system ({error.strerror}); the node goes on without. '
                'It needs a line "rtprio" for its user in /etc/security/limits.conf.')
    return ''
