"""Who may reach the Modbus server, and what it counts; without pymodbus, which only a run that listens loads."""

import ssl
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import ConfigError

TLS_KEYS = "tls_certificate", "tls_key", "tls_client_ca"


class Counters:
    """What the server has seen."""

    def __init__(self) -> None:
        self.requests = self.exceptions = self.malformed = 0


def tls_context(given: Mapping[str, Any]) -> ssl.SSLContext | None:
    """TLS 1.2 or newer, as [modbus] asks for it; None where it asks for none. Raises ConfigError, naming the key.

    A client needs a certificate that tls_client_ca has signed.
    """
    paths = {key: given[key] for key in TLS_KEYS}
    if not any(paths.values()):
        return None
    for key, path in paths.items():
        if not Path(path or "/").is_file():
            raise ConfigError(
                f"[modbus] {key} = '{path}': {'no such file' if path else 'is missing'}; all three of "
                f"{', '.join(TLS_KEYS)} are needed (PEM), or none for Modbus without TLS"
            )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.verify_mode = ssl.CERT_REQUIRED
    try:
        context.load_cert_chain(given["tls_certificate"], given["tls_key"])
        context.load_verify_locations(given["tls_client_ca"])
    except (ssl.SSLError, OSError) as error:
        raise ConfigError(
            f"[modbus] {', '.join(f'{key} = {path}' for key, path in paths.items())} cannot be used: "
            f"{error}"
        ) from None
    return context
