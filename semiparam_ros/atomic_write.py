"""Whole files, or whole lines, or nothing: the one way in which this package writes a result.

What is written goes into a neighbour of the file, which takes its name when it is complete. A write that fails or is
interrupted removes the neighbour and leaves an older file of the name as it was.
"""

from __future__ import annotations

import fcntl
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO
from zlib import crc32

from semiparam_ros.errors import SemiparamError


@contextmanager
def replacing(path: str | os.PathLike[str], durable: bool = False) -> Iterator[IO[bytes]]:
    """A binary stream whose content takes the name ``path`` when the block ends without an exception.

    The file's permissions are those of any new file, as the umask says.

    :param durable: wait until the disk has it, so that a power cut leaves the old file or the new one.
    Raises SemiparamError, naming the file and the reason, when it cannot be written.
    """
    path = Path(path)
    temporary = _neighbour(path)
    try:
        _require_replaceable(path)
        try:
            descriptor = _make(temporary)
            with os.fdopen(descriptor, 'wb') as stream:
                yield stream
                if durable:
                    stream.flush()
                    os.fsync(stream.fileno())
            os.replace(temporary, path)
        except BaseException:  # also Ctrl-C
            temporary.unlink(missing_ok=True)
            raise
        if durable:
            _keep_name(path.parent)
    except OSError as error:
        raise SemiparamError(f'cannot write {path}: {error.strerror or error}.') from error


def require_writable(path: str | os.PathLike[str]) -> None:
    """Begin to write a file, and let it be.

    Raises SemiparamError, as :func:`replacing` does, when that is not possible.
    """
    path = Path(path)
    try:
        _require_replaceable(path)
        temporary = _neighbour(path)
        os.close(_make(temporary))
        temporary.unlink()
    except OSError as error:
        raise SemiparamError(f'cannot write {path}: {error.strerror or error}.') from error


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a whole text file in UTF-8 or nothing; raises SemiparamError when it cannot be written.

    Bytes of the name of a file that are no UTF-8 are shown as Python writes them.
    """
    with replacing(path) as stream:
        stream.write(text.encode(errors='backslashreplace'))


def append_line(path: str | os.PathLike[str], line: str) -> None:
    """Add a line in UTF-8 to a file, which is made with its folder where there is none: all of it or nothing.

    Who reads meanwhile may see a part of it, without the line's end. Raises SemiparamError when it cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open('ab', buffering=0) as stream:
            end, left = stream.tell(), memoryview(f'{line}\n'.encode())
            try:
                while left:
                    left = left[stream.write(left):]
            except OSError:
                stream.truncate(end)
                raise
    except OSError as error:
        raise SemiparamError(f'cannot write {path}: {error.strerror or error}.') from error


def remove_leftovers(path: str | os.PathLike[str]) -> None:
    """Remove the neighbours that killed writers of this file left; those that write it now keep theirs."""
    path = Path(path)
    with suppress(OSError):
        for entry in os.scandir(path.parent):
            if entry.name.startswith(_prefix(path)) and re.fullmatch('[0-9a-f]{12}', entry.name[len(_prefix(path)):]):
                _remove_if_left(entry.path)


def has_lock(descriptor: int) -> bool:
    """Take the lock of an open file, which ends with it; False while another has it.

    Whoever asks has it where a file system knows no locks.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


def _remove_if_left(path: str) -> None:
    """Remove a neighbour, unless another process, or another thread, writes it."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if has_lock(descriptor):
            os.unlink(path)
    finally:
        os.close(descriptor)


def _prefix(path: Path) -> str:
    """Prefix of the neighbours: hidden, no other file's, and short enough for a long name, whose letters may have four
    bytes each."""
    name = path.name
    return f'.{name if len(name) <= 60 else f"{name[:52]}{crc32(os.fsencode(name)):08x}"}.'


def _neighbour(path: Path) -> Path:
    return path.parent / f'{_prefix(path)}{secrets.token_hex(6)}'


def _make(temporary: Path) -> int:
    """Make the neighbour, with its lock. Not tempfile.mkstemp, which makes files that nobody else may read."""
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
    has_lock(descriptor)
    return descriptor


def _require_replaceable(path: Path) -> None:
    """Raise OSError where a rename would replace a folder, a device or a pipe."""
    if '\0' in str(path):
        raise OSError(None, 'its name holds a null character')
    if path.is_dir() or not path.name:
        raise IsADirectoryError(None, 'it is a folder; expected the name of a file')
    if path.exists() and not path.is_file():
        raise OSError(None, 'it is a device or a pipe; expected the name of a file')


def _keep_name(folder: Path) -> None:
    """Write a folder to the disk, and with it the new name in it."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
