"""The one exception that a user's mistake or a damaged input becomes, and how its sentence stays readable."""

from __future__ import annotations

from collections.abc import Sequence


class SemiparamError(ValueError):
    """One clear sentence: what was wrong, where, and what was expected.

    The command line prints it and exits with 2; the node logs it and counts it in its diagnostics. What a stranger sent
    may stand in it, so it is :func:`shortened`.
    """

    def __init__(self, sentence: str) -> None:
        super().__init__(shortened(sentence))


def listed(names: Sequence[str], most: int = 8) -> str:
    """Names for a sentence: all of them, or the first ones and how many more."""
    if not names:
        return 'none'
    shown = [shortened(name, 60) for name in names[:most]]
    return ', '.join(shown) + (f' and {len(names) - most} more' if len(names) > most else '')


def shortened(text: str, most: int = 600) -> str:
    """A text on one line, without its middle where it is too long to be read. What a terminal would obey, such as the
    colours of a name from a stranger's file, is shown as Python writes it."""
    if not text.isprintable():
        text = ''.join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
    half = (most - 5) // 2
    return text if len(text) <= most else f'{text[:half]} ... {text[-half:]}'
