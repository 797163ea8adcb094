"""Compiling the inner loops of a sample with numba.

A compiled function has its types from its annotations: the arrays of this module, numbers, and
NamedTuples of these. It is compiled when its module is imported, and cached on disk by numba: never
while samples come. Tests compare each with a plain form in numpy.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar, get_type_hints

import numba
from numba.core.dispatcher import Dispatcher

from semiparam_ros.core.types import Array, Indices

Vector: TypeAlias = Annotated[Array, numba.float64[::1]]
Matrix: TypeAlias = Annotated[Array, numba.float64[:, ::1]]
Stack: TypeAlias = Annotated[Array, numba.float64[:, :, ::1]]
Integers: TypeAlias = Annotated[Indices, numba.int64[::1]]
"""Arrays without gaps, by rows; one by columns is passed as its transpose."""
Strided: TypeAlias = Annotated[Array, numba.float64[:]]
Part: TypeAlias = Annotated[Array, numba.float64[:, :]]
"""Those that may have gaps: a vector, and a part of a matrix."""

_FAST = {'reassoc', 'contract', 'nsz'}
"""Sums may be added in any order, so that the processor's vectors are used; what is not finite
stays so."""

Function = TypeVar('Function', bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile a function, which writes into its arrays or returns numbers and arrays."""
    _name_by_dependencies(function)
    *arguments, returned = map(_numba_type, _hints(function))
    options: Any = {'fastmath': _FAST, 'error_model': 'numpy'}
    try:
        return numba.njit(returned(*arguments), cache=True, **options)(function)
    except (OSError, RuntimeError):  # no cache can be written, beside this file or at home
        return numba.njit(returned(*arguments), **options)(function)


def direct(function: Function) -> Function:
    """Return a compiled function for callers that pass just what it is annotated with, arrays
    without gaps: nothing looks at them. Of a NamedTuple numba would look at every field, which
    takes a microsecond."""
    overloads = getattr(function, 'overloads', {})  # none where numba is switched off
    return next((each.entry_point for each in overloads.values()), function)


def _name_by_dependencies(function: Callable[..., Any]) -> None:
    """Give the cached function another name with every change of what it uses of other modules:
    numba sees only whether the function's own file has changed."""
    own = function.__code__.co_filename
    used = [function.__globals__.get(name) for name in function.__code__.co_names]
    callees = [each.py_func for each in used if isinstance(each, Dispatcher)]
    files = sorted({each.__code__.co_filename for each in callees} - {own})
    if files:
        names = ''.join(sorted(each.__qualname__ for each in callees))
        contents = b''.join(Path(name).read_bytes() for name in files)
        digest = hashlib.sha256(contents + names.encode())
        function.__qualname__ += f'_{digest.hexdigest()[:16]}'


def _hints(annotated: Callable[..., Any]) -> list[Any]:
    return list(get_type_hints(annotated, include_extras=True).values())


def _numba_type(hint: Any) -> Any:
    """The type of an argument or a result."""
    if hasattr(hint, '__metadata__'):
        return hint.__metadata__[0]
    if hasattr(hint, '_fields'):
        return numba.types.BaseTuple.from_types(tuple(map(_numba_type, _hints(hint))), hint)
    if hasattr(hint, '__args__'):
        return numba.types.BaseTuple.from_types(tuple(map(_numba_type, hint.__args__)))
    return {int: numba.int64, float: numba.float64, bool: numba.boolean,
            type(None): numba.void}[hint]
