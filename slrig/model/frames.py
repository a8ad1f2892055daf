"""Frames as cameras deliver them, whole captures, and exposure brackets."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from slrig.errors import BundleError
from slrig.model.patterns import Pattern
from slrig.model.rig import Pixels, Size, require


@dataclass(frozen=True, slots=True)
class Frame:
    """One exposure as a camera delivered it. Times are CLOCK_MONOTONIC (or the rig's own clock), ns.

    image : (H, W) uint8 or uint16. `t_start_ns`..`t_end_ns` is the exposure, each known to ± `t_err_ns`: from the first
    row's start to the last row's end. `sequence_number` counts every frame the sensor made; `dropped_count` those lost
    since the camera was armed. `shutter_skew_s` : a rolling shutter's last row is exposed this much later than its
    first; 0 for a global shutter, and where the driver does not know. The times span exposure_s + shutter_skew_s.
    colour : makes the same picture in colour when it is called, (H, W, 3) of the image's type, blue, green and red, of
    what the camera sent: the few frames that are wanted so cost time, and the others none. None of a mono camera.
    """

    camera: str
    image: Pixels
    t_start_ns: int
    t_end_ns: int
    t_err_ns: int
    sequence_number: int
    dropped_count: int
    exposure_s: float
    gain: float
    shutter_skew_s: float = 0.0
    colour: Callable[[], Pixels] | None = None

    def __post_init__(self) -> None:
        require(self.image, "Frame.image", (None, None), "u")


@dataclass(frozen=True, slots=True)
class CameraFormat:
    """Extent and bit depth of a camera's frames; full scale is 2^bit_depth - 1."""

    size: Size
    bit_depth: int

    def __post_init__(self) -> None:
        if not 1 <= self.bit_depth <= 16:
            raise BundleError(f"bit_depth: expected 1 to 16, found {self.bit_depth}")

    @property
    def full_scale(self) -> int:
        """The value of a saturated sample."""
        return int(2**self.bit_depth - 1)


@dataclass(frozen=True, slots=True)
class Shot:
    """One frame that shows one pattern, seen by one camera. `time_s` counts from the first frame.

    colour : (H, W, 3) of the image's type, blue, green and red, of white and black frames of a camera that has colour;
    None of all others. What is made of stripes takes the image alone.
    """

    pattern: int
    camera: str
    image: Pixels
    exposure_s: float | None = None
    time_s: float | None = None
    colour: Pixels | None = None

    def __post_init__(self) -> None:
        require(self.image, "Shot.image", (None, None), "u")
        if self.colour is not None:
            require(self.colour, "Shot.colour", (*self.image.shape, 3), "u")


@dataclass(frozen=True, slots=True)
class Capture:
    """Everything one sequence gave: the patterns as described data, and the frames that show them."""

    projector: Size
    patterns: tuple[Pattern, ...]
    cameras: Mapping[str, CameraFormat]
    shots: tuple[Shot, ...]

    def __post_init__(self) -> None:
        for shot in self.shots:
            if not 0 <= shot.pattern < len(self.patterns) or shot.camera not in self.cameras:
                message = f"a frame names pattern {shot.pattern} of camera '{shot.camera}', which is not in the list"
                raise BundleError(message)
            size = self.cameras[shot.camera].size
            if shot.image.shape != size.shape:
                rows, columns = shot.image.shape
                raise BundleError(f"a frame of camera '{shot.camera}' is {columns} x {rows}, the camera is {size}")


FEWEST_EXPOSURES, MOST_EXPOSURES = 2, 6
"""How many exposures a bracket has."""

_LEAST_STEP = 1.1
_SAME_EXPOSURE = 1.05  # exposures that a camera reads back differ by less


def bracket_fault(exposures_s: Sequence[float]) -> str | None:
    """Say why these exposure times are no bracket, and what to ask for; None if they are one.

    >>> bracket_fault([0.005, 0.02, 0.08]) is None
    True
    """
    found = ", ".join(f"{each:g}" for each in exposures_s)
    if not FEWEST_EXPOSURES <= len(exposures_s) <= MOST_EXPOSURES:
        return (
            f"expected {FEWEST_EXPOSURES} to {MOST_EXPOSURES} exposure times, found {len(exposures_s)} ({found}); "
            "three, each four times as long as the one before, are usual, and one alone is exposure_s"
        )
    if not all(0 < each < float("inf") for each in exposures_s):
        return f"expected finite times above 0 s, found {found}; 0.005, 0.02, 0.08 are usual"
    rising = sorted(exposures_s)
    # A tenth as people write it: 0.011 is not quite 1.1 times 0.01 in binary.
    if any(after < (_LEAST_STEP - 1e-9) * before for before, after in pairwise(rising)):
        return (
            f"expected times that differ by {_LEAST_STEP - 1:.0%} at least, found {found}; four times as long as the "
            "one before is usual"
        )
    return None


def exposure_groups(exposures_s: Iterable[float | None]) -> dict[float | None, float | None]:
    """Each exposure time, and the one that stands for all that are alike, the shortest of them.

    A camera that reads each frame's exposure from its hardware names the same one a little differently every time.
    Unknown ones are alike.

    >>> exposure_groups([0.02, 0.005, 0.0201, None])
    {None: None, 0.005: 0.005, 0.02: 0.02, 0.0201: 0.02}
    """
    given = set(exposures_s)
    groups: dict[float | None, float | None] = {None: None} if None in given else {}
    shortest = 0.0
    for each in sorted(e for e in given if e is not None):
        if each > _SAME_EXPOSURE * shortest:
            shortest = each
        groups[each] = shortest
    return groups
