"""Foxglove's MCAP library for JavaScript: a program that prints what it reads, and its packages."""

import fcntl
import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import pytest

from support.browser import unavailable

PACKAGES = {'@mcap/core': '2.2.2', '@mcap/support': '1.1.0', '@foxglove/rosmsg': '5.0.5',
            '@foxglove/rosmsg2-serialization': '3.1.0'}
READER = """
import { McapIndexedReader } from '@mcap/core';
import { loadDecompressHandlers } from '@mcap/support';
import { parse } from '@foxglove/rosmsg';
import { MessageReader } from '@foxglove/rosmsg2-serialization';
import { readFileSync } from 'node:fs';

const bytes = readFileSync(process.argv[2]);
const part = (offset, size) => new Uint8Array(bytes.subarray(Number(offset), Number(offset + size)));
const readable = { size: async () => BigInt(bytes.length), read: async (offset, size) => part(offset, size) };
const decompressHandlers = await loadDecompressHandlers();
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
const readers = new Map();
for (const channel of reader.channelsById.values()) {
  const text = new TextDecoder().decode(reader.schemasById.get(channel.schemaId).data);
  readers.set(channel.id, new MessageReader(parse(text, { ros2: true })));
}
const plain = (key, value) => ArrayBuffer.isView(value) ? Array.from(value) : value;
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const channel = reader.channelsById.get(message.channelId);
  console.log(JSON.stringify({ topic: channel.topic, time: message.logTime.toString(),
    qos: channel.metadata.get('offered_qos_profiles'),
    data: readers.get(channel.id).readMessage(message.data) }, plain));
}
"""


@pytest.fixture(scope='module')
def node_modules() -> Path:
    """A folder with the JavaScript packages, installed once for all checkouts of this user."""
    if shutil.which('npm') is None:
        unavailable('npm is not installed')
    folder = Path(tempfile.gettempdir()) / f'semiparam_ros_test_npm_{os.getuid()}'
    folder.mkdir(exist_ok=True)
    with (folder / 'lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        wanted = json.dumps({'type': 'module', 'private': True, 'dependencies': PACKAGES})
        package, done = folder / 'package.json', folder / 'installed.json'
        if not done.exists() or done.read_text() != wanted:
            package.write_text(wanted)
            install = subprocess.run(['npm', 'install', '--no-audit', '--no-fund', '--loglevel=error'], cwd=folder,
                                     capture_output=True, text=True, timeout=200)
            if install.returncode:
                unavailable(f'npm could not install {", ".join(PACKAGES)}: {install.stderr[-500:]}')
            done.write_text(wanted)
    return folder


def read(node_modules: Path, bag: Path) -> list[dict[str, Any]]:
    """The messages of a bag as this library decodes them.

    The program has no file: other runs of the suite share the folder.
    """
    done = subprocess.run(['node', '--input-type=module', '-', str(bag)], input=READER, cwd=node_modules,
                          capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]
