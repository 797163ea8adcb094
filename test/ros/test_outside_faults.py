"""Every fault of outside_faults.py."""

import pytest

from support import outside_faults


@pytest.mark.slow
@pytest.mark.parametrize('fault', outside_faults.FAULTS, ids=lambda fault: fault.__name__)
def test_the_node_bears_faults_from_outside(ros_domain, tmp_path, fault, long):
    try:
        print(fault(tmp_path, full=long))
    except outside_faults.NotPossible as reason:
        pytest.skip(str(reason))
