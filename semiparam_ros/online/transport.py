"""Objects from process to process. Their arrays go beside the pickle (protocol 5), straight from and into memory.

Within it they would be copied, by a thread that keeps the interpreter's lock meanwhile, and samples would be late.
"""

from __future__ import annotations

import os
import pickle
from multiprocessing.connection import Connection

import numpy as np


def send(line: Connection, value: object) -> None:
    """Nobody may change its arrays until this returns. Nothing is sent of what cannot be pickled."""
    buffers: list[pickle.PickleBuffer] = []
    packed = pickle.dumps(value, 5, buffer_callback=buffers.append)
    parts = [memoryview(packed), *(buffer.raw() for buffer in buffers)]
    line.send([len(part) for part in parts])
    for part in parts:
        while len(part):
            part = part[os.write(line.fileno(), part):]


def receive(line: Connection) -> object:
    """Return what the other process sent. Raises EOFError or OSError when that ends."""
    parts = [np.empty(length, np.uint8).data for length in line.recv()]
    for part in parts:
        while len(part):
            count = os.readv(line.fileno(), [part])
            if not count:
                raise EOFError
            part = part[count:]
    return pickle.loads(parts[0], buffers=parts[1:])
