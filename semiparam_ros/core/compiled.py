"""Compiling the inner loop of a sample with numba, where it is installed.

A compiled function stands beside its readable form in numpy; a test compares the two to 1e-12. It is compiled when its
module is imported, and cached on disk by numba: never while samples come. Without numba the forms in numpy run, and a
sample takes about half as long again.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

try:
    if os.environ.get('SEMIPARAM_COMPILED') == '0':
        raise ImportError('switched off')
    import numba
except ImportError:
    AVAILABLE = False
else:
    AVAILABLE = True

VECTOR, MATRIX, STACK = 'float64[::1]', 'float64[:,::1]', 'float64[:,:,::1]'
"""Types of arguments: arrays without gaps, by rows; one by columns is passed as its transpose."""
STRIDED, PART = 'float64[:]', 'float64[:,:]'
"""Those that may have gaps: a vector, and a part of a matrix."""
INTEGER, NUMBER, INTEGERS = 'int64', 'float64', 'int64[::1]'

_FAST = {'reassoc', 'contract', 'nsz'}
"""Sums may be added in any order, so that the processor's vectors are used; what is not finite stays so."""


def compiled(*arguments: str, returns: str = 'void', calls: Sequence[Callable[..., Any]] = (),
             ) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function of these arguments, which writes into its arrays or returns a number.

    :param calls: compiled functions of other modules that it calls. numba sees only whether a function's own file has
        changed, so theirs give it another name in the cache.
    """
    signature = f'{returns}({", ".join(arguments)})'

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        if not AVAILABLE:
            return function
        files = sorted({each.__code__.co_filename for each in calls})
        if files:
            digest = hashlib.sha256(b''.join(Path(name).read_bytes() for name in files)).hexdigest()
            function.__qualname__ += f'_{digest[:16]}'
        try:
            return numba.njit(signature, cache=True, fastmath=_FAST, error_model='numpy')(function)
        except (OSError, RuntimeError):  # neither beside this file nor in the home of its user can a cache be written
            return numba.njit(signature, fastmath=_FAST, error_model='numpy')(function)

    return decorate
