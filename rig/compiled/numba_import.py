"""Imports numba without packages that no kernel uses; every module of this room imports it first.

When numba is imported it imports PyYAML, only to read a settings file, and scipy, only to check its
version. When compiled code is loaded or a kernel is compiled it imports scipy.linalg, only for
matrix products in kernels, and no kernel has one. Without them a program starts earlier;
docs/compiled_kernels.md has the measured times.

The settings file is .numba_config.yaml in the working folder. It could switch off compilation, and
without PyYAML numba does not read it. So PyYAML is hidden also where it is loaded already.
"""

import os
import sys
import warnings
from typing import Any

from rollerrig.configs.processes.without import without

# numba would advise to install PyYAML where there is such a file
warnings.filterwarnings("ignore", message="A Numba config file is found")
# Numba tries several functions for each call, and writes a message about each one that does not
# fit. Colours in these messages, which are shown only if none fits, would cost time.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")
_loaded_yaml = sys.modules.pop("yaml", None)
with without("yaml"), without("scipy"):
    import numba
    from numba.core import config
if _loaded_yaml:
    sys.modules["yaml"] = _loaded_yaml

# numba fills this module with its settings when it loads it
settings: Any = config


def without_linear_algebra() -> without:
    """Return a context in which numba does not find scipy.linalg."""
    return without("scipy.linalg")


def load_array_functions() -> None:
    """Load numba's array functions before numba loads them itself, together with scipy.linalg."""
    with without_linear_algebra():
        import numba.np.arraymath  # noqa: F401


__all__ = ["load_array_functions", "numba", "settings", "without_linear_algebra"]
