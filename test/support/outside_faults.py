"""Faults from outside that a live node meets: its disk, its worker processes, its clock and its publishers.

Each function is one fault: it starts a node in a process of its own, brings the fault about, checks that every good
sample is answered once and in order and that the node recovers, and returns counts. ``full``: longer, more often.
"""

import contextlib
import os
import random
import resource
import signal
import struct
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from builtin_interfaces.msg import Time
from rcl_interfaces.srv import SetParameters
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from semiparam_ros.settings import dump_params
from support.node_client import TYPES, Client, NodeProcess, Robot, messages, resident_mb, set_stamp
from support.node_helpers import JOINTS, SETTINGS, motion

LIVE = replace(SETTINGS, acceleration_source='measured', features_count=20, initial_samples=100)
TOPICS = ('joint_states', 'joint_accelerations', 'wrench')
YEAR_NS = 365 * 86400 * 10**9
BUSY = replace(LIVE, features_count=200, initial_samples=200)
"""Its estimation takes seconds, so that a worker can be met at work."""


class NotPossible(Exception):
    """The machine does not allow to bring the fault about."""


@contextlib.contextmanager
def live(folder, settings=LIVE, samples=(), topics=TOPICS, worker_may_complain=False):
    """A node, a client that hears all its answers, and a robot; the end must be clean, and the log too."""
    dump_params(settings, folder / 'p.yaml')
    with NodeProcess(folder, folder / 'p.yaml') as node, Client() as client:
        client.connect()
        client.offer(*topics)
        yield node, client, Robot(client, samples, JOINTS)
        assert node.process.poll() is None, node.output
        client.heard['/diagnostics'].clear()
        assert client.report('errors')[2]['internal errors'] == '0', node.output
        code = node.stop()
    assert code == 0
    assert 'internal error' not in node.output, node.output
    assert worker_may_complain or 'Traceback' not in node.output, node.output


# The disk

@contextlib.contextmanager
def small_disk(folder, megabytes):
    """A file system of its own that can be filled and made read-only."""
    folder.mkdir()
    made = subprocess.run(['mount', '-t', 'tmpfs', '-o', f'size={megabytes}m', 'tmpfs', str(folder)],
                          capture_output=True, text=True, check=False)
    if made.returncode:
        raise NotPossible(f'no file system can be mounted here: {made.stderr.strip()}')
    try:
        yield folder
    finally:
        subprocess.run(['umount', '-l', str(folder)], check=True)


def full_disk(folder, full):
    """``~/save_state`` and checkpoints while no room is left, then with room."""
    times = 10 if full else 1
    with small_disk(folder / 'disk', 8) as disk:
        def fault():
            with contextlib.suppress(OSError), (disk / 'filler').open('ab', buffering=0) as filler:
                while True:
                    filler.write(bytes(4096))
        return _saves_in_vain(folder, disk, times, 'No space left on device', fault, (disk / 'filler').unlink)


def read_only_folder(folder, full):
    """``~/save_state`` and checkpoints in a folder that has become read-only, then in one that can be written again."""
    times = 10
    with small_disk(folder / 'disk', 8) as disk:
        def remount(how):
            while subprocess.run(['mount', '-o', f'remount,{how}', str(disk)], capture_output=True,
                                 check=False).returncode:
                time.sleep(0.01)  # a checkpoint is being written
        return _saves_in_vain(folder, disk, times, 'Read-only file system', lambda: remount('ro'),
                              lambda: remount('rw'))


def _saves_in_vain(folder, disk, times, sentence, fault, mend):
    settings = replace(LIVE, state_file='state.npz', state_folder=str(disk), checkpoint_period=0.3)
    saved, known = disk / 'state.npz', {'state.npz', 'estimator.checkpoint.npz', 'estimator.checkpoint.previous.npz',
                                          'estimator.lock'}
    counts = {'faults': times, 'saves refused in a sentence': 0, 'saves afterwards': 0}
    with live(folder, settings, motion(200 + 20 * times)) as (node, client, robot):
        robot.move(200)
        client.wait_report('learning', lambda level, message, values: message.startswith('learning with'))
        assert client.trigger('save_state').success
        for number in range(times):
            before = saved.read_bytes()
            fault()
            robot.move(10)
            fault()
            reply = client.trigger('save_state')
            assert not reply.success and sentence in reply.message and reply.message.endswith('.'), reply.message
            counts['saves refused in a sentence'] += 1
            while int(client.report('inputs')[2].get('refused: checkpoints', 0)) <= number:
                fault()  # room that a file given up has left
                time.sleep(0.1)
            assert saved.read_bytes() == before, 'the earlier state is whole'
            told = node.output.count('written again')
            mend()
            robot.move(10)
            assert client.trigger('save_state').success
            client.wait(lambda told=told: node.output.count('written again') > told, 'it is told')
            client.wait(lambda: {path.name for path in disk.iterdir()} <= known,
                        'nothing half-written stays behind but what is being written')
            counts['saves afterwards'] += 1
        assert client.trigger('load_state').success
        client.heard['/diagnostics'].clear()
        counts['checkpoints refused and told'] = int(client.report('inputs')[2]['refused: checkpoints'])
    return {**counts, 'samples answered': robot.played}


# The worker processes

def workers(node):
    """Process ids of the node's workers, the latest last."""
    found = []
    for entry in Path('/proc').iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                parent = int((entry / 'stat').read_text().rpartition(')')[2].split()[1])
                if parent == node.process.pid and b'resource_tracker' not in (entry / 'cmdline').read_bytes():
                    found.append(int(entry.name))
    return sorted(found)


def kill_workers(node, deaths):
    """SIGKILL for the workers, and for those that replace them, so many times in all."""
    killed: set[int] = set()
    for _ in range(deaths):
        end = time.monotonic() + 60.0
        while not (new := set(workers(node)) - killed) and time.monotonic() < end:
            time.sleep(0.01)
        for worker in new:
            os.kill(worker, signal.SIGKILL)
        killed |= new


def killed_while_estimating(folder, full):
    """SIGKILL for the worker while the initial window is evaluated, by turns once and twice."""
    return _estimates_in_vain(folder, 10 if full else 2, lambda node, number: kill_workers(node, 1 + number % 2))


def out_of_memory_while_estimating(folder, full):
    """No more memory for the worker while the initial window is evaluated (RLIMIT_AS as it stands)."""
    return _estimates_in_vain(folder, 10 if full else 1, exhaust)


def exhaust(node, _):
    """Let the workers have no more memory than they have."""
    for worker in workers(node):
        pages = int(Path(f'/proc/{worker}/statm').read_text().split()[0])
        resource.prlimit(worker, resource.RLIMIT_AS, (pages * resource.getpagesize(), resource.RLIM_INFINITY))


def relieve(node):
    """Memory for all workers again."""
    for worker in workers(node):
        resource.prlimit(worker, resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def _estimates_in_vain(folder, times, fault):
    chance, window = random.Random(1), BUSY.initial_samples
    samples = motion(times * (4 * window + 20))
    with live(folder, BUSY, samples, worker_may_complain=fault is exhaust) as (node, client, robot):
        for number in range(times):
            client.wait_report('learning', lambda level, message, values: message.startswith('gathering'))
            robot.move(window)
            time.sleep(chance.uniform(0.0, 0.3))
            fault(node, number)
            robot.move(20)
            relieve(node)
            # A job is tried a second time; a window that is given up is followed by another one.
            while client.wait_report('learning', _settled)[1] != 'learning with SPK-ML.':
                robot.move(window // 2)
            assert client.trigger('reset').success
        given_up = node.output.count('gives no hyperparameters')
    assert given_up == 0 if fault is exhaust else given_up, 'the worker that took its place was killed too'
    return {'faults': times, 'windows given up': given_up, 'estimated at the second try': times - given_up,
            'samples answered': robot.played}


def _settled(level, message, values):
    return 'estimating' not in message and 'built' not in message


def killed_while_building(folder, full):
    """SIGKILL for the worker while another variant is built, by turns once and twice."""
    times, chance = 20, random.Random(1)
    with live(folder, BUSY, motion(500 + 40 * times)) as (node, client, robot):
        robot.move(300)
        client.wait_report('learning', lambda level, message, values: message == 'learning with SPK-ML.')
        taken = 0
        for number in range(times):
            wanted = ('SP-ML', 'NP-ML', 'SP2-ML')[number % 3]
            begun = client.begin(SetParameters, 'set_parameters', SetParameters.Request(
                parameters=messages({'variant': wanted})))
            robot.move(20)
            time.sleep(chance.uniform(0.0, 0.2))
            kill_workers(node, 1 + number % 2)
            client.wait(begun.done, 'the reply')
            client.wait_report('learning', _settled)
            robot.move(20)
            variant = client.get('variant')[0].string_value
            assert client.report('learning')[1] == f'learning with {variant}.'
            taken += variant == wanted
            if variant != 'SPK-ML':
                client.set(variant='SPK-ML')
                client.wait_report('learning', lambda level, message, values: message == 'learning with SPK-ML.')
        assert client.set(variant='P')[0].successful
        client.wait_report('learning', lambda level, message, values: message == 'learning with P.')
        robot.move(100)
    assert taken < times, 'of ten that were killed twice one had not built its model before'
    return {'faults': times, 'models given up': times - taken, 'models built at the second try': taken,
            'samples answered': robot.played}


def killed_while_diagnosing(folder, full):
    """SIGKILL for the workers while one of them diagnoses, by turns twice and once."""
    times, chance = 10, random.Random(1)
    with live(folder, LIVE, motion(400 + 10 * times)) as (node, client, robot):
        robot.move(400)
        client.take_over()
        refused = 0
        for number in range(times):
            asked = client.begin(Trigger, 'diagnose', Trigger.Request())
            time.sleep(chance.uniform(0.5, 1.5))
            kill_workers(node, 2 - number % 2)
            client.wait(asked.done, 'the reply')
            assert asked.result().message.endswith('.')
            refused += not asked.result().success
            robot.move(10)
        answer = client.trigger('diagnose')
        assert answer.success, answer.message
    assert refused
    return {'faults': times, 'refused in a sentence': refused, 'diagnosed at the second try': times - refused,
            'samples answered': robot.played}


# The clock

def clock_jumps(folder, full):
    """Stamps, and the simulated clock, a year ahead and back again."""
    found = [_clock_jumps(folder, replace(LIVE, acceleration_source=source), 20 if full else 2)
             for source in ('filter', 'measured')[:1 + full]]
    return {name: sum(counts[name] for counts in found) for name in found[0]}


def _clock_jumps(folder, settings, times):
    topics = TOPICS if settings.acceleration_source == 'measured' else ('joint_states', 'wrench')
    samples, part = motion(200 + 40 * times + 40), 20
    moved = [sample._replace(stamp=sample.stamp + YEAR_NS * ((index - 200) // part % 2 if index >= 200 else 0))
             for index, sample in enumerate(samples)]
    with live(folder, settings, moved, topics) as (node, client, robot):
        clock = client.node.create_publisher(Clock, '/clock', 10)
        assert client.set(use_sim_time=True)[0].successful
        client.wait(clock.get_subscription_count, 'the node follows the clock')
        client.meet()
        robot.move(200)
        client.wait_report('learning', lambda level, message, values: message == 'learning with SPK-ML.')
        for _ in range(2 * times):
            robot.move(part)
            message = Time()
            set_stamp(message, robot.samples[robot.played].stamp)
            clock.publish(Clock(clock=message))
        client.wait(lambda: 'the clock jumped' in node.output, 'the jump is told')
        clock.publish(Clock(clock=Time(sec=-5)))
        client.wait(lambda: '/clock has the time -5 s; expected one from 0 on.' in node.output, 'it is refused')
        robot.move(part)
        residual = np.abs(client.values('residual'))
        assert residual[-part:].mean() < 3.0 * residual[180:200].mean(), 'the model was kept'
        refused = _refused(client)
    assert refused == {'/clock': 1}
    return {'jumps ahead': times, 'jumps back': times, 'samples answered': robot.played,
            'refused': sum(refused.values())}


def one_stamp_of_next_year(folder, full):
    """A joint state and a wrench with a stamp a year ahead among the others: what follows lies in the past."""
    times = 20 if full else 1
    with live(folder, LIVE, motion(200)) as (_, client, robot):
        robot.move(200)
        client.wait_report('learning', lambda level, message, values: message == 'learning with SPK-ML.')
        good = [sample._replace(stamp=sample.stamp + 200 * 20_000_000) for sample in motion(30 * times)]
        for index, sample in enumerate(good):
            if index % 30 == 10:
                _publish(client, sample._replace(stamp=sample.stamp + YEAR_NS))
            _publish(client, sample)
        client.wait(lambda: client.stamps('residual')[-1] == good[-1].stamp, 'the last sample')
        answered = client.stamps('residual')[200:]
        counts = {'faults': times, 'good samples': len(good), 'good samples answered': len(
            set(answered) & {sample.stamp for sample in good}), 'samples of next year answered': sum(
                stamp > good[-1].stamp for stamp in answered)}
        assert len(answered) == len(set(answered))
    assert counts['good samples answered'] == len(good)
    return counts


def _publish(client, sample):
    client.state(sample, JOINTS)
    client.accelerations(sample, JOINTS)
    client.wrench(sample)


def _refused(client):
    client.heard['/diagnostics'].clear()
    _, _, values = client.report('inputs')
    return {name.removeprefix('refused: '): int(count) for name, count in values.items() if name.startswith('refused')}


# The publishers

def two_publishers(folder, full):
    """A second driver on ``joint_states``: first as good as the first, then the same stamps, then 10 ms late."""
    part = 2000 if full else 20
    with live(folder, LIVE, motion(200 + 3 * part)) as (_, client, robot), Client() as second:
        second.offer('joint_states')
        robot.move(200)
        client.wait_report('learning', lambda level, message, values: message == 'learning with SPK-ML.')
        before = _refused(client)
        for shift in (10_000_000, 0, -10_000_000):
            for _ in range(part):
                sample = robot.samples[robot.played]
                robot.move(1)
                second.state(sample._replace(stamp=sample.stamp + shift), JOINTS)
        wanted = {'duplicate_stamp': part, 'backward_stamp': part}
        client.wait_report('inputs', lambda level, message, values: all(
            int(values.get(f'refused: {reason}', 0)) >= count for reason, count in wanted.items()))
        assert not before and _refused(client) == wanted
        publishers = client.report('inputs')[2]['joint_states publishers']
    assert publishers == '2'
    return {'joint states of the second': 3 * part, 'taken': part, 'refused as duplicates': part,
            'refused as going back': part, 'samples answered': robot.played}


def other_joint_names(folder, full):
    """A publisher that changes its joints' names midway, and changes them back."""
    times, part = (20, 50) if full else (2, 20)
    with live(folder, LIVE, motion(200 + 3 * part * times)) as (_, client, robot):
        robot.move(200)
        client.wait_report('learning', lambda level, message, values: message == 'learning with SPK-ML.')
        unknown = 0
        for _ in range(times):
            robot.joints = JOINTS
            robot.move(part)
            robot.joints = JOINTS[::-1]
            samples = robot.samples[robot.played:robot.played + part]
            robot.samples[robot.played:robot.played + part] = [sample._replace(
                position=sample.position[::-1], velocity=sample.velocity[::-1],
                acceleration=sample.acceleration[::-1]) for sample in samples]
            robot.move(part)
            for sample in robot.samples[robot.played:robot.played + part]:
                client.state(sample, ['c', 'd'])
                client.accelerations(sample, ['c', 'd'])
                client.wrench(sample)
            del robot.samples[robot.played:robot.played + part]
            unknown += part
            client.wait_report('inputs', lambda level, message, values, count=2 * unknown: int(
                values['ignored: other_joints']) + int(values.get('refused: missing_joint', 0)) == count)
        robot.joints = JOINTS
        refused = _refused(client)
        residual = np.abs(client.values('residual'))
    assert residual[-part:].mean() < 3.0 * residual[150:200].mean(), 'names, not places, were read'
    return {'changes': 3 * times, 'samples under unknown names': unknown, 'refused': refused,
            'samples answered': robot.played}


def patiently(publish, raw):
    """Again while the queue is full, of which DDS tells after a tenth of a second."""
    while True:
        try:
            return publish(raw)
        except RuntimeError:  # RCLError, which rclpy does not export
            pass


def ten_kilohertz(folder, full):
    """``joint_states`` at 10 kHz, wrenches at 100 Hz."""
    seconds, rate, every = (60 if full else 1), 10_000, 100
    settings = replace(LIVE, acceleration_source='filter')
    samples = _at(seconds * rate, rate)
    state = bytearray(serialize_message(TYPES['joint_states'](name=list(JOINTS), position=[1.5, 2.5],
                                                              velocity=[3.5, 4.5])))
    positions, velocities = (state.index(struct.pack('<2d', *values)) for values in ((1.5, 2.5), (3.5, 4.5)))
    with live(folder, settings, topics=('joint_states', 'wrench')) as (node, client, _):
        publish, memory, start = client.outputs['joint_states'].publish, [], time.monotonic()
        for index, sample in enumerate(samples):
            if index % 10 == 0:
                time.sleep(max(0.0, start + index / rate - time.monotonic()))
            struct.pack_into('<iI', state, 4, *divmod(sample.stamp, 10**9))
            struct.pack_into('<2d', state, positions, *sample.position)
            struct.pack_into('<2d', state, velocities, *sample.velocity)
            patiently(publish, bytes(state))
            if index % every == 0:
                client.wrench(sample)
            if index % (rate * seconds // 10) == 0:
                memory.append(resident_mb(node.process.pid))
        took = time.monotonic() - start
        wanted = [sample.stamp for sample in samples[::every]]
        client.wait(lambda: wanted[-1] in client.stamps('residual')[-1:], 'the last wrench is answered')
        behind = time.monotonic() - start - took
        _, _, values = client.wait_report('inputs', lambda level, message, values: int(
            values['joint_states received']) >= len(samples) and int(values['wrench received']) >= len(wanted))
        memory.append(resident_mb(node.process.pid))
        refused, answered = _refused(client), client.stamps('residual')
    assert answered == sorted(set(answered) & set(wanted)), 'once, and in order'
    # Joint states that wait for a late wrench are given up beyond 20000: two seconds of them at this rate.
    assert len(answered) + refused.get('unmatched', 0) == len(wanted) and refused.keys() <= {'overflow', 'unmatched'}
    assert int(values['joint_states received']) == len(samples)
    assert memory[-1] < memory[1] + 40.0
    return {'joint states sent and received': len(samples), 'rate [Hz]': round(len(samples) / took),
            'wrenches answered': len(answered), **refused,
            'last answer after the last message [s]': round(behind, 2),
            'memory [MB]': f'{memory[0]:.0f}, {max(memory):.0f} at most, {memory[-1]:.0f} at the end'}


def _at(count, rate):
    """The motion of ``motion`` at another rate."""
    coarse = motion(round(count * 50 / rate) + 2)
    at, known = np.arange(count) / rate, np.arange(len(coarse)) / 50.0
    columns = {name: np.array([np.interp(at, known, column)
                               for column in np.array([getattr(sample, name) for sample in coarse]).T]).T
               for name in ('position', 'velocity', 'acceleration', 'outputs')}
    stamps = coarse[0].stamp + np.round(at * 1e9).astype(int)
    return [coarse[0]._replace(stamp=int(stamp), **{name: values[index] for name, values in columns.items()})
            for index, stamp in enumerate(stamps)]


FAULTS = (full_disk, read_only_folder, killed_while_estimating, out_of_memory_while_estimating, killed_while_building,
          killed_while_diagnosing, clock_jumps, one_stamp_of_next_year, two_publishers, other_joint_names,
          ten_kilohertz)
