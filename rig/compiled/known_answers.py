"""Questions that numba asks itself again and again while it compiles, answered once.

[N1] The result type of a built-in function (`+`, `<`, `math.exp`) for given argument types: numba
     tries all its candidates at every call in every kernel. The answer is the same each time.
[N2] Whether an array has its own conversion to an array: numba searches all its registries for one
     wherever a kernel reads or writes an array. A plain array has none.
[N3] Whether a code generator takes the place in the source: numba reads its signature at each call.

docs/compiled_kernels.md has the measured times. Source: numba/core/typing/context.py, base.py.
"""

import functools
from typing import Any

from rollerrig.rig.compiled import numba_import  # noqa: F401  the first import of numba

# isort: split
from numba.core import base, types
from numba.core.typing import context as typing_context

_KNOWN = "rollerrig_known_signatures"
_CONVERSION = "__array__"

# numba's classes, whose methods are replaced
_of_types: Any = typing_context.BaseContext
_of_code: Any = base.BaseContext
_resolve_function_type = _of_types.resolve_function_type
_get_function = _of_code.get_function


def _resolve_once(context: Any, function: Any, given: Any, keywords: Any) -> Any:
    """Return the signature of a function for argument types; numba's method finds it once [N1]."""
    if keywords or type(function) is not types.Function:
        return _resolve_function_type(context, function, given, keywords)
    known = function.__dict__.setdefault(_KNOWN, {})
    # another target of numba (a GPU) has another context
    question = (context, *given)
    found = known.get(question)
    if found is None:
        found = _resolve_function_type(context, function, given, keywords)
        if found is not None:
            known[question] = found
    return found


def _get_function_unless_plain(
    context: Any, function: Any, signature: Any, _firstcall: bool = True
) -> Any:
    """Return the code generator of a function; a plain array has no conversion [N2]."""
    if function == _CONVERSION and type(signature.args[0]) is types.Array:
        raise NotImplementedError
    return _get_function(context, function, signature, _firstcall)


_of_types.resolve_function_type = _resolve_once
_of_code.get_function = _get_function_unless_plain
# [N3]
base._has_loc = functools.cache(base._has_loc)
