"""Conclusions from the frames of one camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from slrig.capture.frame_checks import Contradiction, DecodedCode, Samples
from slrig.capture.frame_light import FrameLight
from slrig.model import Axis, Gray, Pattern


@dataclass(slots=True)
class CameraFindings:
    """Conclusions from the frames of one camera. They follow from the frames alone and are rebuilt when a frame is
    retracted.

    first_seen_index : index of the first frame of each pattern. verified : patterns whose frames passed a test that
    another pattern would fail. noises : DN, one for each pair. sums : bit + inverse of the last pair. pending_lines :
    line frames that wait for the code. light_drift : largest change of the light between two frames of one pattern,
    relative to white. reference_confirmed : a pair of a bit or lines and their inverses added up to white and black,
    which confirms these two. verified_axes : axes with a line frame that agreed with the Gray code, which confirms the
    code. lights : light of frames that agree only after it is undone; measured_factors : factor of the light of all
    frames that determine it. fitted_lights : as well as it is known, for comparison within a pair or the line frames of
    an axis. linear_edges : for each pair with edges, whether they show a linear response. agreements : by axis, the
    contradictions of its sinusoids with all of its frames; interim_agreements : those found before all were there.
    """

    first_seen_index: dict[Pattern, int] = field(default_factory=dict)
    verified: set[int] = field(default_factory=set)
    noises: list[float] = field(default_factory=list)
    sums: list[Samples] = field(default_factory=list)
    codes: dict[Axis, tuple[DecodedCode, Gray]] = field(default_factory=dict)
    pending_lines: list[int] = field(default_factory=list)
    light_drift: float | None = None
    reference_confirmed: bool = False
    verified_axes: set[Axis] = field(default_factory=set)
    lights: dict[int, FrameLight] = field(default_factory=dict)
    measured_factors: dict[int, float] = field(default_factory=dict)
    fitted_lights: dict[int, FrameLight] = field(default_factory=dict)
    linear_edges: list[bool] = field(default_factory=list)
    agreements: dict[Axis, list[Contradiction]] = field(default_factory=dict)
    interim_agreements: dict[Axis, list[Contradiction]] = field(default_factory=dict)

    @property
    def usual_factor(self) -> float:
        """Median factor of the light of the frames whose inverses determine it; 1 without such frames."""
        return float(np.median(list(self.measured_factors.values()))) if self.measured_factors else 1.0

    def settled(self, reported: Sequence[Contradiction]) -> list[Contradiction]:
        """Return the contradictions of a camera without those that frames of sinusoids gave before all of their axis
        were there, and without others of frames that these prove wrong.
        """
        passed = [each for axis in self.agreements for each in self.interim_agreements.get(axis, ())]
        final = [each for found in self.agreements.values() for each in found]
        wrong = {index for each in final for index in each.wrong}
        others = [
            each for each in reported
            if each not in final and each not in passed and wrong.isdisjoint({*each.suspects, *each.further_suspects})
        ]  # fmt: skip
        # A frame that equals another one is known better than that one of several does not fit.
        vague = [
            each for each in final if not each.wrong and any(set(o.suspects) <= set(each.suspects) for o in others)
        ]
        return [each for each in reported if each in others or (each in final and each not in vague)]

    def explains(self, reported: Sequence[Contradiction]) -> bool:
        """True if there is no contradiction, or one in which all frames of an axis prove which are wrong."""
        final = [each for found in self.agreements.values() for each in found]
        return len(reported) <= 1 and all(each.wrong and each in final for each in reported)

    @property
    def noise_dn(self) -> float | None:
        """Noise of a frame, DN; None without pairs.

        This is the minimum over all pairs, because finer bits behind a scaler do not add up exactly.
        """
        return min(self.noises, default=None)
