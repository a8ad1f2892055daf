"""Frames as reconstruction may use them: those that are proven wrong count as missing, unequal light is evened out.

A bit is rebuilt from its inverse, a sinusoid from its other shifts, other wrong frames are left out. Where the light
changed between a bit and its inverse, or between frames of lines or sinusoids, which displaces their edges and phases,
all frames are brought to the light of white and black.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
import structlog
from numba import config
from numpy.typing import NDArray

from slrig.bundle import BundleFiles, write_bundle
from slrig.capture import EvidenceSummary, FrameLight, describe_indices
from slrig.errors import StorageError
from slrig.jobs.listener import Listener
from slrig.kernels import KernelCount, count_prepared, rare_garbage_collection, report_compilations
from slrig.meshing import FIRST_STAGE
from slrig.model import (
    MIN_LINE_STEPS,
    Axis,
    Black,
    Calibration,
    CameraFormat,
    Capture,
    FloatArray,
    Gray,
    LineShift,
    Pattern,
    Pinhole,
    Pixels,
    Shot,
    Sine,
    Size,
    White,
)
from slrig.patterns import encode, scan_patterns
from slrig.scan.plan import ReconstructionPlan

_MIN_LIT_FRACTION = 0.2  # of the 99th percentile of white − black
_MIN_LIGHT_RATIO = 1.05  # of two frames of a pair; a smaller one displaces edges by less than noise does


@dataclass(frozen=True, slots=True)
class _Sources:
    """Frames, by index, from which a frame is rebuilt. light : of its inverse, relative to white and black."""

    inverse: int
    white: int
    black: int
    light: float

    def image(self, read: Callable[[Sequence[int]], list[Pixels]], full_scale: int) -> Pixels:
        """Return the frame. read : returns the images of frames."""
        inverse, white, black = read([self.inverse, self.white, self.black])
        return rebuilt_image(inverse, white, black, light=self.light, full_scale=full_scale)


@dataclass(frozen=True, slots=True)
class _SineSources:
    """Frames, by index, from which a frame of a sinusoid is rebuilt: its other shifts, and those whose mean is the mean
    light of all shifts, either all shifts of another period, or white and black and half of the other shifts.
    """

    others: tuple[int, ...]
    mean_of: tuple[int, ...]
    references: tuple[int, int] | None = None

    def image(self, read: Callable[[Sequence[int]], list[Pixels]], full_scale: int) -> Pixels:
        """Return the frame. read : returns the images of frames."""
        mean = np.asarray(np.mean(np.stack(read(self.mean_of)), axis=0, dtype=np.float32))
        if self.references is not None:
            white, black = (image.astype(np.float32) for image in read(self.references))
            mean = mean_of_shifts(mean, white, black)
        return rebuilt_sinusoid(read(self.others), mean, full_scale=full_scale)


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
    rebuilt: Mapping[int, _Sources | _SineSources]
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
            full_scale = self.outline.cameras[shot.camera].full_scale
            yield replace(shot, image=sources.image(self._images, full_scale))

    def _images(self, places: Sequence[int]) -> list[Pixels]:
        """Return the images with these indices of the whole bundle, in their order."""
        found = {place: next(iter(self.whole.shots([place], colour=False))).image for place in places}
        return [found[place] for place in places]


def rebuilt_image(inverse: Pixels, white: Pixels, black: Pixels, *, light: float, full_scale: int) -> Pixels:
    """Return the frame of a bit from that of its inverse, (H, W) each: light is additive, so that the bit has what the
    inverse lacks of light · (white − black). light : of the inverse, relative to white and black.
    """
    dark = black.astype(np.float32)
    image = 2 * dark + np.float32(light) * (white - dark) - inverse
    return np.asarray(np.clip(np.rint(image), 0, full_scale).astype(inverse.dtype))


def rebuilt_sinusoid(others: Sequence[Pixels], mean: NDArray[np.float32], *, full_scale: int) -> Pixels:
    """Return the frame of one of N shifts from those of the others, (H, W) each: N shifts add up to N times the mean.

    mean : (H, W), mean light of all shifts, with what harmonics that gamma adds to it.
    """
    image = (len(others) + 1) * mean - np.sum(np.stack(others), axis=0, dtype=np.float32)
    return np.asarray(np.clip(np.rint(image), 0, full_scale).astype(others[0].dtype))


def mean_of_shifts(
    some: NDArray[np.float32], white: NDArray[np.float32], black: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the mean light of all shifts, (H, W), from the mean of shifts half a period apart, whose harmonics change
    from pixel to pixel: the part of white is the same everywhere.
    """
    contrast = white - black
    lit = contrast >= max(2.0, _MIN_LIT_FRACTION * float(np.percentile(contrast, 99)))
    part = float(np.median((some - black)[lit] / contrast[lit])) if lit.any() else 0.5
    return np.asarray(black + np.float32(part) * contrast, dtype=np.float32)


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
    sines = {index for index, sources in rebuilt.items() if isinstance(sources, _SineSources)}
    fates = {
        "rebuilt from the inverse, white and black": rebuilt.keys() - sines,
        "rebuilt from the other shifts": sines,
        "left out": wrong - rebuilt.keys(),
    }
    note = "; ".join(_describe(outline, indices, fate) for fate, indices in fates.items() if indices)
    return UsableFiles(files, left, places, rebuilt, evened, note)


def _concerns(outline: Capture, shot: Shot, axis: Axis | None) -> bool:
    pattern = outline.patterns[shot.pattern]
    return not isinstance(pattern, Gray | LineShift | Sine) or axis in (None, pattern.axis)


def _sources(
    outline: Capture, index: int, wrong: Collection[int], evidence: EvidenceSummary
) -> _Sources | _SineSources | None:
    """Return the frames from which a wrong one can be rebuilt; None if one of them is not there, or wrong too."""
    camera, pattern = outline.shots[index].camera, outline.patterns[outline.shots[index].pattern]
    if isinstance(pattern, Sine):
        right = {
            outline.patterns[shot.pattern]: place
            for place, shot in reversed(list(enumerate(outline.shots)))
            if place not in wrong and shot.camera == camera
        }
        return _sine_sources(pattern, right)
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


def _sine_sources(pattern: Sine, right: Mapping[Pattern, int]) -> _SineSources | None:
    """Return the frames from which a sinusoid can be rebuilt. right : index of the right frame of each pattern."""
    others = [replace(pattern, shift=shift) for shift in range(pattern.steps) if shift != pattern.shift]
    if pattern.steps < MIN_LINE_STEPS or any(each not in right for each in others):
        return None
    places = tuple(right[each] for each in others)
    for each in right:
        if not isinstance(each, Sine) or each.axis is not pattern.axis or each.steps < MIN_LINE_STEPS:
            continue
        whole = [replace(each, shift=shift) for shift in range(each.steps)]
        if all(shifted in right for shifted in whole):
            return _SineSources(places, tuple(right[shifted] for shifted in whole))
    white, black = right.get(White()), right.get(Black())
    if pattern.inverse is None or pattern.steps < 4 or white is None or black is None:
        return None
    pairs = tuple(right[each] for each in others if each != pattern.inverse)
    return _SineSources(places, pairs, (white, black))


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
        if isinstance(pattern, Gray | LineShift | Sine) and shot.pattern in lights and _concerns(outline, shot, axis):
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


_SIZE = Size(192, 144)
_FOCAL_PX = 192.0
_BASELINE_MM = 60.0
_DISTANCE_MM = 400.0
_CAMERA = "sample"

_log = structlog.get_logger(__name__)


def prepare_kernels(reconstruct: Callable[..., Any], told: Callable[[KernelCount], None]) -> None:
    """Load every kernel that a usual scan needs; the first time they are compiled.

    reconstruct : `slrig.scan.reconstruct.reconstruct_bundle`. `told` hears how far that is, once for every kernel or
    part of one that has to be compiled, on the thread that compiles it.
    """
    with rare_garbage_collection(), _MeshingCompiler() as beside:

        def compiling(_: str) -> None:
            beside.start()
            told(count_prepared())

        def entered(stage: str, *_: object) -> None:
            if stage == FIRST_STAGE:
                beside.join()

        try:
            with report_compilations(compiling), TemporaryDirectory(prefix="slrig-") as folder:
                bundle = Path(folder, "bundle")
                write_bundle(bundle, *sample_scan())
                reconstruct(bundle, Path(folder, "result"), Listener(report=entered), plan=ReconstructionPlan())
        except (OSError, StorageError) as error:
            # A full disk is told by the scan that meets it; kernels are then compiled while it waits.
            _log.warning("kernels could not be prepared", cause=str(error))


class _MeshingCompiler:
    """The other process, while there is need of it. A context manager: at the end of the block it is no more."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._late = config.NUMBA_NUM_THREADS < 2

    def start(self) -> None:
        """Begin, unless that was done, is too late, or no core is idle: where the rig is rendered, it compiles, too."""
        if self._late or not _has_idle_core():
            return
        self._late = True
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "slrig.meshing.preparation"],
                stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        except OSError as error:
            _log.warning("kernels are compiled by one process", cause=str(error))

    def join(self) -> None:
        """Wait until it has done what it can."""
        self._late = True
        if self._process is not None:
            self._process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()


def _has_idle_core() -> bool:
    """Whether fewer threads run now, this one among them, than there are cores; so it is where nobody can tell."""
    try:
        running, _ = Path("/proc/loadavg").read_text().split()[3].split("/")
        return bool(int(running) < config.NUMBA_NUM_THREADS)
    except (OSError, ValueError, IndexError):
        return True


def sample_scan() -> tuple[Capture, Calibration]:
    """Frames of a wavy sheet with a hole in it, as one camera beside a projector sees them, and the calibration."""
    camera, projector = _device(0.0), _device(_BASELINE_MM)
    patterns = scan_patterns(
        _SIZE, line_shift=True, period_px=8, line_width_px=None, gray_cell_px=None, gray_offset_px=0, rows=False,
        inverses=False, closing=1,
    )  # fmt: skip
    column, lit = _seen_columns(camera, projector)
    noise = np.random.default_rng(0)
    shots = []
    for index, profile in enumerate(encode(patterns, _SIZE).profiles):
        light = cv2.GaussianBlur(np.broadcast_to(profile, (1, _SIZE.width_px)).astype(np.float64), (0, 0), 0.8)
        seen = 12 + 0.75 * lit * np.interp(column, np.arange(_SIZE.width_px), light[0]) + noise.normal(0, 1, lit.shape)
        image: Pixels = np.clip(np.rint(seen), 0, 255).astype(np.uint8)
        shots.append(Shot(index, _CAMERA, image, exposure_s=0.0167, time_s=index / 30))
    capture = Capture(_SIZE, patterns, {_CAMERA: CameraFormat(_SIZE, 8)}, tuple(shots))
    return capture, Calibration({_CAMERA: camera}, projector)


def _device(x_mm: float) -> Pinhole:
    """A device that looks along z from (x_mm, 0, 0)."""
    centre = (_SIZE.width_px - 1) / 2, (_SIZE.height_px - 1) / 2
    matrix = np.array([[_FOCAL_PX, 0, centre[0]], [0, _FOCAL_PX, centre[1]], [0, 0, 1]])
    return Pinhole(_SIZE, matrix, np.zeros(5), np.eye(3), np.array([-x_mm, 0.0, 0.0]))


def _seen_columns(camera: Pinhole, projector: Pinhole) -> tuple[FloatArray, FloatArray]:
    """(H, W) each: the projector column that lights what each camera pixel sees, and 1 where there is a surface."""
    y, x = np.mgrid[: _SIZE.height_px, : _SIZE.width_px].astype(np.float64)
    depth_mm = _DISTANCE_MM + 15 * np.sin(x / 17) * np.cos(y / 13)
    x_mm = (x - camera.matrix[0, 2]) / _FOCAL_PX * depth_mm
    column = _FOCAL_PX * (x_mm - _BASELINE_MM) / depth_mm + projector.matrix[0, 2]
    hole = np.hypot(x - 110, y - 60) < 12
    return column, np.where(hole, 0.1, 1.0)
