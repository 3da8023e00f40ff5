"""CANopen timers on a running bench, in real time and in lockstep: they do not depend on SYNC."""

import functools
import struct
import time

import bench_process
import can
import numpy as np
import pytest

from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.bus.sdo_client import RefusedError, SdoClient
from rollerrig.wsp_interface.events import Code

# nodes: a drive, the encoder, the I/O module, and a partner that is only in this test
DRIVE = 1
SPEED = 16
BRAKE = 17
PARTNER = 50
# identifiers of CANopen; for the services of a node, its number is added
EMERGENCY = 0x080
TPDOS = (0x180, 0x280, 0x380, 0x480)
HEARTBEAT = 0x700
MAGNETS = 0x211
INVALID = 1 << 31  # bit of a COB-ID: the service is switched off, so that it can be configured
EVENT_DRIVEN = 254  # transmission type of a PDO
SYNC_S = 0.1  # longer than every time that is measured


class Master:
    """A client of a running bench that reads and writes objects."""

    def __init__(self, bench):
        self.bus = buses.open_client(bench.address())
        self.sdo = SdoClient(self.bus.send, self.bus.recv, lambda message: None)

    def write(self, node, index, sub, value, letter="I"):
        self.sdo.write(node, index, sub, struct.pack(f"<{letter}", value))

    def event_driven(self, node, number, inhibit_ms=0, event_ms=0):
        """Let a transmit PDO be sent by its timer or on a change; return its identifier."""
        can_id = TPDOS[number - 1] + node
        parameters = 0x1800 + number - 1
        self.write(node, parameters, 1, INVALID | can_id)
        self.write(node, parameters, 2, EVENT_DRIVEN, "B")
        self.write(node, parameters, 3, 10 * inhibit_ms, "H")  # in 100 us
        self.write(node, parameters, 5, event_ms, "H")
        self.write(node, parameters, 1, can_id)
        return can_id

    def send(self, can_id, data=b""):
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


@pytest.fixture(
    scope="module", params=["lockstep", pytest.param("wall", marks=pytest.mark.nightly)]
)
def bench(request, tmp_path_factory):
    """A coach that coasts, with a SYNC every 0.1 s."""
    tmp_path = tmp_path_factory.mktemp("timers")
    (tmp_path / "coasting.toml").write_text(
        'title = "The coach coasts"\nvehicle = "uic_z1"\nrig = "full_scale"\n'
        'adhesion = "dry"\ninitial_speed_m_s = 99.0\n'
    )
    # in lockstep without a unit simulated time runs ahead of the client that configures
    seconds = {"lockstep": 20_000, "wall": 600}[request.param]
    run = bench_process.BenchProcess(
        tmp_path / "run",
        "--wsp",
        "none",
        "--pacing",
        request.param,
        "--set",
        f"bus.sync_period_s={SYNC_S}",
        "--set",
        f"duration_max_s={seconds}",
        "--set",
        "loop.record_hz=1",
        "--set",
        "vehicle.resistance_A_N=0",
        "--set",
        "vehicle.resistance_C_N_s2_m2=0",
        scenario=str(tmp_path / "coasting.toml"),
    )
    run.pacing = request.param
    yield run
    run.process.kill()
    run.process.wait()


@pytest.fixture(scope="module")
def master(bench):
    found = Master(bench)
    yield found
    found.bus.shutdown()


def times(bench, can_id, data=""):
    """The times of the recorded frames of an identifier whose data begin with `data`."""
    log = bench.out / "can.log"
    if not log.exists():
        return np.array([])
    # the last line may be incomplete
    lines = log.read_text().splitlines()[:-1]
    frame = f" {can_id:03X}#{data}"
    return np.array([float(line[1 : line.index(")")]) for line in lines if frame in line])


def periods(bench, can_id, wanted_s):
    """The last 25 periods of an identifier, as soon as the last 50 have the wanted median.

    This excludes frames from before the change, and the period at the change itself.
    """

    def found():
        last_s = np.diff(times(bench, can_id)[-51:])
        is_steady = len(last_s) == 50 and abs(np.median(last_s) - wanted_s) < 0.02 * wanted_s
        return [last_s[25:]] if is_steady else None

    (last_s,) = bench_process.until(found, f"{can_id:X}h every {wanted_s} s", 60.0)
    return last_s


@pytest.mark.conformance("CiA 301", "on a running bench: event timer")
def test_an_event_timer_shorter_than_the_sync_period_sends_in_between(bench, master):
    can_id = master.event_driven(SPEED, 3, event_ms=20)
    periods_s = periods(bench, can_id, 0.02)
    if bench.pacing == "lockstep":
        np.testing.assert_allclose(periods_s, 0.02, atol=1e-6)


@pytest.mark.conformance("CiA 301", "on a running bench: inhibit time")
def test_an_event_timer_does_not_override_the_inhibit_time(bench, master):
    can_id = master.event_driven(SPEED, 2, inhibit_ms=50, event_ms=20)
    assert periods(bench, can_id, 0.05).min() > 0.05 - 1e-3


@pytest.mark.conformance("CiA 301", "on a running bench: heartbeat producer")
def test_heartbeats_come_every_period_whatever_the_sync(bench, master):
    master.write(DRIVE, 0x1017, 0, 30, "H")
    periods_s = periods(bench, HEARTBEAT + DRIVE, 0.03)
    # in real time a busy machine may delay some of them
    middle = {"lockstep": np.mean, "wall": np.median}[bench.pacing]
    assert middle(periods_s) == pytest.approx(0.03, rel=0.05)


@pytest.mark.conformance("CiA 301", "on a running bench: emergency inhibit time")
def test_between_two_emergencies_lies_the_inhibit_time(bench, master):
    master.write(BRAKE, 0x1014, 0, INVALID | EMERGENCY + BRAKE)
    master.write(BRAKE, 0x1015, 0, 2500, "H")  # 250 ms
    master.write(BRAKE, 0x1014, 0, EMERGENCY + BRAKE)
    # an RPDO1 that is too short is an error, a right one resets it
    for data in (b"", b"\x00", b"", b"\x00"):
        master.send(MAGNETS, data)
    bench_process.until(lambda: len(times(bench, EMERGENCY + BRAKE)) >= 4, "four emergencies")
    periods_s = np.diff(times(bench, EMERGENCY + BRAKE))
    assert periods_s.min() >= 0.25 - 1e-3


def silence(bench, master):
    """Send heartbeats of the partner, then none; return the time until its loss is reported.

    The time is in s, from the last heartbeat on the clock of the bus. An event has simulated time,
    which is too short after a stall.
    """
    beats = functools.partial(times, bench, HEARTBEAT + PARTNER)
    losses = functools.partial(times, bench, EMERGENCY + BRAKE, "3081")  # heartbeat error 8130h
    sent = len(beats())
    for _ in range(10):
        master.send(HEARTBEAT + PARTNER, b"\x05")
        # 1.6 SYNC periods: a heartbeat that is counted from the SYNC before it would seem late
        time.sleep(0.16)
    bench_process.until(lambda: len(beats()) == sent + 10, "the partner's heartbeats")
    beats_s = beats()[sent:]
    bench_process.until(lambda: losses().size and losses()[-1] > beats_s[-1], "the loss")

    *early_s, last_s = losses()[losses() > beats_s[0]]
    # a busy machine may have delayed a heartbeat for longer than the time-out
    late_beats = np.sum(np.diff(beats_s) > 0.3 - 1e-3)
    assert len(early_s) <= late_beats
    return last_s - beats_s[-1]


@pytest.mark.conformance("CiA 301", "on a running bench: heartbeat consumer")
def test_a_partner_is_lost_only_when_it_is_silent_for_longer_than_its_time(bench, master):
    if bench.pacing == "lockstep":
        pytest.skip(
            "in lockstep without answers simulated time does not agree with the clock of a partner"
        )
    master.write(BRAKE, 0x1016, 2, PARTNER << 16 | 300)
    late_s = [silence(bench, master) for _ in range(3)]
    assert min(late_s) >= 0.3 - 1e-3
    assert np.median(late_s) < 0.4


@pytest.mark.parametrize("pacing", ["lockstep", pytest.param("wall", marks=pytest.mark.nightly)])
@pytest.mark.parametrize(
    "sync_s",
    [
        pytest.param(0.02, marks=pytest.mark.nightly),
        pytest.param(0.05, marks=pytest.mark.nightly),
        pytest.param(0.1, marks=pytest.mark.nightly),
        0.5,
    ],
)
def test_the_reference_unit_heartbeats_within_the_rigs_patience_whatever_the_sync_period(
    sync_s, pacing, tmp_path
):
    run = bench_process.BenchProcess(
        tmp_path / "run",
        "--pacing",
        pacing,
        "--set",
        f"bus.sync_period_s={sync_s}",
        "--set",
        "initial_speed_m_s=99",
        "--set",
        f"duration_max_s={max(2.0, 8 * sync_s)}",
        scenario="dry_stop",
    ).finish()
    beats_s = np.diff(times(run, 0x720))
    assert len(beats_s) > 5
    if pacing == "lockstep":
        assert beats_s.max() <= max(0.1, sync_s) + 0.01
        for code in (Code.UNIT_LOST, Code.NODE_LOST, Code.HEARTBEAT_LOST):
            assert not run.reported(code)
    else:
        assert np.median(beats_s) < 0.15


@pytest.mark.conformance("CiA 301", "SYNC counter 1019h while 1006h is set")
def test_the_syncs_overflow_value_cannot_change_while_a_period_is_set(bench, master):
    master.write(DRIVE, 0x1006, 0, 100_000)
    with pytest.raises(RefusedError, match="08000022"):
        master.write(DRIVE, 0x1019, 0, 10, "B")
    master.write(DRIVE, 0x1006, 0, 0)
    master.write(DRIVE, 0x1019, 0, 10, "B")
