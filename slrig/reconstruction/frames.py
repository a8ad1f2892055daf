"""The frames of one camera and one axis, sorted by what they show, ready for decoding.

Repeats of a pattern at one exposure are averaged. Several exposures are a bracket: each pixel takes the longest
exposure at which nothing it showed was clipped, and values are scaled to the longest.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.errors import PatternError
from slrig.model import Axis, Black, Capture, Gray, LineShift, Pattern, Shot, White

Image = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class AxisFrames:
    """What one camera saw of the patterns of one axis. Images are (H, W) float32 in camera units.

    bits : (B, H, W) float32, most significant first; inverses : the same, or None where none were shown.
    lines : (L, H, W) float32, one per shift; line_patterns says which.
    full_scale : the value of a saturated sample of one exposure.
    ends_repeats : white and black are means of so many times more frames than the others.
    exposure_ratio : the longest exposure of a bracket over the shortest; 1 without a bracket.
    """

    axis: Axis
    white: Image
    black: Image
    bits: NDArray[np.float32]
    inverses: NDArray[np.float32] | None
    gray: Gray
    lines: NDArray[np.float32]
    line_patterns: tuple[LineShift, ...]
    full_scale: float
    exposure_ratio: float = 1.0
    ends_repeats: float = 1.0

    @property
    def clipped_at(self) -> float:
        """The least value of a clipped sample: a bracket's are scaled to the longest exposure."""
        return self.full_scale * self.exposure_ratio

    @property
    def contrast(self) -> Image:
        """(H, W) float32: white minus black, the light that the projector adds."""
        return self.white - self.black


def axis_frames(capture: Capture, camera: str, axis: Axis) -> AxisFrames:
    """Sort the frames of one camera for decoding along one axis.

    Raises
    ------
    PatternError
        Bits are missing or of two codes, or there is neither a white-black pair nor inverses to threshold with.
    """
    images, exposure_ratio = _fused_images(capture, camera)
    grays = [p for p in images if isinstance(p, Gray) and p.axis is axis]
    if not grays:
        message = (
            f"camera '{camera}' has no Gray-code frames of the {axis.value} axis; a scan needs them to number lines"
        )
        raise PatternError(message)
    codes = {(p.bits, p.cell_px, p.offset_px) for p in grays}
    if len(codes) > 1:
        message = (
            f"camera '{camera}' has Gray-code frames of {len(codes)} different codes on the {axis.value} axis "
            f"(bits, cell, offset): {sorted(codes)}; keep one"
        )
        raise PatternError(message)
    first = grays[0]
    direct = {p.bit: images[p] for p in grays if not p.inverted}
    inverse = {p.bit: images[p] for p in grays if p.inverted}
    missing = [b for b in range(first.bits) if b not in direct and b not in inverse]
    if missing:
        message = (
            f"camera '{camera}', {axis.value} axis: bits {missing} of {first.bits} have no frame; "
            "shoot them again or lower the number of bits"
        )
        raise PatternError(message)
    white, black = _white_and_black(images, direct, inverse, camera)
    paired = all(b in direct and b in inverse for b in range(first.bits))
    bits = np.stack([direct[b] if b in direct else white + black - inverse[b] for b in range(first.bits)])
    line_patterns = tuple(
        sorted((p for p in images if isinstance(p, LineShift) and p.axis is axis), key=lambda p: p.shift)
    )
    if len({(p.period_px, p.line_width_px) for p in line_patterns}) > 1:
        message = f"camera '{camera}' has line-shift frames of two periods or widths on the {axis.value} axis; keep one"
        raise PatternError(message)
    lines = (
        np.stack([images[p] for p in line_patterns]) if line_patterns else np.zeros((0, *white.shape), dtype=np.float32)
    )
    return AxisFrames(
        axis=axis,
        white=white,
        black=black,
        bits=bits,
        inverses=np.stack([inverse[b] for b in range(first.bits)]) if paired else None,
        gray=Gray(axis, 0, first.bits, first.cell_px, first.offset_px),
        lines=lines,
        line_patterns=line_patterns,
        full_scale=float(capture.cameras[camera].full_scale),
        exposure_ratio=exposure_ratio,
        ends_repeats=_ends_repeats(capture, camera, axis),
    )


def _ends_repeats(capture: Capture, camera: str, axis: Axis) -> float:
    counts = Counter(capture.patterns[shot.pattern] for shot in capture.shots if shot.camera == camera)
    others = [n for p, n in counts.items() if isinstance(p, Gray | LineShift) and p.axis is axis]
    return max(1.0, min(counts[White()], counts[Black()]) / max(others))


def _white_and_black(
    images: Mapping[Pattern, Image], direct: Mapping[int, Image], inverse: Mapping[int, Image], camera: str
) -> tuple[Image, Image]:
    white, black = images.get(White()), images.get(Black())
    if white is not None and black is not None:
        return white, black
    pairs = [b for b in direct if b in inverse]
    if not pairs:
        message = (
            f"camera '{camera}' has no white and black frames and no bit with its inverse: "
            "nothing tells lit from dark; add a white and a black frame, or inverses"
        )
        raise PatternError(message)
    bright = np.max([np.maximum(direct[b], inverse[b]) for b in pairs], axis=0)
    dark = np.min([np.minimum(direct[b], inverse[b]) for b in pairs], axis=0)
    return (bright if white is None else white), (dark if black is None else black)


def _fused_images(capture: Capture, camera: str) -> tuple[dict[Pattern, Image], float]:
    """The image of each pattern, and the longest exposure over the shortest."""
    shots: dict[Pattern, dict[float | None, list[Shot]]] = {}
    for shot in capture.shots:
        if shot.camera == camera:
            shots.setdefault(capture.patterns[shot.pattern], {}).setdefault(shot.exposure_s, []).append(shot)
    averaged = {
        pattern: {exposure: _mean(repeats) for exposure, repeats in by_exposure.items()}
        for pattern, by_exposure in shots.items()
    }
    exposures = {frozenset(by_exposure) for by_exposure in averaged.values()}
    if not exposures or (len(exposures) == 1 and len(next(iter(exposures))) == 1):
        return {pattern: next(iter(by_exposure.values())) for pattern, by_exposure in averaged.items()}, 1.0
    return _fused_bracket(averaged, camera, float(capture.cameras[camera].full_scale))


def _fused_bracket(
    averaged: Mapping[Pattern, Mapping[float | None, Image]], camera: str, full_scale: float
) -> tuple[dict[Pattern, Image], float]:
    sets = {frozenset(by_exposure) for by_exposure in averaged.values()}
    if len(sets) > 1 or None in next(iter(sets)):
        message = (
            f"camera '{camera}': an exposure bracket needs the same exposures, stated, for every pattern; "
            f"found {[sorted(str(e) for e in each) for each in sets]}"
        )
        raise PatternError(message)
    times = sorted((float(e) for e in next(iter(sets)) if e is not None), reverse=True)
    chosen = np.full(next(iter(next(iter(averaged.values())).values())).shape, len(times) - 1)
    for rank in range(len(times) - 2, -1, -1):
        clipped = np.max([by_exposure[times[rank]] for by_exposure in averaged.values()], axis=0) >= full_scale
        chosen = np.where(clipped, chosen, rank)
    scale = np.array([times[0] / t for t in times], dtype=np.float32)
    fused = {
        pattern: np.choose(chosen, [by_exposure[t] * scale[rank] for rank, t in enumerate(times)]).astype(np.float32)
        for pattern, by_exposure in averaged.items()
    }
    return fused, float(scale[-1])


def _mean(repeats: list[Shot]) -> Image:
    if len(repeats) == 1:
        return repeats[0].image.astype(np.float32)
    return np.asarray(np.mean([shot.image for shot in repeats], axis=0, dtype=np.float64), dtype=np.float32)
