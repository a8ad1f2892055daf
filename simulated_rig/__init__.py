"""A simulated rig: ray-traced light, a camera and a projector in one virtual scene, with exact ground truth.

Rendering modules are loaded only when a rig is opened.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slrig.devices import ScannerHead


def open_head(options: Mapping[str, object], folder: Path) -> ScannerHead:
    """Open the simulated rig, see `simulated_rig.device.open_head`. Raises ConfigError."""
    from simulated_rig import device

    return device.open_head(options, folder)
