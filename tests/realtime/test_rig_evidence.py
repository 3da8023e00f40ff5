"""The evidence for the rig: its references exist, and its measured laws can fail."""

import ast
import re
from pathlib import Path

import pytest

from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.benchmarks import evidence

TESTS = Path(__file__).parent.parent


@pytest.mark.parametrize("reference", evidence.REFERENCES, ids=lambda reference: reference.test)
def test_every_comparison_of_the_evidence_is_a_test_of_the_repository(reference):
    tree = ast.parse((TESTS / reference.file).read_text(encoding="utf-8"))
    names = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    assert reference.test in names


@pytest.fixture(scope="module")
def stop():
    """A short slippery stop and its samples."""
    plan = scenario.load(
        evidence.SLIPPERY, settings=("initial_speed_m_s=20.0", "adhesion.mu_cd=0.04")
    )
    return plan, free.channels(free.moving(free.simulate(plan)), plan.table)


def test_the_losses_of_a_stop_account_for_its_kinetic_energy(stop):
    assert abs(evidence.energy_missing(*stop)) < evidence.ENERGY


@pytest.mark.parametrize("column", ["brake_torque_2_Nm", "sliding_work_1_J", "vehicle_speed_m_s"])
def test_a_loss_that_is_wrong_by_one_percent_is_missed(stop, column):
    plan, channels = stop
    wrong = channels | {column: 1.01 * channels[column]}
    assert abs(evidence.energy_missing(plan, wrong)) > evidence.ENERGY


def test_the_page_has_the_references_and_states_that_it_is_no_certificate():
    page = (TESTS.parent / "docs" / "rig_evidence.md").read_text(encoding="utf-8")
    for reference in evidence.REFERENCES:
        row = (reference.subject, reference.against, reference.deviation, reference.valid)
        assert "| " + " | ".join([*row, reference.test]) + " |" in page
    assert evidence.NOT_A_CERTIFICATE in page
    assert len(re.findall(r"^- met", page, re.MULTILINE)) == 8
