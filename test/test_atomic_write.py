"""A whole file or none, whatever happens while it is written."""

import os
import resource
import signal
import stat
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from semiparam_ros.atomic_write import append_line, remove_leftovers, replacing, require_writable, write_text
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.cli.main import main
from semiparam_ros.cli.options import write_json
from semiparam_ros.errors import SemiparamError
from semiparam_ros.report.horizon_figure import save_figure
from semiparam_ros.settings import Settings, dump_params

BIG = 10**6


def figure():
    drawn = Figure()
    drawn.subplots().plot([1, 2])
    return drawn


def bag(path):
    with BagWriter(path, compression='none') as writer:
        for stamp in range(200):
            writer.write('/t', 'std_msgs/msg/String', {'data': 'x' * 10000}, stamp)


WRITERS = {'text': lambda path: write_text(path, 'x' * BIG), 'line': lambda path: append_line(path, 'x' * BIG),
           'json': lambda path: write_json(path, {'x': 'x' * BIG}),
           'params': lambda path: dump_params(Settings(robot_description='x' * BIG), path),
           'plot': lambda path: save_figure(path, figure()), 'bag': bag}


@contextmanager
def disk_of(n_bytes):
    """Files may not grow beyond so many bytes: writing fails halfway, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize('write', WRITERS.values(), ids=WRITERS)
def test_a_write_that_fails_halfway_leaves_the_old_file_alone(tmp_path, write):
    path = tmp_path / 'result.png'
    path.write_text('old')
    with disk_of(4096), pytest.raises(SemiparamError, match='File too large'):
        write(path)
    assert os.listdir(tmp_path) == ['result.png'] and path.read_text() == 'old'


@pytest.mark.parametrize('write', WRITERS.values(), ids=WRITERS)
def test_permissions_are_those_of_any_new_file(tmp_path, write):
    before = os.umask(0o027)
    try:
        write(tmp_path / 'result.png')
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / 'result.png').stat().st_mode) == 0o640


def test_ctrl_c_removes_what_was_written_so_far(tmp_path):
    with pytest.raises(KeyboardInterrupt), replacing(tmp_path / 'x') as stream:
        stream.write(b'half')
        signal.raise_signal(signal.SIGINT)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize('letter', ['x', 'é', '漢', '🤖'])
def test_the_longest_name_that_a_file_can_have_can_be_written(tmp_path, letter):
    """With a name of 81 Chinese letters or more, what is written first had none that fits a folder."""
    path = tmp_path / (letter * (255 // len(letter.encode())))
    require_writable(path)
    write_text(path, 'all')
    assert os.listdir(tmp_path) == [path.name] and path.read_text() == 'all'


def test_what_a_killed_writer_left_is_removed(tmp_path):
    program = ('import os, sys\nfrom semiparam_ros.atomic_write import replacing\n'
               'with replacing(sys.argv[1], durable=True) as stream:\n'
               '    stream.write(b"half"); stream.flush(); os.kill(os.getpid(), 9)\n')
    path = tmp_path / 'x.npz'
    assert subprocess.run([sys.executable, '-c', program, str(path)], check=False).returncode == -signal.SIGKILL
    left = os.listdir(tmp_path)
    assert len(left) == 1 and left[0].startswith('.x.npz.')
    for name in ('.x.npz.mine', '.x.npzx.0123456789ab', 'x.npz'):
        (tmp_path / name).touch()
    remove_leftovers(path)
    assert sorted(os.listdir(tmp_path)) == ['.x.npz.mine', '.x.npzx.0123456789ab', 'x.npz']


def test_what_another_writer_writes_under_a_long_name_like_this_one_stays(tmp_path):
    """Of two arms whose namespaces begin with the same sixty letters one could not save a state while the other did."""
    left, right = (tmp_path / f'{"robots.line_3.cell_07." * 3}{side}.checkpoint.npz' for side in ('left', 'right'))
    with replacing(left) as stream:
        stream.write(b'left')
        remove_leftovers(right)
    assert left.read_bytes() == b'left'


def test_what_another_writer_of_the_same_file_is_writing_stays(tmp_path):
    """Of two nodes with one state_file one could not save while the other did: 'No such file or directory'."""
    with replacing(tmp_path / 's.npz') as stream:
        stream.write(b'state')
        remove_leftovers(tmp_path / 's.npz')
    assert (tmp_path / 's.npz').read_bytes() == b'state' and os.listdir(tmp_path) == ['s.npz']


@pytest.mark.parametrize(('name', 'reason'), [
    ('none/x', 'No such file'), ('', 'it is a folder'), ('/', 'it is a folder'), ('/dev/null', 'a device or a pipe'),
    ('a\0b', 'null character'), ('n' * 300, 'File name too long')])
def test_an_impossible_place_is_refused_in_a_sentence(tmp_path, name, reason):
    with pytest.raises(SemiparamError, match=reason):
        write_text(tmp_path / name, 'x')
    assert os.listdir(tmp_path) == [] and not Path('/dev/null').is_file()


def test_a_long_name_can_be_written(tmp_path):
    write_text(tmp_path / ('n' * 250), 'x')
    assert os.listdir(tmp_path) == ['n' * 250]


def test_a_fault_of_the_writer_is_not_blamed_on_the_disk(tmp_path):
    with pytest.raises(ZeroDivisionError), replacing(tmp_path / 'x') as stream:
        stream.write(bytes(1 // 0))
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize('name', ['/proc/a.json', '/dev/full', 'a' * 300, '', 'folder', 'file/a.json', 'none/a.json'])
def test_what_cannot_be_written_is_known_before(tmp_path, name):
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'file').touch()
    for attempt in (require_writable, lambda path: write_text(path, 'x')):
        with pytest.raises(SemiparamError, match=r'^cannot write .*\.$'):
            attempt(tmp_path / name)
    require_writable(tmp_path / 'result.json')
    assert sorted(os.listdir(tmp_path)) == ['file', 'folder']


@pytest.mark.parametrize('place', ['/proc/truth.json', '/dev/full'])
def test_a_second_result_that_cannot_be_written_keeps_the_first_from_being_made(tmp_path, capsys, place):
    """As root, who may write everywhere, the folder said yes; the recording was made, and its truth was not."""
    assert main(['simulate', str(tmp_path / 'a.mcap'), '--samples', '100', '--truth', place]) == 2
    assert capsys.readouterr().err.count('\n') == 1
    assert not os.listdir(tmp_path)


def test_the_name_of_a_file_that_is_no_utf8_may_stand_in_a_text(tmp_path):
    """Two commands ended by an internal error once their work was done, when it was to stand on their page."""
    write_text(tmp_path / 'page.html', f'of {os.fsdecode(b"b" + bytes([255]))}.mcap')
    assert (tmp_path / 'page.html').read_text() == r'of b\udcff.mcap'
