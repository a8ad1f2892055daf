"""Where a rig file's `[head]` finds the rendered rig. Light: what renders is loaded when a rig is opened."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slrig.devices import ScannerHead


def open_head(options: Mapping[str, object], folder: Path) -> ScannerHead:
    """Open the rendered rig: see `simulated_rig.device.open_head`. Raises ConfigError."""
    from simulated_rig.device import open_head as opened

    return opened(options, folder)
