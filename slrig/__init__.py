"""slrig: drives structured-light rigs, captures, and reconstructs triangle meshes in millimetres."""

import os
from pathlib import Path

KEY_VARIABLE = "SLRIG_API_KEY"
"""Environment variable with the key of a client; a service with it uses that key instead of making its own."""


def data_home() -> Path:
    """Folder of what slrig keeps for the person who runs it: in the data folder of the XDG base directories."""
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "slrig"


def local_key_path(port: int) -> Path:
    """File with the key by which programs of the same user on the same machine use a service, as long as it runs."""
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "slrig" / f"{port}.key"
