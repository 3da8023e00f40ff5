"""Data that nobody shall read by accident, as text: a key next to data sets, or what a rig hides.

This is a guard against reading by accident, not a secret.
"""

import base64
import json
import zlib
from typing import Any

from rollerrig.configs import unpacking, user_files
from rollerrig.configs.errors import ConfigError

_MOST_BYTES = 16_000_000  # of the data; the key of a thousand data sets has about one million


def encode(content: dict[str, Any]) -> str:
    """Return plain data as lines of text that a reader cannot understand."""
    return base64.encodebytes(zlib.compress(json.dumps(content).encode(), 9)).decode()


def decode(text: str, where: str) -> dict[str, Any]:
    """Return the data in a text of `encode`. Raises ConfigError, which begins with `where`."""
    try:
        packed = base64.b64decode(text, validate=False)
        content = user_files.parse_json(unpacking.inflate(packed, _MOST_BYTES))
        if not isinstance(content, dict):
            raise ValueError("not a table")
    except ValueError as error:
        raise ConfigError(
            f"{where}: the text is damaged or rollerrig has not written it ({error}); use the file "
            "as it was written"
        ) from None
    return content
