"""Acceptance of one pose of the board, with reasons and remedies, and images of poses and coverage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardView, PoseObservation, ViewQuality
from slrig.calibration.poses.guidance import (
    MAX_FOCAL_SIGMA,
    Advice,
    Attitude,
    Coverage,
    DeviceCoverage,
    advise_pose,
    attitude,
    coverage,
)
from slrig.calibration.poses.initial import RigEstimate, estimate_rig, is_in_image
from slrig.calibration.solution import CELLS, PROJECTOR, device_title
from slrig.errors import CalibrationError
from slrig.model import FloatArray, Pixels, Size

RgbImage = NDArray[np.uint8]
"""(H, W, 3) uint8: red, green, blue."""

WIDTH_PX = 640
_PAPER = (250, 250, 248)
_LINE = (205, 205, 200)
_INK = (40, 44, 52)
_UNREACHABLE = (232, 230, 226)
_COVERED = ((224, 240, 226), (36, 128, 84))
_ACCENT = (230, 120, 0)
_MAX_SHADED_POSES = 6
_MAX_DARK_SUM = 330
_MAX_POINTS = 250


def draw_coverage(
    covered: DeviceCoverage, points_px: Sequence[FloatArray], size: Size, *, outline_px: FloatArray | None = None
) -> RgbImage:
    """Draw the image's cells, darker with the number of poses, and the corners of every pose in its own colour.

    points_px : by pose, (n, 2). outline_px : (4, 2), target of the next pose, drawn as a frame with its corner 0
    marked.
    """
    width_px, height_px = _scaled_extent(size, WIDTH_PX)
    picture, scale = np.full((height_px, width_px, 3), _PAPER, dtype=np.uint8), width_px / size.width_px
    for row, column, box in _cell_boxes(picture):
        colour: tuple[int, ...] = _PAPER if covered.reachable[row, column] else _UNREACHABLE
        if covered.cells[row, column]:
            fraction = min(int(covered.cells[row, column]), _MAX_SHADED_POSES) / _MAX_SHADED_POSES
            colour = tuple(round(a + (b - a) * fraction) for a, b in zip(*_COVERED, strict=True))
        cv2.rectangle(picture, *box, colour, -1)
    for _, _, (start, end) in _cell_boxes(picture):
        cv2.rectangle(picture, start, (end[0] + 1, end[1] + 1), _LINE, 1)
    for row, column, (corner, _) in _cell_boxes(picture):
        # Light on dark cells.
        position = (corner[0] + 4, corner[1] + 13)
        background = picture[max(position[1] - 6, 0), min(position[0], picture.shape[1] - 1)]
        colour = _PAPER if int(background.sum()) < _MAX_DARK_SUM else _INK
        label = str(int(covered.cells[row, column]))
        cv2.putText(picture, label, position, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
    for index, points in enumerate(points_px):
        colour = _pose_colour(index)
        visible_px = points[is_in_image(points, size)]
        for point in _scale_points(visible_px[:: 1 + len(visible_px) // _MAX_POINTS], scale):
            cv2.circle(picture, point, 2, colour, -1, cv2.LINE_AA)
    if outline_px is not None and len(outline_px):
        corners = _scale_points(outline_px, scale)
        cv2.polylines(picture, [np.array(corners)], True, _ACCENT, 2, cv2.LINE_AA)
        cv2.circle(picture, corners[0], 6, _ACCENT, -1, cv2.LINE_AA)
    return picture


def draw_pose(image: Pixels, view: BoardView | None, board: Board, *, width_px: int = WIDTH_PX) -> RgbImage:
    """Draw a camera's frame with the corners found: one colour per row, corner 0 in a ring.

    image : (H, W) or (H, W, 3) blue, green, red, of 8 or 16 bit, stretched so that its brightest percent is white.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    size = Size(grey.shape[1], grey.shape[0])
    scale = width_px / size.width_px
    small = cv2.resize(grey, _scaled_extent(size, width_px), interpolation=cv2.INTER_AREA).astype(np.float64)
    white = max(1.0, float(np.percentile(small, 99)))
    stretched = np.clip(small * (235 / white), 0, 255).astype(np.uint8)
    picture = np.ascontiguousarray(np.repeat(stretched[:, :, None], 3, axis=2))
    if view is None or not len(view.corner):
        return picture
    row, points = view.corner // board.columns, _scale_points(view.points_px, scale)
    for index, point in enumerate(points):
        colour = _pose_colour(int(row[index]))
        if index and row[index] == row[index - 1]:
            cv2.line(picture, points[index - 1], point, colour, 1, cv2.LINE_AA)
        cv2.circle(picture, point, 3, colour, 1, cv2.LINE_AA)
    if view.corner[0] == 0:
        cv2.circle(picture, points[0], 8, _ACCENT, 2, cv2.LINE_AA)
    return picture


def _scaled_extent(size: Size, width_px: int) -> tuple[int, int]:
    return width_px, max(1, round(size.height_px * width_px / size.width_px))


def _cell_boxes(picture: RgbImage) -> list[tuple[int, int, tuple[tuple[int, int], tuple[int, int]]]]:
    """Return row, column and two opposite corners, (x, y), of every cell."""
    down = np.linspace(0, picture.shape[0], CELLS + 1).round().astype(int).tolist()
    across = np.linspace(0, picture.shape[1], CELLS + 1).round().astype(int).tolist()
    return [
        (row, column, ((across[column], down[row]), (across[column + 1] - 1, down[row + 1] - 1)))
        for row in range(CELLS)
        for column in range(CELLS)
    ]


def _scale_points(points_px: FloatArray, scale: float) -> list[tuple[int, int]]:
    """Scale pixel coordinates; pixel centres are at whole numbers."""
    scaled = ((points_px + 0.5) * scale - 0.5) if scale != 1.0 else points_px
    return [(round(float(x)), round(float(y))) for x, y in scaled]


def _pose_colour(index: int) -> tuple[int, int, int]:
    """Colour of a pose or row: hues a golden angle apart, so that neighbours differ."""
    hue = np.array([[[round(index * 137.5) % 360 / 2, 200, 190]]], dtype=np.uint8)
    red, green, blue = cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0].tolist()
    return red, green, blue


@dataclass(frozen=True, slots=True)
class PoseLimits:
    """Limits of a pose as pairs (warn, refuse); the values are our own.

    moved_px : beyond the noise of a board at rest, chosen so that a movement towards the camera leaves the numbers of a
    solve within their uncertainty. sharpness_px, and blur_squares : blur of the edges, in pixels and in squares; above
    a fifth of a square, neighbouring edges overlap. incidence_deg : at 60° the board is foreshortened by half, and a
    corner is as blurred as it is wide. filled : fraction of the image inside the board's corners. corners : fraction of
    the board's corners. displacement : rms, of the corners from an earlier pose over the image's diagonal. parallel_deg
    : between the boards' normals.
    """

    moved_px: tuple[float, float] = (0.04, 0.2)
    saturated: tuple[float, float] = (0.005, 0.05)
    contrast: tuple[float, float] = (0.2, 0.08)
    sharpness_px: tuple[float, float] = (1.6, 3.0)
    blur_squares: tuple[float, float] = (0.12, 0.2)
    decoded: tuple[float, float] = (0.4, 0.2)
    corners: tuple[float, float] = (0.5, 0.2)
    min_corners: int = 12
    filled: tuple[float, float] = (0.05, 0.02)
    incidence_deg: tuple[float, float] = (52.0, 60.0)
    displacement: tuple[float, float] = (0.02, 0.006)
    parallel_deg: float = 5.0


LIMITS = PoseLimits()


@dataclass(frozen=True, slots=True)
class PoseAssessment:
    """Result of the checks of one pose.

    refusals, warnings : sentences with cause and remedy; a pose without refusals is accepted. corners_found, filled
    (fraction of the image), tilt_deg (between the board's normal and the line of sight), distance_mm (NaN while the
    focal length is unknown), sharpness_px, saturated, moved_px : by camera, NaN where not measured. coverage, advice :
    of all accepted poses, this one included if it is accepted.
    """

    name: str
    accepted: bool
    refusals: tuple[str, ...]
    warnings: tuple[str, ...]
    corners_found: Mapping[str, int]
    corners_expected: int
    filled: Mapping[str, float]
    tilt_deg: Mapping[str, float]
    distance_mm: Mapping[str, float]
    sharpness_px: Mapping[str, float]
    saturated: Mapping[str, float]
    moved_px: Mapping[str, float]
    coverage: Coverage
    advice: Advice


def check_pose(
    pose: PoseObservation, quality: Mapping[str, ViewQuality], earlier: Sequence[PoseObservation], board: Board,
    sizes: Mapping[str, Size],
) -> PoseAssessment:  # fmt: skip
    """Check one pose.

    quality : by camera, of this pose. earlier : the accepted poses before. sizes : cameras by name, and PROJECTOR where
    one is calibrated.
    """
    rig = estimate_rig([*earlier, pose], board, sizes)
    views = {name: view for name, view in pose.views.items() if len(view.corner)}
    attitudes = {name: _known_attitude(rig, name, pose, board) for name in views}
    incidence_deg = {
        name: _foreshortening_deg(views[name], board) if each is None else each.incidence_deg
        for name, each in attitudes.items()
    }
    checker = _PoseChecker(pose, board, [], [])
    for camera in (name for name in sizes if name != PROJECTOR):
        if camera in views:
            checker.check_view(camera, views[camera], sizes[camera], incidence_deg[camera])
            if camera in quality:
                checker.check_quality(camera, quality[camera], views[camera])
        elif len(pose.views) > (camera in pose.views):
            checker.warn(camera, "does not see the board", "a pose that all cameras see also connects them")
    if not views:
        checker.refusals.append("no camera sees the board: move it into the image, and shoot again")
    if PROJECTOR in sizes and not pose.correspondences:
        checker.refusals.append(
            "no light of the projector was decoded on the board: move it into the projector's light, dim the room's "
            "light, and shoot again"
        )
    checker.check_displacement(earlier, sizes)
    checker.check_parallel(rig, earlier)
    accepted = not checker.refusals
    accepted_poses = [*earlier, pose] if accepted else list(earlier)
    if not accepted:
        rig = estimate_rig(accepted_poses, board, sizes)
    covered = coverage(accepted_poses, board, sizes, rig=rig)

    def by_camera(field: str) -> dict[str, float]:
        return {name: getattr(quality[name], field) if name in quality else np.nan for name in views}

    return PoseAssessment(
        name=pose.name,
        accepted=accepted,
        refusals=tuple(checker.refusals),
        warnings=tuple(checker.warnings),
        corners_found={name: len(view.corner) for name, view in pose.views.items()},
        corners_expected=board.corner_count,
        filled={name: _hull_fraction(view.points_px, sizes[name]) for name, view in views.items()},
        tilt_deg=incidence_deg,
        distance_mm={name: np.nan if each is None else each.distance_mm for name, each in attitudes.items()},
        sharpness_px=by_camera("sharpness_px"),
        saturated=by_camera("saturated"),
        moved_px=by_camera("moved_px"),
        coverage=covered,
        advice=advise_pose(accepted_poses, board, sizes, rig=rig, covered=covered),
    )


def check_same_devices(capture: str, found: Mapping[str, Size], expected: Mapping[str, Size]) -> None:
    """Raise CalibrationError if a capture has other cameras than expected, or devices of another size.

    capture : its name. found, expected : its devices, and those of the earlier poses; PROJECTOR if there is one.
    """
    faults = [
        f"expected {size} pixels of {device_title(name)}, found {found[name]}"
        for name, size in expected.items()
        if name in found and found[name] != size
    ]
    faults += [f"{device_title(name)} is missing" for name in expected if name not in found]
    faults += [f"{device_title(name)} is not one of the rig's" for name in found if name not in expected]
    if faults:
        message = (
            f"{capture} was captured with another rig: {'; '.join(faults)}. Use poses of one rig only, with the same "
            "cameras, projector and resolutions"
        )
        raise CalibrationError(message)


def _hull_fraction(points_px: FloatArray, size: Size) -> float:
    """Return the fraction of an image inside the convex hull of points."""
    return _hull_area(points_px) / (size.width_px * size.height_px)


def _hull_area(points: FloatArray) -> float:
    return float(cv2.contourArea(cv2.convexHull(points.astype(np.float32)))) if len(points) > 2 else 0.0


@dataclass
class _PoseChecker:
    """Collects refusals and warnings of one pose."""

    pose: PoseObservation
    board: Board
    refusals: list[str]
    warnings: list[str]

    def warn(self, camera: str, finding: str, remedy: str) -> None:
        self.warnings.append(f"camera '{camera}' {finding}: {remedy}")

    def check_limit(self, value: float, limits: tuple[float, float], camera: str, finding: str, remedy: str) -> None:
        """Warn or refuse if a value exceeds its limit; the order of the pair gives the direction."""
        warn, refuse = limits
        side = 1 if refuse >= warn else -1
        if side * value > side * refuse:
            self.refusals.append(f"camera '{camera}' {finding}: {remedy}")
        elif side * value > side * warn:
            self.warn(camera, finding, remedy)

    def check_view(self, camera: str, view: BoardView, size: Size, incidence_deg: float) -> None:
        limits, count, total = LIMITS, len(view.corner), self.board.corner_count
        finding = f"sees {count} of the board's {total} corners"
        if count < min(limits.min_corners, total):
            self.refusals.append(f"camera '{camera}' {finding}, too few: show more of the board")
        else:
            self.check_limit(count / total, limits.corners, camera, finding, "show more of the board")
        fraction = _hull_fraction(view.points_px, size) * total / max(count, 1)
        finding = f"sees the board small, on {fraction:.1%} of its image"
        self.check_limit(fraction, limits.filled, camera, finding, "bring it nearer")
        self.check_limit(
            incidence_deg, limits.incidence_deg, camera,
            f"sees the board too steeply, {incidence_deg:.0f}° from facing it",
            f"tilt it back to 15–45°, at most {limits.incidence_deg[1]:.0f}°",
        )  # fmt: skip

    def check_quality(self, camera: str, quality: ViewQuality, view: BoardView) -> None:
        limits, blur_px, moved_px = LIMITS, quality.sharpness_px, quality.moved_px
        remedy = f"at most {limits.moved_px[1]:g} px: rest the board on something, release it, and shoot again"
        finding = f"saw the board move by {moved_px:.2g} px while the pose was shot"
        if np.isinf(moved_px):
            # A frame with late light shows two patterns at once, and no board is found in it.
            finding = "saw the board in the first frame and not in a later one, where it moved or the light came late"
            remedy = "rest the board on something, release it, and shoot again; slrig doctor measures the light"
        self.check_limit(moved_px, limits.moved_px, camera, finding, remedy)
        self.check_limit(
            quality.saturated, limits.saturated, camera, f"has {quality.saturated:.1%} of the board's pixels saturated",
            "expose for a shorter time, close the aperture, or tilt the board out of the reflection",
        )  # fmt: skip
        self.check_limit(
            quality.contrast, limits.contrast, camera,
            f"sees too little light on the board, {quality.contrast:.0%} of full scale on its white squares",
            "expose for a longer time, dim the room's light, or move the board into the projector's light",
        )  # fmt: skip
        square_px = self._square_px(view)
        # The stricter of both limits counts, in pixels and in squares.
        warn, refuse = np.fmin(limits.sharpness_px, np.array(limits.blur_squares) * square_px).tolist()
        self.check_limit(
            blur_px, (warn, refuse), camera,
            f"sees the board too blurred, {blur_px:.1f} px across an edge with squares of {square_px:.0f} px",
            "bring it nearer to where the lens is focused, or focus the camera",
        )  # fmt: skip
        self.check_limit(
            quality.decoded, limits.decoded, camera, f"decoded light on only {quality.decoded:.0%} of the lit board",
            "light it more evenly, dim the room's light, focus the projector on it, or tilt it out of a reflection",
        )  # fmt: skip

    def check_displacement(self, earlier: Sequence[PoseObservation], sizes: Mapping[str, Size]) -> None:
        """Refuse a pose in which the cameras see the board at its position in one earlier pose."""
        for other in earlier:
            displacements = [
                _relative_displacement(view, other.views[camera], sizes[camera])
                for camera, view in self.pose.views.items()
                if camera in other.views
            ]
            greatest = max((each for each in displacements if each is not None), default=np.inf)
            if greatest <= LIMITS.displacement[1]:
                self.refusals.append(
                    f"the pose adds nothing: it is the same as {other.name}. Move the board, and shoot"
                )
                return
            if greatest <= LIMITS.displacement[0]:
                self.warnings.append(
                    f"the pose adds little: it is nearly the same as {other.name}; move the board more"
                )
                return

    def check_parallel(self, rig: RigEstimate, earlier: Sequence[PoseObservation]) -> None:
        """Warn of a board parallel to all earlier ones: such poses do not determine the focal length."""
        for name, device in rig.devices.items():
            others = [device.poses[each.name] for each in earlier if each.name in device.poses]
            if name == PROJECTOR or self.pose.name not in device.poses or not others:
                continue
            normal = device.poses[self.pose.name].rotation[:, 2]
            angles = [np.degrees(np.arccos(min(1.0, abs(float(normal @ each.rotation[:, 2]))))) for each in others]
            which = f"all {len(others)} earlier poses" if len(others) > 1 else "the earlier pose"
            if max(angles) < LIMITS.parallel_deg:
                self.warn(
                    name, f"sees the board parallel to {which}, within {max(angles):.0f}°",
                    "parallel poses alone do not determine the lens, and no solve uses them alone; tilt it by 30°",
                )  # fmt: skip
                return

    def _square_px(self, view: BoardView) -> float:
        """Return the side of a square in the image, px, from the areas that the corners span on the board and in the
        image.
        """
        area_mm, area_px = _hull_area(self.board.points_mm[view.corner, :2]), _hull_area(view.points_px)
        return self.board.square_mm * float(np.sqrt(area_px / area_mm)) if area_mm > 0 else float("nan")


def _relative_displacement(view: BoardView, other: BoardView, size: Size) -> float | None:
    """Return the rms displacement of common corners over the image's diagonal, or None where too few are common."""
    common, first, second = np.intersect1d(view.corner, other.corner, return_indices=True)
    if len(common) < 4 or 2 * len(common) < max(len(view.corner), len(other.corner)):
        return None
    displacement_px = view.points_px[first] - other.points_px[second]
    return float(np.sqrt((displacement_px**2).sum(axis=1).mean()) / np.hypot(size.width_px, size.height_px))


def _known_attitude(rig: RigEstimate, camera: str, pose: PoseObservation, board: Board) -> Attitude | None:
    """Return the attitude of the board to a camera; None while the focal length is unknown, or without a pose."""
    device = rig.devices[camera]
    if pose.name not in device.poses or device.focal_sigma > MAX_FOCAL_SIGMA:
        return None
    return attitude(device.poses[pose.name], board.points_mm.mean(axis=0))


def _foreshortening_deg(view: BoardView, board: Board) -> float:
    """Return the angle between the board's normal and the line of sight, degrees, from its foreshortening at its
    centre; NaN where it cannot be determined.
    """
    positions = board.points_mm[view.corner, :2]
    homography = cv2.findHomography(positions, view.points_px)[0] if len(view.corner) >= 4 else None
    if homography is None:
        return float("nan")
    x, y, w = homography @ np.append(positions.mean(axis=0), 1.0)
    affine = (homography[:2, :2] - np.outer([x / w, y / w], homography[2, :2])) / w
    wide, narrow = np.linalg.svd(affine, compute_uv=False)
    return float(np.degrees(np.arccos(min(1.0, narrow / wide))))
