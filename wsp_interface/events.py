"""The events of a run: one row a code, with its level, its fields and the template of its sentence.

An event says what happened. Programs use its code and its fields; its text is for people and is
made from them here, by `text` alone. To add an event, add a code and a row. `docs/events.md` is
written from the table.

A part of a template in square brackets is left out where a field in it is None; only such a field
may be None. Values are in SI units; `{pressure_Pa:bar}` shows one in the unit that people use.
"""

import re
from collections.abc import Mapping
from enum import StrEnum
from string import Formatter
from typing import Any, NamedTuple, Protocol

from rollerrig.configs.processes import exits

INFO, WARNING, ERROR = LEVELS = ("info", "warning", "error")


class Code(StrEnum):
    """What happened. A code never changes its meaning; new events get new codes."""

    RUN_FAILED = "run.failed"
    RUN_INTERRUPTED = "run.interrupted"
    RUN_STOPPED = "run.stopped"
    RUN_DERAILED = "run.derailed"
    RUN_BUS_LOST = "run.bus_lost"
    RUN_STARTED = "run.started"
    RUN_STARTED_EARLY = "run.started_early"
    RUN_ENDED_BY_HARNESS = "run.ended_by_harness"
    BENCH_KILLED = "bench.killed"
    BENCH_EXCEPTION = "bench.exception"
    LOOP_STALLED = "loop.stalled"
    LOOP_REFUSED = "loop.refused"
    RECORDER_ENDED = "recorder.ended"
    RECORDER_OVERRUN = "recorder.overrun"
    RECORD_UNREADABLE = "record.unreadable"
    EVENTS_LEFT_OUT = "events.left_out"
    SCENARIO_CHOSEN = "scenario.chosen"
    SCENARIO_REFUSED = "scenario.refused"
    SCENARIO_ADHESION_REPLACED = "scenario.adhesion_replaced"
    SET_POINT_SPEED = "set_point.speed"
    SET_POINT_BRAKE_DEMAND = "set_point.brake_demand"
    SET_POINT_BRAKE_DEMAND_NONE = "set_point.brake_demand_none"
    SET_POINT_FRICTION = "set_point.friction"
    SET_POINT_FRICTION_NONE = "set_point.friction_none"
    EMERGENCY_STOP_SET = "emergency_stop.set"
    EMERGENCY_STOP_RESET = "emergency_stop.reset"
    COACH_DERAILED = "coach.derailed"
    AIR_EXHAUSTED = "air.exhausted"
    SAND_EMPTY = "sand.empty"
    WHEEL_FLAT = "wheel.flat"
    WSP_VENTS_WITHOUT_SLIDING = "wsp.vents_without_sliding"
    WSP_VENTS_ON = "wsp.vents_on"
    WSP_AXLES_SWAPPED = "wsp.axles_swapped"
    WSP_REFERENCE_DRIFTS = "wsp.reference_drifts"
    WSP_REFERENCE_DRIFTS_IN_FAULT = "wsp.reference_drifts_in_fault"
    FAULT_BEGINS = "fault.begins"
    FAULT_LIFTED = "fault.lifted"
    FAULT_REFUSED = "fault.refused"
    FAULT_NEVER_BEGAN = "fault.never_began"
    UNIT_APPEARED = "unit.appeared"
    UNIT_STATE = "unit.state"
    UNIT_READY = "unit.ready"
    UNIT_IDENTITY = "unit.identity"
    UNIT_LOST = "unit.lost"
    UNIT_BACK = "unit.back"
    UNIT_SILENT = "unit.silent"
    UNIT_ANSWERS = "unit.answers"
    UNIT_EMERGENCY = "unit.emergency"
    UNIT_FAILED = "unit.failed"
    UNIT_UNANSWERED = "unit.unanswered"
    UNIT_NO_COMMAND = "unit.no_command"
    UNIT_TWO_SENDERS = "unit.two_senders"
    UNIT_ENDED = "unit.ended"
    NODE_LOST = "node.lost"
    NODE_BACK = "node.back"
    NODE_EMERGENCY = "node.emergency"
    NMT_STATE = "nmt.state"
    NMT_FOREIGN = "nmt.foreign"
    HEARTBEAT_LOST = "heartbeat.lost"
    HEARTBEAT_BACK = "heartbeat.back"
    GUARDING_LOST = "guarding.lost"
    GUARDING_BACK = "guarding.back"
    SYNC_MISSING = "sync.missing"
    SYNC_FOREIGN = "sync.foreign"
    PDO_TOO_SHORT = "pdo.too_short"
    PDO_REFUSED = "pdo.refused"
    PDO_LATE = "pdo.late"
    FRAME_EXTENDED = "frame.extended"
    FRAME_REMOTE = "frame.remote"
    FRAME_LENGTH = "frame.length"
    CAN_ERROR_ACTIVE = "can.error_active"
    CAN_ERROR_PASSIVE = "can.error_passive"
    CAN_BUS_OFF = "can.bus_off"
    DRIVE_STATE = "drive.state"
    DRIVE_FAULT = "drive.fault"
    DRIVES_WITHOUT_MASTER = "drives.without_master"
    MAGNETS_FAIL_SAFE = "magnets.fail_safe"
    MAGNETS_VENT_ALONE = "magnets.vent_alone"
    MAGNETS_FOREIGN = "magnets.foreign"
    SANDERS_STOPPED = "sanders.stopped"
    DYNAMIC_BRAKE_RELEASED = "dynamic_brake.released"
    BUS_PLACE = "bus.place"
    BUS_PORT = "bus.port"
    BUS_PORT_IN_USE = "bus.port_in_use"
    BUS_FRAMES_LOST = "bus.frames_lost"
    BUS_CONTROLLER = "bus.controller"
    HUB_FULL = "hub.full"
    HUB_FOREIGN_CLIENT = "hub.foreign_client"
    SERVER_EXPOSED = "server.exposed"
    SERVER_SILENT_CLOSED = "server.silent_closed"
    SERVER_SILENT_GAVE_WAY = "server.silent_gave_way"
    SERVER_OUT_OF_DESCRIPTORS = "server.out_of_descriptors"
    MODBUS_SERVED = "modbus.served"
    MODBUS_UNAVAILABLE = "modbus.unavailable"
    MODBUS_SERIAL_SERVED = "modbus.serial_served"
    MODBUS_SERIAL_LOST = "modbus.serial_lost"
    MODBUS_SERIAL_BACK = "modbus.serial_back"
    HARNESS_JOINED = "harness.joined"
    HARNESS_LEFT = "harness.left"
    HARNESS_REFUSED = "harness.refused"
    HARNESS_TEXT = "harness.text"
    OPERATOR_NOTE = "operator.note"
    SEQUENCE_STEP = "sequence.step"
    SEQUENCE_ROWS_SAVED = "sequence.rows_saved"
    TEST_BRAKE = "test.brake"
    TEST_BRAKE_RAMP = "test.brake_ramp"
    TEST_FRICTION = "test.friction"
    TEST_FRICTION_DEFAULT = "test.friction_default"
    TEST_SAND_ON = "test.sand_on"
    TEST_SAND_OFF = "test.sand_off"
    TEST_FAULT = "test.fault"
    TEST_FAULT_LIFTED = "test.fault_lifted"


class Row(NamedTuple):
    """One kind of event.

    `advice` follows the sentence: what it means for the run, or what to do.
    """

    level: str
    fields: Mapping[str, type]
    sentence: str
    advice: str = ""


class Event(NamedTuple):
    """An event of a run.

    `code` is None only in the records of benches from before there were codes.
    """

    time_s: float
    level: str
    text: str
    code: Code | None
    fields: dict[str, Any]


class OnEvent(Protocol):
    """A callback that takes the code and the fields of an event."""

    def __call__(self, code: Code, /, **fields: Any) -> None:
        """Take an event that happens now."""


_NODE = {"node": int}
_CAN_ID = {"can_id": int}
_REASON = {"reason": str}
_FAULT = {"fault": str, "kind": str, "reaches_unit": bool, "units": list}
_EMERGENCY = {"node": int, "error_code": int, "error_register": int}

TABLE: dict[Code, Row] = {
    # the run and its processes
    Code.RUN_FAILED: Row(ERROR, _REASON, "{reason}"),
    Code.RUN_INTERRUPTED: Row(WARNING, {"signal": str}, "the run is interrupted by {signal}"),
    Code.RUN_STOPPED: Row(WARNING, {}, "the run is stopped over Modbus"),
    Code.RUN_DERAILED: Row(WARNING, {}, "the run ends: the coach is derailed"),
    Code.RUN_BUS_LOST: Row(WARNING, {}, "the run ends: its bus is lost"),
    Code.RUN_STARTED: Row(INFO, {}, "the run is started over Modbus"),
    Code.RUN_STARTED_EARLY: Row(
        WARNING,
        {"speed_m_s": float, "set_speed_m_s": float},
        "the run is started at {speed_m_s:km/h}, before the rollers have settled at the set speed of "
        "{set_speed_m_s:km/h}",
        "start it when discrete input 4 is 1",
    ),
    Code.RUN_ENDED_BY_HARNESS: Row(INFO, {}, "the harness ends the run"),
    Code.BENCH_KILLED: Row(ERROR, {}, "the bench was killed", "the recorder completed the files"),
    Code.BENCH_EXCEPTION: Row(ERROR, {"message": str, "exception": str}, "{message}: {exception}"),
    Code.LOOP_STALLED: Row(
        WARNING,
        {"stalled_s": float, "ahead_s": float},
        "the loop stood still for {stalled_s:.3f} s",
        "from here on the times in can.log are {ahead_s:.3f} s ahead of simulated time; a pause of 1 s "
        "or longer before standstill makes the run of a unit not valid, a shorter one does not",
    ),
    Code.LOOP_REFUSED: Row(
        INFO, {"refused": str}, "the system refused the real-time thread {refused}"
    ),
    Code.RECORDER_ENDED: Row(
        ERROR,
        {"status": int, "reason": str},
        "the recorder {status:exit}[: {reason}]",
        "the run goes on, its record ends about here",
    ),
    Code.RECORDER_OVERRUN: Row(
        ERROR,
        {"lost": int, "rows": str},
        "{lost} {rows} lost: the recorder was held up and the ring overran",
    ),
    Code.RECORD_UNREADABLE: Row(ERROR, _REASON, "{reason}"),
    Code.EVENTS_LEFT_OUT: Row(
        WARNING,
        {"events": int},
        "{events} events are left out before this one",
        "events.jsonl has those that were recorded",
    ),
    Code.SCENARIO_CHOSEN: Row(
        INFO, {"scenario": str}, "scenario '{scenario}' is selected over Modbus"
    ),
    Code.SCENARIO_REFUSED: Row(
        WARNING, _REASON, "a scenario requested over Modbus is refused: {reason}"
    ),
    Code.SCENARIO_ADHESION_REPLACED: Row(
        WARNING,
        {"mu_cd": float, "given_by": str, "initial_adhesion": float, "stated_by": str},
        "adhesion.mu_cd = {mu_cd:g} ({given_by}) replaces initial_adhesion = {initial_adhesion:g} "
        "({stated_by})",
        "to keep an initial adhesion, leave mu_cd out, or set adhesion.initial_adhesion instead",
    ),
    Code.SET_POINT_SPEED: Row(
        INFO,
        {"speed_m_s": float},
        "the speed of the held rig is set to {speed_m_s:km/h} over Modbus",
    ),
    Code.SET_POINT_BRAKE_DEMAND: Row(
        INFO,
        {"source": str, "pressure_Pa": float},
        "the brake demand is set to {pressure_Pa:bar} by {source}",
    ),
    Code.SET_POINT_BRAKE_DEMAND_NONE: Row(
        INFO, {"source": str}, "the brake demand by {source} is withdrawn"
    ),
    Code.SET_POINT_FRICTION: Row(
        INFO, {"axle": int, "mu": float}, "the friction mu_cd under axle {axle} is set to {mu:g}"
    ),
    Code.SET_POINT_FRICTION_NONE: Row(
        INFO, {"axle": int}, "the friction under axle {axle} is that of the scenario again"
    ),
    Code.EMERGENCY_STOP_SET: Row(WARNING, {}, "emergency stop over Modbus: set"),
    Code.EMERGENCY_STOP_RESET: Row(WARNING, {}, "emergency stop over Modbus: reset"),
    # the plant
    Code.COACH_DERAILED: Row(
        ERROR,
        {"side": str, "axle": int, "distance_m": float},
        "derailed: the {side} wheel of axle {axle} left its rail after {distance_m:.1f} m",
        "reduce the speed, or check the profiles, gauge_m and the suspension in the table multibody",
    ),
    Code.AIR_EXHAUSTED: Row(
        WARNING,
        {"reservoir_Pa": float, "demand_Pa": float},
        "the air is exhausted: the reservoir holds {reservoir_Pa:bar}, the demand is {demand_Pa:bar}",
        "brakes are weak from here on",
    ),
    Code.SAND_EMPTY: Row(
        WARNING,
        {"axle": int},
        "the sand box is empty: the sander of axle {axle} delivers no more sand",
    ),
    Code.WHEEL_FLAT: Row(
        WARNING,
        {"axle": int, "length_m": float},
        "the wheels of axle {axle} have flats of {length_m:mm}",
    ),
    # what the run shows of the unit
    Code.WSP_VENTS_WITHOUT_SLIDING: Row(
        WARNING,
        {"axle": int, "sliding_m_s": float, "speed_m_s": float},
        "the dump valve of axle {axle} vents at {speed_m_s:km/h}, although the axle does not slide "
        "(sliding {sliding_m_s:.2f} m/s)",
        "check the sensor of the axle, and diameters and thresholds in the unit; further vents are "
        "only counted (vents_without_sliding)",
    ),
    Code.WSP_VENTS_ON: Row(
        WARNING,
        {"axle": int, "for_s": float, "speed_m_s": float},
        "the dump valve of axle {axle} has vented for {for_s:.1f} s at {speed_m_s:km/h} while the axle "
        "does not slide",
        "check when the unit ends a vent; further ones are only measured "
        "(longest_vent_without_sliding)",
    ),
    Code.WSP_AXLES_SWAPPED: Row(
        WARNING,
        {"axle": int, "other": int, "for_s": float},
        "axles {axle} and {other} are probably swapped: for {for_s:.1f} s the dump valve of axle "
        "{axle}, which does not slide, vents while axle {other} slides and its valve fills",
        "check the order of the speed sensors and of the magnets",
    ),
    Code.WSP_REFERENCE_DRIFTS: Row(
        WARNING,
        {"reference_m_s": float, "speed_m_s": float, "for_s": float},
        "the reference speed of the unit drifts: it is {reference_m_s:km/h} at a train speed of "
        "{speed_m_s:km/h}, and has been wrong for {for_s:.1f} s",
        "check the wheel diameters in the unit, and how fast its reference speed may fall",
    ),
    Code.WSP_REFERENCE_DRIFTS_IN_FAULT: Row(
        WARNING,
        {"fault": str, "reference_m_s": float, "speed_m_s": float, "for_s": float},
        "the reference speed of the unit drifts in fault {fault}: it is {reference_m_s:km/h} at a "
        "train speed of {speed_m_s:km/h}, and has been wrong for {for_s:.1f} s",
        "check what the unit does with an implausible axle",
    ),
    Code.FAULT_BEGINS: Row(WARNING, _FAULT, "fault {fault} begins"),
    Code.FAULT_LIFTED: Row(
        INFO, _FAULT | {"frames_met": int}, "fault {fault} is lifted[, it met {frames_met} frames]"
    ),
    Code.FAULT_REFUSED: Row(WARNING, _REASON, "a fault requested over Modbus is refused: {reason}"),
    Code.FAULT_NEVER_BEGAN: Row(
        WARNING,
        {"fault": str, "kind": str, "at_s": float},
        "fault {fault} never began: it was planned for {at_s:g} s, and the run did not last so long",
        "plan it earlier, or check that the run lasts long enough",
    ),
    # the WSP unit
    Code.UNIT_APPEARED: Row(
        INFO, _NODE | {"state": str}, "the WSP unit (node {node}) appears: {state}"
    ),
    Code.UNIT_STATE: Row(INFO, _NODE | {"state": str}, "the WSP unit (node {node}) is {state}"),
    Code.UNIT_READY: Row(INFO, {}, "the WSP unit is on the bus"),
    Code.UNIT_IDENTITY: Row(
        INFO,
        _NODE | {"vendor_id": int, "product_code": int, "revision": int, "serial": int},
        "the WSP unit (node {node}) identifies itself (1018h): vendor {vendor_id:X}h[, product "
        "{product_code:X}h][, revision {revision:X}h][, serial number {serial:X}h]",
    ),
    Code.UNIT_LOST: Row(
        ERROR,
        _NODE | {"silent_s": float},
        "the WSP unit (node {node}) is lost: no heartbeat for {silent_s:ms}",
    ),
    Code.UNIT_BACK: Row(
        INFO, _NODE | {"state": str}, "the WSP unit (node {node}) is back: {state}"
    ),
    Code.UNIT_SILENT: Row(
        ERROR,
        _NODE | {"syncs": int, "silent_s": float},
        "the WSP unit (node {node}) is silent: it sends its heartbeat, but no command of the valves "
        "for {silent_s:ms}, after it has answered each SYNC; {syncs} SYNCs have no answer",
        "the magnets stay as they are; check what stops the control of the unit",
    ),
    Code.UNIT_ANSWERS: Row(INFO, _NODE, "the WSP unit (node {node}) commands the valves again"),
    Code.UNIT_EMERGENCY: Row(
        WARNING,
        _EMERGENCY,
        "the WSP unit (node {node}): EMCY {error_code:04X}h, error register {error_register:02X}h",
    ),
    Code.UNIT_FAILED: Row(
        ERROR,
        _EMERGENCY,
        "the WSP unit (node {node}) reports that it has failed: EMCY {error_code:04X}h",
    ),
    Code.UNIT_UNANSWERED: Row(
        WARNING, {"syncs": int}, "the WSP unit left {syncs} SYNCs unanswered"
    ),
    Code.UNIT_NO_COMMAND: Row(
        ERROR,
        _NODE | _CAN_ID,
        "the WSP unit (node {node}) has given no valid command of the valves before standstill",
        "it ran without protection; send {can_id:03X}h with 11 bits and one data byte",
    ),
    Code.UNIT_TWO_SENDERS: Row(
        ERROR,
        _NODE | _CAN_ID,
        "two programs command the valves of the WSP unit (node {node}): both send {can_id:03X}h",
        "let one unit run, or give the other one a bus of another bench",
    ),
    Code.UNIT_ENDED: Row(
        ERROR,
        {"unit": str, "status": int, "last_words": str, "log": str},
        "the {unit} {status:exit}[; its last words: {last_words}]",
        "its log is {log}",
    ),
    # nodes of the rig
    Code.NODE_LOST: Row(
        ERROR, _NODE | {"silent_s": float}, "node {node} is lost: no heartbeat for {silent_s:ms}"
    ),
    Code.NODE_BACK: Row(INFO, _NODE | {"state": str}, "node {node} is back: {state}"),
    Code.NODE_EMERGENCY: Row(
        WARNING,
        _EMERGENCY,
        "node {node}: EMCY {error_code:04X}h, error register {error_register:02X}h",
    ),
    Code.NMT_STATE: Row(INFO, _NODE | {"state": str}, "node {node}: NMT {state}"),
    Code.NMT_FOREIGN: Row(
        WARNING,
        _NODE | {"command": int},
        "another program sends the NMT command {command} (2 stop, 128 pre-operational, 129 and 130 "
        "reset) to node {node} (0: all nodes) during the stop",
        "from here on the run does not show what the unit does",
    ),
    Code.HEARTBEAT_LOST: Row(
        ERROR,
        _NODE | {"partner": int, "silent_s": float},
        "node {node}: heartbeat of node {partner} lost: silent for more than {silent_s:ms}",
    ),
    Code.HEARTBEAT_BACK: Row(
        INFO, _NODE | {"partner": int}, "node {node}: heartbeat of node {partner} is back"
    ),
    Code.GUARDING_LOST: Row(
        ERROR, _NODE, "node {node}: node guarding lost: the master no longer sends requests"
    ),
    Code.GUARDING_BACK: Row(INFO, _NODE, "node {node}: node guarding is back"),
    Code.SYNC_MISSING: Row(
        WARNING,
        _NODE | {"silent_s": float},
        "node {node}: no SYNC for {silent_s:ms}, 1.5 times the period in 1006h",
    ),
    Code.SYNC_FOREIGN: Row(
        WARNING,
        {},
        "another node sends SYNC (080h), but the bench is the SYNC producer",
        "the nodes of the rig obey it, and the run does not wait for an answer to it; stop that SYNC, "
        "or leave SYNC to the other node with bus.master=false",
    ),
    Code.PDO_TOO_SHORT: Row(
        WARNING,
        _NODE | {"pdo": int, "length": int, "expected": int},
        "node {node}: RPDO {pdo} is ignored: {length} bytes instead of {expected}",
    ),
    Code.PDO_REFUSED: Row(
        WARNING,
        _NODE | {"pdo": int, "index": int, "sub": int, "value": float, "abort": str},
        "node {node}: RPDO {pdo}: object {index:04X}h:{sub} refuses {value} ({abort})",
    ),
    Code.PDO_LATE: Row(WARNING, _NODE | {"pdo": int}, "node {node}: RPDO {pdo} is late"),
    Code.FRAME_EXTENDED: Row(
        WARNING,
        _CAN_ID,
        "another program sends {can_id:08X}h as an extended frame (29 bits), which the rig refuses",
        "send {can_id:03X}h with 11 bits (in python-can: is_extended_id=False)",
    ),
    Code.FRAME_REMOTE: Row(
        WARNING,
        _CAN_ID,
        "another program sends {can_id:03X}h as a remote frame, which the rig refuses",
        "send {can_id:03X}h as a data frame",
    ),
    Code.FRAME_LENGTH: Row(
        WARNING,
        _CAN_ID | {"length": int, "least": int, "most": int},
        "another program sends {can_id:03X}h with {length} data bytes, which the rig refuses",
        "send {least} to {most} data bytes",
    ),
    Code.CAN_ERROR_ACTIVE: Row(INFO, _NODE, "node {node}: error active again"),
    Code.CAN_ERROR_PASSIVE: Row(
        WARNING,
        _NODE | {"counter": str},
        "node {node}: error passive: its {counter} error counter has passed 127",
    ),
    Code.CAN_BUS_OFF: Row(
        ERROR, _NODE, "node {node}: bus-off: its transmit error counter has passed 255"
    ),
    Code.DRIVE_STATE: Row(
        INFO,
        _NODE | {"state": str, "transition": int},
        "node {node}: drive {state} (transition {transition})",
    ),
    Code.DRIVE_FAULT: Row(
        ERROR,
        _NODE | {"error_code": int, "reason": str},
        "node {node}: drive fault {error_code:04X}h: {reason}",
    ),
    Code.DRIVES_WITHOUT_MASTER: Row(
        WARNING,
        {"nodes": list},
        "rig.drives=bus, and after 1 s no master has enabled the drives of nodes {nodes}",
        "their rollers run without motors; let a master write the controlwords 6, 7, 15 (6040h), or "
        "leave the motors to the bench with --set rig.drives=rig",
    ),
    Code.MAGNETS_FAIL_SAFE: Row(
        WARNING,
        _NODE | {"magnets": int, "reason": str},
        "node {node}: magnets take the fail-safe value {magnets:02X}h: {reason}",
    ),
    Code.MAGNETS_VENT_ALONE: Row(
        WARNING,
        _NODE | {"axle": int},
        "node {node}: vent magnet of axle {axle} without its hold magnet: treated as vent",
    ),
    Code.MAGNETS_FOREIGN: Row(
        WARNING,
        _NODE,
        "another program than the WSP unit sets the magnets of node {node} by SDO",
        "from here on the run does not show what the unit does",
    ),
    Code.SANDERS_STOPPED: Row(
        WARNING, _NODE | {"reason": str}, "node {node}: sanders stop: {reason}"
    ),
    Code.DYNAMIC_BRAKE_RELEASED: Row(
        WARNING,
        _NODE | {"reason": str},
        "node {node}: the motors give no more force, the friction brake alone brakes: {reason}",
    ),
    # the bus and the ways into the bench
    Code.BUS_PLACE: Row(INFO, {"address": str}, "the rig is on the bus {address}"),
    Code.BUS_PORT: Row(
        INFO, {"protocol": str, "port": int}, "the bus speaks {protocol} on port {port}"
    ),
    Code.BUS_PORT_IN_USE: Row(
        WARNING,
        {"port": int, "address": str},
        "port {port} is in use by another program: programs reach this bench on {address}",
        "choose a port with --set bus.socketcand_port=N",
    ),
    Code.BUS_FRAMES_LOST: Row(
        WARNING, {"bus": str, "reason": str}, "{bus}: frames are lost: {reason}"
    ),
    Code.BUS_CONTROLLER: Row(WARNING, {"bus": str, "condition": str}, "{bus}: {condition}"),
    Code.HUB_FULL: Row(
        WARNING,
        {"bus": str, "protocol": str, "clients_max": int, "address": str},
        "CAN hub {bus}: more than {clients_max} clients[ of {address}] speak {protocol}",
        "further clients are disconnected; close some",
    ),
    Code.HUB_FOREIGN_CLIENT: Row(
        WARNING,
        {"bus": str, "protocol": str},
        "CAN hub {bus}: a client on the port for {protocol} speaks another protocol",
        "the hub disconnects it",
    ),
    Code.SERVER_EXPOSED: Row(
        WARNING,
        {"server": str, "host": str, "port": int, "who": str},
        "{server} LISTENS BEYOND THIS MACHINE, on {host}:{port}",
        "everybody there {who} can drive the rig",
    ),
    Code.SERVER_SILENT_CLOSED: Row(
        WARNING,
        {"server": str, "after_s": float},
        "{server}: a client that sent no valid message for {after_s:g} s is disconnected",
        "a web page or a port scanner may open such connections; ss -tnp shows the program",
    ),
    Code.SERVER_SILENT_GAVE_WAY: Row(
        WARNING,
        {"server": str, "places": int},
        "{server}: all {places} places are taken, so clients that have sent nothing valid give way to "
        "new ones",
        "ss -tnp shows the programs that hold the connections",
    ),
    Code.SERVER_OUT_OF_DESCRIPTORS: Row(
        WARNING,
        {"reason": str, "limit": int},
        "no client can join: {reason} (this process may have {limit} descriptors)",
        "silent clients are disconnected, and the bench tries again; close programs that hold "
        "connections, or allow more with ulimit -n",
    ),
    Code.MODBUS_SERVED: Row(
        INFO,
        {"transport": str, "host": str, "port": int},
        "Modbus {transport} is served on {host}:{port}",
    ),
    Code.MODBUS_UNAVAILABLE: Row(WARNING, _REASON, "this run has no Modbus TCP: {reason}"),
    Code.MODBUS_SERIAL_SERVED: Row(
        INFO,
        {"device": str, "baud_rate": int},
        "Modbus RTU is served on {device}, {baud_rate} baud",
    ),
    Code.MODBUS_SERIAL_LOST: Row(
        WARNING, {"device": str}, "Modbus: the serial line {device} is lost"
    ),
    Code.MODBUS_SERIAL_BACK: Row(INFO, {"device": str}, "Modbus: the serial line {device} is back"),
    # harnesses, sequences and operators
    Code.HARNESS_JOINED: Row(INFO, {}, "a harness has joined"),
    Code.HARNESS_LEFT: Row(INFO, {}, "a harness has left"),
    Code.HARNESS_REFUSED: Row(WARNING, _REASON, "refused to the harness: {reason}"),
    Code.HARNESS_TEXT: Row(INFO, {"message": str}, "{message}"),
    Code.OPERATOR_NOTE: Row(INFO, {"note": str}, "note: {note}"),
    Code.SEQUENCE_STEP: Row(INFO, {"title": str}, "{title}"),
    Code.SEQUENCE_ROWS_SAVED: Row(
        INFO,
        {"folder": str, "file": str},
        "{folder} could not be written; the rows are kept in {file}",
    ),
    Code.TEST_BRAKE: Row(INFO, {"pressure_Pa": float}, "brake demand {pressure_Pa:bar}"),
    Code.TEST_BRAKE_RAMP: Row(
        INFO,
        {"pressure_Pa": float, "ramp_s": float},
        "brake demand to {pressure_Pa:bar} within {ramp_s:g} s",
    ),
    Code.TEST_FRICTION: Row(
        INFO, {"mu": float, "axles": list}, "friction {mu:g} under axles {axles}"
    ),
    Code.TEST_FRICTION_DEFAULT: Row(INFO, {}, "friction as in the scenario"),
    Code.TEST_SAND_ON: Row(INFO, {}, "sand on"),
    Code.TEST_SAND_OFF: Row(INFO, {}, "sand off"),
    Code.TEST_FAULT: Row(INFO, {"fault": str}, "fault {fault}"),
    Code.TEST_FAULT_LIFTED: Row(INFO, {"fault": str}, "fault {fault} lifted"),
}

# units of templates: what an SI value is multiplied with, digits behind the point, the unit's name
_UNITS = {
    "bar": (1e-5, 2, "bar"),
    "mm": (1e3, 0, "mm"),
    "ms": (1e3, 3, "ms"),
    "km/h": (3.6, 1, "km/h"),
}
_JSON_TYPES = {
    str: "string",
    int: "integer",
    float: "number",
    bool: "boolean",
    list: "list of integers",
}
_OPTIONAL = re.compile(r"\[(.*?)\]")


class _Sentences(Formatter):
    """`str.format` that knows the units of people, and lists."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """One value as text."""
        if format_spec == "exit":
            return exits.exit_text(value)
        if format_spec in _UNITS:
            factor, places, unit = _UNITS[format_spec]
            return f"{round(factor * value, places):g} {unit}"
        if isinstance(value, list):
            return ", ".join(map(str, value))
        return format(value, format_spec)


_SENTENCES = _Sentences()


def fields_in(template: str) -> set[str]:
    """Return the names of the fields in a template."""
    return {name for _, name, _, _ in _SENTENCES.parse(template) if name}


def optional(row: Row) -> set[str]:
    """Return the names of the fields that may be None: those in square brackets."""
    return {
        name for part in _OPTIONAL.findall(row.sentence + row.advice) for name in fields_in(part)
    }


def check(code: Code, fields: Mapping[str, Any]) -> None:
    """Raise TypeError unless the fields are those of the code's row, each of its type."""
    row = TABLE[code]
    if fields.keys() != row.fields.keys():
        raise TypeError(f"event {code}: fields {sorted(fields)}, allowed: {sorted(row.fields)}")
    may_be_none = optional(row)
    for name, value in fields.items():
        allowed = (int, float) if row.fields[name] is float else row.fields[name]
        if not isinstance(value, allowed) and not (value is None and name in may_be_none):
            raise TypeError(
                f"event {code}: {name} is {value!r}, allowed: {row.fields[name].__name__}"
            )


def text(code: Code, fields: Mapping[str, Any], advice: bool = True) -> str:
    """Return the sentence of an event; without `advice` only what happened."""
    row = TABLE[code]
    sentence = _fill(row.sentence, fields)
    if advice and row.advice:
        return f"{sentence}; {_fill(row.advice, fields)}"
    return sentence


def _fill(template: str, fields: Mapping[str, Any]) -> str:
    """Return a template with the values of its fields."""

    def part(found: re.Match[str]) -> str:
        missing = any(fields[name] is None for name in fields_in(found[1]))
        return "" if missing else found[1]

    return _SENTENCES.vformat(_OPTIONAL.sub(part, template), (), fields)


def make(time_s: float, code: Code, /, **fields: Any) -> Event:
    """Return the event of a code at a simulated time. Raises TypeError for wrong fields."""
    check(code, fields)
    return Event(time_s, TABLE[code].level, text(code, fields), code, fields)


def ignore(code: Code, /, **fields: Any) -> None:
    """Do nothing with an event, but check its fields: the callback where nobody records events."""
    check(code, fields)


def from_json(content: Mapping[str, Any]) -> Event:
    """Return the event in a line of events.jsonl or in a summary, as it is written there.

    The code is None where the record has none, or one of a newer version. Raises KeyError,
    TypeError or ValueError for what is not an event.
    """
    code = content.get("code")
    return Event(
        float(content["time_s"]),
        str(content["level"]),
        str(content["text"]),
        Code(code) if isinstance(code, str) and code in TABLE else None,
        dict(content.get("fields") or {}),
    )


def markdown() -> str:
    """Return the page of events for the documentation."""
    lines = [
        "# Events",
        "",
        "This page is for programmers: after reading it you know every event that a run can record.",
        "[Runs](runs.md) describes the files that contain events. `make docs` writes this page.",
        "",
        "Programs use codes and fields. The text is made from them for people and may change. A field in",
        "square brackets may be null; its part of the text is then left out. The unit of a number is in",
        "the name of its field. `reaches_unit`: whether the rig may lose the unit by the fault, so that a lost",
        "unit then makes no run invalid; a false sensor does not.",
        "",
        "| code | level | fields | text |",
        "|---|---|---|---|",
    ]
    for code, row in TABLE.items():
        may_be_none = optional(row)
        names = []
        for name, kind in row.fields.items():
            field = f"`{name}` {_JSON_TYPES[kind]}"
            names.append(f"[{field}]" if name in may_be_none else field)
        template = f"{row.sentence}; {row.advice}" if row.advice else row.sentence
        lines.append(f"| `{code}` | {row.level} | {', '.join(names)} | `{template}` |")
    return "\n".join(lines) + "\n"
