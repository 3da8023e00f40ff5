"""The frames of a run show a fault by what the nodes report."""

from rollerrig.firmware_sim.drive402.drive import OVER_TEMPERATURE
from rollerrig.realtime.discover import bus_signs
from rollerrig.realtime.record import records
from rollerrig.wsp_interface.bus.connection_set import EMERGENCY
from rollerrig.wsp_interface.bus.frames import Frame, candump_line


def test_a_hot_drive_is_found_by_the_code_that_it_reports(tmp_path):
    code = OVER_TEMPERATURE.to_bytes(2, "little")
    frame = Frame(EMERGENCY + 2, code + bytes(6), time_ns=100_000_000)
    (tmp_path / "can.log").write_text(candump_line(frame) + "\n")
    run = records.Run(tmp_path, None, {}, [], {})
    assert bus_signs.of(run) == ["drive_over_temperature axle=2"]
