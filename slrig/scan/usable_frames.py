"""Frames as reconstruction may use them: those that are proven wrong count as missing, unequal light is evened out.

A bit is rebuilt from its inverse, other wrong frames are left out. Where the light changed between a bit and its
inverse, or between line frames, which displaces their edges, all frames are brought to the light of white and black.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slrig.bundle import BundleFiles
from slrig.capture import EvidenceSummary, FrameLight, describe_indices
from slrig.model import Axis, Black, Capture, Gray, LineShift, Pixels, Shot, White

_MIN_LIGHT_RATIO = 1.05  # of two frames of a pair; a smaller one displaces edges by less than noise does


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
    frames. rebuilt : by index in the whole bundle. evened : by index in the whole bundle, the light to undo, and the
    index of the black frame. note : which frames are not used.
    """

    whole: BundleFiles
    outline: Capture
    places: tuple[int, ...]
    rebuilt: Mapping[int, _Sources]
    evened: Mapping[int, tuple[FrameLight, int]]
    note: str

    @property
    def folder(self) -> Path:
        """Folder of the bundle."""
        return self.whole.folder

    def shots(self, order: Sequence[int]) -> Iterator[Shot]:
        """Yield the frames with these indices of the outline. Raises as `BundleFiles.shots` does."""
        places = [self.places[index] for index in order]
        dark = sorted({self.evened[place][1] for place in places if place in self.evened})
        black_by_place = dict(zip(dark, (each.image for each in self.whole.shots(dark, colour=False)), strict=True))
        for place, shot in zip(places, self.whole.shots(places), strict=True):
            if place in self.evened:
                light, black_place = self.evened[place]
                yield replace(shot, image=evened_image(shot.image, black_by_place[black_place], light))
                continue
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


def evened_image(image: Pixels, black: Pixels, light: FrameLight) -> Pixels:
    """Return a frame, (H, W), as the light of white and black would have made it."""
    undone = light.undo(image.astype(np.float32), black.astype(np.float32))
    return np.asarray(np.clip(np.rint(undone), 0, np.iinfo(image.dtype).max).astype(image.dtype))


def usable_files(files: BundleFiles, evidence: EvidenceSummary, axis: Axis | None) -> UsableFiles | None:
    """Return the bundle without the frames that are proven wrong, and with even light; None if all frames of the axis,
    None for both axes, can be used as they are.

    The frames of a bracket, whose evidence is that of one exposure, stay as they are.
    """
    outline = files.outline
    exposures = {name: {shot.exposure_s for shot in outline.shots if shot.camera == name} for name in outline.cameras}
    wrong = frozenset(
        index
        for index, shot in enumerate(outline.shots)
        if shot.pattern in evidence.wrong.get(shot.camera, ()) and _concerns(outline, shot, axis)
    )
    evened = {
        place: light
        for name in outline.cameras
        for place, light in _evened(outline, name, wrong, axis, evidence.frame_light.get(name, {})).items()
    }
    if not (wrong or evened) or any(len(each) > 1 for each in exposures.values()):
        return None
    rebuilt = {index: sources for index in wrong if (sources := _sources(outline, index, wrong, evidence)) is not None}
    places = tuple(index for index in range(len(outline.shots)) if index not in wrong - rebuilt.keys())
    left = replace(outline, shots=tuple(outline.shots[index] for index in places))
    fates = {"rebuilt from the inverse, white and black": rebuilt.keys(), "left out": wrong - rebuilt.keys()}
    note = "; ".join(_describe(outline, indices, fate) for fate, indices in fates.items() if indices)
    return UsableFiles(files, left, places, rebuilt, evened, note)


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


def _evened(
    outline: Capture, camera: str, wrong: Collection[int], axis: Axis | None, lights: Mapping[int, FrameLight]
) -> dict[int, tuple[FrameLight, int]]:
    """Return the light to undo of the frames of a camera, by index, with the index of black."""
    groups: dict[object, dict[int, FrameLight]] = {}
    black = -1
    for place, shot in enumerate(outline.shots):
        pattern = outline.patterns[shot.pattern]
        if shot.camera != camera or place in wrong:
            continue
        if isinstance(pattern, Black) and black < 0:
            black = place
        if isinstance(pattern, Gray | LineShift) and shot.pattern in lights and _concerns(outline, shot, axis):
            group = (pattern.axis, pattern.bit) if isinstance(pattern, Gray) else pattern.axis
            groups.setdefault(group, {})[place] = lights[shot.pattern]
    factors = [[each.factor for each in frames.values()] for frames in groups.values()]
    if black < 0 or all(max(each) <= _MIN_LIGHT_RATIO * min(each) for each in factors):
        return {}
    # All of them: what is left between pairs looks like a camera that is not linear.
    return {place: (light, black) for frames in groups.values() for place, light in frames.items()}


def _describe(outline: Capture, indices: Collection[int], fate: str) -> str:
    by_camera: dict[str, list[int]] = {}
    for index in sorted(indices):
        by_camera.setdefault(outline.shots[index].camera, []).append(outline.shots[index].pattern)
    frames = ", ".join(f"{describe_indices(each)} of camera '{name}'" for name, each in by_camera.items())
    return f"frames not used: {frames}, {fate}"
