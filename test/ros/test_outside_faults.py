"""Every fault of outside_faults.py in its short form."""

import pytest

from support import outside_faults


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize('fault', outside_faults.FAULTS, ids=lambda fault: fault.__name__)
def test_the_node_bears_faults_from_outside(ros_domain, tmp_path, fault):
    try:
        fault(tmp_path, full=False)
    except outside_faults.NotPossible as reason:
        pytest.skip(str(reason))
