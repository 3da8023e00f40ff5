"""The table of faults fits the code and the tests: tests/mutants.py can apply each row."""

import ast

import mutants
import pytest

FAULTS = mutants.faults()
# rooms of the product in which a wrong line would spoil what a user gets
ROOMS = (
    "configs",
    "firmware_sim/cia301",
    "firmware_sim/drive402",
    "firmware_sim/faults",
    "firmware_sim/fmu",
    "firmware_sim/modbus",
    "firmware_sim/wsp",
    "realtime/bench",
    "realtime/campaign",
    "realtime/commands",
    "realtime/datasets",
    "realtime/desk",
    "realtime/discover",
    "realtime/loop",
    "realtime/record",
    "realtime/reports",
    "realtime/telemetry",
    "rig/contact",
    "rig/identify",
    "rig/mechanisms",
    "rig/multibody",
    "wsp_interface/bus",
    "wsp_interface/sequences",
    "wsp_interface/unit_map",
)


def test_every_room_has_a_fault_and_no_two_faults_share_a_name():
    for room in ROOMS:
        assert any(fault.file.startswith(f"{room}/") for fault in FAULTS), room
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_fault_changes_one_place_and_names_tests_that_exist(fault):
    source = (mutants.ROOT / fault.file).read_text()
    changed = fault.changed(source)
    assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(source))
    assert fault.found == "" or (fault.found == "none" and fault.reason)
    for test in fault.tests:
        file, _, function = test.partition("::")
        text = (mutants.ROOT / file).read_text()
        name, _, _ = function.partition("[")
        assert not name or f"def {name}(" in text, test
