"""Reading text files that people write."""

from __future__ import annotations

import errno
from pathlib import Path

LARGEST = 2**24
"""[characters] No file that people write is longer; a device gives them without end."""


def read_text(path: Path) -> str:
    """Return the text of a file. Raises OSError, also where it is too long, and ValueError where it is no UTF-8."""
    with path.open(encoding='utf-8') as file:
        text = file.read(LARGEST + 1)
    if len(text) > LARGEST:
        raise OSError(errno.EFBIG, f'it has more than {LARGEST} characters')
    return text
