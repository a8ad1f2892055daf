"""Which calls a driver's projector takes now, and the refusal of the others, in the same words for all drivers."""

from __future__ import annotations

import threading
from typing import NoReturn

from slrig.errors import DeviceStateError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Size


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
            message = f"{self.label} is closed; open the rig again"
            raise DeviceStateError(message)

    def require_loaded(self, doing: str) -> PatternSequence:
        """Return the loaded sequence. Raises DeviceStateError, which says what was asked for."""
        self.require_open()
        if self.loaded is None:
            message = f"asked to {doing}, no sequence is loaded; call load first"
            raise DeviceStateError(message)
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
        message = (
            f"asked to play {exposure_s} s patterns every {period_s} s, {self.label} has no trigger wire; show each "
            "pattern, and trigger the cameras by software"
        )
        raise UnsupportedByDeviceError(message)
