"""Who may reach the Modbus server, and the counters of the server.

This module does not import pymodbus, which only a run that listens loads.
"""

import ssl
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import ConfigError

TLS_KEYS = ("tls_certificate", "tls_key", "tls_client_ca")


@dataclass
class Counters:
    """What the server has counted since it began."""

    requests: int = 0
    exceptions: int = 0  # requests that were answered with an exception
    malformed: int = 0  # connections closed, or serial frames ignored, for wrong framing


def tls_context(settings: Mapping[str, Any]) -> ssl.SSLContext | None:
    """Return the TLS context (1.2 or newer) that the table [modbus] requires.

    Returns None where the table has no TLS files. A client needs a certificate that
    `tls_client_ca` has signed. Raises ConfigError, which gives the key.
    """
    paths = {key: settings[key] for key in TLS_KEYS}
    if not any(paths.values()):
        return None

    for key, path in paths.items():
        _require_file(key, path)

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.verify_mode = ssl.CERT_REQUIRED
    try:
        context.load_cert_chain(settings["tls_certificate"], settings["tls_key"])
        context.load_verify_locations(settings["tls_client_ca"])
    except (ssl.SSLError, OSError) as error:
        files = ", ".join(f"{key} = '{path}'" for key, path in paths.items())
        raise ConfigError(
            f"[modbus] {files}: the files cannot be used: {error}; give PEM files that belong together"
        ) from None
    return context


def _require_file(key: str, path: str) -> None:
    """Raise ConfigError unless a TLS key of [modbus] gives a file."""
    if path and Path(path).is_file():
        return
    problem = "there is no such file" if path else "the key is missing"
    raise ConfigError(
        f"[modbus] {key} = '{path}': {problem}; give all three of {', '.join(TLS_KEYS)} (PEM files), "
        "or none for Modbus without TLS"
    )
