"""A projector that lights a test chart: it writes what it shows, and since when, into a file that a camera reads."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from slrig.devices import Projector, ProjectorInfo, Shown
from slrig.errors import DeviceStateError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Pixels, Size

LATENCY_S = 0.004
_ERROR_NS = 50_000


class Options(BaseModel):
    """The keys of a `[projector]` table that belong to this driver.

    light : the file, from the rig file's folder. size_px : width, height.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    light: str
    size_px: tuple[int, int] = (128, 96)


class LampProjector:
    """Implements `slrig.devices.Projector`. It steps; it does not play."""

    def __init__(self, path: Path, size: Size) -> None:
        self._info = ProjectorInfo("projector", "test chart lamp", path.name, size, False, LATENCY_S)
        self._path = path
        self._sequence: PatternSequence | None = None
        self._closed = threading.Event()
        self._path.write_bytes(b"")
        self._light(np.zeros((1, 1), np.uint8), time.monotonic_ns())

    @property
    def info(self) -> ProjectorInfo:
        """See `Projector`."""
        return self._info

    def load(self, sequence: PatternSequence) -> None:
        """See `Projector`."""
        self._require_open()
        if sequence.projector != self._info.size:
            message = f"asked patterns for {sequence.projector}, the lamp is {self._info.size}; encode them for that"
            raise UnsupportedByDeviceError(message)
        self.blank()
        self._sequence = sequence

    def show(self, index: int) -> Shown:
        """See `Projector`."""
        self._require_open()
        if self._sequence is None:
            message = f"asked to show pattern {index}, no sequence is loaded; call load first"
            raise DeviceStateError(message)
        if not 0 <= index < len(self._sequence):
            message = f"asked to show pattern {index}, patterns 0 to {len(self._sequence) - 1} are loaded"
            raise UnsupportedByDeviceError(message)
        visible_ns = time.monotonic_ns() + round(LATENCY_S * 1e9)
        self._light(self._sequence.profiles[index], visible_ns)
        while (left_ns := visible_ns + _ERROR_NS - time.monotonic_ns()) > 0:
            if self._closed.wait(left_ns / 1e9):
                break
        return Shown(index, visible_ns, _ERROR_NS)

    def play(self, exposure_s: float, period_s: float) -> None:
        """See `Projector`."""
        self._require_open()
        message = f"asked to play {exposure_s:g} s patterns every {period_s:g} s, the lamp has no wire; step it"
        raise UnsupportedByDeviceError(message)

    def stop(self) -> None:
        """See `Projector`."""
        self.blank()

    def blank(self) -> None:
        """See `Projector`."""
        if not self._closed.is_set():
            self._light(np.zeros((1, 1), np.uint8), time.monotonic_ns())

    def close(self) -> None:
        """See `Projector`."""
        self.blank()
        self._sequence = None
        self._closed.set()

    def _light(self, rows: Pixels, t_ns: int) -> None:
        with self._path.open("ab") as file:
            file.write(json.dumps({"t_ns": t_ns, "rows": rows.tolist()}).encode() + b"\n")

    def _require_open(self) -> None:
        if self._closed.is_set():
            message = "the projector is closed; open the rig again"
            raise DeviceStateError(message)


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:
    """Open the lamp that writes a file."""
    table = Options.model_validate(dict(options))
    return LampProjector(folder / table.light, Size(*table.size_px))
