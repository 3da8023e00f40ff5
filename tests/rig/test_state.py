"""The state in kernels: one address, whose fields are those of Python's named tuple."""

import itertools

import numpy as np
import pytest
from numba.core.errors import TypingError

from rollerrig.configs.vehicle import ALLOWED_AXLES
from rollerrig.rig import state as states
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.compiled.state_type import rig_of
from rollerrig.rig.multibody import coach_state

ALL_AXLES = pytest.mark.parametrize("axles", ALLOWED_AXLES)


@kernel
def _write(state):
    for j in range(state.axles):
        state.wheel_speed[j] += 10.0 + j
    state.rail_work[state.axles - 1] = state.time[0]


@kernel
def _mark(state, rig, axles):
    mine = rig_of(state, rig, axles)
    for j in range(mine.axles):
        mine.wheel_speed[j] = 100.0 * rig + j
    mine.vehicle_speed[0] = rig
    mine.rail_sand[:] = rig
    mine.roller_film[:] = rig


@kernel
def _sizes(state):
    return state.time.size, state.roller_rate.size, state.wheel_load[1:3].sum()


@kernel
def _end(coach):
    if coach is None:
        return 0.0
    return coach[coach.size - 1]


@kernel
def _coach_end(state):
    return _end(state.coach)


@kernel
def _unknown(state):
    return state.colour[0]


def _numbered(axles=4, more=0):
    buffer = np.arange(float(states.SIZE + more))
    return buffer, states.views(buffer, axles)


@ALL_AXLES
def test_a_kernel_writes_where_python_reads(axles):
    buffer, state = _numbered(axles)
    slots = states.slots(axles)
    expected = buffer.copy()
    expected[slots["wheel_speed"]] += 10.0 + np.arange(axles)
    expected[slots["rail_work"].stop - 1] = expected[slots["time"].start]
    _write(state)
    np.testing.assert_array_equal(buffer, expected)
    np.testing.assert_array_equal(state.wheel_speed, expected[slots["wheel_speed"]])


@ALL_AXLES
def test_fields_have_the_same_shape_in_a_kernel_and_in_python(axles):
    _, state = _numbered(axles)
    assert _sizes(state) == (1, axles, state.wheel_load[1:3].sum())
    assert _sizes.py_func(state) == _sizes(state)


def test_one_kernel_serves_all_numbers_of_axles():
    for axles in ALLOWED_AXLES:
        _write(_numbered(axles)[1])
    assert len(_write.signatures) == 1


@ALL_AXLES
def test_every_slot_has_a_place_of_its_own(axles):
    rigs = states.rigs_together(axles)
    places = sorted(
        (place.start, place.stop)
        for rig in range(rigs)
        for place in states.slots(axles, rig).values()
    )
    assert places[0][0] == 0
    assert all(stop <= start for (_, stop), (start, _) in itertools.pairwise(places))
    assert places[-1][1] <= states.size_of(rigs)


@ALL_AXLES
def test_the_state_of_all_rigs_has_their_axles_one_after_another(axles):
    rigs = states.rigs_together(axles)
    buffer = np.zeros(states.size_of(rigs))
    whole = states.views(buffer, axles * rigs)
    alone = [states.views(buffer, axles, rig) for rig in range(rigs)]
    for rig in range(rigs):
        _mark(whole, rig, axles)
    speeds = np.concatenate([state.wheel_speed for state in alone])
    np.testing.assert_array_equal(whole.wheel_speed, speeds)
    for rig, state in enumerate(alone):
        np.testing.assert_array_equal(state.wheel_speed, 100.0 * rig + np.arange(axles))
        assert state.vehicle_speed == [rig]
        np.testing.assert_array_equal(state.rail_sand, float(rig))
        np.testing.assert_array_equal(state.roller_film, float(rig))
        assert state.roller_film.size == states.SECTORS * axles


def test_a_kernel_sees_the_coach_only_where_the_state_has_one():
    _, planar = _numbered()
    whole, with_coach = _numbered(more=coach_state.SIZE)
    assert _coach_end(planar) == 0.0
    assert _coach_end(with_coach) == whole[-1]


def test_a_field_that_the_state_does_not_have_does_not_compile():
    _, state = _numbered()
    with pytest.raises(TypingError, match="colour"):
        _unknown(state)


def test_a_state_that_is_not_of_numbers_is_refused():
    _, state = _numbered()
    with pytest.raises(TypeError):
        _sizes(state._replace(time="now"))
