"""What the projector needs of whatever puts patterns on an output."""

from __future__ import annotations

from typing import Protocol

from drivers.display.timing import Presented
from slrig.model import PatternSequence, Pixels, Size


class Stage(Protocol):
    """An output with patterns on it. One thread uses it, but for `cover`; it is dark after opening."""

    @property
    def size(self) -> Size:
        """The pixels that are shown."""
        ...

    @property
    def refresh_s(self) -> float:
        """One refresh period."""
        ...

    @property
    def model(self) -> str:
        """What is connected, in words."""
        ...

    @property
    def serial(self) -> str:
        """Its serial number, else the output's name."""
        ...

    def load(self, sequence: PatternSequence) -> None:
        """Take patterns, after a look at whether they can be shown as they are."""
        ...

    def show(self, index: int | None) -> Presented:
        """Show a pattern, None the dark."""
        ...

    def compare(self, levels: Pixels) -> None:
        """See that this picture, (H, W) uint8, is in the frame buffer, where that can be read."""
        ...

    def cover(self) -> bool:
        """Go dark by other means than `show`, from any thread; return whether that was done."""
        ...

    def close(self) -> None:
        """Leave the output dark, as far as that can be done."""
        ...
