"""Data that nobody shall read by accident, as text: a key next to data sets, or what a rig hides.

This is a guard against reading by accident, not a secret.
"""

import base64
import json
import zlib
from typing import Any

from rollerrig.configs.errors import ConfigError


def encode(content: dict[str, Any]) -> str:
    """Return plain data as lines of text that a reader cannot understand."""
    return base64.encodebytes(zlib.compress(json.dumps(content).encode(), 9)).decode()


def decode(text: str, where: str) -> dict[str, Any]:
    """Return the data in a text of `encode`. Raises ConfigError, which begins with `where`."""
    try:
        content = json.loads(zlib.decompress(base64.b64decode(text, validate=False)))
        if not isinstance(content, dict):
            raise ValueError("not a table")
    except (ValueError, zlib.error) as error:
        raise ConfigError(
            f"{where}: the text is damaged or rollerrig has not written it ({error}); use the file "
            "as it was written"
        ) from None
    return content
