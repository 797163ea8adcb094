"""One node of a name writes into a folder of states: a second one is told of the first."""

from __future__ import annotations

import fcntl
import os
import threading
from contextlib import suppress
from pathlib import Path

from semiparam_ros.errors import SemiparamError


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
        """Take it, or have it; anew where its file has gone. Raises SemiparamError while another process has it.

        Where no lock can be made (no folder, a file system without locks) nothing is said: writing tells what is wrong.
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
        flags = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        try:
            written = os.open(self._path, os.O_RDWR | os.O_CREAT | flags, 0o666)
        except OSError:
            return
        try:
            self._descriptor = self._locked(written)
        finally:
            os.close(written)

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

    def _locked(self, written: int) -> int | None:
        """A descriptor that has the lock of a file open for writing; None where there are no locks."""
        descriptor = os.open(f'/proc/self/fd/{written}', os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(descriptor)
            if not isinstance(error, BlockingIOError):
                return None
            owner = os.pread(written, 20, 0).decode(errors='replace').strip()
            raise SemiparamError(f'process {owner}, another node of the name {self._node_name}, has its states in '
                                 f'{self._folder} too, so this one writes none there; expected another name or '
                                 'another state_folder.') from None
        with suppress(OSError):
            os.ftruncate(written, 0)
            os.pwrite(written, f'{os.getpid()}\n'.encode(), 0)
        return descriptor


def stem(node_name: str) -> str:
    """Stem of the names of a node's files."""
    return node_name.strip('/').replace('/', '.')
