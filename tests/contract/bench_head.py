"""The head that benches open: cameras and a projector, and nothing that is known of what is before them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from slrig.devices import Camera, Clock, Projector, SystemClock
from slrig.model import Calibration, Truth


@dataclass(frozen=True)
class BenchHead:
    """Implements `slrig.devices.Head`."""

    cameras: Mapping[str, Camera]
    projector: Projector
    clock: Clock = field(default_factory=SystemClock, kw_only=True)

    @property
    def calibration(self) -> Calibration | None:
        """See `Head`. None: nothing is measured here."""
        return None

    def truth(self) -> Truth | None:
        """See `Head`."""
        return None
