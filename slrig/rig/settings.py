"""Settings as applied: what each camera of a rig was last asked for, and what it says that it uses."""

from __future__ import annotations

from dataclasses import dataclass

from slrig.capture import differs_from_request
from slrig.devices import AppliedSettings, CameraSettings


@dataclass(frozen=True, slots=True)
class SettingsInUse:
    """applied : what the camera read back; None before it took any. refused : why it did not take what was asked for
    last, and so goes on with the settings before.
    """

    asked: CameraSettings
    applied: AppliedSettings | None
    refused: str | None = None

    @property
    def words(self) -> tuple[str, ...]:
        """What a person should know of them, a sentence each; none where the camera uses what was asked for.

        >>> SettingsInUse(CameraSettings(0.02), AppliedSettings(0.015, 1.0)).words
        ('It was asked for an exposure of 20 ms, and uses 15 ms: write a value that it can use into the rig file.',)
        """
        if self.refused is not None:
            return (f"It refused what it was asked for last: {self.refused}",)
        if self.applied is None:
            return ()
        asked, uses, told = self.asked, self.applied, []
        if differs_from_request(uses.exposure_s, asked.exposure_s):
            told.append(f"an exposure of {1e3 * asked.exposure_s:.4g} ms, and uses {1e3 * uses.exposure_s:.4g} ms")
        if differs_from_request(uses.gain, asked.gain):
            told.append(f"a gain of {asked.gain:.4g}, and uses {uses.gain:.4g}")
        return tuple(f"It was asked for {each}: write a value that it can use into the rig file." for each in told)
