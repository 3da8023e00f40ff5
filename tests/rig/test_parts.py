"""Kernels that kernels call are parts of those that Python calls, and compute the same."""

import numba
import numpy as np
import pytest

from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.compiled.part import KernelDispatcher

# numba's decorator makes parts too, and keeps no file: each process compiles
in_process = numba.njit(error_model="numpy")


@in_process
def power(x, exponent):
    return x**exponent


@in_process
def powers(x):
    return power(x, 2) + power(x, 3) + power(x, 0.5)


@in_process
def of_axle(values, axle):
    return values[axle]


@in_process
def first_and_last(values):
    return of_axle(values, 0) + of_axle(values, values.size - 1)


# a function of another program, which needs the value of an argument as a constant
@numba.njit
def times(x, factor):
    return x * numba.literally(factor)


@numba.njit
def times_two_and_three(x):
    return times(x, 2) + times(x, 3)


@pytest.mark.skipif(not isinstance(kernel(lambda: None), KernelDispatcher), reason="no compiler")
def test_a_part_is_compiled_once_for_all_constants_and_not_for_python():
    assert powers(4.0) == 16.0 + 64.0 + 2.0
    assert first_and_last(np.array([1.0, 2.0, 5.0])) == 6.0
    assert not of_axle.overloads
    assert len({id(part) for part in of_axle._parts.values()}) == 1
    # a whole number and a fraction are two types
    assert len({id(part) for part in power._parts.values()}) == 2


def test_python_may_call_what_was_a_part():
    assert powers(4.0) == 82.0
    assert power(3.0, 2) == 9.0
    assert powers(4.0) == 82.0


def test_a_function_whose_types_depend_on_a_constant_is_compiled_for_it():
    assert times_two_and_three(1.5) == 7.5
