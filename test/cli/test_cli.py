"""The command line: what it prints, where it fails and with which exit code."""

import json
import math
import os
import subprocess
import sys
import types
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

from semiparam_ros import __version__
from semiparam_ros.atomic_write import write_text
from semiparam_ros.cli import main as cli
from semiparam_ros.cli import options
from semiparam_ros.cli.options import write_json
from semiparam_ros.cli.run import check_file
from semiparam_ros.errors import SemiparamError
from support.recordings import write_arm, write_params

SEMIPARAM = [sys.executable, '-m', 'semiparam_ros.cli.main']


def semiparam(*arguments: str, **options) -> subprocess.CompletedProcess:
    return subprocess.run([*SEMIPARAM, *arguments], capture_output=True, text=True, timeout=60, check=False, **options)


@pytest.fixture
def command(monkeypatch):
    """A sub-command of the test's own in place of `bench`, given what its run() does."""
    def install(run):
        module = types.ModuleType('semiparam_ros.cli.bench')
        module.HELP, module.add_arguments, module.run = 'a stand-in', lambda parser: None, run
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return install


def raising(error):
    def run(_):
        raise error
    return run


def test_version():
    assert semiparam('--version').stdout == f'semiparam_ros {__version__}\n'


def test_overview_names_and_explains_every_command():
    lines = semiparam('--help').stdout.splitlines()
    for name in cli.COMMANDS:
        assert any(line.split()[:1] == [name] and len(line.split()) > 2 for line in lines), name


@pytest.mark.parametrize('name', cli.COMMANDS)
def test_every_command_has_help(name):
    result = semiparam(name, '--help')
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith(f'usage: semiparam {name} ')


def test_a_lone_name_gets_the_overview(capsys):
    assert cli.main([]) == 2
    told = capsys.readouterr()
    assert not told.out and all(f'\n  {name} ' in told.err for name in cli.COMMANDS)


@pytest.mark.parametrize(('arguments', 'words'), [
    ('evaluat', "'evaluate'"),
    ('run extra', 'unrecognized arguments: extra'),
    ('replay', 'required: BAG'),
    ('replay a.mcap --json nowhere/b.json', 'cannot write nowhere/b.json'),
    ('evaluate a.mcap --json nowhere/b.json', 'cannot write nowhere/b.json'),
    ('evaluate a.mcap --plot nowhere/b.png', 'cannot write nowhere/b.png'),
    ('evaluate a.mcap --params arm.yaml --series', '--series adds to what goes to --json FILE, which is missing'),
    ('evaluate a.mcap --ros-args -p variant:=P', 'evaluate starts no node; expected --ros-args with run,'),
    ('fit a.mcap', 'required: --output/-o'),
    *[(f'fit a.mcap --params arm.yaml -o b.yaml --variant {variant} {words}',
       f'{words.split()[0]} says nothing to {variant}; expected one of {heard} beside it')
      for variant, words, heard in (('SPK-ML', '--grid-tau 1 2', 'NP-VS, SP2-VS'),
                                    ('auto', '--grid-ratio 0.1 1', 'NP-VS, SP2-VS'),
                                    ('NP-VS', '--starts 2', 'P, NP-ML, SP-ML, SP2-ML, SPK-ML'),
                                    ('SP2-VS', '--method nelder-mead', 'P, NP-ML, SP-ML, SP2-ML, SPK-ML'),
                                    ('SP2-VS', '--white-noise', 'P, NP-ML, SP-ML, SP2-ML, SPK-ML'))],
    ('compare a.mcap', 'required: TEST'),
    ('compare a.mcap b.mcap --params arm.yaml --variant P --grid-tau 1 2', '--grid-tau says nothing to P; expected'),
    ('diagnose a.mcap --params arm.yaml --variants XX', "variant 'XX' is unknown"),
    ('diagnose a.mcap --jobs 0', '--jobs is 0; expected at least 1'),
    ('diagnose --benchmark --seeds 0', '--seeds is 0; expected at least 1'),
    ('diagnose --benchmark --kinds payload+payloda', "no effect 'payloda' to simulate"),
    *[(f'diagnose --benchmark {words}', f'simulates; expected no {words.split()[0]} beside it')
      for words in ('--params arm.yaml', '--output found.yaml', '--html page.html', '--judge a.mcap', '--split 0.0',
                    '--in a.mcap payload@hand', '--variants P')],
    *[(f'diagnose a.mcap {words}', f'{words.split()[0]} is for --benchmark, which is missing')
      for words in ('--outputs effort', '--sizes 1', '--seeds 3', '--first-seed 1', '--samples 50',
                    '--estimate-accelerations')],
    ('diagnose --benchmark a.mcap', 'simulates; expected no BAG beside it'),
    ('diagnose a.mcap -o b.txt --html ./b.txt', 'b.txt is named for two results'),
    ('diagnose a.mcap --params arm.yaml --json arm.yaml', 'arm.yaml is read, too; expected another name'),
    ('export a.mcap --urdf b.xml --mjcf b.xml', 'b.xml is named for two results; expected another name for each'),
    ('export a.mcap --params arm.yaml --urdf a.mcap', 'a.mcap is read, too; expected another name for the output'),
    ('evaluate a.mcap --json ../x/../x/a.mcap', 'cannot write'),
    ('simulate b.txt', "'b.txt' is no name for an MCAP bag"),
    ('simulate b.mcap --effect list', '--effect list lists the kinds alone; expected no OUT.mcap beside it'),
    ('simulate --effect list --truth b.json', '--effect list lists the kinds alone; expected no --truth beside it'),
    ('simulate --effect list --effect payload', '--effect list lists the kinds alone; expected no --effect payload'),
    ('simulate --effect list --params arm.yaml', '--effect list lists the kinds alone; expected no --params beside'),
    ('simulate b.mcap --truth nowhere/b.json', 'cannot write nowhere/b.json'),
    ('simulate b.mcap --truth b.mcap.partial', 'b.mcap.partial is named for two results; expected another name'),
    ('convert a.mcap b.mcap --joint elbow=b', "no joint 'elbow' to rename; it has r_elbow"),
    ('convert a.mcap b.mcap --effort-factors r_elbow=2,r_elbow=3', "effort_factors names 'r_elbow' twice"),
    ('convert a.mcap b.mcap --effort-factors elbow=2', "effort_factors names 'elbow'"),
    ('convert a.mcap b.mcap --topic /wrench=/a --topic /wrench=/b', "'/wrench' is to become '/a' and '/b'"),
    ('convert a.mcap b.mcap --joint r_elbow=a,r_elbow=b', "'r_elbow' is to become 'a' and 'b'; expected one name"),
    ('convert a.mcap b.mcap --effort-sign nan', '--effort-sign is nan; expected a finite number'),
    ('convert a.mcap b.mcap --effort-sign 0', '--effort-sign is 0; expected 1 or -1'),
    ('convert a.mcap b.mcap --wrench-sign 1000', '--wrench-sign is 1000; expected 1 or -1'),
    ('convert a.mcap b.mcap --effort-factors r_elbow=inf', "effort factor of r_elbow is 'inf'; expected a finite"),
    ('convert a.mcap b.mcap --effort-factors r_elbow=2 --topic /wrench', "some of the joints in 'a.mcap': none."),
    ('convert a.mcap b.mcap --joint r_elbow=r_shoulder_yaw', 'r_shoulder_yaw, r_shoulder_yaw; expected another name'),
    ('convert a.mcap b.mcap --joint r_*=joint', 'would become joint, joint, joint, joint; expected another name for'),
    ('convert a.mcap b.mcap --robot-description arm.yaml', "'arm.yaml': the robot description is not valid XML"),
    ('bench --variant P', '--peers, which is missing'),
    ('bench --params arm.yaml', '--params configures the variants of --peers, which is missing'),
    *[(f'bench --peers a.mcap {words}', f'{words.split()[0]} is for times beside other recursions')
      for words in ('--urdf a.urdf', '--frame hand', '--rounds 2')],
    ('bench --json nowhere/b.json', 'cannot write nowhere/b.json'),
    ('bench --peers a.mcap --json a.mcap', 'a.mcap is read, too; expected another name'),
    ('bench --peers a.mcap --params arm.yaml --json arm.yaml', 'arm.yaml is read, too; expected another name'),
    ('record b.txt', "'b.txt' is no name for an MCAP bag"),
    ('record b.mcap --json nowhere/b.json', 'cannot write nowhere/b.json'),
])
def test_a_wrong_call_ends_at_once_in_one_sentence_and_leaves_nothing(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_arm(tmp_path / 'a.mcap', 20)
    write_params(tmp_path / 'arm.yaml')
    before = sorted(tmp_path.iterdir())
    assert cli.main(arguments.split()) == 2
    told = capsys.readouterr()
    assert words in told.err and told.err.count('\n') == 1 and not told.out
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(('arguments', 'words'), [
    (['evaluate', ''], 'argument BAG: the name is empty'),
    (['diagnose', 'a.mcap', '--params', ''], 'argument --params: the name is empty'),
    (['convert', '', 'b.mcap'], 'argument INPUT: the name is empty'),
    (['simulate', ''], 'argument OUT.mcap: the name is empty'),
    (['fit', 'a.mcap', '-o', 'b.yaml', '--variant', ''], 'argument --variant: the text is empty'),
    (['simulate', 'b.mcap', '--sensor-frame', ''], 'argument --sensor-frame: the text is empty'),
    (['simulate', 'b.mcap', '--joints', 'r_elbow', ''], 'argument --joints: the text is empty'),
    (['convert', 'a.mcap', 'b.mcap', '--wrench-frame='], 'argument --wrench-frame: the text is empty')])
def test_an_empty_name_is_not_the_working_folder(arguments, words, tmp_path, monkeypatch, capsys):
    """As of a variable of the shell that is not set: whatever bag lay in the working folder was evaluated."""
    monkeypatch.chdir(tmp_path)
    write_arm(tmp_path / 'a.mcap', 20)
    assert cli.main(arguments) == 2
    assert words in capsys.readouterr().err and [path.name for path in tmp_path.iterdir()] == ['a.mcap']


def test_overview_needs_no_heavy_import():
    code = ('import sys; from semiparam_ros.cli.main import main; main(["--help"]); '
            'print({"numpy", "pinocchio", "rclpy"} & set(sys.modules))')
    result = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True, timeout=60)
    assert result.stdout.splitlines()[-1] == 'set()'


def test_one_linear_algebra_thread_unless_the_user_chose(command, monkeypatch):
    seen = []
    command(lambda args: seen.append(os.environ['OMP_NUM_THREADS']) or 0)
    monkeypatch.delenv('OMP_NUM_THREADS', raising=False)
    cli.main(['bench'])
    monkeypatch.setenv('OMP_NUM_THREADS', '3')
    cli.main(['bench'])
    assert seen == ['1', '3']


def test_a_mistake_of_the_user_is_one_sentence(command, capsys):
    command(raising(SemiparamError('the bag has no topic /wrench.')))
    assert cli.main(['bench']) == 2
    assert capsys.readouterr().err == 'semiparam: the bag has no topic /wrench.\n'


def test_an_interrupt_within_an_import_is_no_internal_error(command, capsys):
    """As RuntimeError: Error calling __set_name__ on 'Field' instance."""
    error = RuntimeError('Error calling __set_name__')
    error.__cause__ = KeyboardInterrupt()
    command(raising(error))
    assert cli.main(['bench']) == 130 and not capsys.readouterr().err


def test_a_missing_file_is_one_sentence(command, capsys):
    command(lambda args: len(Path('/nowhere/at/all').read_text()))
    assert cli.main(['bench']) == 2
    assert capsys.readouterr().err == 'semiparam: /nowhere/at/all: No such file or directory.\n'


def test_a_fault_of_the_program_shows_its_traceback_on_request_only(command, capsys, monkeypatch):
    command(raising(TypeError('unexpected')))
    monkeypatch.delenv('SEMIPARAM_TRACEBACK', raising=False)
    assert cli.main(['bench']) == 1
    quiet = capsys.readouterr().err
    assert quiet.count('\n') == 1
    assert 'TypeError: unexpected' in quiet
    monkeypatch.setenv('SEMIPARAM_TRACEBACK', '1')
    cli.main(['bench'])
    assert 'Traceback' in capsys.readouterr().err


def test_interrupt_gives_130(command):
    command(raising(KeyboardInterrupt()))
    assert cli.main(['bench']) == 130


def test_a_reader_who_leaves_is_no_error():
    buffered = {name: value for name, value in os.environ.items() if name != 'PYTHONUNBUFFERED'}
    reader, pipe = os.pipe()
    os.close(reader)  # now, for the pipe has room for all that is written: who left later would not be missed
    process = subprocess.Popen([*SEMIPARAM, '--help'], stdout=pipe, stderr=subprocess.PIPE, env=buffered)
    os.close(pipe)
    assert process.stderr.read() == b''
    assert process.wait(timeout=60) == 141


TABLE = (*SEMIPARAM, 'convert', '--joints', 'a', '--position', '1', '--rate', '9')


def test_the_reader_of_a_table_of_results_may_leave_too():
    """The console of rich ended with 1, as for a fault of the program."""
    script = ('import sys; from semiparam_ros.cli import main, options\n'
              "main._dispatch = lambda *_: [options.tell('x' * 100) for _ in range(10_000)] and 0\n"
              'sys.exit(main.main([]))')
    process = subprocess.Popen([sys.executable, '-c', script], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b''
    assert process.wait(timeout=60) == 141


@pytest.mark.parametrize('closed', ['>&-', '2>&-', '>&- 2>&-', '<&- >&- 2>&-', '2>/dev/full'])
def test_closed_streams_are_no_fault(closed, tmp_path):
    """After all was done the command ended with an internal error; a file could get the number of standard error."""
    (tmp_path / 'table.txt').write_text('1\n2\n')
    command = ' '.join([*TABLE, 'table.txt', 'out.mcap', closed])
    done = subprocess.run(['bash', '-c', command], cwd=tmp_path, capture_output=True, timeout=60, check=False)
    assert done.returncode == (2 if 'full' in closed else 0) and b'internal error' not in done.stderr
    assert (tmp_path / 'out.mcap').read_bytes()[-8:] == b'\x89MCAP0\r\n'


@pytest.mark.parametrize('argv, ours, theirs', [
    (['replay', 'bag'], ['replay', 'bag'], []),
    (['run', '--ros-args', '-r', 'a:=b'], ['run'], ['--ros-args', '-r', 'a:=b']),
    (['run', '--ros-args', '-p', 'x:=1', '--', '--params', 'f'], ['run', '--params', 'f'],
     ['--ros-args', '-p', 'x:=1', '--']),
    (['--ros-args', '--', 'run', '--ros-args'], ['run'], ['--ros-args', '--', '--ros-args']),
])
def test_ros_arguments_are_set_apart(argv, ours, theirs):
    assert cli.split_ros_arguments(argv) == (ours, theirs)


def test_ros_arguments_reach_the_command(command, monkeypatch):
    seen = []
    monkeypatch.setattr(cli, 'NODES', ('bench',))
    command(lambda args: seen.append(args.ros_args) or 0)
    assert cli.main(['bench', '--ros-args', '-r', '__ns:=/left']) == 0
    assert seen == [['--ros-args', '-r', '__ns:=/left']]


@pytest.mark.parametrize('beside', [('{}',), ('--judge', '{}')])
def test_a_recording_does_not_judge_what_was_fitted_to_it(beside, tmp_path, repository, capsys):
    """The error after was called one on another recording; twice the same counted as two."""
    bag, link = repository / 'bags/icub_xy.mcap', tmp_path / 'link.mcap'
    link.symlink_to(bag)
    assert cli.main(['diagnose', str(bag), *(word.format(link) for word in beside)]) == 2
    assert f'{link} is named twice; expected another recording.' in capsys.readouterr().err


def test_another_recording_that_judges_judges_the_described_inertias_too(tmp_path, repository, capsys, recwarn):
    """They were judged on no sample, with warnings of numpy: of inertias that are wrong nothing was said."""
    bags = [str(tmp_path / name) for name in ('fits.mcap', 'judges.mcap')]
    for seed, bag in enumerate(bags):
        assert cli.main(['simulate', bag, '--samples', '500', '--seed', str(seed), '--robot-seed', '0']) == 0
    capsys.readouterr()
    assert cli.main(['diagnose', bags[0], '--judge', bags[1], '--params',
                     str(repository / 'config/icub_right_arm.yaml')]) == 0
    assert 'But the inertias are not those of the robot description' in capsys.readouterr().out
    assert not [warning for warning in recwarn if issubclass(warning.category, RuntimeWarning)]


def test_json_is_versioned_and_takes_numpy(tmp_path):
    write_json(tmp_path / 'a.json', {'nmse': np.array([0.5, 1.0]), 'samples': np.int64(3), 'deep': {'x': (1, 2)}})
    assert json.loads((tmp_path / 'a.json').read_text()) == {
        'schema': 1, 'nmse': [0.5, 1.0], 'samples': 3, 'deep': {'x': [1, 2]}}


@pytest.mark.parametrize('value', [math.nan, math.inf, np.array([1.0, np.nan])])
def test_json_refuses_what_is_not_finite_and_says_where(tmp_path, value):
    with pytest.raises(SemiparamError, match=r'at P\.nmse'):
        write_json(tmp_path / 'a.json', {'P': {'nmse': value}})
    assert list(tmp_path.iterdir()) == []


def test_a_result_that_cannot_be_written_is_one_sentence(tmp_path):
    with pytest.raises(SemiparamError, match='cannot write'):
        write_text(tmp_path / 'missing' / 'a.json', '{}')


def test_a_written_file_is_as_readable_as_any_other(tmp_path):
    write_text(tmp_path / 'a', 'text')
    (tmp_path / 'b').write_text('text')
    assert (tmp_path / 'a').stat().st_mode == (tmp_path / 'b').stat().st_mode


@pytest.mark.parametrize('rules', [['__ns:=/left', '__name:=arm'], ['arm:__ns:=/left', 'estimator:__node:=arm'],
                                   ['__ns:=/left', '__node:=arm', '__ns:=/right', '__node:=hand']])
def test_run_checks_a_file_for_the_name_that_ros_gives_the_node(tmp_path, rules):
    """It refused files that fitted: of all ways to rename a node it knew one."""
    path = tmp_path / 'p.yaml'
    path.write_text('/left/arm: {ros__parameters: {variant: P}}')
    check_file(path, ['--ros-args', *(argument for rule in rules for argument in ('-r', rule))])
    with pytest.raises(SemiparamError, match='ROS gives no section to the node /estimator'):
        check_file(path, [])


def test_a_terminal_that_does_not_know_its_width_gets_its_tables(monkeypatch):
    """Of COLUMNS=0 nothing was printed, with the exit code 0."""
    monkeypatch.setenv('COLUMNS', '0')
    console = type(options.output)(file=StringIO())
    console.print('figures')
    assert console.file.getvalue() == 'figures\n'
