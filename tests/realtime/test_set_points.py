"""The events of set-points show every value that stays, without an event for each write."""

import itertools

from rollerrig.realtime.record.set_points import LONGEST_S, QUIET_S, SetPoints
from rollerrig.wsp_interface.events import Code

WRITE_S = 0.1


class Log:
    """Set-points that a client writes ten times a second, and their events."""

    def __init__(self):
        self.now_s = 0.0
        self.events = []
        self.set_points = SetPoints(self.take)

    def take(self, code, /, **fields):
        self.events.append((round(self.now_s, 3), code, fields["pressure_Pa"]))

    def write(self, *demands_Pa):
        """Write these demands, one after another; each stays for the time between two writes."""
        for demand_Pa in demands_Pa:
            code = Code.SET_POINT_BRAKE_DEMAND
            self.set_points.change("demand", self.now_s, code, pressure_Pa=demand_Pa)
            self.wait(WRITE_S)

    def wait(self, for_s):
        """Let the bench look at the set-points once a cycle."""
        for _ in range(round(for_s / 0.01)):
            self.now_s += 0.01
            self.set_points.poll(self.now_s)

    @property
    def demands_Pa(self):
        return [demand_Pa for _, _, demand_Pa in self.events]


def test_a_change_is_an_event_when_it_comes_and_the_same_value_again_is_none():
    log = Log()
    log.write(*[3.8e5] * 50)
    assert log.events == [(0.0, Code.SET_POINT_BRAKE_DEMAND, 3.8e5)]
    log.write(0.0)
    assert log.events[1:] == [(5.0, Code.SET_POINT_BRAKE_DEMAND, 0.0)]


def test_of_a_ramp_its_begin_and_its_end_are_events():
    log = Log()
    log.write(*(1e4 * step for step in range(1, 39)))
    log.wait(5.0)
    assert log.demands_Pa == [1e4, 3.8e5]
    # the end of the ramp is known when the value has stayed
    last_change_s = 37 * WRITE_S
    assert QUIET_S <= log.events[1][0] - last_change_s < QUIET_S + 0.02


def test_a_demand_that_never_stays_is_an_event_every_ten_seconds():
    log = Log()
    log.write(*(1e4 * (1 + step % 7) for step in range(600)))
    assert len(log.events) == round(600 * WRITE_S / LONGEST_S)
    times_s = [time_s for time_s, _, _ in log.events]
    for before_s, after_s in itertools.pairwise(times_s):
        assert after_s - before_s >= LONGEST_S


def test_the_value_at_the_end_of_the_run_is_an_event():
    log = Log()
    log.write(1e5, 2e5, 3e5)
    log.set_points.report_all()
    assert log.demands_Pa == [1e5, 3e5]
    log.set_points.report_all()
    assert log.demands_Pa == [1e5, 3e5]


def test_a_short_pulse_leaves_the_value_that_stays():
    log = Log()
    log.write(3.8e5, 0.0)
    log.wait(5.0)
    assert log.demands_Pa == [3.8e5, 0.0]
