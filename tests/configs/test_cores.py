"""The number of cores for work in parallel follows affinity and control groups."""

import os

import pytest

from rollerrig.configs.processes import cores

BOUND = len(os.sched_getaffinity(0))


@pytest.fixture
def groups(tmp_path):
    """A folder of control groups, in which this process is in a group of a group."""
    (tmp_path / "own").write_text("12:cpu:/elsewhere\n0::/outer/inner\n")
    (tmp_path / "groups" / "outer" / "inner").mkdir(parents=True)

    def allowed(outer=None, inner=None):
        for name, limit in (("outer", outer), ("outer/inner", inner)):
            if limit is not None:
                (tmp_path / "groups" / name / "cpu.max").write_text(f"{limit}\n")
        return cores.allowed(tmp_path / "groups", tmp_path / "own")

    return allowed


@pytest.mark.parametrize(
    ("outer", "inner", "most"),
    [
        (None, None, BOUND),
        ("max 100000", "max 100000", BOUND),
        # less than one core is one worker
        ("max 100000", "50000 100000", 1),
        ("100000 100000", "max 100000", 1),
        # a share of a core counts as a core
        ("150000 100000", "max 100000", 2),
        ("no number", "0 0", BOUND),
    ],
)
def test_a_container_has_the_cores_of_its_quota(groups, outer, inner, most):
    assert groups(outer, inner) == min(BOUND, most)


def test_without_control_groups_the_affinity_counts(tmp_path):
    assert cores.allowed(tmp_path, tmp_path / "missing") == BOUND


def test_a_process_that_is_bound_to_a_core_has_one():
    first = min(os.sched_getaffinity(0))
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {first})
    try:
        assert cores.allowed() == 1
    finally:
        os.sched_setaffinity(0, before)
