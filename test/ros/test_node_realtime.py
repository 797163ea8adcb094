"""The realtime priority of the node's own threads, where the system permits it."""

import os
import subprocess
from dataclasses import replace
from pathlib import Path

from semiparam_ros.ros.estimator.process import take_priority
from semiparam_ros.settings import dump_params
from support.node_client import Client, NodeProcess, children_of
from support.node_helpers import JOINTS, SETTINGS, motion

PRIORITY = 3


def permitted():
    """Whether a process of ours may have one; tried in a child, which takes it to its end."""
    child = os.fork()
    if not child:
        os._exit(bool(take_priority(PRIORITY)))
    return os.waitpid(child, 0)[1] == 0


def policy_of(process_id):
    return os.sched_getscheduler(process_id) & ~os.SCHED_RESET_ON_FORK


def threads_of(process_id):
    return [int(entry.name) for entry in Path(f'/proc/{process_id}/task').iterdir()]


def test_the_node_takes_the_priority_and_the_processes_beside_it_do_not(tmp_path, ros_domain):
    dump_params(replace(SETTINGS, realtime_priority=PRIORITY), tmp_path / 'p.yaml')
    with NodeProcess(tmp_path, tmp_path / 'p.yaml') as node, Client() as client:
        client.connect()
        client.offer('joint_states', 'joint_accelerations', 'wrench')
        client.play(motion(80), JOINTS)
        main = node.process.pid
        if permitted():
            assert os.sched_getscheduler(main) == os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, node.output
            assert os.sched_getparam(main).sched_priority == PRIORITY
            assert sum(policy_of(thread) == os.SCHED_FIFO for thread in threads_of(main)) > 1, "DDS's threads too"
            assert children_of(main) and {policy_of(child) for child in children_of(main)} == {os.SCHED_OTHER}
        else:
            assert f'realtime_priority {PRIORITY} is refused by the system' in node.output
            assert policy_of(main) == os.SCHED_OTHER


def test_a_thread_that_ends_meanwhile_refuses_nothing(monkeypatch):
    """Threads of DDS come and go while the node starts."""
    ended = subprocess.Popen(['true'])
    ended.wait()
    monkeypatch.setattr(os, 'listdir', lambda _: [str(ended.pid)])
    assert take_priority(PRIORITY) == ''


def test_no_priority_changes_nothing():
    before = os.sched_getscheduler(0)
    assert take_priority(0) == '' and os.sched_getscheduler(0) == before
