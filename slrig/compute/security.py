"""Access to a pool: its address, and the certificates that its members show to one another. A pool needs TLS: other
users of a machine, and containers on it, reach 127.0.0.1 as well.
"""

from __future__ import annotations

import os
import ssl
import stat
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

from slrig.config import is_loopback, read_private_text
from slrig.disk import storage_errors
from slrig.errors import ConfigError, ExtraMissingError

AUTHORITY, CERTIFICATE, KEY = "authority.pem", "certificate.pem", "key.pem"

MEMBER = "member"
"""The folder that all members of one user on one machine share, where no certificates are named."""


def require_pool_extra() -> None:
    """Raise ExtraMissingError unless the libraries of a pool are installed."""
    if missing := [name for name in ("cryptography", "obstore") if find_spec(name) is None]:
        message = f"A pool needs {' and '.join(missing)}, not installed here: pip install 'slrig[pool]'"
        raise ExtraMissingError(message)


@dataclass(frozen=True, slots=True)
class PoolAddress:
    """Address of a pool's scheduler. certificates : folder of this machine's; None: those of `own_folder`."""

    host: str
    port: int
    certificates: Path | None = None

    def __str__(self) -> str:
        return f"tls://[{self.host}]:{self.port}" if ":" in self.host else f"tls://{self.host}:{self.port}"

    @property
    def own_folder(self) -> Path:
        """Folder of the scheduler at this port with certificates for members of its user on its machine."""
        base = os.environ.get("XDG_RUNTIME_DIR") or os.environ.get("XDG_STATE_HOME")
        return Path(base or Path.home() / ".local" / "state", f"slrig-pool-{self.port}")

    def tls(self, *, listens: bool) -> ssl.SSLContext:
        """TLS context of a member, read now: certificates may have been renewed. Raises ConfigError."""
        folder = self.certificates
        if folder is None:
            folder = self.own_folder / MEMBER
            if not self.own_folder.exists():
                message = (
                    f"no slrig pool of this user has listened at port {self.port} of this machine: there is no "
                    f"{self.own_folder}. Start slrig pool as this user, or name the folder with this machine's "
                    "certificates"
                )
                raise ConfigError(message)
            require_private(self.own_folder)
        files = [folder / name for name in (AUTHORITY, CERTIFICATE, KEY)]
        if missing := [file.name for file in files if not file.is_file()]:
            message = (
                f"{folder} lacks {', '.join(missing)}. Name the folder of one machine that slrig pool certificates "
                "made, such as its folder 'worker'."
            )
            raise ConfigError(message)
        authority, certificate, key = files
        read_private_text(key, "the key of this machine's certificate")
        purpose = ssl.Purpose.CLIENT_AUTH if listens else ssl.Purpose.SERVER_AUTH
        try:
            found = ssl.create_default_context(purpose, cafile=authority)
            # Every holder of a certificate of the authority is a member, under any name.
            found.check_hostname, found.verify_mode = False, ssl.CERT_REQUIRED
            found.minimum_version = ssl.TLSVersion.TLSv1_3
            found.load_cert_chain(certificate, key)
        except (OSError, ValueError) as cause:
            message = f"{folder}: its certificates cannot be used ({cause}). Make new ones: slrig pool certificates."
            raise ConfigError(message) from cause
        return found


def pool_address(address: str, certificates: Path | None) -> PoolAddress:
    """The pool at tls://HOST:PORT. Raises ConfigError: the address is none, it is another machine's and no certificates
    are named, or those that are cannot be used.
    """
    parts = urlsplit(address)
    try:
        port = parts.port
    except ValueError:
        port = None
    if parts.scheme == "tcp":
        message = (
            f"{address}: a pool has no plain mode, not at 127.0.0.1 either, which other users of the machine reach. "
            "Write tls:// in place of tcp://. On one machine slrig pool makes certificates, and workers and services "
            "of the same user find them; for more machines or users make some: slrig pool certificates."
        )
        raise ConfigError(message)
    if parts.scheme != "tls" or not parts.hostname or port is None:
        message = f"'{address}' is not an address of a scheduler: expected tls://HOST:PORT, such as tls://pool:8786."
        raise ConfigError(message)
    if certificates is None and not is_loopback(parts.hostname):
        message = (
            f"{address}: expected the folder with this machine's certificates, found none. Make them with slrig pool "
            "certificates, and name the folder; only a pool that is at 127.0.0.1 makes its own."
        )
        raise ConfigError(message)
    found = PoolAddress(parts.hostname, port, certificates)
    if certificates is not None:
        found.tls(listens=False)
    return found


def require_private(folder: Path) -> None:
    """Raise ConfigError unless a folder is this user's, and no other's to read or change."""
    with storage_errors(folder):
        found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o077:
        message = f"{folder} belongs to another user, or others may use it. Remove it, or name another place."
        raise ConfigError(message)
