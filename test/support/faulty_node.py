"""The real node with faults put into what its callbacks call: `python test/support/faulty_node.py run --params
FILE`.
"""

import sys

from semiparam_ros.cli.main import main
from semiparam_ros.online.learner import Learner
from semiparam_ros.online.tare import Tare
from semiparam_ros.ros.estimator import diagnostics
from semiparam_ros.ros.estimator.diagnosing import Diagnosing
from semiparam_ros.ros.estimator.publishers import Outputs

UNLUCKY_STAMP_NS = 1_200_000_000


def broken(*_):
    raise ZeroDivisionError('a fault put there by a test')


def fails_where(method, unlucky):
    """The method, but for arguments that are unlucky."""
    return lambda self, *arguments: broken() if unlucky(*arguments) else method(self, *arguments)


if __name__ == '__main__':
    Tare.take = broken
    Diagnosing._diagnose = broken
    Learner.clear_pending = broken
    Learner.check = fails_where(Learner.check, lambda settings: settings.forgetting == 0.9)
    Learner.change = fails_where(Learner.change, lambda settings: settings.forgetting == 0.8)
    Outputs.publish = fails_where(Outputs.publish, lambda answer: answer.prediction.sample.stamp == UNLUCKY_STAMP_NS)
    diagnostics.TimingReport.make = broken
    sys.exit(main(sys.argv[1:]))
