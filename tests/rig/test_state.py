"""The state in kernels: one address, whose fields are those of Python's named tuple."""

import numpy as np
import pytest
from numba.core.errors import TypingError

from rollerrig.rig import state as states
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.multibody import coach_state


@kernel
def _write(state):
    for j in range(states.AXLES):
        state.wheel_speed[j] += 10.0 + j
    state.rail_work[3] = state.time[0]


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


def _numbered(size=states.SIZE):
    buffer = np.arange(float(size))
    return buffer, states.views(buffer)


def test_a_kernel_writes_where_python_reads():
    buffer, state = _numbered()
    expected = buffer.copy()
    expected[states.SLOTS["wheel_speed"]] += [10.0, 11.0, 12.0, 13.0]
    expected[states.SLOTS["rail_work"].stop - 1] = expected[0]
    _write(state)
    np.testing.assert_array_equal(buffer, expected)
    np.testing.assert_array_equal(state.wheel_speed, expected[states.SLOTS["wheel_speed"]])


def test_fields_have_the_same_shape_in_a_kernel_and_in_python():
    _, state = _numbered()
    assert _sizes(state) == (1, states.AXLES, state.wheel_load[1:3].sum())
    assert _sizes.py_func(state) == _sizes(state)


def test_a_kernel_sees_the_coach_only_where_the_state_has_one():
    _, planar = _numbered()
    whole, with_coach = _numbered(states.SIZE + coach_state.SIZE)
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
