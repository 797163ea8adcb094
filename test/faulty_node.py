"""The real node with faults put into what its callbacks call: `python test/faulty_node.py run --params FILE`."""

import sys

from semiparam_ros.cli.main import main
from semiparam_ros.ros import diagnostics
from semiparam_ros.ros.diagnosing import Diagnosing
from semiparam_ros.ros.learner import Learner
from semiparam_ros.ros.outputs import Outputs
from semiparam_ros.ros.tare import Tare

UNLUCKY_STAMP_NS = 1_200_000_000


def broken(*_):
    raise ZeroDivisionError('a fault put there by a test')


def fails_where(method, unlucky):
    """The method, but for arguments that are unlucky."""
    return lambda self, *arguments: broken() if unlucky(*arguments) else method(self, *arguments)


Tare.take = broken
Diagnosing._start = broken
Learner.clear_pending = broken
Learner.check = fails_where(Learner.check, lambda settings: settings.forgetting == 0.9)
Learner.change = fails_where(Learner.change, lambda settings: settings.forgetting == 0.8)
Outputs.publish = fails_where(Outputs.publish, lambda answer: answer.prediction.sample.stamp == UNLUCKY_STAMP_NS)
diagnostics.timing_report = broken

if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
