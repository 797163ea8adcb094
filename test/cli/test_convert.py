"""`semiparam convert`: tables and foreign bags become MCAP."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from semiparam_ros.bags.loading import load_samples
from semiparam_ros.bags.reader import open_bag
from semiparam_ros.bags.text_tables import parse_columns
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings.snapshot import Settings
from support.commands import refusal, semiparam
from support.node_helpers import damage_every_chunk, motion, write_bag

ICUB_JOINTS = ('r_shoulder_pitch', 'r_shoulder_roll', 'r_shoulder_yaw', 'r_elbow')
TWO_JOINTS = ('--joints', 'hip,knee', '--position', '1-2', '--velocity', '3-4', '--rate', '100')


def convert(*arguments) -> int:
    return semiparam('convert', *arguments)


def table(tmp_path: Path, text: str) -> Path:
    path = tmp_path / 'table.txt'
    path.write_text(text)
    return path


def messages(path: Path, topic: str):
    with open_bag(path) as bag:
        return list(bag.messages([topic]))


def test_the_icub_tables_convert_in_one_short_command(shared_data, repository, tmp_path, capsys):
    source = shared_data / 'icub_arm' / 'icubdyn_train.dat'
    bag = tmp_path / 'train.mcap'
    assert convert(source, bag, '--columns', repository / 'config' / 'icub_table.yaml',
                   '--robot-description', shared_data / 'icub_arm' / 'iCubGenova01.urdf') == 0
    assert '2000 rows, 68.966 s' in capsys.readouterr().err
    loaded = load_samples(bag, Settings(joints=ICUB_JOINTS, sensor_frame='r_arm_ft_sensor'))
    rows = np.loadtxt(source)
    np.testing.assert_allclose(loaded.samples.inputs, np.radians(rows[:, :12]), rtol=1e-14)
    np.testing.assert_array_equal(loaded.samples.outputs, rows[:, 12:])
    np.testing.assert_allclose(loaded.samples.time, 0.0345 * np.arange(2000), atol=1e-9)
    assert loaded.frame_id == 'r_arm_ft_sensor' and loaded.faults == {} and 'iCub' in loaded.robot_description


def test_a_ros1_bag_with_a_topic_and_joints_renamed(shared_data, tmp_path):
    bag = tmp_path / 'ur3.mcap'
    assert convert(shared_data / 'ur3_arm' / 'id1.bag', bag, '--topic', '/arm=/joint_states', '--effort-sign', '-1',
                   '--joint', 'Base=shoulder_pan_joint,Shoulder=shoulder_lift_joint,Elbow=elbow_joint',
                   '--joint', 'Wrist *=wrist_*_joint', '--robot-description', shared_data / 'ur3_arm' / 'ur3.urdf') == 0
    loaded = load_samples(bag, Settings(outputs='effort', acceleration_source='filter'))
    assert loaded.joints == ('shoulder_pan_joint', 'shoulder_lift_joint', 'elbow_joint', 'wrist_1_joint',
                             'wrist_2_joint', 'wrist_3_joint')
    assert len(loaded.samples) == 5941
    original = next(iter(messages(shared_data / 'ur3_arm' / 'id1.bag', '/arm')))
    np.testing.assert_array_equal(loaded.samples.outputs[0], -np.array(original.data.effort))
    assert messages(bag, '/joint_states')[0].log_time == original.log_time


def test_a_database_without_metadata(shared_data, tmp_path):
    bag = tmp_path / 'panda.mcap'
    assert convert(shared_data / 'panda_arm' / 'panda_exciting_trajectory.db3', bag, '--joint', 'fer_*=panda_*') == 0
    states = messages(bag, '/joint_states')
    assert len(states) == 727
    assert states[0].data.name == [f'panda_joint{number}' for number in range(1, 8)]


def test_names_of_joints_are_literal_but_for_one_star(tmp_path, capsys):
    """Brackets made a pattern fit nothing, two stars gave other names, and a joint's own entry counted for nothing."""
    source, bag = tmp_path / 'in.mcap', tmp_path / 'out.mcap'
    assert convert(table(tmp_path, '1 2 3 4\n'), source, '--joints', 'arm[0]_j1,arm[0]_hand', *TWO_JOINTS[2:]) == 0
    assert convert(source, bag, '--joint', 'arm[0]_*=left_*', '--joint', 'arm[0]_hand=gripper') == 0
    assert messages(bag, '/joint_states')[0].data.name == ['left_j1', 'gripper']
    assert "no joint '*_j*' to rename" in refusal(capsys, 'convert', source, bag, '--joint', '*_j*=*_k*')


def test_topics_without_a_change_are_copied_byte_by_byte(shared_data, tmp_path):
    source = shared_data / 'panda_arm' / 'panda_exciting_trajectory.db3'
    assert convert(source, tmp_path / 'copy.mcap') == 0
    assert [m.raw for m in messages(tmp_path / 'copy.mcap', '/joint_states')] == \
        [m.raw for m in messages(source, '/joint_states')]


def test_messages_that_fit_no_type_are_copied_too_where_another_topic_changes(tmp_path):
    """They were left out, although nothing of theirs was to change."""
    source, bag = tmp_path / 'in.mcap', tmp_path / 'out.mcap'
    with BagWriter(source) as writer:
        writer.write('/joint_states', 'sensor_msgs/msg/JointState', {'name': ['a'], 'position': [1.0]}, 10**9)
        writer.add_topic('/note', 'std_msgs/msg/String')
        writer.write_raw('/note', bytes((0, 1, 0, 0, 9, 0, 0, 0)), 10**9)
    assert convert(source, bag, '--joint', 'a=b') == 0
    with open_bag(bag) as copied, open_bag(source) as original:
        raw = [[message.raw for message in each.messages(['/note'], decode=False)] for each in (copied, original)]
    assert len(raw[0]) == 1 and raw[0] == raw[1]


def test_efforts_of_more_joints_than_are_named_stay_too_many(tmp_path):
    """They were cut to the names, so that a message that is refused became one that is learnt."""
    source, bag = tmp_path / 'in.mcap', tmp_path / 'out.mcap'
    with BagWriter(source) as writer:
        for effort in ([1.0], [1.0, 2.0], [1.0, 2.0, 3.0]):
            writer.write('/joint_states', 'sensor_msgs/msg/JointState', {'name': ['a', 'b'], 'effort': effort}, 10**9)
    assert convert(source, bag, '--joint', 'a=c', '--effort-sign', '-1', '--effort-factors', 'c=2') == 0
    assert [state.data.effort for state in messages(bag, '/joint_states')] == [
        [-2.0], [-2.0, -2.0], [-2.0, -2.0, -3.0]]


@pytest.mark.parametrize(('taken', 'option', 'sentence'), [
    ('/joint_states', ('--wrench-sign', -1), 'wrenches are to change, but no topic that is taken holds geometry_msgs'),
    ('/joint_states', ('--wrench-frame', 'ft'), 'wrenches are to change'),
    ('/wrench', ('--effort-sign', -1), 'efforts are to change, but no topic that is taken holds sensor_msgs')])
def test_an_option_that_changes_nothing_of_a_bag_is_refused(taken, option, sentence, tmp_path, capsys):
    """It was passed over: the bag was written as it was."""
    write_bag(tmp_path / 'in.mcap', motion(20))
    output = tmp_path / 'out.mcap'
    assert sentence in refusal(capsys, 'convert', tmp_path / 'in.mcap', output, '--topic', taken, *option)
    assert not output.exists()


@pytest.mark.parametrize(('option', 'sentence'), [
    (('--effort-sign', -1), "in.mcap': efforts are to change, but its joint states hold none."),
    (('--effort-factors', 'a=2'), "effort_factors names 'a', of which there is no effort; expected some of ")])
def test_efforts_that_are_not_there_do_not_change(option, sentence, tmp_path, capsys):
    """The bag was written as it was."""
    with BagWriter(tmp_path / 'in.mcap') as writer:
        writer.write('/joint_states', 'sensor_msgs/msg/JointState', {'name': ['a'], 'position': [0.1]}, 10**9)
    assert sentence in refusal(capsys, 'convert', tmp_path / 'in.mcap', tmp_path / 'out.mcap', *option)


def test_joints_of_accelerations_or_temperatures_alone_are_renamed(tmp_path):
    """It was said that the bag had no such joint."""
    header = {'frame_id': 'a'}
    for topic, type_name, message in (
            ('/joint_accelerations', 'trajectory_msgs/msg/JointTrajectory', {'joint_names': ['a']}),
            ('/temperature', 'sensor_msgs/msg/Temperature', {'header': header})):
        with BagWriter(tmp_path / 'in.mcap') as writer:
            writer.write(topic, type_name, message, 10**9)
        assert convert(tmp_path / 'in.mcap', tmp_path / 'out.mcap', '--joint', 'a=c') == 0
        data = messages(tmp_path / 'out.mcap', topic)[0].data
        assert 'c' in (getattr(data, 'joint_names', None) or [data.header.frame_id])


def test_a_bag_of_which_nothing_can_be_read_is_not_converted(tmp_path, capsys):
    """An empty bag was written, and the exit code was 0."""
    source = tmp_path / 'in.mcap'
    write_bag(source, motion(20))
    damage_every_chunk(source)
    assert ' 0 of ' in refusal(capsys, 'convert', source, tmp_path / 'out.mcap')
    assert [path.name for path in tmp_path.iterdir()] == ['in.mcap']


def test_columns_by_name_with_times_signs_and_efforts(tmp_path):
    path = table(tmp_path, '# a remark\nt;q1;q2;w1;w2;e1;e2;fx;fy;fz;tx;ty;tz\n'
                           '1574901258.850321557;90;-45;180;0;1;2;1;2;3;4;5;6\n'
                           '\n1574901258.860321557;91;-44;180;0;1;2;1;2;3;4;5;7\n')
    bag = tmp_path / 'out.mcap'
    assert convert(path, bag, '--joints', 'hip,knee', '--time', 't', '--position', 'q1,q2', '--velocity', 'w1,w2',
                   '--effort', 'e1,e2', '--force', 'fx,fy,fz', '--torque', 'tx,ty,tz', '--degrees',
                   '--wrench-sign', '-1', '--effort-sign', '-1', '--wrench-frame', 'wrist') == 0
    state, second = messages(bag, '/joint_states')
    assert state.log_time == 1574901258850321557 and second.log_time - state.log_time == 10_000_000
    assert (state.data.header.stamp.sec, state.data.header.stamp.nanosec) == (1574901258, 850321557)
    np.testing.assert_allclose(state.data.position, [math.pi / 2, -math.pi / 4])
    np.testing.assert_allclose(state.data.velocity, [math.pi, 0.0])
    assert state.data.effort == [-1.0, -2.0]
    wrench = messages(bag, '/wrench')[0].data
    assert wrench.header.frame_id == 'wrist'
    assert (wrench.wrench.force.x, wrench.wrench.torque.z) == (-1.0, -6.0)


def test_a_bag_of_a_killed_recorder_may_have_notes_beside_it(tmp_path):
    """Without a metadata.yaml its folder was taken for one of tables, and the notes for one that is damaged."""
    folder = tmp_path / 'killed'
    folder.mkdir()
    (folder / 'notes.txt').write_text('run of tuesday\n')
    assert convert(table(tmp_path, '1 2 3 4\n'), folder / 'run_0.mcap', *TWO_JOINTS) == 0
    assert convert(folder, tmp_path / 'out.mcap') == 0
    assert len(messages(tmp_path / 'out.mcap', '/joint_states')) == 1


def test_the_heading_over_row_numbers_may_be_empty(tmp_path):
    """The columns of a table with tabs were taken one too far to the left: row numbers for times."""
    bag = tmp_path / 'out.mcap'
    for separator in '\t,;':
        path = table(tmp_path, '\tt\tq1\tq2\n0\t1.5\t0.1\t0.2\n1\t1.6\t0.3\t0.4\n'.replace('\t', separator))
        assert convert(path, bag, '--joints', 'hip,knee', '--time', 't', '--position', 'q1,q2') == 0
        states = messages(bag, '/joint_states')
        assert [(state.log_time, list(state.data.position)) for state in states] == [
            (1_500_000_000, [0.1, 0.2]), (1_600_000_000, [0.3, 0.4])]


@pytest.mark.parametrize('text', ['"time, s","q, rad",w,e\n1,0.1,0.2,9\n', '"t" ; "q; x";"w";"e"\n"1";"0.1";0.2;9\n',
                                  't\t"q, rad"\tw\te\n1\t0.1\t0.2\t9\n'])
def test_what_stands_in_quotes_is_one_cell(text, tmp_path):
    """A mark within a name put all names behind it one column further to the right: efforts for velocities."""
    path, bag = table(tmp_path, text), tmp_path / 'out.mcap'
    assert convert(path, bag, '--joints', 'a', '--time', '1', '--position', '2', '--velocity', 'w') == 0
    state = messages(bag, '/joint_states')[0]
    assert (state.log_time, state.data.position, state.data.velocity) == (10**9, [0.1], [0.2])


def test_a_first_row_that_lacks_a_number_is_no_header(tmp_path):
    path, bag = table(tmp_path, '1,2,,4\n5,6,7,8\n'), tmp_path / 'out.mcap'
    assert convert(path, bag, '--joints', 'a,b', '--position', '1-2', '--rate', '1') == 0
    assert messages(bag, '/joint_states')[0].data.position == [1.0, 2.0]


ONE_JOINT = ('--joints', 'a', '--time', '1', '--position', '2')


@pytest.mark.parametrize(('text', 'rows'), [
    ('1 2 9\r3 4 9\r5 6 9\r', [(1.0, 2.0), (3.0, 4.0), (5.0, 6.0)]),  # was one row
    ('1_1,1_2\n3,4\n', [(3.0, 4.0)]),  # names of axes were the numbers 11 and 12
    ('1,2,,\n3,4,5,\n5,6\n', [(1.0, 2.0), (3.0, 4.0), (5.0, 6.0)]),
    ('t\tq\tremark\n1\t2\t\n', [(1.0, 2.0)]),
    ('"1"\t"2"\t"a, b"\n"3"\t"4"\t""\n', [(1.0, 2.0), (3.0, 4.0)]),  # was cut at every blank
    ('t "a b" q\n1 "x y" 2\n', [(1.0, 2.0)]),
    ('remark time 9\nidle 1 2\n"on" 3 4\n', [(1.0, 2.0), (3.0, 4.0)]),
    ('1e-99999999999999999999,2\n3,4\n', [(0.0, 2.0), (3.0, 4.0)])])  # was a decimal.InvalidOperation
def test_rows_are_those_that_the_file_has(text, rows, tmp_path):
    path, bag = tmp_path / 'table.txt', tmp_path / 'out.mcap'
    path.write_bytes(text.encode())
    columns = ('--time', 't', '--position', 'q') if text.startswith('t') else ONE_JOINT[2:]
    columns = ('--time', '2', '--position', '3') if text.startswith('remark') else columns
    assert convert(path, bag, *ONE_JOINT[:2], *columns) == 0
    assert [(1e-9 * state.log_time, *state.data.position) for state in messages(bag, '/joint_states')] == rows


NAMED = ('--joints', 'a', '--time', 't', '--position', 'q')


@pytest.mark.parametrize(('text', 'options', 'sentence'), [
    ('1,NA\n2,3\n', ONE_JOINT, "line 1: 'NA' is not a number (position)"),  # was passed by as a header
    ('1,1_5\n2,3\n', ONE_JOINT, "line 1: '1_5' is not a number (position)"),  # was 15
    ('t,q,q\n1,2,3\n', NAMED, "has 2 columns 'q'; expected distinct names"),  # was the first of them
    ('"t","q"\n"1",0.1,2\n', NAMED, 'line 2 has 3 columns, but line 1 has 2'),  # row numbers were times
    ('t [s] q v\n1 2 3\n', NAMED, 'line 2 has 3 columns, but line 1 has 4'),  # velocities were positions
    ('title\n1 2 3\n2 2 33 2 3\n', ONE_JOINT, 'line 3 has 5 columns, but line 2 has 3'),  # two rows run together
    ('1\t2\ta, b\n3\t4\t5\n', ONE_JOINT, 'line 1 may be a header or a row'),  # was passed by as a header
    ('1,2,NA\n3,4,5\n', ONE_JOINT, 'line 1 may be a header or a row (1, 2, NA)'),
    ('time,0,1,2\n0,5,6,7\n', ONE_JOINT, 'column 1 is not the one that the header calls 1'),
    ('1,"' + 'x' * 200_000 + '"\n', ONE_JOINT, 'line 1 cannot be read: field larger than field limit')])
def test_a_column_that_may_be_another_is_refused(text, options, sentence, tmp_path, capsys):
    assert sentence in refusal(capsys, 'convert', table(tmp_path, text), tmp_path / 'out.mcap', *options)


def test_options_win_over_the_columns_file(tmp_path):
    columns = tmp_path / 'columns.yaml'
    columns.write_text('joints: [a, b]\nrate: 10\ndegrees: true\ncolumns: {position: 1-2, velocity: 3-4}\n')
    path = table(tmp_path, '1 2 3 4 5 6\n' * 3)
    bag = tmp_path / 'out.mcap'
    assert convert(path, bag, '--columns', columns, '--joints', 'c,d', '--radians', '--position', '5,6',
                   '--period', '0.5', '--start', '2') == 0
    states = messages(bag, '/joint_states')
    assert states[0].data.name == ['c', 'd'] and states[0].data.position == [5.0, 6.0]
    assert [state.log_time for state in states] == [2_000_000_000, 2_500_000_000, 3_000_000_000]


def test_a_table_that_was_made_of_a_bag_may_have_its_name(tmp_path):
    """run.mcap.csv was taken for a bag."""
    path = table(tmp_path, '1 2 3 4\n').rename(tmp_path / 'run.mcap.csv')
    assert convert(path, tmp_path / 'out.mcap', *TWO_JOINTS) == 0


def test_names_of_joints_have_no_blanks_about_them(tmp_path):
    """' knee' came into the recording, and no command found the joint."""
    bag = tmp_path / 'out.mcap'
    assert convert(table(tmp_path, '1 2 3 4\n'), bag, '--joints', 'hip, knee', *TWO_JOINTS[2:]) == 0
    assert messages(bag, '/joint_states')[0].data.name == ['hip', 'knee']


def quantities(count=50):
    """Time, positions and currents of two joints, each as its own array."""
    time = 100.0 + 0.01 * np.arange(count)
    position = np.column_stack([np.sin(time), np.cos(time)])
    return {'t': time, 'q': position, 'current': 3.0 * position}


def saved_arrays(folder, arrays, form):
    path = folder / f'run.{form}'
    if form == 'npz':
        np.savez(path, **arrays, note=np.array(['bench']), rate=100.0)
    elif form == 'mat':  # of a struct, samples along the rows as MATLAB has them
        savemat(path, {'log': {name: values.T for name, values in arrays.items()}, 'title': 'bench'})
    else:
        path.mkdir()
        for name, values in arrays.items():
            np.savetxt(path / f'{name}.csv', values, delimiter=',', fmt='%.17g')
    return path


@pytest.mark.parametrize('form', ['npz', 'mat', 'folder'])
def test_arrays_and_one_file_for_each_quantity(form, tmp_path):
    arrays, within = quantities(), 'log.' if form == 'mat' else ''
    path, bag = saved_arrays(tmp_path, arrays, form), tmp_path / 'out.mcap'
    assert convert(path, bag, '--joints', 'hip,knee', '--time', f'{within}t', '--position', f'{within}q', '--effort',
                   f'{within}current', '--effort-factors', 'knee=-11.5', '--effort-sign', '-1') == 0
    states = messages(bag, '/joint_states')
    np.testing.assert_array_equal([state.data.position for state in states], arrays['q'])
    np.testing.assert_allclose([state.data.effort for state in states], arrays['current'] * [-1.0, 11.5], rtol=1e-15)
    assert states[1].log_time - states[0].log_time == pytest.approx(10_000_000, abs=100)
    loaded = load_samples(bag, Settings(outputs='effort', joints=('hip', 'knee')))  # velocities are filtered
    assert len(loaded.samples) > 40


def test_single_columns_of_an_array_and_factors_for_a_bag(tmp_path, capsys):
    path, bag = saved_arrays(tmp_path, quantities(), 'npz'), tmp_path / 'out.mcap'
    assert convert(path, bag, '--joints', 'knee', '--rate', '100', '--position', 'q:2', '--effort', 'current:2') == 0
    assert convert(bag, tmp_path / 'turned.mcap', '--joint', 'knee=elbow', '--effort-factors', 'elbow=2') == 0
    before, after = (messages(path, '/joint_states')[3].data for path in (bag, tmp_path / 'turned.mcap'))
    assert after.name == ['elbow'] and after.effort == [2.0 * before.effort[0]]
    for options, sentence in (
            (('q', '--effort-factors', 'c=2'), "effort_factors names 'c'; expected some of the joints a, b"),
            (('q', '--effort-factors', '2'), 'expected NAME=FACTOR'),
            (('p',), 'position has 1 columns; expected 2, one for each of --joints')):
        assert sentence in refusal(capsys, 'convert', path, bag, '--joints', 'a,b', '--rate', 9,
                                   '--position', *options)


def test_arrays_may_have_numbers_for_names(tmp_path):
    """Of a folder with 1.csv and 2.csv the names became the first sample."""
    first, second = quantities()['q'].T
    path, bag = saved_arrays(tmp_path, {'1': first, '2': second}, 'folder'), tmp_path / 'out.mcap'
    assert convert(path, bag, '--joints', 'hip,knee', '--rate', '100', '--position', '2,1') == 0
    np.testing.assert_array_equal([state.data.position for state in messages(bag, '/joint_states')],
                                  np.column_stack([second, first]))


@pytest.mark.parametrize('form', ['npz', 'mat', 'folder'])
def test_ranges_of_an_array_and_rows_that_do_not_match(form, tmp_path, capsys):
    within = 'log.' if form == 'mat' else ''
    arrays = quantities() | {'short': quantities(49)['current']}
    path, bag = saved_arrays(tmp_path, arrays, form), tmp_path / 'out.mcap'
    assert convert(path, bag, '--joints', 'hip,knee', '--time', f'{within}t', '--position', f'{within}q:1-2') == 0
    np.testing.assert_array_equal([state.data.position for state in messages(bag, '/joint_states')], arrays['q'])
    shape = '2 x 49' if form == 'mat' else '49 x 2'
    for columns in ('short', 'short:1-2'):
        assert (f"'{within}short' has {shape} values, where the others have 50 samples; expected as many "
                'samples in each.') in refusal(
            capsys, 'convert', path, bag, '--joints', 'hip,knee', '--time', f'{within}t',
            '--position', f'{within}q', '--effort', within + columns)


@pytest.mark.parametrize('form', ['npz', 'mat'])
def test_an_array_without_numbers_is_no_missing_column(form, tmp_path, capsys):
    within = 'log.' if form == 'mat' else ''
    path = saved_arrays(tmp_path, quantities() | {'names': np.array(['hip', 'knee'] * 25)}, form)
    assert f"'{within}names' holds no numbers; expected an array of them." in refusal(
        capsys, 'convert', path, tmp_path / 'out.mcap', '--joints', 'hip,knee', '--time', f'{within}t',
        '--position', f'{within}q', '--effort', f'{within}names')


def test_arrays_that_nobody_asked_for_do_not_tell_where_samples_run(tmp_path):
    """Limits of the joints outvoted them: two rows were written, one of each joint, whose columns were the samples."""
    limits = {name: np.array([1.0, 2.0]) for name in ('q_min', 'q_max', 'dq_max', 'current_max')}
    path, bag = saved_arrays(tmp_path, quantities() | limits, 'npz'), tmp_path / 'out.mcap'
    assert convert(path, bag, '--joints', 'hip,knee', '--rate', '100', '--position', 'q:1-2',
                   '--effort', 'current:1-2') == 0
    np.testing.assert_array_equal([state.data.position for state in messages(bag, '/joint_states')], quantities()['q'])


HUGE = b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d,)}"


@pytest.mark.parametrize(('name', 'content', 'sentence'), [
    ('a.npz', b'PK no archive', 'is damaged or holds no plain arrays'), ('a.npz', b'', 'holds no plain arrays'),
    ('a.mat', b'MATLAB 5.0 but not really', 'is damaged or holds no plain arrays'),
    ('a.npy', None, 'holds no arrays of numbers'),
    *[('a.npy', b'\x93NUMPY\x01\0v\0' + (HUGE % count).ljust(118),
       'is damaged or') for count in (10**13, 10**26)]])  # were a MemoryError and an OverflowError
def test_array_files_that_hold_nothing_end_in_one_sentence(name, content, sentence, tmp_path, capsys):
    path = tmp_path / name
    if content is None:
        np.save(path, np.array(['a', 'b']))
    else:
        path.write_bytes(content)
    assert sentence in refusal(capsys, 'convert', path, tmp_path / 'out.mcap', *TWO_JOINTS)


def test_a_cell_array_or_long_doubles_beside_others_do_no_harm(tmp_path):
    """Structs in a cell array ended in a ValueError of numpy; a long double was told as no number."""
    cell = np.empty(2, object)
    cell[:] = [{'a': 1.0}, np.arange(3.0)]
    savemat(tmp_path / 'run.mat', quantities() | {'notes': cell})
    np.savez(tmp_path / 'run.npz', **{name: values.astype(np.longdouble) for name, values in quantities().items()})
    for name in ('run.mat', 'run.npz'):
        bag = tmp_path / 'out.mcap'
        assert convert(tmp_path / name, bag, '--joints', 'hip,knee', '--time', 't', '--position', 'q') == 0
        states = messages(bag, '/joint_states')
        np.testing.assert_array_equal([state.data.position for state in states], quantities()['q'])


@pytest.mark.parametrize('told', ['description', 'columns'])
def test_degrees_are_of_angles_alone(told, tmp_path):
    """0.5 m of a joint that slides became 9 mm."""
    links = ''.join(f'<link name="{name}"/>' for name in 'abc')
    (tmp_path / 'arm.urdf').write_text(f"""<robot name="r">{links}
        <joint name="lift" type="prismatic"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint>
        <joint name="turn" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 0 1"/></joint></robot>""")
    (tmp_path / 'columns.yaml').write_text('sliding: [lift]\n')
    options = ('--robot-description', tmp_path / 'arm.urdf') if told == 'description' else \
        ('--columns', tmp_path / 'columns.yaml')
    assert convert(table(tmp_path, '90 0.5 180 2\n'), tmp_path / 'out.mcap', '--joints', 'turn,lift', *TWO_JOINTS[2:],
                   '--degrees', *options) == 0
    state = messages(tmp_path / 'out.mcap', '/joint_states')[0].data
    np.testing.assert_allclose([state.position, state.velocity], [[np.pi / 2, 0.5], [np.pi, 2.0]], rtol=1e-15)


def test_tables_called_by_numbers_are_those_that_are_named(tmp_path):
    """Of twelve tables 10.csv stood second, and was taken for 2.csv."""
    folder, bag = tmp_path / 'run', tmp_path / 'out.mcap'
    folder.mkdir()
    for number in range(1, 13):
        (folder / f'{number}.csv').write_text(f'{number}\n{number}\n')
    names = ','.join(f'j{number}' for number in range(1, 13))
    assert convert(folder, bag, '--joints', names, '--position', '1-12', '--rate', '9') == 0
    assert messages(bag, '/joint_states')[0].data.position == list(range(1, 13))


def test_two_tables_of_one_name_in_a_folder_are_refused(tmp_path, capsys):
    """The last one was taken without a word."""
    path = saved_arrays(tmp_path, quantities(), 'folder')
    (path / 'q.txt').write_text('1 2\n' * 50)
    assert "has several tables called 'q'; expected distinct names" in refusal(
        capsys, 'convert', path, tmp_path / 'out.mcap', '--joints', 'a,b', '--time', 't', '--position', 'q')


def test_the_same_input_gives_the_same_bytes(tmp_path):
    path = table(tmp_path, ''.join(f'{k} 2 3 {k / 7}\n' for k in range(5000)))
    for name in ('one', 'two'):
        assert convert(path, tmp_path / f'{name}.mcap', *TWO_JOINTS) == 0
    assert (tmp_path / 'one.mcap').read_bytes() == (tmp_path / 'two.mcap').read_bytes()


def test_rows_that_later_steps_will_refuse_are_counted(tmp_path, capsys):
    path = table(tmp_path, '1 2 3 4 1\n1 nan 3 4 1\n1 2 3 4 0.5\n')
    assert convert(path, tmp_path / 'o.mcap', *TWO_JOINTS[:-2], '--time', '5') == 0
    said = capsys.readouterr().err
    assert '1 rows hold a number that is not finite.' in said and '2 rows are not later than the row before.' in said


BAD_TABLES = {
    'line 2, short': ('1 2 3 4\n1 2 3\n', TWO_JOINTS, 'line 2 has 3 columns; expected at least 4'),
    'a word': ('1 2 3 4\n1 2 x 4\n', TWO_JOINTS, "line 2: 'x' is not a number (velocity)"),
    'nothing': ('# only a remark\n', TWO_JOINTS, 'holds no row of numbers'),
    'no joints': ('1 2\n', ('--rate', '1'), 'needs the names of its joints'),
    'no position': ('1 2\n', ('--joints', 'a', '--velocity', '1', '--rate', '1'), 'no position columns'),
    'no time': ('1 2\n', ('--joints', 'a', '--position', '1', '--velocity', '2'), 'rows have no time'),
    'half a wrench': ('1 2 3 4\n', (*TWO_JOINTS, '--force', '1-3'), 'both force and torque'),
    'too few columns named': ('1 2 3 4\n', (*TWO_JOINTS, '--effort', '1'), 'effort has 1 columns; expected 2'),
    'column 0': ('1 2 3 4\n', (*TWO_JOINTS, '--effort', '0-1'), 'columns count from 1'),
    'no such name': ('a b c d\n1 2 3 4\n', (*TWO_JOINTS, '--effort', 'a,e'), "no column 'e'; its header has a, b"),
    'negative rate': ('1 2 3 4\n', (*TWO_JOINTS[:-1], '-5'), 'rate is -5.0; expected a positive number'),
    'hardly any rate': ('1 2 3 4\n', (*TWO_JOINTS[:-1], '1e-320'), 'the period of this rate is inf; expected a finite'),
    'time before 1970': ('1 2 3 4 -1\n', (*TWO_JOINTS[:-2], '--time', '5'), 'line 1 has the time -1 s'),
    'time beyond all': ('1 2 3 4 1e9999999\n', (*TWO_JOINTS[:-2], '--time', '5'), 'line 1 has the time Infinity s'),
    'time is nan': ('1 2 3 4 nan\n', (*TWO_JOINTS[:-2], '--time', '5'), 'line 1 has the time NaN s'),
    'rate beside a time': ('1 2 3 4 5\n', (*TWO_JOINTS, '--time', '5'), '--rate is for tables without'),
    'unit of no time': ('1 2 3 4\n', (*TWO_JOINTS, '--time-unit', 'ms'), '--time-unit needs columns'),
    'temperatures nowhere': ('1 2 3 4\n', (*TWO_JOINTS, '--temperatures', 'hip'), '--temperatures needs columns'),
    'sign of no wrench': ('1 2 3 4\n', (*TWO_JOINTS, '--wrench-sign', '-1'), '--wrench-sign needs columns'),
    'sign of no effort': ('1 2 3 4\n', (*TWO_JOINTS, '--effort-sign', '-1'), '--effort-sign needs columns'),
    'factors of no effort': ('1 2 3 4\n', (*TWO_JOINTS, '--effort-factors', 'hip=2'), 'effort_factors needs efforts'),
    'option for bags': ('1 2 3 4\n', (*TWO_JOINTS, '--topic', '/a'), '--topic is for bags'),
}


@pytest.mark.parametrize('case', BAD_TABLES)
def test_a_bad_table_ends_in_one_sentence_and_leaves_no_file(case, tmp_path, capsys):
    text, options, sentence = BAD_TABLES[case]
    assert sentence in refusal(capsys, 'convert', table(tmp_path, text), tmp_path / 'out.mcap', *options)
    assert [path.name for path in tmp_path.iterdir()] == ['table.txt']


@pytest.mark.parametrize(('text', 'sentence'), [
    ('joints: [a]\nperoid: 1\n', "'peroid' is unknown; did you mean 'period'?"),
    ('- 1\n', 'holds no columns'),
    ('joints: [a\n', 'is not valid YAML'),
    ('joints: [a\x07]\n', "is not valid YAML: it holds the character '\\x07'."),
    ('columns: 3\n', "columns is 3; expected a mapping"),
    ('degrees: maybe\n', "degrees is 'maybe'; expected true or false"),
    ('columns: {positon: 1}\njoints: [a]\n', "column role 'positon' is unknown"),
    ('wrench_sign: .nan\n', 'wrench_sign is nan; expected a finite number'),
    ('wrench_sign: 0\n', 'wrench_sign is 0; expected 1 or -1'),
    ('effort_factors: {a: 0}\n', 'the effort factor of a is 0'),
    ('joints: 7\n', 'joints is 7; expected distinct names'),
    ('joints: [a, a]\n', "joints is ['a', 'a']; expected distinct names"),
    ('temperatures: {a: 1}\n', "temperatures is {'a': 1}; expected distinct names"),
    ('joints: "a,,b"\n', "joints is 'a,,b'; expected distinct names"),
    ('joints: [on, off]\n', 'joints is [True, False]; expected distinct names'),  # were True and False
    ('wrench_frame:\n', 'wrench_frame is None; expected a text'),  # was None
    ('period: yes\n', 'period is True; expected a number'),  # was 1 s
    ('joints: [a]\ncolumns: {position: 1}\nrate: 1\nsliding: [b]\n', "sliding names 'b'; expected some of"),
    ('rate: 10\nperiod: 5\n', 'both rate and period are given; expected one of them'),
    ('joints: [a]\ncolumns: {time: 1, position: 2}\nrate: 5\n', 'gives a column of the time, and a rate or period'),
    ('joints: [a]\njoints: [b]\n', "in line 2: 'joints' is there twice"),
    ('5: 6\n', "'5' is unknown"),  # a TypeError of difflib
    ('columns: {time: 1-99999999999999999999}\n', 'names 99999999999999999999 columns'),  # an OverflowError
    (f'columns: {{time: "{"9" * 5000}"}}\n', 'is no column; expected a number from 1'),  # a ValueError of int
    (f'start: {"9" * 400}\n', 'expected a number'),  # an OverflowError
])
def test_a_bad_columns_file_ends_in_one_sentence(text, sentence, tmp_path, capsys):
    columns = tmp_path / 'columns.yaml'
    columns.write_text(text)
    assert sentence in refusal(capsys, 'convert', table(tmp_path, '1 2\n'), tmp_path / 'out.mcap',
                               '--columns', columns)


def test_wrong_files_end_in_one_sentence(tmp_path, capsys):
    path = table(tmp_path, '1 2 3 4\n')
    for arguments, sentence in {
            (tmp_path / 'no.txt', tmp_path / 'o.mcap', *TWO_JOINTS): 'No such file or directory',
            (path, tmp_path / 'o.bag', *TWO_JOINTS): 'expected one that ends in .mcap',
            (path, tmp_path / 'no' / 'o.mcap', *TWO_JOINTS): 'there is no folder',
            (path, tmp_path / 'o.mcap', *TWO_JOINTS, '--robot-description', tmp_path / 'no.urdf'): 'no.urdf'}.items():
        assert sentence in refusal(capsys, 'convert', *arguments)
    bag = tmp_path / 'good.mcap'
    assert convert(path, bag, *TWO_JOINTS) == 0
    before = bag.read_bytes()
    for arguments, sentence in {
            (bag, bag): 'is read, too; expected another name for the output',
            (bag, tmp_path / 'o.mcap', '--topic', '/no'): 'has no topic /no; it has /joint_states',
            **{(bag, tmp_path / 'o.mcap', '--topic', f'/joint_states={new}'):
               f'/joint_states is to become {new!r}, which is no name of a topic; expected one such as /joint_states'
               for new in ('/x=/y', 'x', '/x/', '/1', '/x y', '/ü')},
            (bag, tmp_path / 'o.mcap', '--joint', 'a='): "'a=' is no renaming; expected OLD=NEW",
            (bag, tmp_path / 'o.mcap', '--rate', '5'): '--rate is for text tables'}.items():
        assert sentence in refusal(capsys, 'convert', *arguments)
    assert bag.read_bytes() == before


def test_a_pipe_is_refused(tmp_path, capsys):
    """The rows that a look at the first bytes had taken out of it were missing, without a word."""
    path = tmp_path / 'pipe'
    os.mkfifo(path)
    assert 'is a device or a pipe; expected a file' in refusal(
        capsys, 'convert', path, tmp_path / 'out.mcap', *TWO_JOINTS)


def test_what_a_killed_recorder_left_is_not_written_over_while_it_is_read(tmp_path, capsys):
    """The output is written as OUTPUT.mcap.partial: the recording was emptied, and its reader ended by SIGBUS."""
    assert convert(table(tmp_path, '1 2 3 4\n'), tmp_path / 'run.mcap', *TWO_JOINTS) == 0
    left = (tmp_path / 'run.mcap').rename(tmp_path / 'run.mcap.partial')
    before = left.read_bytes()
    assert 'run.mcap.partial is read, too; expected another name for the output' in refusal(
        capsys, 'convert', left, tmp_path / 'run.mcap')
    assert left.read_bytes() == before and not (tmp_path / 'run.mcap').exists()
    assert convert(left, tmp_path / 'whole.mcap') == 0


def test_headers_of_every_type_can_have_their_stamps_from_the_log(tmp_path):
    """Of types that are copied they stayed 0."""
    source, bag = tmp_path / 'in.mcap', tmp_path / 'out.mcap'
    with BagWriter(source) as writer:
        writer.write('/imu', 'sensor_msgs/msg/Imu', {'orientation': {'x': 0.5}}, 3_000_000_004)
        writer.write('/note', 'std_msgs/msg/String', {'data': 'a text of some length'}, 10**9)
    assert convert(source, bag, '--stamps-from-log') == 0
    imu, note = messages(bag, '/imu')[0].data, messages(bag, '/note')[0].data
    assert (imu.header.stamp.sec, imu.header.stamp.nanosec, imu.orientation.x) == (3, 4, 0.5)
    assert note.data == 'a text of some length'


def test_header_stamps_can_come_from_the_log(tmp_path):
    path = table(tmp_path, '1 2 3 4\n1 2 3 4\n')
    convert(path, tmp_path / 'a.mcap', *TWO_JOINTS)
    assert convert(tmp_path / 'a.mcap', tmp_path / 'b.mcap', '--stamps-from-log') == 0
    state = messages(tmp_path / 'b.mcap', '/joint_states')[1]
    assert state.data.header.stamp.sec * 10**9 + state.data.header.stamp.nanosec == state.log_time == 1_010_000_000


@pytest.mark.parametrize(('text', 'columns'), [
    ('1-4', (1, 2, 3, 4)), ('1, 3,5-6', (1, 3, 5, 6)), ('q-1,q2', ('q-1', 'q2')), (3, (3,)), ([1, '2-3'], (1, 2, 3)),
    ('\u00b2', ('\u00b2',)),
])
def test_columns_are_numbers_ranges_or_names(text, columns):
    assert parse_columns(text) == columns


@pytest.mark.parametrize('text', ['1-99999999999', '5-4'])
def test_a_range_of_no_column_or_of_more_than_a_table_has_is_refused(text):
    with pytest.raises(SemiparamError, match=f"'{text}' names .* columns; expected 1 to 10000"):
        parse_columns(text)
