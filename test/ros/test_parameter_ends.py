"""Every live parameter at both ends of its range while samples come."""

import numpy as np
import pytest

from support import parameter_ends


@pytest.mark.slow
def test_every_end_is_accepted_answered_and_undone(tmp_path, ros_domain, long):
    rate, history, each, features = (200.0, 10_000, 100, 200) if long else (50.0, 150, 6, 20)
    rows, wrong, internal, code, memory_mb = parameter_ends.run(tmp_path, rate, history, each, features)
    assert not wrong and not internal and not code
    assert len(rows) == sum(1 for _ in parameter_ends.ends()) > 40
    for name, value, accepted, late in rows if long else ():
        periods = np.quantile(late, (0.5, 0.99, 1.0)) * rate
        print(f'{name} {value!r:.40}: {accepted:.200}; median, 99 % and latest [periods] {periods.round(2)}')
        assert periods[0] < parameter_ends.PERIODS
    print(f'{memory_mb:.0f} MB')
