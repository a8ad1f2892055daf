"""Projector protocols, the values they exchange, and the state checks that all projector drivers share."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import NoReturn, Protocol, runtime_checkable

from slrig.devices.camera import DEFAULT_LIMITS, CallLimits
from slrig.errors import DeviceStateError, UnsupportedByDeviceError
from slrig.model import Pattern, PatternSequence, Size


@dataclass(frozen=True, slots=True)
class ProjectorInfo:
    """Declared data of a projector.

    plays : True if it can step through a loaded sequence on its own and trigger the cameras by wire. gap_s : shortest
    time from the end of a pattern's light to the next pulse; duty : largest fraction of time with light. latency_s :
    typical time from `show` to light. refresh_s : refresh period of a projector whose light is constant only over whole
    periods; None if exposures may have any length. limits : time-outs of its calls. recorded : patterns of a recording,
    in its order, which a scan plays by default; empty if the projector shows any pattern. lights : True if it has
    separate red, green and blue lights, and shows `Primary`. shades : False if it shows black and white only, so that
    it refuses patterns with shades of grey. pulses_expose : True if its pulses last as long as the exposure that `play`
    was given.
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
    shades: bool = True
    pulses_expose: bool = False


@dataclass(frozen=True, slots=True)
class DisplayedPattern:
    """Pattern `index` lights the whole scene from `t_visible_ns` ± `t_err_ns` on, in the rig's clock."""

    index: int
    t_visible_ns: int
    t_err_ns: int


@runtime_checkable
class Projector(Protocol):
    """A projector, used by one thread. It is dark after opening, `stop`, `blank` and `close`."""

    @property
    def info(self) -> ProjectorInfo:
        """Declared data; readable in every state."""
        ...

    def load(self, sequence: PatternSequence) -> None:
        """Load a sequence without showing it.
        Raises UnsupportedByDeviceError: the sequence is for a projector of another size, or too long.
        """
        ...

    def show(self, index: int) -> DisplayedPattern:
        """Show one pattern of the loaded sequence until the next call; return when the time of its light is known.

        The light may come after the return, by `info.latency_s` at most, because a display accepts its next picture
        before the previous one is on the screen. The caller waits for `t_visible_ns`.

        Raises DeviceStateError: nothing is loaded, or the projector is closed.
        """
        ...

    def play(self, exposure_s: float, period_s: float) -> None:
        """Step once through the loaded sequence, one pattern per period, and trigger the cameras by wire.
        Raises UnsupportedByDeviceError: `info.plays` is False.
        """
        ...

    def stop(self) -> None:
        """End `play`; the projector is dark afterwards. Idempotent."""
        ...

    def blank(self) -> None:
        """Switch the light off. Idempotent; does nothing after `close`."""
        ...

    def close(self) -> None:
        """Switch the light off and release the device. Idempotent; works after an unplug and in every state."""
        ...


@runtime_checkable
class StoredPatternProjector(Projector, Protocol):
    """A projector that shows only patterns in its memory, which the user writes by a separate command."""

    def write_patterns(self, sequence: PatternSequence) -> str:
        """Write these patterns to the memory, or to files for it, and return a report with the next steps.

        `load` never writes patterns, because a trial must not replace them.

        Raises UnsupportedByDeviceError: the patterns are for another size, or too many; DeviceError or StorageError:
        memory or files cannot be written.
        """
        ...


@runtime_checkable
class UnknownPolarityProjector(Projector, Protocol):
    """A projector whose current register may be inverted, which the doctor measures.

    Until the rig file states the polarity, the projector uses pulsed light that is dim for either polarity.
    """

    @property
    def is_polarity_unknown(self) -> bool:
        """True if the rig file does not state the polarity."""
        ...

    @property
    def light_period_s(self) -> float:
        """Period of the pulsed light; exposures must be multiples of it."""
        ...

    def set_trial_current(self, share: float) -> None:
        """Set the current register to a fraction of its maximum, 0.4 to 0.6, and go dark until the next `show`.
        Raises UnsupportedByDeviceError: the fraction is out of range, or the polarity is known.
        """
        ...

    def polarity_option(self, *, rises: bool) -> str:
        """Return the line for the [projector] table. rises : True if light increases with the register value."""
        ...


class ProjectorState:
    """State of a driver's projector. The driver checks it before each access to the device.

    label : name of the projector in messages. loaded : loaded sequence or None; set by the driver. closed : event that
    any thread sets when the projector is closed; a thread that waits for light also waits for it.
    """

    def __init__(self, label: str = "the projector") -> None:
        self.label = label
        self.loaded: PatternSequence | None = None
        self.closed = threading.Event()

    def require_open(self) -> None:
        """Raise DeviceStateError once `closed` is set."""
        if self.closed.is_set():
            raise DeviceStateError(f"{self.label} is closed; open the rig again")

    def require_loaded(self, action: str) -> PatternSequence:
        """Return the loaded sequence. Raises DeviceStateError: nothing is loaded, with `action` in the message."""
        self.require_open()
        if self.loaded is None:
            raise DeviceStateError(f"cannot {action}: no sequence is loaded; call load first")
        return self.loaded

    def require_pattern(self, index: int) -> PatternSequence:
        """Return the loaded sequence after checking that it has a pattern of this index.
        Raises DeviceStateError: nothing is loaded, or the projector is closed; UnsupportedByDeviceError: the index is
        out of range.
        """
        sequence = self.require_loaded(f"show pattern {index}")
        if not 0 <= index < len(sequence):
            message = f"requested pattern {index}, the loaded sequence has patterns 0 to {len(sequence) - 1}"
            raise UnsupportedByDeviceError(message)
        return sequence

    def require_size(self, sequence: PatternSequence, size: Size) -> None:
        """Raise UnsupportedByDeviceError if a sequence has another size, because the projector would scale it."""
        if sequence.projector != size:
            message = f"{self.label} shows {size}, the sequence was made for {sequence.projector}; encode it for {size}"
            raise UnsupportedByDeviceError(message)

    def refuse_to_play(self, exposure_s: float, period_s: float) -> NoReturn:
        """Raise UnsupportedByDeviceError: this projector cannot trigger cameras."""
        self.require_open()
        raise UnsupportedByDeviceError(
            f"requested {exposure_s} s patterns every {period_s} s, but {self.label} has no trigger wire; show each "
            "pattern, and trigger the cameras by software"
        )
