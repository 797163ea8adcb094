"""Damaged bags: what is read of them, what is said about the rest, and that nothing wrong is ever read.

Each case damages the same recording of 6001 messages; `pytest -s -k as_far_as_it_goes` prints how many are read.
"""

import os
import random
import signal
import struct
import subprocess
import sys
import tracemalloc
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer

from semiparam_ros.bags.mcap_format import MAGIC
from semiparam_ros.bags.reader import open_bag
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.errors import SemiparamError
from support.commands import refusal, semiparam

ROWS = 3000
INTACT = 2 * ROWS + 1


def record(bag: BagWriter, rows: int = ROWS) -> None:
    source = random.Random(1)
    bag.write('/robot_description', 'std_msgs/msg/String', {'data': '<robot name="r"/>'}, 10**9)
    for row in range(rows):
        stamp = 10**9 + row * 10**7
        header = {'stamp': {'sec': stamp // 10**9, 'nanosec': stamp % 10**9}, 'frame_id': 'sensor'}
        bag.write('/joint_states', 'sensor_msgs/msg/JointState', {
            'header': header, 'name': ['hip', 'knee'], 'position': [source.random(), source.random()],
            'velocity': [source.random(), source.random()]}, stamp)
        bag.write('/wrench', 'geometry_msgs/msg/WrenchStamped', {
            'header': header, 'wrench': {'force': {'x': source.random()}}}, stamp)


@pytest.fixture(scope='module')
def intact(tmp_path_factory) -> dict[str, bytes]:
    """The bytes of the recording for each compression."""
    found = {}
    for compression in ('zstd', 'lz4', 'none'):
        path = tmp_path_factory.mktemp(compression) / 'intact.mcap'
        with BagWriter(path, compression=compression) as bag:
            record(bag)
        found[compression] = path.read_bytes()
    return found


@pytest.fixture(scope='module')
def truth(intact, tmp_path_factory) -> set[tuple[str, int, int, bytes]]:
    """Every message of the recording."""
    path = tmp_path_factory.mktemp('truth') / 'intact.mcap'
    path.write_bytes(intact['zstd'])
    with open_bag(path) as bag:
        messages = {(m.topic, m.log_time, m.publish_time, m.raw) for m in bag.messages(decode=False)}
        assert len(messages) == INTACT and not bag.losses
    return messages


def chunk_table(data: bytes, path: Path) -> tuple[list[int], list[int]]:
    """Where the chunks begin, and how many messages each holds, by the reader of the ``mcap`` package."""
    path.write_bytes(data)
    with path.open('rb') as file:
        offsets = [chunk.chunk_start_offset for chunk in make_reader(file).get_summary().chunk_indexes]
        file.seek(0)
        chunks = [record for record in StreamReader(file, emit_chunks=True).records if isinstance(record, Chunk)]
    return offsets, [sum(isinstance(record, Message) for record in breakup_chunk(chunk)) for chunk in chunks]


def flipped(data: bytes, *positions: int) -> bytes:
    changed = bytearray(data)
    for position in positions:
        changed[position] ^= 0x10
    return bytes(changed)


def without_index(data: bytes, chunks: list[int]) -> bytes:
    """The file as a killed recorder leaves it: behind the last chunk there is nothing."""
    return data[:chunks[-1]] if len(chunks) > 1 else data


def zeroed(data: bytes, start: int) -> bytes:
    return data[:start] + bytes(5000) + data[start + 5000:]


def none(chunks: int, compression: str) -> set[int]:
    return set()


def lost(*numbers: int):
    """Which chunks a case loses; negative numbers count from the last."""
    return lambda chunks, compression: {number % chunks for number in numbers}


# Name: (how the bytes are damaged, given those of the intact file and where its chunks begin; which chunks that costs).
CASES = {
    'cut before the last chunks': (lambda data, chunks: data[:chunks[-2] + 100], lost(-1, -2)),
    'cut inside the footer': (lambda data, chunks: data[:-20], none),
    'killed recorder, no index': (without_index, lost(-1)),
    'byte flipped in a chunk': (lambda data, chunks: flipped(data, chunks[2] + 1000), lost(2)),
    'bytes flipped in two chunks': (lambda data, chunks: flipped(data, chunks[1] + 999, chunks[3] + 999), lost(1, 3)),
    'byte flipped in the first chunk': (lambda data, chunks: flipped(data, chunks[0] + 1000), lost(0)),
    'byte flipped in a chunk, no index': (
        lambda data, chunks: flipped(without_index(data, chunks), chunks[2] + 1000), lost(2, -1)),
    'length of a chunk damaged': (lambda data, chunks: flipped(data, chunks[2] + 3), none),
    # An uncompressed chunk has no name to find it by, so that its lengths have to agree.
    'length of a chunk damaged, no index': (
        lambda data, chunks: flipped(without_index(data, chunks), chunks[2] + 3),
        lambda chunks, compression: {2, chunks - 1} if compression == 'none' else {chunks - 1}),
    'opcode of a chunk damaged, no index': (
        lambda data, chunks: flipped(without_index(data, chunks), chunks[2]), lost(-1)),
    'index damaged': (lambda data, chunks: flipped(data, len(data) - 300), none),
    'footer damaged': (lambda data, chunks: flipped(data, len(data) - 25), none),
    'first bytes damaged': (lambda data, chunks: flipped(data, 2), none),
    'block of zeros': (lambda data, chunks: zeroed(data, chunks[2] - 50), lost(2)),
    'block of zeros, no index': (lambda data, chunks: zeroed(without_index(data, chunks), chunks[2] - 50), lost(2, -1)),
    'checksum of a chunk set to zero': (
        lambda data, chunks: data[:chunks[2] + 33] + bytes(4) + data[chunks[2] + 37:], lost(2)),
}


def read(path: Path):
    with open_bag(path) as bag:
        return [(m.topic, m.log_time, m.publish_time, m.raw) for m in bag.messages(decode=False)], bag.losses


@pytest.mark.parametrize('compression', ['zstd', 'lz4', 'none'])
@pytest.mark.parametrize('case', CASES)
def test_a_damaged_bag_is_read_as_far_as_it_goes(case, compression, intact, truth, tmp_path):
    data = intact[compression]
    chunks, sizes = chunk_table(data, tmp_path / 'intact.mcap')
    damage, lose = CASES[case]
    path = tmp_path / 'damaged.mcap'
    path.write_bytes(damage(data, chunks))
    messages, losses = read(path)
    expected = INTACT - sum(sizes[number] for number in lose(len(chunks), compression))
    print(f'{case} ({compression}): {len(messages)} of {INTACT} messages | {losses}')
    assert len(messages) == len(set(messages)) == losses.saved == expected
    assert set(messages) <= truth, 'a message was read that was never recorded'
    assert [m[1] for m in messages] == sorted(m[1] for m in messages)
    assert losses.sentence.startswith(f'{str(path)!r} is damaged: ') and '\n' not in losses.sentence
    assert losses.intact in (None, INTACT)


def test_the_account_of_a_bag_with_an_index_is_exact_before_anything_is_read(intact, tmp_path):
    chunks, sizes = chunk_table(intact['zstd'], tmp_path / 'intact.mcap')
    path = tmp_path / 'damaged.mcap'
    path.write_bytes(flipped(intact['zstd'], chunks[2] + 1000))
    with open_bag(path) as bag:
        losses = bag.losses
    assert (losses.saved, losses.intact) == (INTACT - sizes[2], INTACT)
    assert (losses.chunks, losses.chunks_lost) == (len(chunks), 1)
    (start, end), = losses.byte_ranges
    assert start == chunks[2] < end <= chunks[3]
    assert f'{losses.saved} of {INTACT} messages read; 1 of {len(chunks)} chunks lost; unreadable bytes {start}-{end}' \
        in losses.sentence


def test_an_index_alone_that_is_lost_still_counts_the_messages_of_lost_chunks(intact, tmp_path):
    chunks, sizes = chunk_table(intact['zstd'], tmp_path / 'intact.mcap')
    path = tmp_path / 'damaged.mcap'
    path.write_bytes(flipped(intact['zstd'], chunks[2] + 1000, len(intact['zstd']) - 300))
    with open_bag(path) as bag:
        assert (bag.losses.saved, bag.losses.intact) == (INTACT - sizes[2], INTACT)


def test_a_recorder_killed_in_the_middle_leaves_what_it_had_flushed(truth, tmp_path):
    """SIGKILL, so that nothing tidies up; ``record`` of this file writes on until then."""
    script = ('import sys, time; sys.path[:0] = sys.argv[2:]; import test_bags_damaged as t; '
              'bag = t.BagWriter(sys.argv[1]); t.record(bag, 1000); bag.flush(); t.record_more(bag); '
              "print('ready', flush=True); time.sleep(60)")
    path = tmp_path / 'killed.mcap'
    process = subprocess.Popen([sys.executable, '-c', script, path, *Path(__file__).parents[:2]],
                               stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == 'ready\n'
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    messages, losses = read(Path(f'{path}.partial'))
    assert set(messages) <= truth and len(messages) == 2001
    assert losses.intact is None and 'the end of the file is missing; 2001 messages read' in losses.sentence


def record_more(bag: BagWriter) -> None:
    """A few messages that stay in the memory of the process."""
    for _ in range(10):
        bag.write('/wrench', 'geometry_msgs/msg/WrenchStamped', {}, 10**12)


def mutated(data: bytes, source: random.Random) -> bytes:
    """One to four random injuries: flips, zeroed or random blocks, missing or inserted bytes, a cut end."""
    for _ in range(source.randint(1, 4)):
        at, size = source.randrange(len(data)), source.choice([1, 1, 1, 8, 100, 5000])
        kind = source.randrange(6)
        if kind < 2:
            data = flipped(data, at)
        elif kind == 2:
            data = data[:at] + bytes(size) + data[at + size:]
        elif kind == 3:
            data = data[:at] + source.randbytes(size) + data[at + size:]
        elif kind == 4:
            data = data[:at] + data[at + size:] if source.random() < 0.5 else data[:at] + bytes(size) + data[at:]
        elif source.random() < 0.3:
            data = data[:at]
        data = data or b'\x89'
    return data


@pytest.mark.parametrize('seed', [pytest.param(seed, marks=[pytest.mark.long] * (seed >= 20)) for seed in range(60)])
def test_random_damage_never_reads_a_message_that_was_not_recorded(seed, intact, truth, tmp_path):
    source = random.Random(seed)
    path = tmp_path / 'damaged.mcap'
    path.write_bytes(mutated(intact[source.choice(['zstd', 'lz4', 'none'])], source))
    try:
        messages, losses = read(path)
        with open_bag(path) as bag:
            assert sum(1 for _ in bag.messages()) == len(messages)
    except SemiparamError as error:
        assert str(path) in str(error) and '\n' not in str(error)
        return
    assert set(messages) <= truth and len(set(messages)) == len(messages) == losses.saved


@pytest.mark.parametrize('seed', range(30))
def test_random_damage_to_messages_outside_chunks_ends_in_an_account_or_a_sentence(seed, truth, tmp_path):
    """Such files have no checksums, so wrong values cannot be told; but nothing breaks."""
    source = random.Random(seed)
    path = tmp_path / 'damaged.mcap'
    with path.open('wb') as file:
        unchunked(file)
    whole = read(path)
    assert len(whole[0]) == 400 and not whole[1]
    path.write_bytes(mutated(path.read_bytes(), source))
    try:
        with open_bag(path) as bag:
            assert sum(1 for _ in bag.messages()) <= 400
            assert isinstance(bag.losses.sentence, str)
    except SemiparamError as error:
        assert str(path) in str(error)


def unchunked(file) -> None:
    writer = Writer(file, use_chunking=False)
    writer.start('ros2', 'test')
    schema = writer.register_schema('std_msgs/msg/String', 'ros2msg', b'string data')
    channel = writer.register_channel('/chatter', 'cdr', schema)
    for number in range(400):
        text = f'{number:04d}'.encode()
        writer.add_message(channel, number, b'\x00\x01\x00\x00\x05\x00\x00\x00' + text + b'\x00', number, number)
    writer.finish()


@pytest.mark.parametrize('name', ['ur3_arm/id1.bag', 'panda_arm/panda_exciting_trajectory.db3'])
@pytest.mark.parametrize('kept', [0.0, 0.3, 0.9, 0.9999])
def test_a_cut_bag_of_another_format_ends_in_one_sentence(name, kept, shared_data, tmp_path, capsys):
    path = tmp_path / Path(name).name
    data = (shared_data / name).read_bytes()
    path.write_bytes(data[:int(kept * len(data))])
    assert str(path) in refusal(capsys, 'convert', path, tmp_path / 'out.mcap')
    assert not list(tmp_path.glob('out*'))


@pytest.mark.parametrize('seed', range(12))
@pytest.mark.parametrize('name', ['ur3_arm/id1.bag', 'panda_arm/panda_exciting_trajectory.db3'])
def test_random_damage_to_other_formats_never_ends_in_a_traceback(name, seed, shared_data, tmp_path):
    source = random.Random(seed)
    path = tmp_path / Path(name).name
    path.write_bytes(mutated((shared_data / name).read_bytes(), source))
    try:
        with open_bag(path) as bag:
            for _ in bag.messages():
                pass
    except SemiparamError as error:
        assert str(path) in str(error) and '\n' not in str(error)


def test_converting_a_damaged_bag_repairs_it_and_says_what_is_missing(intact, tmp_path, capsys):
    chunks, sizes = chunk_table(intact['zstd'], tmp_path / 'intact.mcap')
    path, repaired = tmp_path / 'damaged.mcap', tmp_path / 'repaired.mcap'
    path.write_bytes(flipped(intact['zstd'], chunks[2] + 1000))
    assert semiparam('convert', path, repaired) == 0
    assert f'{INTACT - sizes[2]} of {INTACT} messages read' in capsys.readouterr().err
    messages, losses = read(repaired)
    assert len(messages) == INTACT - sizes[2] and not losses


def test_a_recording_directory_whose_recorder_was_killed_is_read(intact, tmp_path):
    folder = tmp_path / 'rosbag2_directory'
    folder.mkdir()
    chunks, sizes = chunk_table(intact['zstd'], tmp_path / 'intact.mcap')
    (folder / 'rosbag2_0.mcap').write_bytes(without_index(intact['zstd'], chunks))
    messages, losses = read(folder)
    assert len(messages) == INTACT - sizes[-1]
    assert 'rosbag2_0.mcap' in losses.sentence


def packed(data: bytes, compression: str, claimed: int) -> bytes:
    """An MCAP file of one chunk of these records, which says that they are so many bytes."""
    def record(opcode: int, body: bytes) -> bytes:
        return bytes([opcode]) + struct.pack('<Q', len(body)) + body

    small = zstandard.compress(data) if compression == 'zstd' else lz4.frame.compress(data)
    chunk = struct.pack('<QQQII', 0, 0, claimed, 0, len(compression)) + compression.encode()
    return b''.join([MAGIC, record(1, bytes(8)), record(6, chunk + struct.pack('<Q', len(small)) + small),
                     record(15, bytes(4)), record(2, bytes(20)), MAGIC])


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
def test_a_chunk_that_holds_more_than_it_says_takes_no_more_memory(compression, tmp_path):
    """100 kB of it took 3 GB."""
    path = tmp_path / 'a.mcap'
    path.write_bytes(packed(bytes(2**25), compression, 1000))
    tracemalloc.start()
    with pytest.raises(SemiparamError, match='a chunk has the wrong size'):
        open_bag(path)
    assert tracemalloc.get_traced_memory()[1] < 2**21
    tracemalloc.stop()


def test_zeros_are_no_records(tmp_path):
    """Each nine of them were one without a content: a chunk of 30 kB took minutes."""
    path = tmp_path / 'a.mcap'
    path.write_bytes(packed(bytes(9 * 1000), 'zstd', 9 * 1000))
    with pytest.raises(SemiparamError, match='no record can begin here'):
        open_bag(path)


def test_a_file_that_is_cut_while_it_is_read_loses_what_was_cut(intact, tmp_path):
    path = tmp_path / 'cut.mcap'
    path.write_bytes(intact['none'])
    program = ('import os, sys\n'
               'from semiparam_ros.bags.reader import open_bag\n'
               'with open_bag(sys.argv[1]) as bag:\n'
               '    messages = bag.messages(decode=False)\n'
               '    next(messages)\n'
               '    os.truncate(sys.argv[1], 100_000)\n'
               '    count = 1 + sum(1 for _ in messages)\n'
               '    print(count, bag.losses.reasons)\n')
    done = subprocess.run([sys.executable, '-c', program, path], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, (done.returncode, done.stderr)
    count, reasons = done.stdout.split(' ', 1)
    assert 0 < int(count) < INTACT and 'the file has become shorter while it was read' in reasons
