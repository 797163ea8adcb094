"""One node of a name writes into a folder of states: a second one is told of the first."""

from __future__ import annotations

import fcntl
import os
from contextlib import suppress
from pathlib import Path

from semiparam_ros.errors import SemiparamError


class FolderLock:
    """The right to write a node's states, which ends with the process, however that ends.

    A lock of the process (POSIX): the processes that it starts do not have it, and cannot keep it from the next node.

    :param node_name: fully qualified; slashes become dots.
    """

    def __init__(self, folder: Path, node_name: str) -> None:
        self._folder, self._node_name = folder, node_name
        self._path = folder / f'{stem(node_name)}.lock'
        self._descriptor: int | None = None

    def take(self) -> None:
        """Take it, or have it already. Raises SemiparamError while another process has it.

        Where no lock can be made (no folder, a file system without locks) nothing is said: writing tells what is wrong.
        """
        if self._descriptor is not None:
            return
        with suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK,
                                 0o666)
        except OSError:
            return
        try:
            fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            taken = isinstance(error, (BlockingIOError, PermissionError))
            owner = os.pread(descriptor, 20, 0).decode(errors='replace').strip() if taken else ''
            os.close(descriptor)
            if taken:
                raise SemiparamError(f'process {owner}, another node of the name {self._node_name}, has its states in '
                                     f'{self._folder} too, so this one writes none there; expected another name or '
                                     'another state_folder.') from None
            return
        with suppress(OSError):
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f'{os.getpid()}\n'.encode(), 0)
        self._descriptor = descriptor


def stem(node_name: str) -> str:
    """What a node's files are called by."""
    return node_name.strip('/').replace('/', '.')
