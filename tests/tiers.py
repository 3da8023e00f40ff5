"""The two tiers of tests: parameters of which `make test` has the first ones."""

from collections.abc import Iterable

import pytest


def first_of(values: Iterable, count: int = 1) -> list:
    """Return the parameters of a test; those after the first `count` are in the nightly tier."""
    every = list(values)
    later = [pytest.param(value, marks=pytest.mark.nightly) for value in every[count:]]
    return [*every[:count], *later]
