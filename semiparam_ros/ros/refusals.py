"""What the node would not take, beside messages that no sample can be made of: for /diagnostics."""

from __future__ import annotations

from collections import Counter

from semiparam_ros.errors import shortened

DESCRIPTION, TRAJECTORY, PARAMETERS = 'robot_description', 'desired_trajectory', 'parameters'
CHECKPOINTS = 'checkpoints'


class Refusals:
    """Counts by where they came in, and the last sentence of a topic; callers of services have theirs in the reply."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.last = ''

    def add(self, where: str, sentence: str) -> None:
        """One more."""
        self.counts[where] += 1
        if where != PARAMETERS:
            self.last = shortened(sentence)

    @property
    def on_topics(self) -> int:
        """How many messages."""
        return self.counts.total() - self.counts[PARAMETERS]
