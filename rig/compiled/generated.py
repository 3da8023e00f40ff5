"""Kernels whose source text the program writes itself.

Compiled code cannot loop over the fields of a named tuple or over the rows of a table of functions:
each needs its own type. Here the source is written line by line from the table, as a developer would
write it by hand, and compiled like any other kernel.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rollerrig.rig.compiled.kernel import (
    inlined_without_cache,
    inlined_without_cache_counted,
    kernel,
)


def kernel_from_source(
    name: str, lines: Sequence[str], file: str, module: str, names: Mapping[str, Any]
) -> Any:
    """Returns the kernel `name` that the lines define; `names` are the global names that they use.

    The kernel is cached as if its source were in `file` of `module`.
    """
    space: dict[str, Any] = {"__name__": module, **names}
    exec(compile("\n".join(lines), file, "exec"), space)
    return kernel(space[name])


def tuple_builder(
    structure: Any, arguments: str, fields: Iterable[str], counted: bool = False, **names: Any
) -> Any:
    """Returns an inlined kernel that builds a named tuple.

    `fields` are Python expressions, one for each field, of `arguments` and `names`. `counted`: the
    expressions make arrays at addresses, for which numba needs reference counting.
    """
    space: dict[str, Any] = {"structure": structure, **names}
    exec(f"def build({arguments}):\n    return structure({', '.join(fields)})", space)
    compiled = inlined_without_cache_counted if counted else inlined_without_cache
    return compiled(space["build"])


def tuple_writer(arguments: str, places: Sequence[str]) -> Any:
    """Returns an inlined kernel that writes the entries of its last argument, a tuple, to `places`."""
    space: dict[str, Any] = {}
    exec(f"def write({arguments}, values):\n    {', '.join(places)} = values", space)
    return inlined_without_cache(space["write"])


def buffer_viewer(structure: Any, places: Iterable[slice | None]) -> Any:
    """Returns an inlined kernel that views a flat buffer as a named tuple; None remains None."""
    return tuple_builder(
        structure,
        "buffer",
        ("None" if place is None else f"buffer[{place.start}:{place.stop}]" for place in places),
    )
