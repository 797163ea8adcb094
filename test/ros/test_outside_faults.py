"""Every fault of outside_faults.py."""

import pytest

from support import outside_faults

LONG = outside_faults.read_only_folder, outside_faults.killed_while_building, outside_faults.killed_while_diagnosing
"""What the node does about them is what it does about a full disk and about another job that is killed."""


@pytest.mark.slow
@pytest.mark.parametrize('fault', [pytest.param(fault, marks=[pytest.mark.long] * (fault in LONG), id=fault.__name__)
                                   for fault in outside_faults.FAULTS])
def test_the_node_bears_faults_from_outside(ros_domain, tmp_path, fault, long):
    try:
        print(fault(tmp_path, full=long))
    except outside_faults.NotPossible as reason:
        pytest.skip(str(reason))
