"""One pose of a calibration board, read from its frames: corners in every camera, the projector's light on the board,
and figures of the quality of each camera's view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from slrig.bundle import read_capture, read_description
from slrig.calibrate.store import ReadPose
from slrig.calibration import COLUMN, PROJECTOR, ROW, Board, BoardView, Correspondences, PoseObservation, ViewQuality
from slrig.calibration.detection import board_mask, find_board, interior_mask, measure_blur_px, paper_mask, refine_view
from slrig.calibration.health.drift import estimate_board_poses
from slrig.errors import PatternError, PoseRefusedError, TurntableRefusedError
from slrig.model import (
    Axis,
    Black,
    Calibration,
    Capture,
    FloatArray,
    Gray,
    LineShift,
    Pattern,
    Pixels,
    Shot,
    Size,
    White,
)
from slrig.multiview import MIN_POSES, BoardAxis, axis_from_board
from slrig.patterns import MIN_BORDER_DISTANCE_PX, cell_positions, edge_positions, index_of_word, line_positions
from slrig.reconstruction import (
    AxisFrames,
    CodeTables,
    CorrespondenceLimits,
    ProjectorPositions,
    axis_frames,
    exposure_count,
    has_phase,
    projector_positions,
)

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
Window = tuple[slice, slice]
"""A cut of an image: its rows and its columns."""

_MOST_VIEWS = 6
_SHOOT = "shoot white, black, the Gray bits and their inverses of columns and of rows, with line shift if it is offered"


@dataclass(frozen=True, slots=True)
class PoseFrames:
    """One camera's frames of one pose.

    white : (H, W) float32, mean of its white frames; clipped : (H, W) bool, pixels at full scale in one of them.
    black : (H, W) float32, mean of its black frames, None where there are none.
    views : (H, W) float32 each, frames in which the whole board is lit, in the order in which they were taken: white
    ones, and where inverses were shown the sum of a bit and its inverse, less black.
    """

    white: Image
    clipped: Mask
    black: Image | None
    views: tuple[Image, ...]


def bundle_device_sizes(folder: Path) -> dict[str, Size]:
    """The sizes of the devices that a bundle is of: cameras by name, and PROJECTOR where it played codes.

    From its description alone. `slrig.calibration.poses.checks.check_same_devices` compares those of two poses.
    Raises BundleError.
    """
    description = read_description(folder)
    cameras = {name: form.size for name, form in description.camera_formats().items()}
    coded = any(isinstance(pattern, Gray | LineShift) for pattern in description.pattern_list())
    return {**cameras, PROJECTOR: description.projector_size()} if coded else cameras


def window_about(region: Mask, margin_px: int) -> Window:
    """The box about what is True in an image, and a margin round it."""
    spans = []
    for axis, length in enumerate(region.shape):
        (places,) = np.nonzero(region.any(axis=1 - axis))
        spans.append(slice(max(int(places[0]) - margin_px, 0), min(int(places[-1]) + 1 + margin_px, length)))
    return spans[0], spans[1]


def coded_axes(capture: Capture, camera: str, name: str) -> tuple[Axis, ...]:
    """The axes with codes for a camera: both, or none.

    Raises
    ------
    PoseRefusedError
        One axis only, or there are several exposures.
    """
    shots = [shot for shot in capture.shots if shot.camera == camera]
    if exposure_count([shot.exposure_s for shot in shots]) > 1:
        message = (
            f"pose '{name}', camera '{camera}': expected frames of one exposure, found several; a board needs no "
            "bracket: shoot the pose with one exposure at which its paper is bright and not clipped"
        )
        raise PoseRefusedError(message)
    shown = {capture.patterns[shot.pattern] for shot in shots}
    axes = tuple(axis for axis in Axis if any(isinstance(p, Gray) and p.axis is axis for p in shown))
    if len(axes) == 1:
        (only,) = axes
        other = next(axis for axis in Axis if axis is not only)
        message = (
            f"pose '{name}', camera '{camera}': expected codes of both axes, found those of {only}s alone; a point of "
            f"the projector has a column and a row. Shoot the pose again with the {other} patterns as well: {_SHOOT}"
        )
        raise PoseRefusedError(message)
    return axes


def pose_frames(capture: Capture, camera: str, name: str) -> PoseFrames:
    """Sort out the frames of one camera that show the whole board.

    Raises
    ------
    PoseRefusedError
        The camera has no white frame.
    """
    shots = [shot for shot in capture.shots if shot.camera == camera]
    whites = [shot.image for shot in shots if isinstance(capture.patterns[shot.pattern], White)]
    blacks = [shot.image for shot in shots if isinstance(capture.patterns[shot.pattern], Black)]
    if not whites:
        message = (
            f"pose '{name}': camera '{camera}' has no white frame, and in the others the board is lit in stripes; "
            f"{_SHOOT}"
        )
        raise PoseRefusedError(message)
    full_scale = capture.cameras[camera].full_scale
    clipped = np.any([image >= full_scale for image in whites], axis=0)
    black = _mean(blacks) if blacks else None
    return PoseFrames(_mean(whites), np.asarray(clipped), black, tuple(_views(capture.patterns, shots, black)))


def cut_capture(capture: Capture, camera: str, window: Window) -> Capture:
    """The frames of one camera, cut to a window of its image."""
    form = capture.cameras[camera]
    shots = tuple(replace(shot, image=shot.image[window]) for shot in capture.shots if shot.camera == camera)
    rows, columns = window
    size = Size(columns.stop - columns.start, rows.stop - rows.start)
    return Capture(capture.projector, capture.patterns, {camera: replace(form, size=size)}, shots)


def _views(patterns: tuple[Pattern, ...], shots: list[Shot], black: Image | None) -> list[Image]:
    """At most six evenly chosen frames in which all is lit, the first and the last among them."""
    dark = np.zeros((1, 1), dtype=np.float32) if black is None else black
    waiting: dict[Pattern, Shot] = {}
    lit: list[tuple[Shot, Shot | None]] = []
    for shot in shots:
        pattern = patterns[shot.pattern]
        if isinstance(pattern, White):
            lit.append((shot, None))
        elif isinstance(pattern, Gray) and black is not None:
            inverse = waiting.pop(replace(pattern, inverted=not pattern.inverted), None)
            if inverse is None:
                waiting[pattern] = shot
            else:
                lit.append((shot, inverse))
    chosen = np.unique(np.linspace(0, len(lit) - 1, min(_MOST_VIEWS, len(lit))).round().astype(int))
    return [
        shot.image.astype(np.float32) if other is None else shot.image + other.image.astype(np.float32) - dark
        for shot, other in (lit[index] for index in chosen)
    ]


def _mean(images: list[Pixels]) -> Image:
    return np.asarray(np.mean(images, axis=0, dtype=np.float32), dtype=np.float32)


_LEAST_WINDOW, _MOST_WINDOW = 7, 31
"""Sides of the surroundings of a corner that are followed, px: 0.8 of the way to its neighbour, within these."""
_LEVELS = 2
_CLEAR_PX = 1.0
_ALIKE = 0.9
_LOST_PX = 1e3
_MOVING_FLOW_PX = 0.12
"""The flow of boards at rest comes to half of this."""
_CHANCE = 27.9
"""The χ² of six numbers exceeds this by chance in one of ten thousand cases."""
_LEAST_COMMON = 6
_CHANGED, _CHANGED_SHARE = 0.1, 0.002
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-3)


def moved_px(views: Sequence[Image], view: BoardView, board: Board, region: Mask, full_scale: float, /) -> float:
    """The rms distance, px, of the corners from where the first frame shows them, less the effect of noise on those at
    rest; NaN with one frame only.

    The greatest over the frames, if all are below a pixel; otherwise that of the last frame that is not.

    views : (H, W) float32 each, frames of one pose in which the whole board is lit, in the order of time; region :
    (H, W) bool, the board. Corners are followed by the optical flow of their surroundings (Lucas and Kanade 1981),
    which measures small movements. A larger one may carry a corner to the place of its neighbour, which looks alike; so
    where the flow is large, or the frames differ much, the board is searched again, and `inf` means that it is not
    found.
    """
    if len(views) < 2:
        return float("nan")
    window = window_about(region, _MOST_WINDOW)
    start = view.points_px - np.array([window[1].start, window[0].start])
    board_there = region[window]
    first = _grey(views[0][window], full_scale)
    worst = 0.0
    for each in reversed(views[1:]):
        image = _grey(each[window], full_scale)
        moved = _rms(_flow(first, image, start))
        if not (moved < _CLEAR_PX and _correlation(first, image, board_there) > _ALIKE):
            # Looking for the board takes long; how far it went further on the way matters no more.
            return _apart(views[0], each, board, full_scale)
        worst = max(worst, moved)
    shifts = _as_a_whole(views, view, board, full_scale)
    return max([worst, *shifts]) if worst > _MOVING_FLOW_PX or not shifts else max(shifts)


def _as_a_whole(views: Sequence[Image], view: BoardView, board: Board, full_scale: float) -> list[float]:
    """By how much all corners together moved from the first frame to one in the middle, and to the last, px; without
    frames with too few corners.
    """
    chosen = sorted({0, len(views) // 2, len(views) - 1})
    before, *after = (refine_view(views[at], view, board, full_scale=full_scale) for at in chosen)
    return [moved for each in after if (moved := _moved_together(before, each)) is not None]


def _moved_together(before: BoardView, after: BoardView) -> float | None:
    """The rms of the affine displacement between two views, px, by as much as it exceeds chance, else 0; None if
    they have too few corners in common.
    """
    _, mine, its = np.intersect1d(before.corner, after.corner, return_indices=True)
    if len(mine) < _LEAST_COMMON:
        return None
    variance = before.sigma_px[mine] ** 2 + after.sigma_px[its] ** 2
    off, place = after.points_px[its] - before.points_px[mine], before.points_px[mine]
    terms = np.column_stack([np.ones(len(place)), place - place.mean(axis=0)])
    weight = 1 / np.sqrt(variance)[:, None]
    moved = terms @ np.linalg.lstsq(terms * weight, off * weight, rcond=None)[0]
    square = np.sum(moved**2, axis=1)
    exceeds = float(np.sum(square / variance)) / _CHANCE
    return float(np.sqrt(np.mean(square) * (1 - 1 / exceeds))) if exceeds > 1 else 0.0


def differ(first: Image, last: Image, full_scale: float, /) -> bool:
    """Whether two fully lit frames differ somewhere."""
    changed = np.abs(last - first) > _CHANGED * full_scale
    return float(np.mean(changed)) > _CHANGED_SHARE


def _apart(first: Image, image: Image, board: Board, full_scale: float) -> float:
    """Movement of the board from one frame to another, found in both: `view` may be of a mean of the two."""
    try:
        before, after = (find_board(each, board, full_scale=full_scale) for each in (first, image))
    except PoseRefusedError:
        return float("inf")
    _, mine, its = np.intersect1d(before.corner, after.corner, return_indices=True)
    return _rms(after.points_px[its] - before.points_px[mine]) if len(mine) else float("inf")


def _flow(first: NDArray[np.uint8], image: NDArray[np.uint8], start: FloatArray) -> FloatArray:
    """(n, 2) float64: by how much the surroundings of each corner moved; far off where they were lost."""
    to_neighbour_px = float(np.median(cKDTree(start).query(start, k=[2])[0]))
    side = int(np.clip(0.8 * to_neighbour_px, _LEAST_WINDOW, _MOST_WINDOW)) | 1
    given = start.astype(np.float32).reshape(-1, 1, 2)
    followed, status, _ = cv2.calcOpticalFlowPyrLK(
        first, image, given, given.copy(), winSize=(side, side), maxLevel=_LEVELS, criteria=_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    moved = (followed - given).reshape(-1, 2).astype(np.float64)
    moved[status.ravel() == 0] = _LOST_PX
    return np.asarray(moved)


def _correlation(first: NDArray[np.uint8], image: NDArray[np.uint8], where: Mask) -> float:
    """Correlation of two pictures of the board, 1 if only brightness and contrast differ."""
    a, b = first[where].astype(np.float64), image[where].astype(np.float64)
    spread = float(a.std() * b.std())
    return float(np.mean((a - a.mean()) * (b - b.mean())) / spread) if spread > 0 else 0.0


def _grey(image: Image, full_scale: float) -> NDArray[np.uint8]:
    return np.asarray(np.clip(image * (255.0 / full_scale), 0, 255), dtype=np.uint8)


def _rms(moved: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))


MOST_LIGHT = 30_000
"""Correspondences kept of one camera and axis. The probability of a pixel is proportional to its weight (1/σ²). Pixels
with five times the σ of enough others are not drawn: black ink adds a hundredth to the information of paper, and a
camera's stray light displaces its positions most.
"""

_ENOUGH_LIGHT = 5_000
_WORSE = 5.0
_USUAL_BLUR_PX = 0.65
_MOST_BLUR_PX = 4.0
_FROM_BORDER_PX = 2.0
_ROUND_PX = 8
_FEWEST_LIGHT = 100


def read_pose(folder: Path, board: Board, name: str) -> ReadPose:
    """Read one pose from a scan bundle.

    Raises
    ------
    PoseRefusedError
        As `read_captured` does.
    PatternError, BundleError
        The frames are not a sound capture.
    """
    return read_captured(read_capture(folder), board, name)


def read_captured(capture: Capture, board: Board, name: str) -> ReadPose:
    """Read one pose from its frames.

    A camera that does not see the board is left out, as long as another one does. A camera without codes, or with
    unreadable light on all of the board while another camera's is readable, has corners and no light.

    Raises
    ------
    PoseRefusedError
        No camera sees the board; it moved so far that it is not the same place in the last frame; codes of one axis
        only; the codes were shown and no camera can read them on the board. The message names the cameras, the causes
        and what to do.
    PatternError
        Frames of a code are missing.
    """
    views: dict[str, BoardView] = {}
    figures: dict[str, ViewQuality] = {}
    light: dict[str, Correspondences] = {}
    unseen: list[str] = []
    unread: list[str] = []
    for camera in capture.cameras:
        axes = coded_axes(capture, camera, name)
        frames = pose_frames(capture, camera, name)
        full_scale = float(capture.cameras[camera].full_scale)
        try:
            view = find_board(frames.white, board, full_scale=full_scale)
        except PoseRefusedError as cause:
            unseen.append(f"camera '{camera}': {_still_or(cause, frames, board, full_scale)}")
            continue
        observed = _BoardObservation(camera, view, frames, board, full_scale)
        found = observed.light(capture, axes, name)
        views[camera], figures[camera] = view, observed.figures(found)
        if found and all(len(each.position_px) >= _FEWEST_LIGHT for each in found):
            light[camera] = _joined(found)
        elif found:
            unread.append(f"camera '{camera}': {observed.unread(found)}")
    if not views:
        message = f"pose '{name}': no camera sees the board. {'; '.join(unseen)}"
        raise PoseRefusedError(message)
    if unread and not light:
        message = f"pose '{name}': the projector's codes cannot be read on the board. {'; '.join(unread)}"
        raise PoseRefusedError(message)
    return ReadPose(PoseObservation(name, views, light), figures)


class _BoardObservation:
    """The board in the frames of one camera."""

    def __init__(self, camera: str, view: BoardView, frames: PoseFrames, board: Board, full_scale: float) -> None:
        self._camera = camera
        self._view = view
        self._frames = frames
        self._board = board
        self._full_scale = full_scale
        shape = frames.clipped.shape
        self._shape = (shape[0], shape[1])
        self.region = board_mask(view, board, self._shape)
        self.blur_px = measure_blur_px(frames.white, view, board, full_scale=full_scale)
        measured = self.blur_px if np.isfinite(self.blur_px) else _USUAL_BLUR_PX
        self._used_blur_px = float(np.clip(measured, _USUAL_BLUR_PX, _MOST_BLUR_PX))

    def light(self, capture: Capture, axes: tuple[Axis, ...], name: str) -> tuple[ProjectorPositions, ...]:
        """The light on the board along each axis, in the whole camera's pixels; lit and decoded are of the board's."""
        if not axes or not self.region.any():
            return ()
        window = window_about(self.region, _ROUND_PX)
        cut = cut_capture(capture, self._camera, window)
        region = self.region[window]
        from_border = self._used_blur_px * 2 + _FROM_BORDER_PX
        distance = cv2.distanceTransform(np.pad(region, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1]
        region_mask = (distance > from_border) & ~self._frames.clipped[window]
        found = []
        for axis in axes:
            try:
                frames = axis_frames(cut, self._camera, axis)
            except PatternError as error:
                message = f"pose '{name}': {error}"
                raise PatternError(message) from error
            read = projector_positions(
                frames, code_tables(frames, capture.projector), region_mask, CorrespondenceLimits(),
                camera_blur_px=self._used_blur_px,
            )  # fmt: skip
            offset = np.array([window[1].start, window[0].start], dtype=np.float64)
            found.append(
                replace(read, pixels_px=read.pixels_px + offset, lit=read.lit & region, decoded=read.decoded & region)
            )
        return tuple(found)

    def figures(self, light: tuple[ProjectorPositions, ...]) -> ViewQuality:
        """Quality of the camera's view of the board."""
        frames = self._frames
        paper = paper_mask(self._view, self._board, self._shape)
        clear = interior_mask(self._view, self._board, self._shape, margin_px=2 * self._used_blur_px)
        bright = paper & clear if (paper & clear).any() else paper
        if frames.black is not None:
            contrast = _median(frames.white[bright] - frames.black[bright])
        else:
            dark = self.region & ~paper & clear
            contrast = _median(frames.white[bright]) - _median(frames.white[dark])
        return ViewQuality(
            moved_px=moved_px(frames.views, self._view, self._board, self.region, self._full_scale),
            saturated=float(frames.clipped[self.region].mean()) if self.region.any() else float("nan"),
            contrast=contrast / self._full_scale,
            sharpness_px=self.blur_px,
            decoded=_decoded(light),
        )

    def unread(self, light: tuple[ProjectorPositions, ...]) -> str:
        """Explain missing projector light, and what to do."""
        clipped = float(self._frames.clipped[self.region].mean())
        lit = float(np.mean([each.lit.sum() for each in light])) / max(int(self.region.sum()), 1)
        if clipped > 0.25:
            return f"{clipped:.0%} of the board is clipped in the white frame; halve the exposure and shoot it again"
        if lit < 0.1:
            return (
                f"the projector lights {lit:.0%} of it; move the board into the projector's picture, open its lens or "
                "raise the exposure, and shoot it again"
            )
        return (
            f"{lit:.0%} of it is lit and {_decoded(light):.0%} of that decoded; focus the projector on the board, "
            "darken the room, do not move the board, and shoot it again"
        )


def code_tables(frames: AxisFrames, projector: Size) -> CodeTables:
    """Code tables of the patterns of one axis on this projector, without the margin at its border."""
    gray, extent_px = frames.gray, projector.along(frames.axis)
    if has_phase(frames):
        position = line_positions(frames.line_patterns, gray, projector)
    else:
        position = edge_positions(gray, projector)
        inside = np.minimum(position, extent_px - 1 - position) >= MIN_BORDER_DISTANCE_PX
        position = np.where(inside, position, np.nan)
    return CodeTables(index_of_word(gray), cell_positions(gray, projector), position)


def _joined(found: tuple[ProjectorPositions, ...]) -> Correspondences:
    """Both axes in one, thinned."""
    parts = []
    for each in found:
        sigma = each.sigma_px
        kept = np.arange(len(sigma))
        if len(kept) > _ENOUGH_LIGHT:
            kept = np.flatnonzero(sigma <= _WORSE * np.partition(sigma, _ENOUGH_LIGHT)[_ENOUGH_LIGHT])
        if len(kept) > MOST_LIGHT:
            # Drawn by chance, and the same every time: a fixed step would walk along with rows or stripes. The least of
            # exponential variates with these rates are a sample without replacement (Efraimidis and Spirakis 2006).
            late = np.random.default_rng(len(kept)).exponential(size=len(kept)) * sigma[kept] ** 2
            kept = kept[np.sort(np.argpartition(late, MOST_LIGHT)[:MOST_LIGHT])]
        axis = np.full(len(kept), COLUMN if each.axis is Axis.COLUMN else ROW, dtype=np.uint8)
        parts.append((each.pixels_px[kept], axis, each.position_px[kept], each.sigma_px[kept]))
    pixels, axes, position, sigma = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Correspondences(pixels, axes, position, sigma)


def _decoded(light: tuple[ProjectorPositions, ...]) -> float:
    """Share of the lit pixels that are decoded along all axes."""
    if not light:
        return float("nan")
    lit = np.logical_and.reduce([each.lit for each in light])
    decoded = np.logical_and.reduce([each.decoded for each in light])
    return float(decoded.sum() / lit.sum()) if lit.any() else 0.0


def _median(values: NDArray[np.float32]) -> float:
    return float(np.median(values)) if values.size else float("nan")


def _still_or(cause: PoseRefusedError, frames: PoseFrames, board: Board, full_scale: float) -> str:
    """The cause for which no board was found, unless it is that the board moved between white frames."""
    if len(frames.views) > 1 and differ(frames.views[0], frames.views[-1], full_scale):
        try:
            find_board(frames.views[0], board, full_scale=full_scale)
        except PoseRefusedError:
            return str(cause)
        return (
            "the board is in the first frame, and not in the mean of all white ones: it moved while the pose was shot; "
            "hold it still, on a stand if there is one, and shoot it again"
        )
    return str(cause)


def axis_of_poses(
    poses: Sequence[PoseObservation],
    board: Board,
    calibration: Calibration,
    angles_deg: Sequence[float] | None = None,
    *,
    refused: Mapping[str, str] | None = None,
) -> BoardAxis:
    """The axis that a board was turned about. angles_deg : stated angles of the turntable, pose by pose.
    refused : the poses that could not be read, and why, for the message of a refusal.

    Raises
    ------
    CalibrationError
        The calibration is of other cameras than saw the board.
    TurntableRefusedError
        As `axis_from_board` does.
    """
    if len(poses) < MIN_POSES and refused:
        name, why = next(iter(refused.items()))
        message = (
            f"the board was read in {len(poses)} of {len(poses) + len(refused)} poses, and an axis takes {MIN_POSES}. "
            f"{name}: {why}"
        )
        raise TurntableRefusedError(message)
    known = estimate_board_poses(poses, board, calibration)
    return axis_from_board(known.names, known.poses, known.covariance, board.points_mm, angles_deg)
