"""Frames that are proven wrong count as missing: a bit is rebuilt from its inverse, other frames are left out."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slrig.bundle import BundleFiles
from slrig.capture import EvidenceSummary, describe_indices
from slrig.model import Axis, Black, Capture, Gray, LineShift, Pixels, Shot, White


@dataclass(frozen=True, slots=True)
class _Sources:
    """Frames, by index, from which a frame is rebuilt. light : of its inverse, relative to white and black."""

    inverse: int
    white: int
    black: int
    light: float


@dataclass(frozen=True, slots=True)
class UsableFiles:
    """A bundle without its wrong frames.

    outline : as in `BundleFiles`, without frames that are left out. places : index in the whole bundle of each of its
    frames. rebuilt : by index in the whole bundle. note : which frames are not used.
    """

    whole: BundleFiles
    outline: Capture
    places: tuple[int, ...]
    rebuilt: Mapping[int, _Sources]
    note: str

    @property
    def folder(self) -> Path:
        """Folder of the bundle."""
        return self.whole.folder

    def shots(self, order: Sequence[int]) -> Iterator[Shot]:
        """Yield the frames with these indices of the outline. Raises as `BundleFiles.shots` does."""
        places = [self.places[index] for index in order]
        for place, shot in zip(places, self.whole.shots(places), strict=True):
            sources = self.rebuilt.get(place)
            if sources is None:
                yield shot
                continue
            indices = [sources.inverse, sources.white, sources.black]
            inverse, white, black = (each.image for each in self.whole.shots(indices, colour=False))
            full_scale = self.outline.cameras[shot.camera].full_scale
            yield replace(shot, image=rebuilt_image(inverse, white, black, light=sources.light, full_scale=full_scale))


def rebuilt_image(inverse: Pixels, white: Pixels, black: Pixels, *, light: float, full_scale: int) -> Pixels:
    """Return the frame of a bit from that of its inverse, (H, W) each: light is additive, so that the bit has what the
    inverse lacks of light · (white − black). light : of the inverse, relative to white and black.
    """
    dark = black.astype(np.float32)
    image = 2 * dark + np.float32(light) * (white - dark) - inverse
    return np.asarray(np.clip(np.rint(image), 0, full_scale).astype(inverse.dtype))


def usable_files(files: BundleFiles, evidence: EvidenceSummary, axis: Axis | None) -> UsableFiles | None:
    """Return the bundle without the frames that are proven wrong; None if all frames of the axis, None for both axes,
    can be used.

    The frames of a bracket, whose evidence is that of one exposure, stay as they are.
    """
    outline = files.outline
    exposures = {name: {shot.exposure_s for shot in outline.shots if shot.camera == name} for name in outline.cameras}
    wrong = frozenset(
        index
        for index, shot in enumerate(outline.shots)
        if shot.pattern in evidence.wrong.get(shot.camera, ()) and _concerns(outline, shot, axis)
    )
    if not wrong or any(len(each) > 1 for each in exposures.values()):
        return None
    rebuilt = {index: sources for index in wrong if (sources := _sources(outline, index, wrong, evidence)) is not None}
    places = tuple(index for index in range(len(outline.shots)) if index not in wrong - rebuilt.keys())
    left = replace(outline, shots=tuple(outline.shots[index] for index in places))
    fates = {"rebuilt from the inverse, white and black": rebuilt.keys(), "left out": wrong - rebuilt.keys()}
    note = "; ".join(_describe(outline, indices, fate) for fate, indices in fates.items() if indices)
    return UsableFiles(files, left, places, rebuilt, note)


def _concerns(outline: Capture, shot: Shot, axis: Axis | None) -> bool:
    pattern = outline.patterns[shot.pattern]
    return not isinstance(pattern, Gray | LineShift) or axis in (None, pattern.axis)


def _sources(outline: Capture, index: int, wrong: Collection[int], evidence: EvidenceSummary) -> _Sources | None:
    """Return the frames from which a wrong one can be rebuilt; None if one of them is not there, or wrong too."""
    camera, pattern = outline.shots[index].camera, outline.patterns[outline.shots[index].pattern]
    if not isinstance(pattern, Gray):
        return None
    found: list[int] = []
    for wanted in (pattern.inverse, White(), Black()):
        for place, shot in enumerate(outline.shots):
            if place not in wrong and shot.camera == camera and outline.patterns[shot.pattern] == wanted:
                found.append(place)
                break
        else:
            return None
    light = evidence.light.get(camera, {}).get(f"{pattern.axis} Gray code")
    return _Sources(found[0], found[1], found[2], 1.0 if light is None else light.median)


def _describe(outline: Capture, indices: Collection[int], fate: str) -> str:
    by_camera: dict[str, list[int]] = {}
    for index in sorted(indices):
        by_camera.setdefault(outline.shots[index].camera, []).append(outline.shots[index].pattern)
    frames = ", ".join(f"{describe_indices(each)} of camera '{name}'" for name, each in by_camera.items())
    return f"frames not used: {frames}, {fate}"
