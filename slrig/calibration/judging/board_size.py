"""Whether the board is as large as it is said to be: its stretch by its own poses, its scale by an earlier calibration.

No pose tells how large everything is: a board of another size in another distance looks the same, and all distances of
the devices come out larger by the same share. An earlier calibration of the same devices knows them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from slrig.calibration.board import PRINT_SIGMA, Board
from slrig.calibration.judging.grades import Grade, Judgement
from slrig.calibration.solution import (
    PARAMETERS,
    Solution,
    covariance_of,
    device_title,
    devices_of,
    scale_mode,
)
from slrig.errors import setting
from slrig.model import Calibration, FloatArray, Pinhole

LEAST_OFF = 0.001
"""What a board in a box, a warm day and a rig that was touched may do to a distance, over itself."""
SURE = 5.0
"""Standard deviations of a share from which it is told."""
_TURNED_DEG = 1.0
_POSE = PARAMETERS.index("turn_x")
_EACH = len(PARAMETERS)


@dataclass(frozen=True, slots=True)
class ScaleCheck:
    """The scale of a solve against that of an earlier calibration.

    checked : whether they have two devices in common, whose distance tells it. share : by how much more everything
    measures than before, NaN where it was not checked, or distances differ in no one way; sigma : of that, by both
    solves, the board's size left out. words : what is wrong, and what to do; none where nothing is.
    """

    checked: bool
    share: float
    sigma: float
    words: tuple[str, ...]


def check_scale(solution: Solution, earlier: Calibration, board: Board) -> ScaleCheck:
    """Hold the distances of the devices against those of an earlier calibration.

    They are told apart from 0.1 % on, and from five of their own standard deviations. All of them off by one ratio,
    while the devices look in the same directions: the board's squares are not as large as they were said to be. Off
    otherwise: the rig was rebuilt.
    """
    now, before = devices_of(solution.calibration), devices_of(earlier)
    common = [name for name in now if name in before]
    pairs = [pair for pair in combinations(common, 2) if _distance_mm(before, *pair) > 0 < _distance_mm(now, *pair)]
    if not pairs:
        shared = ", ".join(device_title(name) for name in common) or "no device"
        unchecked = (
            f"the scale is not checked: that takes two devices which the earlier calibration has too, found {shared}; "
            "measure both rulers of the board"
        )
        return ScaleCheck(False, float("nan"), float("nan"), (unchecked,))
    mode = solution.size.scale_sigma * scale_mode(solution.calibration)
    own = solution.covariance - np.outer(mode, mode)
    shares, sigmas, told = [], [], []
    for first, second in pairs:
        new_mm, old_mm = _distance_mm(now, first, second), _distance_mm(before, first, second)
        variance = _variance_mm2(now, own, first, second)
        variance += _variance_mm2(before, covariance_of(earlier, board=False), first, second)
        shares.append(new_mm / old_mm - 1)
        sigmas.append(float(np.sqrt(variance)) / old_mm)
        told.append(f"{device_title(first)} to {device_title(second)}: {new_mm:.2f} mm, before {old_mm:.2f} mm")
    share, sigma = float(np.mean(shares)), max(sigmas)
    off = [abs(each) > max(LEAST_OFF, SURE * own_sigma) for each, own_sigma in zip(shares, sigmas, strict=True)]
    if not any(off):
        return ScaleCheck(True, share, sigma, ())
    changed = "; ".join(words for words, wrong in zip(told, off, strict=True) if wrong)
    turned = any(_turned_deg(now, before, *pair) > _TURNED_DEG for pair in pairs)
    alike = max(shares) - min(shares) <= max(LEAST_OFF, SURE * sigma)
    if all(off) and alike and not turned:
        words = (
            f"everything is {abs(share):.2%} {'larger' if share > 0 else 'smaller'} than in the earlier calibration "
            f"({changed}): the board's squares measure {board.square_mm / (1 + share):.5g} mm instead of "
            f"{board.square_mm:.5g} mm, or those of the earlier board were wrong, or the rig was rebuilt; measure both "
            f"rulers of the board, give {setting('measured_mm')}, and calibrate again if they are off"
        )
        return ScaleCheck(True, share, sigma, (words,))
    words = (
        f"the devices do not stand as in the earlier calibration ({changed}): the rig was rebuilt, or a device was "
        "bumped. If neither is so, measure both rulers of the board, and calibrate again"
    )
    return ScaleCheck(True, float("nan"), sigma, (words,))


def judged_size(solution: Solution, scale: ScaleCheck | None) -> Iterator[Judgement]:
    """What is to be said of a print's stretch, and of the scale where it was held against another one."""
    size = solution.size
    if abs(size.stretch) > max(LEAST_OFF, SURE * size.stretch_sigma):
        longer, shorter = ("wider", "high") if size.stretch > 0 else ("higher", "wide")
        words = (
            f"the print is {abs(size.stretch):.2%} ± {size.stretch_sigma:.2%} {longer} than it is {shorter}, against "
            "what it says; no pose tells which of the two is wrong, and everything may be off by half of that: measure "
            f"both rulers, and give what they read: {setting('measured_mm')}"
        )
        yield Judgement(Grade.USABLE, "stretch", None, size.stretch, words)
    if scale is not None and scale.words:
        yield Judgement(Grade.USABLE, "scale", None, scale.share, scale.words[0])


def unattended_faults(solution: Solution, board: Board, scale: ScaleCheck | None) -> tuple[str, ...]:
    """Why nobody but a person is to put a calibration in use, as far as the board's size goes; none if a clock may."""
    faults = [judgement.words for judgement in judged_size(solution, scale)]
    if (scale is None or not scale.checked) and board.square_sigma >= PRINT_SIGMA:
        faults.append(
            "nothing vouches for the scale: there is no earlier calibration in use to hold it against, and of the "
            f"board only that its squares are said to be {board.square_mm:g} mm. Activate the first calibration "
            f"yourself, or say how sure the size is: {setting('square_sigma')} of a certificate, or "
            f"{setting('measured_mm')} by the rulers"
        )
    return tuple(faults)


def _distance_mm(devices: Mapping[str, Pinhole], first: str, second: str) -> float:
    return float(np.linalg.norm(devices[second].centre_mm - devices[first].centre_mm))


def _variance_mm2(devices: Mapping[str, Pinhole], covariance: FloatArray, first: str, second: str) -> float:
    """Of the distance of two devices. A turn w and a shift dt move a centre -Rᵀt by -Rᵀ(dt + t x w)."""
    way = devices[second].centre_mm - devices[first].centre_mm
    way /= np.linalg.norm(way)
    order = list(devices)
    row = np.zeros(_EACH * len(order))
    for name, sign in ((first, -1.0), (second, 1.0)):
        device = devices[name]
        seen = device.rotation @ way
        start = _EACH * order.index(name) + _POSE
        row[start : start + 3] = -sign * np.cross(seen, device.translation_mm)
        row[start + 3 : start + 6] = -sign * seen
    return max(float(row @ covariance @ row), 0.0)


def _turned_deg(now: Mapping[str, Pinhole], before: Mapping[str, Pinhole], first: str, second: str) -> float:
    """By how much the second device turned as the first sees it, or the direction to it: the larger, degrees."""
    new = now[second].rotation @ now[first].rotation.T
    old = before[second].rotation @ before[first].rotation.T
    turn = np.arccos(np.clip((np.trace(new @ old.T) - 1) / 2, -1, 1))
    ways = []
    for devices in (now, before):
        way = devices[first].rotation @ (devices[second].centre_mm - devices[first].centre_mm)
        ways.append(way / np.linalg.norm(way))
    return float(np.degrees(max(turn, np.arccos(np.clip(ways[0] @ ways[1], -1, 1)))))
