"""Kernels whose source text the program writes itself.

Compiled code cannot loop over the fields of a named tuple, nor over a table of functions: each
field and each function has a type of its own. Here the source is written line by line from the
table, as a developer would write it by hand, and compiled like any other kernel.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from rollerrig.rig.compiled.kernel import (
    inlined_without_cache,
    inlined_without_cache_counted,
    kernel,
)


class Term(NamedTuple):
    """One term of a `conditional_sum`: Python expressions of its arguments."""

    condition: str
    increment: str


def conditional_sum(
    name: str, arguments: str, terms: Iterable[Term], functions: Mapping[str, Any]
) -> Any:
    """Return a kernel that adds terms to its first argument, `value`, one after another.

    A term is added if its condition holds; its increment may use the `value` so far. `functions`
    are the kernels that the terms call, by their names in the expressions. The `name` is unique in
    the product.
    """
    lines = [f"def {name}(value, {arguments}):"]
    for term in terms:
        lines.append(f"    if {term.condition}:")
        lines.append(f"        value += {term.increment}")
    lines.append("    return value")
    return _cached_kernel(name, lines, functions)


def selection(name: str, arguments: str, expressions: Sequence[str]) -> Any:
    """Return a kernel that computes one of the expressions; its last argument is the number."""
    lines = [
        f"def {name}({arguments}, number):",
        f"    return ({', '.join(expressions)})[number]",
    ]
    return _cached_kernel(name, lines, {})


def elementwise(name: str, formula: Any, count: int) -> Any:
    """Return a kernel that fills its last argument (n,) with a formula of `count` arrays (n,)."""
    arrays = [f"x{k}" for k in range(count)]
    values = ", ".join(f"{array}[k]" for array in arrays)
    lines = [
        f"def {name}({', '.join([*arrays, 'out'])}):",
        "    for k in range(out.size):",
        f"        out[k] = formula({values})",
    ]
    return _cached_kernel(name, lines, {"formula": formula})


def _cached_kernel(name: str, lines: Sequence[str], names: Mapping[str, Any]) -> Any:
    """Return the kernel `name` that the lines define; numba caches it as a kernel of this file."""
    space: dict[str, Any] = {"__name__": __name__, **names}
    exec(compile("\n".join(lines), __file__, "exec"), space)
    return kernel(space[name])


def tuple_builder(
    structure: Any, arguments: str, fields: Iterable[str], counted: bool = False, **names: Any
) -> Any:
    """Return an inlined kernel that builds a named tuple.

    `fields` are Python expressions, one for each field, of `arguments` and `names`. `counted`: the
    expressions make arrays at addresses, for which numba needs reference counting.
    """
    space: dict[str, Any] = {"structure": structure, **names}
    exec(f"def build({arguments}):\n    return structure({', '.join(fields)})", space)
    compiled = inlined_without_cache_counted if counted else inlined_without_cache
    return compiled(space["build"])


def tuple_writer(arguments: str, places: Sequence[str]) -> Any:
    """Return an inlined kernel that writes the entries of its last argument to `places`."""
    space: dict[str, Any] = {}
    exec(f"def write({arguments}, values):\n    {', '.join(places)} = values", space)
    return inlined_without_cache(space["write"])
