"""Stops on a GPU, without one: compiled to machine code of a GPU, and run in numba's simulator."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from llvmlite import binding, ir
from program import CLI, rollerrig
from simulated_gpu import LONG, VEHICLES
from test_stops_in_lanes import CASES

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes.without import without
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.campaign import campaign
from rollerrig.realtime.campaign.stops import stops_in_lanes, ticks_on_device
from rollerrig.realtime.loop import ticks_in_lanes
from rollerrig.rig import many_rigs
from rollerrig.rig.compiled import device, record_type
from rollerrig.rig.state import SIZE

pytest.importorskip("numba_cuda", reason="pip install 'rollerrig[cuda]'")
SIMULATOR = {"NUMBA_ENABLE_CUDASIM": "1"}
# of the H100
CAPABILITY = (9, 0)
# the layout of memory that NVIDIA's compiler has
DATA_LAYOUT = (
    "e-p:64:64:64-i1:8:8-i8:8:8-i16:16:16-i32:32:32-i64:64:64-i128:128:128-f32:32:32-f64:64:64"
)


def rig_of(plan, unit):
    """Return the record of a thread, whose state is that of a rig among many."""
    seat = np.zeros(SIZE), 0
    stop = stops_in_lanes.waiting_stop(plan, unit, plan.table.kept, 1, seat)
    record = stops_in_lanes.record_of(stop)
    state = many_rigs.placed(seat[0].ctypes.data, 0, 1, plan.kind.axles)
    there = record._replace(m=record.m._replace(state=state, roller_state=state))
    clocks = np.zeros((1, ticks_in_lanes.COLUMNS_OF_CLOCK), dtype=np.int64)
    return ticks_on_device.Rig(there, clocks)


@pytest.fixture(scope="module")
def kind():
    plan = scenario.load("velim_a1")
    return record_type.type_of(rig_of(plan, logic.load(plan["wsp_config"])))


@pytest.mark.parametrize("stem", store.names("scenarios"))
def test_one_kernel_serves_every_vehicle_with_and_without_a_unit(stem, kind):
    plan = scenario.load(stem)
    assert stops_in_lanes.fits(plan)
    for unit in (logic.load(plan["wsp_config"]), "none"):
        assert record_type.type_of(rig_of(plan, unit)) == kind


def test_the_ticks_compile_to_machine_code_of_a_gpu(kind):
    nvjitlink = pytest.importorskip("cuda.bindings.nvjitlink")
    code = device.ptx(ticks_on_device.threads(kind), CAPABILITY)
    # one entry, and nothing that it calls is missing
    assert code.count(".visible .entry") == 1
    assert ".extern .func" not in code
    assert "fma.rn.f64" in code

    link = nvjitlink.create(1, [f"-arch=sm_{CAPABILITY[0]}{CAPABILITY[1]}"])
    text = code.encode()
    nvjitlink.add_data(link, nvjitlink.InputType.PTX, text, len(text), "ticks")
    nvjitlink.complete(link)
    assert nvjitlink.get_linked_cubin_size(link) > len(text) // 10
    nvjitlink.destroy(link)


def test_a_record_has_the_same_layout_on_a_core_and_on_a_gpu(kind):
    from numba.core.registry import cpu_target

    here = cpu_target.target_context
    there = binding.create_target_data(DATA_LAYOUT)
    structures = [here.data_model_manager[kind].structure]
    compared = 0
    while structures:
        structure = structures.pop()
        assert structure.get_abi_size(there) == here.get_abi_sizeof(structure)
        for number, element in enumerate(structure.elements):
            offset = structure.get_element_offset(here.target_data, number)
            assert structure.get_element_offset(there, number) == offset
            compared += 1
            if isinstance(element, ir.LiteralStructType):
                structures.append(element)
    assert compared > 500


def simulated(*words):
    """Return the largest differences of `simulated_gpu`, by case."""
    done = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("simulated_gpu.py")), *words],
        env=os.environ | SIMULATOR | {"PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_stops_in_the_simulator_of_a_gpu_are_those_in_lanes():
    found = simulated()
    assert set(found) == {*CASES, *VEHICLES}
    assert max(found.values()) < 1e-9, found


@pytest.mark.nightly
def test_whole_stops_in_the_simulator_of_a_gpu_are_those_in_lanes():
    found = simulated("long")
    assert set(found) == {*LONG}
    assert max(found.values()) < 1e-9, found


# --- the command ---


PLAN = """
scenario = "velim_a1"
design = "matrix"
[vary]
{vary}
"""


@pytest.mark.parametrize(
    ("vary", "named"),
    [
        ("rig = ['plain_track', 'virtual_track']", "run 1 .* a virtual track"),
        # with kernels of the coach
        pytest.param(
            "\"vehicle.model\" = ['planar', 'multibody']",
            "run 1 .* the coach in 3D",
            marks=pytest.mark.nightly,
        ),
        ("\"contact.model\" = ['polach']", "run 0 .* the contact model polach"),
        ('"bus.arbitration" = [false, true]', "run 1 .* arbitration of the bus"),
    ],
)
def test_a_plan_that_does_not_run_on_a_gpu_is_refused_by_name(vary, named, tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text(PLAN.format(vary=vary))
    campaign.load(str(path))
    with pytest.raises(ConfigError, match=f"{named}.*leave --device out"):
        campaign.load(str(path), device=campaign.CUDA)


def test_a_failure_that_is_a_fault_is_refused_by_name():
    with pytest.raises(
        ConfigError, match=r"\[failures\] \w+ does not run on a GPU because of a fault"
    ):
        campaign.load("etcs_failures", device=campaign.CUDA)


def test_a_program_as_unit_is_refused():
    with pytest.raises(ConfigError, match="does not run on a GPU; allowed there are reference"):
        campaign.load("low_adhesion", unit_command="./unit {host} {port}", device=campaign.CUDA)


def test_without_the_package_the_message_says_how_to_install_it(monkeypatch):
    monkeypatch.delitem(sys.modules, "numba_cuda", raising=False)
    with without("numba_cuda"), pytest.raises(ConfigError, match=r"rollerrig\[cuda\]"):
        campaign.load("low_adhesion", device=campaign.CUDA)


def test_without_a_gpu_nothing_is_written(tmp_path):
    out = tmp_path / "campaign"
    done = rollerrig(
        "campaign", "low_adhesion", "--device", "cuda", "--out", str(out), CUDA_VISIBLE_DEVICES="-1"
    )
    assert done.status == 2
    assert "no GPU of NVIDIA was found" in done.messages
    assert not out.exists()


def test_results_of_cores_are_not_continued_on_a_gpu(tmp_path):
    cores = campaign.load("low_adhesion", chunk=20)
    campaign.claim(cores, tmp_path)
    with pytest.raises(ConfigError, match="holds the results of another plan"):
        campaign.claim(cores._replace(device=campaign.CUDA), tmp_path)
    campaign.claim(cores, tmp_path)


@pytest.mark.nightly
def test_a_campaign_in_the_simulator_gives_the_rows_of_cores(tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text(PLAN.format(vary="initial_speed_m_s = [6.0, 8.0]"))
    for device_name in campaign.DEVICES:
        done = rollerrig(
            *("campaign", str(path), "--device", device_name, "--workers", "1"),
            *("--out", str(tmp_path / device_name)),
            **SIMULATOR,
        )
        assert done.status == 0, done.messages
    cores, simulated_rows = (campaign.result(tmp_path / name) for name in campaign.DEVICES)
    assert simulated_rows.schema == cores.schema
    assert simulated_rows.to_pylist() == cores.to_pylist()


@pytest.mark.nightly
def test_the_benchmark_compares_and_counts_in_the_simulator():
    # numba reads the variable when it is imported, so a new interpreter is needed
    words = ("bench", "campaign", "--device", "cuda", "--count", "4", "--json")
    done = subprocess.run(
        [sys.executable, *CLI, *words],
        env=os.environ | SIMULATOR,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)["campaign"]
    assert found["compared"] == 4
    assert found["largest_difference"] < 1e-9
    assert found["stops_per_minute"] == pytest.approx(60.0 * 4 / found["gpu_s"])


def test_the_hours_of_a_million_stops_follow_from_the_time_of_one():
    done = rollerrig("bench", "million", "--count", "2", "--json")
    assert done.status == 0, done.messages
    for plan in json.loads(done.printed)["million"]["plans"]:
        exact, *longer = plan["steps"]
        assert exact["hours"] == pytest.approx(1e6 * plan["stop_s"] / 2 / 3600)
        assert [step["step_s"] for step in longer] == [2e-4, 5e-4, 1e-3]
        assert all(step["stops"] == 2 for step in longer)
