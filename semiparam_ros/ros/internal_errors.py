"""Errors that nobody expected: counted by their place, told once with a traceback, and never the end of the node."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Callable


class InternalErrors:
    """Counts for /diagnostics, and the log.

    :param log: receives a text that must be seen. :param again: receives the sentence of an error seen before.
    """

    def __init__(self, log: Callable[[str], object], again: Callable[[str], object]) -> None:
        self.counts: Counter[str] = Counter()
        self.last = ''
        self._log, self._again = log, again
        self._seen: set[str] = set()

    def add(self, place: str, error: BaseException) -> str:
        """One more; returns its sentence. The first of its kind goes into the log with its traceback."""
        sentence = f'internal error at {place}, {type(error).__name__}: {error!s:.300}'
        self.counts[place] += 1
        self.last = sentence
        text = ''.join(traceback.format_exception(type(error), error, error.__traceback__))
        kind = f'{place} {type(error).__name__} {_innermost(error)}'
        if kind in self._seen:
            self._again(sentence)
        else:
            self._seen.add(kind)
            self._log(f'{sentence}\n{text}')
        return sentence


def _innermost(error: BaseException) -> str:
    """File and line where it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    return f'{frames[-1].filename}:{frames[-1].lineno}' if frames else ''
