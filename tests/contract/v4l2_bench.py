"""Fake video devices, described for the fake kernel (`v4l2_kernel`), and the light before them."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from slrig.devices import Clock
from slrig.model import Size
from tests.contract.stage import Stage
from tests.contract.v4l2_kernel import STAMP_FLAGS
from tests.contract.v4l2_sensor import BIT_DEPTHS, GAIN_UNITS
from tests.unit.capture.fake_rig import Scene

ROOT = Path(__file__).resolve().parents[2]
DEBIAN_PYTHON = Path("/usr/bin/python3")
CAMERA = Size(80, 60)
PROJECTOR = Size(32, 24)
STAMPS = tuple(STAMP_FLAGS)
"""What a fake camera may stamp a frame with."""


@cache
def why_not() -> str:
    """Why the fake device cannot stand here; "" if it can."""
    if shutil.which("umockdev-wrapper") is None:
        return "umockdev is not installed: apt install umockdev gir1.2-umockdev-1.0 python3-gi"
    probe = "import gi; gi.require_version('UMockdev', '1.0'); from gi.repository import UMockdev"
    if subprocess.run([DEBIAN_PYTHON, "-c", probe], capture_output=True, check=False).returncode:  # noqa: S603
        return "UMockdev's bindings are not installed: apt install gir1.2-umockdev-1.0 python3-gi"
    return ""


_USB = "/devices/pci0000:00/0000:00:14.0/usb1/1-2"
TREE = (
    f"P: {_USB}\nE: SUBSYSTEM=usb\nE: DEVTYPE=usb_device\nA: idVendor=1234\\n\nA: idProduct=abcd\\n\n"
    # "=00" makes a plain file, which can be mapped; without it, umockdev makes a terminal.
    f"A: serial=S123\\n\n\nP: {_USB}/1-2:1.0/video4linux/video0\nN: video0=00\nE: DEVNAME=/dev/video0\n"
    "E: SUBSYSTEM=video4linux\nA: dev=81:0\\n\nA: index=0\\n\nA: name=Bench camera\\n\n\n"
)
"""The device tree of a USB camera, as umockdev reads it."""


def control(number: int, name: str, minimum: int, maximum: int, default: int, **more: object) -> dict[str, Any]:
    ranges = {"minimum": minimum, "maximum": maximum, "step": 1, "default": default}
    return {"id": number, "name": name, **ranges, **more}


CONTROLS = (
    control(0x00980900, "Brightness", -64, 64, 0),
    control(0x00980901, "Contrast", 0, 64, 32),
    control(0x0098090C, "White Balance, Automatic", 0, 1, 1),
    control(0x00980910, "Gamma", 72, 500, 220),
    control(0x00980913, "Gain", GAIN_UNITS, 8 * GAIN_UNITS, 2 * GAIN_UNITS),
    control(0x00980918, "Power Line Frequency", 0, 2, 1),
    control(0x0098091B, "Sharpness", 0, 6, 3),
    control(0x0098091C, "Backlight Compensation", 0, 2, 1),
    # Aperture priority: the exposure is the device's own until it is told otherwise.
    control(0x009A0901, "Auto Exposure", 0, 3, 3),
    control(0x009A0902, "Exposure Time, Absolute", 1, 400, 156),
    control(0x009A0903, "Exposure, Dynamic Framerate", 0, 1, 1),
    control(0x009A090A, "Focus, Absolute", 0, 250, 0),
    control(0x009A090C, "Focus, Automatic Continuous", 0, 1, 1),
)


@dataclass(frozen=True)
class Faked:
    """A fake camera. Times in seconds; `stamp`, `lost` and their like as in `v4l2_kernel`.

    rates_of : times per frame of one format and size ("YUYV 160 x 120"), in place of `rates`. line_s : what a unit of
    its exposure in lines lasts. A control may have `kind`, `flags`, `insists_on`, `stalls` (the requests "describe",
    "get", "set" that it answers with `errno`), and `long`, a 64-bit value.
    """

    formats: Mapping[str, list[tuple[int, int]]] = field(
        default_factory=lambda: {"GREY": [(CAMERA.width_px, CAMERA.height_px)]}
    )
    rates: tuple[tuple[int, int], ...] = ((1, 50), (1, 200), (1, 400), (1, 25))
    rates_of: Mapping[str, tuple[tuple[int, int], ...]] = field(default_factory=dict)
    controls: tuple[dict[str, Any], ...] = CONTROLS
    driver: str = "uvcvideo"
    line_s: float = 0.0
    stamp: str = "start"
    readout_s: float = 0.0
    bands: int = 1
    jitter_s: float = 0.0
    lag_frames: int = 3
    lost: float = 0.0
    corrupt: float = 0.0
    flags_corrupt: bool = True
    noise_when_corrupt: bool = True
    tells_rate: bool = True
    stretches: bool = True
    padding_bytes: int = 0
    seed: int = 0
    nodes: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: {"video0": {}})

    def config(self, light: Path, faults: Path) -> dict[str, Any]:
        keys = (
            *("rates_of", "driver", "line_s"),
            *("formats", "rates", "controls", "stamp", "readout_s", "jitter_s", "lag_frames", "lost", "corrupt"),
            *("flags_corrupt", "tells_rate", "stretches", "padding_bytes", "seed"),
        )
        most = max(width * height for sizes in self.formats.values() for width, height in sizes)
        usual = {"card": "Bench camera", "bus": "usb-0000:00:14.0-2", "capabilities": 0x04200001}
        room = {"most_bytes": 2 * most + 3 * 4096}
        return {
            **{key: getattr(self, key) for key in keys},
            "tree": TREE,
            "light": str(light),
            "faults": str(faults),
            "nodes": {name: {**usual, **room, **own} for name, own in self.nodes.items()},
        }


def staged(code: str = "GREY", *, noise_dn: float = 0.0, clock: Clock | None = None) -> Stage:
    """The light before a fake camera of this pixel format."""
    scene = Scene(
        camera=CAMERA,
        bit_depth=BIT_DEPTHS[code],
        projector=PROJECTOR,
        first_column_px=1.0,
        columns_per_px=0.33,
        rows_per_px=0.33,
        blur_px=0.7,
        noise_dn=noise_dn,
    )
    return Stage(scene, latency_s=0.002, clock=clock)
