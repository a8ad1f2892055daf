"""What is known of the sensors on OAK boards: from the device, and from Luxonis' page on frame synchronisation.

Facts: https://docs.luxonis.com/hardware/platform/deploy/frame-sync names the sensors with a global shutter, and those
that expose at any time when triggered (snapshot). The others take part in a continuous stream at their own frame rate
only, which no pattern can wait for.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from slrig.model import Size

GLOBAL_SHUTTER = frozenset({"OV9281", "OV9282", "OV9782", "OV7251", "AR0234"})
SNAPSHOT = frozenset({"OV9282", "OV9782", "AR0234"})


@dataclass(frozen=True, slots=True)
class OakSensor:
    """One camera on a device. `name` is the chip's; `fastest_fps` is 0 where the device does not tell."""

    socket: str
    name: str
    size: Size
    colour: bool
    autofocus: bool
    fastest_fps: float

    @property
    def global_shutter(self) -> bool:
        """All rows are exposed together. A sensor that is not known is taken to roll."""
        return self.name.upper() in GLOBAL_SHUTTER

    @property
    def snapshot(self) -> bool:
        """An edge on FSIN starts an exposure at any time."""
        return self.name.upper() in SNAPSHOT

    def longest_skew_ns(self, fps: float) -> int:
        """How much later the last row may be exposed than the first, at most, ns.

        Rows are read out one after the other within one period of the fastest mode that reads them all.
        """
        if self.global_shutter:
            return 0
        return round(1e9 / max(self.fastest_fps, fps))


def read_sensors(features: Iterable[Any], vendor: Any) -> Mapping[str, OakSensor]:
    """The cameras that a device says it has, by socket; others than mono and colour are left out."""
    kinds = vendor.CameraSensorType
    found = {}
    for feature in features:
        # The first is what the sensor is used for unless asked otherwise.
        kind = feature.supportedTypes[0] if feature.supportedTypes else kinds.MONO
        if kind not in (kinds.MONO, kinds.COLOR) or feature.width < 1 or feature.height < 1:
            continue
        whole = [
            config.maxFps
            for config in feature.configs
            if (config.width, config.height) == (feature.width, feature.height)
        ]
        found[feature.socket.name] = OakSensor(
            socket=feature.socket.name,
            name=feature.sensorName,
            size=Size(feature.width, feature.height),
            colour=kind == kinds.COLOR,
            autofocus=feature.hasAutofocus,
            fastest_fps=max(whole, default=0.0),
        )
    return found
