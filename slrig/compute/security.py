"""Who may join a pool: addresses that are safe, and the certificates that its members show to one another."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from slrig.config import is_loopback, read_private_text
from slrig.errors import ConfigError, ExtraMissingError

if TYPE_CHECKING:
    from distributed import Security

AUTHORITY, CERTIFICATE, KEY = "authority.pem", "certificate.pem", "key.pem"


def require_pool_extra() -> None:
    """Raise ExtraMissingError unless the libraries of a pool are installed."""
    if missing := [name for name in ("cryptography", "distributed", "obstore") if find_spec(name) is None]:
        message = f"A pool needs {' and '.join(missing)}, not installed here: pip install 'slrig[pool]'"
        raise ExtraMissingError(message)


def pool_security(address: str, certificates: Path | None) -> Security | None:
    """What a member of the pool at `address` shows and asks for; None on this machine alone, without encryption.

    Raises
    ------
    ConfigError
        The address is none, or others could reach it without a certificate; or the certificates cannot be used.
    """
    parts = urlsplit(address)
    try:
        port = parts.port
    except ValueError:
        port = None
    if parts.scheme not in {"tls", "tcp"} or not parts.hostname or port is None:
        message = f"'{address}' is no address of a pool's scheduler: expected tls://HOST:PORT, such as tls://pool:8786."
        raise ConfigError(message)
    if parts.scheme == "tcp":
        if not is_loopback(parts.hostname):
            message = (
                f"{address}: whoever reaches a pool without encryption can run any code on its machines. Use tls://, "
                "with certificates that slrig pool certificates makes; tcp:// is for 127.0.0.1 alone."
            )
            raise ConfigError(message)
        return None
    if certificates is None:
        message = f"{address}: expected the folder with this machine's certificates, found none; name it."
        raise ConfigError(message)
    files = [certificates / name for name in (AUTHORITY, CERTIFICATE, KEY)]
    if missing := [file.name for file in files if not file.is_file()]:
        message = (
            f"{certificates} lacks {', '.join(missing)}. Name the folder of one machine that slrig pool certificates "
            "made, such as its folder 'worker'."
        )
        raise ConfigError(message)
    read_private_text(certificates / KEY, "the key of this machine's certificate")
    from distributed import Security

    authority, certificate, key = map(str, files)
    # One certificate per machine, whatever its part.
    return Security(
        require_encryption=True,
        tls_ca_file=authority,
        tls_client_cert=certificate,
        tls_client_key=key,
        tls_worker_cert=certificate,
        tls_worker_key=key,
        tls_scheduler_cert=certificate,
        tls_scheduler_key=key,
    )
