"""Every live parameter at both ends of its range while samples come, of docs/robustness.md."""

import pytest

from support import parameter_ends


@pytest.mark.slow
def test_every_end_is_accepted_answered_and_undone(tmp_path, ros_domain):
    rows, wrong, internal, code, _ = parameter_ends.run(tmp_path, 50.0, 150, 6, 20)
    assert not wrong and not internal and not code
    assert len(rows) == sum(1 for _ in parameter_ends.ends()) > 40
