"""Images in a video: of each pattern one frame, or several equal ones."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.bundle import MAX_CAMERA_PX
from slrig.errors import BundleError
from slrig.importers.stacks import ArrayImages
from slrig.model import FloatArray

VIDEOS = {".avi", ".mkv", ".mov", ".mp4"}
MAX_FRAMES = 20_000

_SIGNATURES = ((0, b"RIFF"), (0, b"\x1aE\xdf\xa3"), (4, b"ftyp"), (4, b"moov"), (4, b"mdat"), (4, b"wide"))
"""Place and text of the beginning of AVI, Matroska and QuickTime: no playlist, which names other files, begins so."""
_GREY_16 = int.from_bytes(b"Y1\0\x10", "little")

_FLICKER = np.float32(0.1)  # of the light, between two frames
_LAG_PX = 3  # from which noise of neighbours is not correlated, but patterns along their stripes are
_STEP = 4  # of rows or columns, whose differences are enough
_MAX_NOISE_SHARE = 0.25  # of the difference of equal frames that is correlated
_MAX_EQUAL_SHARE = 2e-3  # the correlated difference of equal frames, over that of frames of two patterns
_MIN_HELD_SHARE = 0.5  # of the frames, in runs of equal ones, if patterns are held
_LONG_RUN = 3.0  # times the usual one: at either end of a video, perhaps not a pattern
_MIN_REPEATS = 1.6  # times the usual run, of 3 frames at least: two patterns that look alike
_MIN_RUN_SHARE = 0.25  # of the usual run: shorter ones are of a change


def read_video(path: Path) -> ArrayImages:
    """Return the images in a video, by their first frames.

    If most frames lie in runs of equal ones, each run is an image, the mean of its frames without the first and last,
    and frames of changes are left out; long runs at either end may be idle. Otherwise each frame is an image.
    Raises BundleError: the video cannot be read, or is too long.
    """
    previous: NDArray[Any] | None = None
    changes: list[tuple[float, float]] = []
    count, is_grey = 0, True
    for frame in _frames(path):
        is_grey = is_grey and (frame.ndim == 2 or bool((frame[..., :1] == frame).all()))
        if previous is not None:
            changes.append(_change(previous, frame))
        previous, count = frame, count + 1
    if previous is None:
        raise BundleError(f"{path}: expected a video that OpenCV can decode, found no frame; export it as FFV1 in .avi")
    runs, words = find_runs(np.array(changes).reshape(-1, 2))
    used = [_used_frames(start, stop) for start, stop in runs]
    images = _means(path, used, previous, is_grey=is_grey)
    names = [f"frame {start}" for start, _ in runs]
    is_averaged = any(stop - start > 1 for start, stop in used) and previous.dtype == np.uint8
    usual = np.median([stop - start for start, stop in runs])
    ends = {names[index]: runs[index] for index in (0, -1)}
    idle = [name for name, (start, stop) in ends.items() if stop - start > _LONG_RUN * usual]
    summary = f"{path.name}: {count} frames, {words}"
    return ArrayImages(dict(zip(names, images, strict=True)), is_averaged, summary, idle)


def _frames(path: Path) -> Iterator[NDArray[Any]]:
    """Yield the frames of a video, (H, W) or, in BGR, (H, W, 3), uint8 or uint16."""
    with path.open("rb") as stream:
        start = stream.read(16)
    if not any(start[place:].startswith(text) for place, text in _SIGNATURES):
        raise BundleError(
            f"{path}: expected a video as AVI, Matroska or QuickTime, found another file; export it again"
        )
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    video = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
    try:
        if int(video.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) == _GREY_16:
            video.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        size_px = video.get(cv2.CAP_PROP_FRAME_WIDTH) * video.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if size_px > MAX_CAMERA_PX:
            raise BundleError(f"{path}: expected at most {MAX_CAMERA_PX} pixels, found {size_px:.0f}; crop the video")
        shape: tuple[int, ...] | None = None
        for number in range(MAX_FRAMES):
            is_there, frame = video.read()
            if not is_there:
                return
            shape = shape or frame.shape
            if frame.shape != shape:
                message = f"{path}: expected frames of one extent, found another from frame {number}; export it again"
                raise BundleError(message)
            yield frame
    finally:
        video.release()
        cv2.utils.logging.setLogLevel(level)
    raise BundleError(f"{path}: expected at most {MAX_FRAMES} frames, found more; cut the video to the patterns")


def _change(first: NDArray[Any], second: NDArray[Any]) -> tuple[float, float]:
    """Return mean square of the difference of two frames, and the part of it that is correlated along an axis.

    A small factor between the frames, of light that flickers, does not count.
    """
    one, other = (frame if frame.ndim == 2 else frame[..., 1] for frame in (first, second))
    before, after = (frame[:, ::_STEP].astype(np.float32) for frame in (one, other))
    factor = np.clip(np.vdot(before, after) / max(float(np.vdot(before, before)), 1.0), 1 - _FLICKER, 1 + _FLICKER)
    down, across = after - factor * before, other[::_STEP] - factor * one[::_STEP]
    correlated = [float(np.mean(part[_LAG_PX:] * part[:-_LAG_PX])) for part in (down, across.T) if len(part) > _LAG_PX]
    return float(np.mean(down * down)), max(correlated, default=0.0)


def find_runs(changes: FloatArray) -> tuple[list[tuple[int, int]], str]:
    """Return first and last + 1 frame of each image, and in words how they were found.

    changes : (n - 1, 2) of consecutive frames: mean square of their difference, and the part of it that is correlated
    over some pixels. Noise is not correlated; a change of patterns is, along the stripes. Flicker and compression are,
    too, but little next to a change.
    """
    count = len(changes) + 1
    energy, correlated = changes.T
    change = float(np.quantile(correlated, 0.9)) if count > 1 else 0.0
    is_equal = correlated <= np.maximum(_MAX_NOISE_SHARE * energy, _MAX_EQUAL_SHARE * change)
    edges = [0, *(np.flatnonzero(~is_equal) + 1).tolist(), count]
    runs = list(pairwise(edges))
    held = [stop - start for start, stop in runs if stop - start > 1]
    if sum(held) < _MIN_HELD_SHARE * count or len(held) < 2:
        return [(frame, frame + 1) for frame in range(count)], "each an image"
    usual = float(np.median(held))
    is_run = [stop - start >= max(2.0, _MIN_RUN_SHARE * usual) for start, stop in runs]
    kept = [run for run, is_one in zip(runs, is_run, strict=True) if is_one]
    words = []
    gap = float(np.median([after[0] - run[1] for run, after in pairwise(kept)] or [0]))
    images: list[tuple[int, int]] = []
    for start, stop in kept:
        repeats = round((stop - start + gap) / (usual + gap))
        if (start, stop) in (kept[0], kept[-1]) or repeats < 2 or stop - start < max(3.0, usual) * _MIN_REPEATS:
            images.append((start, stop))
            continue
        bounds = np.linspace(start, stop, repeats + 1).round().astype(int).tolist()
        images += pairwise(bounds)
        words.append(f"frames {start} to {stop - 1} taken as {repeats} images that look alike")
    left_out = sum(stop - start for (start, stop), is_one in zip(runs, is_run, strict=True) if not is_one)
    summary = f"{len(images)} images of about {usual:.0f} equal frames each, their mean taken"
    changing = f"{left_out} frames of changes left out" if left_out else ""
    return images, "; ".join(filter(None, (summary, changing, *words)))


def _used_frames(start: int, stop: int) -> tuple[int, int]:
    """Return the frames of a run that are averaged: not those at its ends, which may hold some of a change."""
    trim = min(1, (stop - start - 1) // 2)
    return start + trim, stop - trim


def _means(
    path: Path, used: Sequence[tuple[int, int]], frame: NDArray[Any], *, is_grey: bool
) -> Sequence[NDArray[Any]]:
    """Return the mean of each of these runs of frames, uint16 if any has several, in a temporary file."""
    several = any(stop - start > 1 for start, stop in used)
    scale = 257.0 if several and frame.dtype == np.uint8 else 1.0
    shape = (len(used), *(frame.shape[:2] if is_grey else frame.shape))
    with tempfile.TemporaryFile() as spool:
        means = np.memmap(spool, dtype=np.uint16 if several else frame.dtype, shape=shape)
    rest = iter(enumerate(used))
    number, (start, stop) = next(rest)
    total = np.zeros(shape[1:])
    for index, each in enumerate(_frames(path)):
        if index < start:
            continue
        total += each[..., 0] if is_grey and each.ndim == 3 else each
        if index + 1 == stop:
            means[number] = np.rint(total * (scale / (stop - start)))
            total[:] = 0
            number, (start, stop) = next(rest, (0, (MAX_FRAMES, MAX_FRAMES)))
    return list(means)
