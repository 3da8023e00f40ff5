"""Records in kernels: named tuples as addresses, and tables of them."""

from typing import NamedTuple

import numpy as np
import pytest

from rollerrig.rig.compiled import record_type
from rollerrig.rig.compiled.kernel import kernel


class Spring(NamedTuple):
    stiffness: float
    lengths: np.ndarray


class Body(NamedTuple):
    number: int
    spring: Spring
    rests: bool


record_type.register(Spring)
record_type.register(Body)


@kernel
def stretched(springs):
    total = 0.0
    for i in range(len(springs)):
        total += springs[i].stiffness * springs[i].lengths[-1]
    return total


@kernel
def of_all(bodies):
    moving = 0
    for i in range(len(bodies)):
        moving += 0 if bodies[i].rests else bodies[i].number
    return moving, stretched(bodies.spring)


@kernel
def of_one(body):
    return stretched(record_type.table_of_one(body.spring))


def bodies(count):
    return [
        Body(10 * i, Spring(2.0 + i, np.array([0.0, 3.0 + i])), i % 2 == 0) for i in range(count)
    ]


def test_a_kernel_finds_each_record_of_a_table_and_the_records_in_it():
    table = record_type.table(bodies(4))
    assert of_all(table) == (10 + 30, 2.0 * 3.0 + 3.0 * 4.0 + 4.0 * 5.0 + 5.0 * 6.0)


def test_a_record_alone_is_a_table_of_one():
    assert of_one(bodies(3)[2]) == 4.0 * 5.0


def test_a_record_of_a_table_can_be_replaced_and_tables_can_be_shorter():
    table = record_type.table(bodies(4))
    record_type.write(table, 1, bodies(4)[3])
    assert of_all(table) == (30 + 30, 2.0 * 3.0 + 5.0 * 6.0 + 4.0 * 5.0 + 5.0 * 6.0)
    assert of_all(record_type.first(table, 2)) == (30, 2.0 * 3.0 + 5.0 * 6.0)


def test_an_array_of_a_record_is_the_array_itself():
    records = bodies(1)
    table = record_type.table(records)
    records[0].spring.lengths[-1] = 100.0
    assert of_all(table)[1] == 2.0 * 100.0


def test_records_of_another_type_are_refused():
    other = Body(1, Spring(1.0, np.array([1], dtype=np.int64)), True)
    with pytest.raises(TypeError, match="same type"):
        record_type.table([*bodies(1), other])
    with pytest.raises(TypeError, match="same type"):
        record_type.write(record_type.table(bodies(1)), 0, other)
