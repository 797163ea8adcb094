"""One node of a name writes into a folder of states: a second one is told of the first."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path

from semiparam_ros.atomic_write import has_lock
from semiparam_ros.errors import SemiparamError


class AnotherHasIt(SemiparamError):
    """Another process has the lock of a folder."""


class FolderLock:
    """The right to write a node's states, which ends with the process, however that ends.

    The file is open for reading alone while the lock is held: a disk can still be made read-only. The process beside
    the node is forked before, and those that replace it are begun anew, so none of them keeps it from the next node.

    :param node_name: fully qualified; slashes become dots.
    """

    def __init__(self, folder: Path, node_name: str) -> None:
        self._folder, self._node_name = folder, node_name
        self._path = folder / f'{stem(node_name)}.lock'
        self._descriptor: int | None = None
        self._turn = threading.Lock()

    def take(self) -> None:
        """Take it, or have it; anew where its file has gone. Raises :class:`AnotherHasIt` while another process has it.

        Where no lock can be made (no folder, a file system without locks) nothing is said: writing tells what is wrong.
        A lock that is there and cannot be opened is a SemiparamError: another node may have it.
        """
        with self._turn:  # the node's own thread may ask for it, and that of checkpoints
            self._take()

    def _take(self) -> None:
        if self._descriptor is not None:
            if self._is_there(self._descriptor):
                return
            self.release()
        with suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
        opened = self._opened()
        if opened is None:
            return
        try:
            self._descriptor = self._locked(opened)
        finally:
            os.close(opened)

    def release(self) -> None:
        """Give it up before the process ends."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def _is_there(self, descriptor: int) -> bool:
        """Return whether the file that is locked is the one that others find: the folder may have been removed and made
        anew."""
        try:
            return os.path.samestat(os.fstat(descriptor), self._path.lstat())
        except OSError:
            return False

    def _opened(self) -> int | None:
        """Return a descriptor of its file, for reading alone if another user's; None where it can have none."""
        flags = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        with suppress(OSError):
            return os.open(self._path, os.O_RDWR | os.O_CREAT | flags, 0o666)
        try:
            return os.open(self._path, os.O_RDONLY | flags)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise SemiparamError(f'{self._path} cannot be opened ({error.strerror}): another node of this name may '
                                 'write there, so this one writes nothing; expected a file that this user may read.'
                                 ) from error

    def _locked(self, opened: int) -> int:
        """Return a descriptor that has the lock of an open file."""
        descriptor = os.open(f'/proc/self/fd/{opened}', os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        if not has_lock(descriptor):
            os.close(descriptor)
            raise AnotherHasIt(f'process {_owner(opened)}, another node of the name {self._node_name}, has its '
                               f'states in {self._folder} too, so this one writes none there; expected another '
                               'name or another state_folder.')
        with suppress(OSError):
            os.ftruncate(opened, 0)
            os.pwrite(opened, f'{os.getpid()}\n'.encode(), 0)
        return descriptor


def _owner(opened: int) -> str:
    try:
        return os.pread(opened, 20, 0).decode(errors='replace').strip()
    except OSError:  # no file: something else of this name has the lock
        return '(unknown)'


def stem(node_name: str) -> str:
    """Stem of the names of a node's files."""
    return node_name.strip('/').replace('/', '.')
