"""Kernels compiled a second time with other functions under some of the names that they use.

A formula has one source. Where several wheels are computed with vector instructions, the same
source is compiled with `vector_math.MATH` in the place of `math`. Otherwise each formula would
exist twice, and the two copies could drift apart.

    fast_curve = variant(polach.curve, math=MATH)

A variant has the bytecode of the original function and a copy of its global names. It is compiled
together with its caller, so it needs no cache.
"""

from types import FunctionType, ModuleType
from typing import Any

from rollerrig.rig.compiled.kernel import inlined_without_cache, uncompiled


def variant(formula: Any, **replacements: Any) -> Any:
    """Return an inlined kernel with the code of `formula` and other functions under some names."""
    function = uncompiled(formula)
    clone = FunctionType(function.__code__, function.__globals__ | replacements)
    return inlined_without_cache(clone)


def module_variant(module: ModuleType, **replacements: Any) -> Any:
    """Return a copy of a module in which some names are replaced."""
    copy = ModuleType(module.__name__)
    vars(copy).update(vars(module))
    vars(copy).update(replacements)
    return copy
