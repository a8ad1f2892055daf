"""A recorded scan bundle as a rig: showing a pattern makes the cameras deliver the frames recorded of it.

A scan of it reproduces the times, exposures and images of the recording, at any speed: see `ReplayClock`. Each scan
restarts the recording; a bracket (one sequence per exposure) continues in it from one sequence to the next.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import structlog
from pydantic import Field, field_validator

from drivers.replay.camera import ReplayCamera, ReplayClock, ReplayProjector, ReplayState
from slrig.bundle import Bundle, Strict, read_bundle, validate
from slrig.devices import Camera, Projector, ScannerHead
from slrig.errors import BundleError, ConfigError
from slrig.model import Calibration, Truth, trim_incomplete_codes

__all__ = ["ReplayCamera", "ReplayClock", "ReplayHead", "ReplayOptions", "ReplayProjector", "open_head"]

_log = structlog.get_logger(__name__)

_SPEEDS = (0.05, 1000.0)


class ReplayOptions(Strict, use_attribute_docstrings=True):
    """The `[head]` table of a replayed rig."""

    bundle: str = Field(min_length=1)
    """Folder of the recording, relative to the rig file's."""

    speed: float = 0.0
    """Speed of the replay: 1 takes as long as the recording, 2 half of that, 0.05 to 1000; 0 is as fast as possible."""

    @field_validator("speed")
    @classmethod
    def _check_speed(cls, speed: float) -> float:
        least, most = _SPEEDS
        if speed != 0 and not least <= speed <= most:
            message = f"expected 0, or {least:g} to {most:g} times the recording's own speed, found {speed:g}"
            raise ValueError(message)
        return speed


class ReplayHead:
    """Implements `slrig.devices.ScannerHead` on a recorded bundle.

    `clock` sets the speed, by default as fast as possible; all time stamps count in it.
    """

    def __init__(self, bundle: Bundle, clock: ReplayClock | None = None) -> None:
        self.clock = clock = ReplayClock() if clock is None else clock
        replay_state = ReplayState()
        self._calibration = bundle.calibration
        self._cameras = {name: ReplayCamera(name, bundle, clock, replay_state) for name in bundle.capture.cameras}
        self._projector = ReplayProjector(bundle, self._cameras, clock, replay_state)

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """See `ScannerHead`."""
        return self._cameras

    @property
    def projector(self) -> Projector:
        """See `ScannerHead`."""
        return self._projector

    @property
    def calibration(self) -> Calibration | None:
        """See `ScannerHead`: the calibration in the bundle."""
        return self._calibration

    def truth(self) -> Truth | None:
        """See `ScannerHead`. A recording has frames only."""
        return None


def open_head(options: Mapping[str, object], folder: Path) -> ScannerHead:
    """Open a recorded bundle as a rig, from a rig file's `[head]` table (without its `driver`).

    Parameters
    ----------
    options
        `ReplayOptions`.
    folder
        Folder of the rig file: the bundle's path is relative to it.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message, or the bundle does not exist.
    BundleError
        The bundle is damaged.
    CalibrationError
        Its calibration is damaged.
    """
    table = validate(ReplayOptions, options, "the [head] table of a replayed rig")
    path = folder / table.bundle
    if not (path / "bundle.json").is_file():
        message = (
            f'[head] bundle = "{table.bundle}": {path} is not a scan bundle (it has no bundle.json); name its folder'
        )
        raise ConfigError(message)
    bundle = read_bundle(path)
    if not bundle.capture.shots:
        message = f"{path / 'bundle.json'}: the recording has no frames; there is nothing to replay"
        raise BundleError(message)
    capture, warnings = trim_incomplete_codes(bundle.capture)
    for warning in warnings:
        _log.warning(warning, recording=str(path))
    return ReplayHead(replace(bundle, capture=capture), ReplayClock(table.speed))
