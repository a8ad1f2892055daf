"""What slrig asks of a projector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from slrig.devices.limits import USUAL, CallLimits
from slrig.model import Pattern, PatternSequence, Size


@dataclass(frozen=True, slots=True)
class ProjectorInfo:
    """Declared data about a projector.

    `plays` says whether it can step through a loaded sequence by itself, triggering the cameras by wire.
    `latency_s` is the typical time from `show` to light. `refresh_s` is one refresh period of a projector whose light
    is steady over whole ones only; None where exposures may have any length. `limits` say how long its calls may take.
    `recorded` are the patterns of a recording, in its order: a scan that asks for none plays them. Empty where any
    pattern can be shown.
    """

    name: str
    model: str
    serial: str
    size: Size
    plays: bool
    latency_s: float
    refresh_s: float | None = None
    limits: CallLimits = USUAL
    recorded: tuple[Pattern, ...] = ()


@dataclass(frozen=True, slots=True)
class Shown:
    """Pattern `index` has been lighting the whole scene since `t_visible_ns` ± `t_err_ns` (the rig's clock)."""

    index: int
    t_visible_ns: int
    t_err_ns: int


@runtime_checkable
class Projector(Protocol):
    """A projector. One thread owns it. Dark after opening, after `stop`, `blank` and `close`."""

    @property
    def info(self) -> ProjectorInfo:
        """Declared data; readable in every state."""
        ...

    def load(self, sequence: PatternSequence) -> None:
        """Take a sequence. Shows nothing yet.
        Raises UnsupportedByDeviceError: the sequence is for a projector of another size, or too long.
        """
        ...

    def show(self, index: int) -> Shown:
        """Show one pattern of the loaded sequence and hold it; return once its light is on the scene.
        Raises DeviceStateError: nothing is loaded, or the projector is closed.
        """
        ...

    def play(self, exposure_s: float, period_s: float) -> None:
        """Step once through the loaded sequence, one pattern per period, triggering the cameras by wire.
        Raises UnsupportedByDeviceError: `info.plays` is False.
        """
        ...

    def stop(self) -> None:
        """End `play`; the projector is dark afterwards. Idempotent."""
        ...

    def blank(self) -> None:
        """Go dark now. Idempotent; a no-op after `close`."""
        ...

    def close(self) -> None:
        """Go dark and let the device go. Idempotent; works after an unplug and in every state."""
        ...
