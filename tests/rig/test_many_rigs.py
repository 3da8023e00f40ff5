"""The buffer of very many rigs: each value of each rig has a place of its own."""

import numpy as np
import pytest

from rollerrig.configs.vehicle import ALLOWED_AXLES
from rollerrig.rig import many_rigs, state
from rollerrig.rig.state import SIZE, State


@pytest.mark.parametrize("axles", ALLOWED_AXLES)
@pytest.mark.parametrize("rigs", [1, 7, 500])
def test_no_two_values_have_the_same_place(axles, rigs):
    _, first, next_rig = many_rigs.numbers(axles, rigs)
    places = np.concatenate([first + rig * next_rig for rig in range(rigs)])
    assert np.unique(places).size == places.size
    assert 0 <= places.min() <= places.max() < many_rigs.size_of(rigs, axles)


@pytest.mark.parametrize("axles", ALLOWED_AXLES)
def test_the_places_of_a_rig_among_few_are_those_of_a_core(axles):
    # so many rigs need no multiple of the room
    rigs = state.MOST_LANES // axles
    few = np.arange(float(many_rigs.size_of(rigs, axles)))
    assert many_rigs.multiple(rigs, axles) == 1
    for rig in (0, rigs - 1):
        alone = np.zeros(SIZE)
        source, first, next_rig = many_rigs.numbers(axles, rigs)
        alone[source] = few[first + rig * next_rig]
        expected = state.views(few, axles, rig)
        found = state.views(alone, axles)
        for name in State._fields[:-1]:
            assert np.array_equal(getattr(found, name), getattr(expected, name)), name


def test_a_copied_rig_changes_no_other_one():
    axles, rigs = 4, 100
    many = np.zeros(many_rigs.size_of(rigs, axles))
    alone = np.arange(1.0, SIZE + 1.0)
    many_rigs.copy(alone, many, 41, rigs, axles)
    source, first, next_rig = many_rigs.numbers(axles, rigs)
    assert np.count_nonzero(many) == source.size
    places = many_rigs.found(source[::7], 41, rigs, axles)
    assert np.array_equal(many[places], alone[source[::7]])
    assert np.array_equal(places, (first + 41 * next_rig)[::7])
