"""What nobody shall read by accident, as text: a key beside sets or a rig, and what a rig hides. No secret: a guard."""

import base64
import json
import zlib
from typing import Any

from rollerrig.configs.errors import ConfigError


def shut(content: dict[str, Any]) -> str:
    """Plain data as lines of text that say nothing to a reader."""
    return base64.encodebytes(zlib.compress(json.dumps(content).encode(), 9)).decode()


def opened(text: str, where: str) -> dict[str, Any]:
    """What `shut` was given. Raises ConfigError, which begins with `where`, for any other text."""
    try:
        found = json.loads(zlib.decompress(base64.b64decode(text, validate=False)))
        if not isinstance(found, dict):
            raise ValueError("not a table")
    except (ValueError, zlib.error) as error:
        raise ConfigError(
            f"{where}: it is damaged or was not sealed by rollerrig ({error}); take the file as it was "
            "written"
        ) from None
    return found
