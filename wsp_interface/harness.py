"""Everything for your own tests: the harness on a bench's bus, and the fixture that starts benches.

A test is a plain function. Pytest finds the fixture by its entry point, or by one line in
conftest.py: `from rollerrig.wsp_interface.harness import rollerrig_bench`.

    def test_no_wheel_locks(rollerrig_bench):
        rig = rollerrig_bench(initial_speed_km_h=60.0, adhesion="soap")
        rig.brake(bar=3.8)
        rig.until(lambda: rig.vehicle_speed_m_s < 1.0, timeout_s=60.0)
        assert rig.longest_lock_s < 0.4
"""

import contextlib

from rollerrig.wsp_interface.harness_client import COLUMNS, Event, Harness, TimeOutError, connect

with contextlib.suppress(ImportError):  # a bench runs without pytest
    from rollerrig.wsp_interface.fixture import rollerrig_bench

__all__ = ["COLUMNS", "Event", "Harness", "TimeOutError", "connect", "rollerrig_bench"]
