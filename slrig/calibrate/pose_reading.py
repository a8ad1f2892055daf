"""One pose of a calibration board, read from its frames: corners in every camera, the projector's light on the board,
and figures that tell how well each camera saw it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.bundle import read_capture
from slrig.calibrate.pose_frames import PoseFrames, coded_axes, cut_capture, pose_frames, window_about
from slrig.calibrate.pose_movement import differ, moved_px
from slrig.calibrate.solving import ReadPose
from slrig.calibration import COLUMN, ROW, Board, BoardView, Correspondences, PoseObservation, ViewQuality
from slrig.calibration.detection import board_mask, find_board, interior_mask, measure_blur_px, paper_mask
from slrig.errors import PatternError, PoseRefusedError
from slrig.model import Axis, Capture, Size
from slrig.patterns import MIN_BORDER_DISTANCE_PX, cell_positions, edge_positions, index_of_word, line_positions
from slrig.reconstruction import (
    AxisFrames,
    CodeTables,
    CorrespondenceLimits,
    ProjectorPositions,
    axis_frames,
    has_phase,
    projector_positions,
)

MOST_LIGHT = 30_000
"""Correspondences kept of one camera and axis. A pixel is drawn the more likely, the more it tells (1/σ²). Of pixels
known five times less well than enough others none is: black ink adds a hundredth to what paper tells, and a camera's
stray light displaces its positions most.
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
        The frames are no sound capture.
    """
    return read_captured(read_capture(folder), board, name)


def read_captured(capture: Capture, board: Board, name: str) -> ReadPose:
    """Read one pose from its frames.

    A camera that does not see the board is left out, as long as another one does. A camera that was shown no codes, or
    all of whose light on the board is unreadable while another camera's is not, has corners and no light.

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
        seen = _Seen(camera, view, frames, board, full_scale)
        found = seen.light(capture, axes, name)
        views[camera], figures[camera] = view, seen.figures(found)
        if found and all(len(each.position_px) >= _FEWEST_LIGHT for each in found):
            light[camera] = _joined(found)
        elif found:
            unread.append(f"camera '{camera}': {seen.unread(found)}")
    if not views:
        message = f"pose '{name}': no camera sees the board. {'; '.join(unseen)}"
        raise PoseRefusedError(message)
    if unread and not light:
        message = f"pose '{name}': the projector's codes cannot be read on the board. {'; '.join(unread)}"
        raise PoseRefusedError(message)
    return ReadPose(PoseObservation(name, views, light), figures)


class _Seen:
    """The board in one camera, and what the frames tell of it."""

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
        told = self.blur_px if np.isfinite(self.blur_px) else _USUAL_BLUR_PX
        self._used_blur_px = float(np.clip(told, _USUAL_BLUR_PX, _MOST_BLUR_PX))

    def light(self, capture: Capture, axes: tuple[Axis, ...], name: str) -> tuple[ProjectorPositions, ...]:
        """The light on the board along each axis, in the whole camera's pixels; lit and decoded are of the board's."""
        if not axes or not self.region.any():
            return ()
        window = window_about(self.region, _ROUND_PX)
        cut = cut_capture(capture, self._camera, window)
        region = self.region[window]
        from_border = self._used_blur_px * 2 + _FROM_BORDER_PX
        distance = cv2.distanceTransform(np.pad(region, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1]
        asked = (distance > from_border) & ~self._frames.clipped[window]
        found = []
        for axis in axes:
            try:
                frames = axis_frames(cut, self._camera, axis)
            except PatternError as error:
                message = f"pose '{name}': {error}"
                raise PatternError(message) from error
            seen = projector_positions(
                frames, code_tables(frames, capture.projector), asked, CorrespondenceLimits(),
                camera_blur_px=self._used_blur_px,
            )  # fmt: skip
            offset = np.array([window[1].start, window[0].start], dtype=np.float64)
            found.append(
                replace(seen, pixels_px=seen.pixels_px + offset, lit=seen.lit & region, decoded=seen.decoded & region)
            )
        return tuple(found)

    def figures(self, light: tuple[ProjectorPositions, ...]) -> ViewQuality:
        """How well the camera saw the board."""
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
        """Why there is no light, and what to do."""
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
    """What the patterns of one axis mean on this projector; what lies near its border is left out of them."""
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
