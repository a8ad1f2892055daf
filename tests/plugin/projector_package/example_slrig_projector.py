"""A projector that lights a test chart: it writes what it shows, and since when, into a file that a camera reads."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from slrig.devices import DisplayedPattern, Projector, ProjectorInfo, ProjectorState, SystemClock
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
        self._state = ProjectorState()
        self._path.write_bytes(b"")
        self._light(np.zeros((1, 1), np.uint8), time.monotonic_ns())

    @property
    def info(self) -> ProjectorInfo:
        """See `Projector`."""
        return self._info

    def load(self, sequence: PatternSequence) -> None:
        """See `Projector`."""
        self._state.require_open()
        self._state.require_size(sequence, self._info.size)
        self.blank()
        self._state.loaded = sequence

    def show(self, index: int) -> DisplayedPattern:
        """See `Projector`."""
        sequence = self._state.require_pattern(index)
        visible_ns = time.monotonic_ns() + round(LATENCY_S * 1e9)
        self._light(sequence.profiles[index], visible_ns)
        SystemClock().wait_until(visible_ns + _ERROR_NS, self._state.closed)
        return DisplayedPattern(index, visible_ns, _ERROR_NS)

    def play(self, exposure_s: float, period_s: float) -> None:
        """See `Projector`."""
        self._state.refuse_to_play(exposure_s, period_s)

    def stop(self) -> None:
        """See `Projector`."""
        self.blank()

    def blank(self) -> None:
        """See `Projector`."""
        if not self._state.closed.is_set():
            self._light(np.zeros((1, 1), np.uint8), time.monotonic_ns())

    def close(self) -> None:
        """See `Projector`."""
        self.blank()
        self._state.loaded = None
        self._state.closed.set()

    def _light(self, rows: Pixels, t_ns: int) -> None:
        with self._path.open("ab") as file:
            file.write(json.dumps({"t_ns": t_ns, "rows": rows.tolist()}).encode() + b"\n")


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:
    """Open the lamp that writes a file."""
    table = Options.model_validate(dict(options))
    return LampProjector(folder / table.light, Size(*table.size_px))
