"""Arrays with names as the columns of one table: numpy and MATLAB files, folders of text tables."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from semiparam_ros.bags.text_lines import Cells, filled, number_in, text_lines
from semiparam_ros.errors import SemiparamError

SUFFIXES = ('.npz', '.npy', '.mat')
TABLES = ('.csv', '.txt', '.dat', '.tsv')
OF_BAGS = ('*.mcap', '*.mcap.partial', '*.db3', 'metadata.yaml')
"""Files that no folder of tables holds; that of a bag may hold notes."""


def is_table_folder(path: Path) -> bool:
    """Tell whether a path is a folder of text tables rather than a bag."""
    return path.is_dir() and bool(_tables(path)) and not any(any(path.glob(pattern)) for pattern in OF_BAGS)


def holds_arrays(path: Path) -> bool:
    """Tell whether :func:`array_lines` reads this path."""
    return path.suffix.lower() in SUFFIXES or is_table_folder(path)


def array_lines(path: Path, asked: Iterable[str] = ()) -> Cells:
    """A header line of names, then a line of cells for each sample, as a text table would have them.

    :param asked: columns that are read: their arrays tell which side the samples run along.

    An array of several columns gives NAME:1, NAME:2 and so on. Raises SemiparamError where nothing can be read.
    """
    columns = _columns(_arrays(path), repr(str(path)), asked)
    yield 1, list(columns)
    for number, row in enumerate(zip(*(values.tolist() for values in columns.values()), strict=True), 2):
        yield number, [repr(value) for value in row]


def raise_unmatched(path: Path, column: str, asked: Iterable[str]) -> None:
    """Raise SemiparamError where a column is of an array that is left out: it holds no numbers, or as many rows as no
    other."""
    arrays = _arrays(path)
    columns = _columns(arrays, repr(str(path)), asked)
    count = len(next(iter(columns.values())))
    for name in (column, column.rpartition(':')[0]):
        shape = np.shape(arrays[name]) if name in arrays else ()
        if name in arrays and not _is_numeric(arrays[name]):
            raise SemiparamError(f"{str(path)!r}: '{name}' holds no numbers; expected an array of them.")
        if shape and count not in shape:
            raise SemiparamError(f"{str(path)!r}: '{name}' has {' x '.join(map(str, shape))} values, where the others "
                                 f'have {count} samples; expected as many samples in each.')


def _tables(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in TABLES)


def _arrays(path: Path) -> dict[str, Any]:
    return _folder(path) if path.is_dir() else _file(path)


def _folder(folder: Path) -> dict[str, Any]:
    arrays = dict[str, Any]()
    for path in _tables(folder):
        if path.stem in arrays:
            raise SemiparamError(f'{str(folder)!r} has several tables called {path.stem!r}; expected distinct names, '
                                 'for that of a file names its columns.')
        try:
            rows = [[number_in(cell) for cell in filled(cells)] for _, cells in text_lines(path)]
            arrays[path.stem] = np.array(rows)
        except SemiparamError:
            raise
        except ValueError:
            raise SemiparamError(f'{str(path)!r} is no table of numbers alone; expected as many of them in each line '
                                 'and no header, for in a folder the name of a file names its columns.') from None
    return arrays


def _file(path: Path) -> dict[str, Any]:
    name = repr(str(path))
    try:
        if path.suffix.lower() == '.mat':
            return _matlab(path)
        loaded = np.load(path, allow_pickle=False)
        return {'array': loaded} if isinstance(loaded, np.ndarray) else {key: loaded[key] for key in loaded.files}
    except OSError as error:
        raise SemiparamError(f'{name} cannot be read: {error.strerror or error}.') from error
    except NotImplementedError as error:
        raise SemiparamError(f"{name} is of MATLAB 7.3 or later; save it with save(FILE, '-v7').") from error
    except (ValueError, TypeError, KeyError, EOFError, MemoryError, OverflowError, zipfile.BadZipFile) as error:
        raise SemiparamError(f'{name} is damaged or holds no plain arrays ({" ".join(str(error).split())}); save '
                             'arrays of numbers.') from error


def _matlab(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    try:
        return dict(_fields(loadmat(path, simplify_cells=True)))
    except (OSError, NotImplementedError):
        raise
    except Exception as error:  # the reader fails in many ways on a damaged file
        raise ValueError(str(error)) from error


def _fields(values: Mapping[str, Any], within: str = '') -> Iterator[tuple[str, Any]]:
    """Arrays by name, those of a struct as STRUCT.FIELD."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _fields(value, f'{within}{name}.')
        elif not name.startswith('__'):
            yield within + name, value


def _is_numeric(values: Any) -> bool:
    return isinstance(values, np.ndarray) and values.dtype.kind in 'iuf'


def _columns(arrays: Mapping[str, Any], where: str, asked: Iterable[str]) -> dict[str, np.ndarray[Any, Any]]:
    """Columns (N,) by name. Samples run along the longer side that most arrays share, of those that are asked for."""
    numeric = {name: np.atleast_1d(np.squeeze(values)) for name, values in arrays.items() if _is_numeric(values)}
    numeric = {name: values.astype(float) if values.dtype.itemsize > 8 else values for name, values in numeric.items()
               if values.ndim <= 2 and values.size > 1}
    wanted = {name for column in asked for name in (column, column.rpartition(':')[0])} & numeric.keys()
    lengths = [max(numeric[name].shape) for name in wanted or numeric]
    if not lengths:
        raise SemiparamError(f'{where} holds no arrays of numbers; expected one for each quantity, a row a sample.')
    count = max(set(lengths), key=lambda length: (lengths.count(length), length))
    columns: dict[str, np.ndarray[Any, Any]] = {}
    for name, values in numeric.items():
        if count not in values.shape:
            continue
        rows = values.reshape(len(values), -1) if len(values) == count else values.T
        names = [name] if rows.shape[1] == 1 else [f'{name}:{number}' for number in range(1, rows.shape[1] + 1)]
        columns.update(zip(names, rows.T, strict=True))
    return columns
