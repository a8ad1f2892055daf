"""What slrig asks of a projector, and which calls a driver's projector takes now, refused alike by all drivers."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import NoReturn, Protocol, runtime_checkable

from slrig.devices.camera import DEFAULT_LIMITS, CallLimits
from slrig.errors import DeviceStateError, UnsupportedByDeviceError
from slrig.model import Pattern, PatternSequence, Size


@dataclass(frozen=True, slots=True)
class ProjectorInfo:
    """Declared data about a projector.

    `plays` says whether it can step through a loaded sequence by itself, triggering the cameras by wire; `gap_s` is
    then the least time from the end of a pattern's light to the next pulse, and `duty` how much of the time may be lit.
    `latency_s` is the typical time from `show` to light. `refresh_s` is one refresh period of a projector whose light
    is steady over whole ones only; None where exposures may have any length. `limits` say how long its calls may take.
    `recorded` are the patterns of a recording, in its order: a scan that asks for none plays them. Empty where any
    pattern can be shown. `lights` says whether it has lights of its own for red, green and blue, and shows `Primary`.
    """

    name: str
    model: str
    serial: str
    size: Size
    plays: bool
    latency_s: float
    refresh_s: float | None = None
    limits: CallLimits = DEFAULT_LIMITS
    recorded: tuple[Pattern, ...] = ()
    gap_s: float = 0.0005
    duty: float = 1.0
    lights: bool = False


@dataclass(frozen=True, slots=True)
class DisplayedPattern:
    """Pattern `index` lights the whole scene from `t_visible_ns` ± `t_err_ns` on (the rig's clock)."""

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

    def show(self, index: int) -> DisplayedPattern:
        """Show one pattern of the loaded sequence and hold it; return once it is known when its light is on the scene.

        That may be a little later, by `info.latency_s` at most: a display is given its next picture while the one
        before is still on its way. Whoever needs the light waits for it.

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


@runtime_checkable
class StoredPatternProjector(Projector, Protocol):
    """A projector that shows only the patterns that were put into its memory when a person asked for it."""

    def write_patterns(self, sequence: PatternSequence) -> str:
        """Fill its memory with these patterns, or write files for that, and return what was done and what is to do.

        `load` never writes them: what is tried only to see whether the projector takes it must not replace them.
        Raises UnsupportedByDeviceError: the patterns are for another size, or too many; DeviceError or StorageError:
        memory or files cannot be written.
        """
        ...


@runtime_checkable
class UnknownPolarityProjector(Projector, Protocol):
    """A projector that may not know yet whether more current means a greater number or a smaller one.

    Until its rig file tells, it is dim whichever it is, with light that pulses. The doctor finds it out.
    """

    @property
    def is_polarity_unknown(self) -> bool:
        """Whether it is not known."""
        ...

    @property
    def light_period_s(self) -> float:
        """From one pulse of the dim light to the next: expose for whole ones."""
        ...

    def set_trial_current(self, share: float) -> None:
        """Set the number that stands for the current, 0.4 to 0.6 of the greatest; dark until the next `show`.
        Raises UnsupportedByDeviceError: another number, or its sense is known.
        """
        ...

    def polarity_option(self, *, rises: bool) -> str:
        """What to write into the [projector] table, if light rises with the number, or if it falls."""
        ...


class ProjectorState:
    """Open or closed, and what is loaded. A driver's projector asks it before it touches the device.

    label : what messages call the projector. loaded : the sequence, None if there is none; the driver sets it. closed :
    set once the projector is, by any thread; whoever waits for light waits for this, too.
    """

    def __init__(self, label: str = "the projector") -> None:
        self.label = label
        self.loaded: PatternSequence | None = None
        self.closed = threading.Event()

    def require_open(self) -> None:
        """Raise DeviceStateError once `closed` is set."""
        if self.closed.is_set():
            raise DeviceStateError(f"{self.label} is closed; open the rig again")

    def require_loaded(self, doing: str) -> PatternSequence:
        """Return the loaded sequence. Raises DeviceStateError, which says what was asked for."""
        self.require_open()
        if self.loaded is None:
            raise DeviceStateError(f"asked to {doing}, no sequence is loaded; call load first")
        return self.loaded

    def require_pattern(self, index: int) -> PatternSequence:
        """Return the loaded sequence, which has a pattern of this index.
        Raises DeviceStateError: nothing is loaded, or the projector is closed; UnsupportedByDeviceError: the sequence
        has no such pattern.
        """
        sequence = self.require_loaded(f"show pattern {index}")
        if not 0 <= index < len(sequence):
            message = f"asked to show pattern {index}, the loaded sequence has patterns 0 to {len(sequence) - 1}"
            raise UnsupportedByDeviceError(message)
        return sequence

    def require_size(self, sequence: PatternSequence, size: Size) -> None:
        """Raise UnsupportedByDeviceError unless a sequence is for a projector of this size: it would be scaled."""
        if sequence.projector != size:
            message = f"{self.label} shows {size}, the sequence was made for {sequence.projector}; encode it for {size}"
            raise UnsupportedByDeviceError(message)

    def refuse_to_play(self, exposure_s: float, period_s: float) -> NoReturn:
        """Raise UnsupportedByDeviceError: this projector cannot trigger cameras."""
        self.require_open()
        raise UnsupportedByDeviceError(
            f"asked to play {exposure_s} s patterns every {period_s} s, {self.label} has no trigger wire; show each "
            "pattern, and trigger the cameras by software"
        )
