"""The live benchmark: a node of its own, answers counted and timed, and an empty loop beside it."""

import json
import os
import subprocess
import sys

import numpy as np

import live_benchmark
from live_benchmark import empty_loop, quantiles


def test_a_slow_robot_is_answered_every_time(ros_domain):
    result = subprocess.run([sys.executable, live_benchmark.__file__, '--rate', '100', '--seconds', '1',
                             '--features', '40', '--window', '250'], capture_output=True, text=True,
                            timeout=180, check=False,
                            env={**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'})
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert found['sent'] == found['answered'] == 100 and found['lost'] == 0
    for latency in (found['latency_ms'], found['while_estimating']):
        assert 0.0 < latency['median'] <= latency['p99'] <= latency['max']
    assert found['memory_mb']['end'] > 50.0 and 0.0 < found['cpu_percent'] < 200.0
    assert found['empty_loop']['busy_share'] <= 0.95


def test_an_empty_loop_is_late_by_its_own_work_at_least():
    late = empty_loop(200.0, 0.4, 0.2)
    assert len(late) == 40 and np.all(late >= 0.4 * 5.0)
    assert quantiles(np.array([1.0, 3.0]))['median'] == 2.0
