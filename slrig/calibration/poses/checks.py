"""Checks of one pose of the board: refused with its cause and cure, or accepted; its picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.calibration.board import Board, BoardView, PoseObservation, ViewFigures
from slrig.calibration.poses.guidance import (
    FOCAL_KNOWN,
    Advice,
    Attitude,
    Coverage,
    DeviceCoverage,
    attitude,
    coverage,
    next_move,
)
from slrig.calibration.poses.initial import RigGuess, rig_guess, within
from slrig.calibration.solution import CELLS, PROJECTOR, device_title
from slrig.errors import CalibrationError
from slrig.model import FloatArray, Pixels, Size

Picture = NDArray[np.uint8]
"""(H, W, 3) uint8: red, green, blue."""

WIDTH_PX = 640
_PAPER = (250, 250, 248)
_LINE = (205, 205, 200)
_INK = (40, 44, 52)
_UNREACHABLE = (232, 230, 226)
_COVERED = ((224, 240, 226), (36, 128, 84))
_ACCENT = (230, 120, 0)
_MANY = 6
_DARK = 330
_MOST_POINTS = 250


def coverage_picture(
    covered: DeviceCoverage,
    points_px: Sequence[FloatArray],
    size: Size,
    *,
    outline_px: FloatArray | None = None,
) -> Picture:
    """Return the image's cells, the darker the more poses cover them, and the corners of every pose in its own colour.

    points_px : by pose, (n, 2). outline_px : (4, 2), where the board should go next, drawn as a frame; its corner 0 is
    marked.
    """
    across, down = _extent(size, WIDTH_PX)
    picture, scale = np.full((down, across, 3), _PAPER, dtype=np.uint8), WIDTH_PX / size.width_px
    for row, column, box in _cell_boxes(picture):
        count = int(covered.cells[row, column])
        if count:
            colour = _between(*_COVERED, min(count, _MANY) / _MANY)
        else:
            colour = _PAPER if covered.reachable[row, column] else _UNREACHABLE
        cv2.rectangle(picture, *box, colour, -1)
    for _, _, (start, end) in _cell_boxes(picture):
        cv2.rectangle(picture, start, (end[0] + 1, end[1] + 1), _LINE, 1)
    for row, column, (corner, _) in _cell_boxes(picture):
        _text(picture, str(int(covered.cells[row, column])), (corner[0] + 4, corner[1] + 13))
    for index, points in enumerate(points_px):
        colour = _pose_colour(index)
        shown = points[within(points, size)]
        for point in _scaled(shown[:: 1 + len(shown) // _MOST_POINTS], scale):
            cv2.circle(picture, point, 2, colour, -1, cv2.LINE_AA)
    if outline_px is not None and len(outline_px):
        corners = _scaled(outline_px, scale)
        cv2.polylines(picture, [np.array(corners)], True, _ACCENT, 2, cv2.LINE_AA)
        cv2.circle(picture, corners[0], 6, _ACCENT, -1, cv2.LINE_AA)
    return picture


def pose_picture(image: Pixels, view: BoardView | None, board: Board, *, width_px: int = WIDTH_PX) -> Picture:
    """Return a camera's frame with the corners that were found: rows in one colour each, corner 0 in a ring.

    image : (H, W) or (H, W, 3) blue, green, red, of 8 or 16 bit, stretched so that its brightest percent is white.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    size = Size(grey.shape[1], grey.shape[0])
    scale = width_px / size.width_px
    small = cv2.resize(grey, _extent(size, width_px), interpolation=cv2.INTER_AREA).astype(np.float64)
    white = max(1.0, float(np.percentile(small, 99)))
    flat = np.clip(small * (235 / white), 0, 255).astype(np.uint8)
    picture = np.ascontiguousarray(np.repeat(flat[:, :, None], 3, axis=2))
    if view is None or not len(view.corner):
        return picture
    row = view.corner // board.columns
    points = _scaled(view.points_px, scale)
    for index, point in enumerate(points):
        colour = _pose_colour(int(row[index]))
        if index and row[index] == row[index - 1]:
            cv2.line(picture, points[index - 1], point, colour, 1, cv2.LINE_AA)
        cv2.circle(picture, point, 3, colour, 1, cv2.LINE_AA)
    if view.corner[0] == 0:
        cv2.circle(picture, points[0], 8, _ACCENT, 2, cv2.LINE_AA)
    return picture


def _extent(size: Size, width_px: int) -> tuple[int, int]:
    return width_px, max(1, round(size.height_px * width_px / size.width_px))


def _cell_boxes(picture: Picture) -> list[tuple[int, int, tuple[tuple[int, int], tuple[int, int]]]]:
    """Return row, column and two opposite corners, (x, y), of every cell."""
    down = np.linspace(0, picture.shape[0], CELLS + 1).round().astype(int).tolist()
    across = np.linspace(0, picture.shape[1], CELLS + 1).round().astype(int).tolist()
    return [
        (row, column, ((across[column], down[row]), (across[column + 1] - 1, down[row + 1] - 1)))
        for row in range(CELLS)
        for column in range(CELLS)
    ]


def _scaled(points_px: FloatArray, scale: float) -> list[tuple[int, int]]:
    """Return pixel coordinates of a sheet, from coordinates whose pixel centres are at whole numbers."""
    placed = ((points_px + 0.5) * scale - 0.5) if scale != 1.0 else points_px
    return [(round(float(x)), round(float(y))) for x, y in placed]


def _between(low: tuple[int, int, int], high: tuple[int, int, int], share: float) -> tuple[int, int, int]:
    red, green, blue = (round(a + (b - a) * share) for a, b in zip(low, high, strict=True))
    return red, green, blue


def _pose_colour(index: int) -> tuple[int, int, int]:
    """A colour per pose or row: hues a golden angle apart, so that neighbours differ."""
    hue = np.array([[[round(index * 137.5) % 360 / 2, 200, 190]]], dtype=np.uint8)
    red, green, blue = cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0].tolist()
    return red, green, blue


def _text(picture: Picture, words: str, place: tuple[int, int]) -> None:
    """Write words, light where the paper under them is dark."""
    under = picture[max(place[1] - 6, 0), min(place[0], picture.shape[1] - 1)]
    colour = _PAPER if int(under.sum()) < _DARK else _INK
    cv2.putText(picture, words, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)


@dataclass(frozen=True, slots=True)
class PoseLimits:
    """Where a pose is warned of, and where it is refused. Pairs are (warn, refuse); all numbers are ours.

    moved_px : beyond what noise makes of a board that stands still. One of a dozen made-up poses, half a metre away,
    that came nearer by 0.14 mm (0.05 px) while it was shot left all numbers of the solve within 2.2 of their
    deviations; 0.5 mm (0.17 px) put one off by 4.2, and the pose did not stand out from the others. Sideways, 0.5 mm
    did no more than 0.14 mm nearer. sharpness_px, and blur_share : the edges' blur, in pixels and over the side of a
    square: past a fifth of a square, the edges of neighbouring squares run together.
    steep_deg : foreshortened by half at 60°, and a corner is then as blurred as it is wide. filled : share of the
    picture inside the board's corners. corners : share of the board's corners. same : rms displacement of the corners
    from an earlier pose over the picture's diagonal. parallel_deg : between the boards' normals.
    """

    moved_px: tuple[float, float] = (0.04, 0.2)
    saturated: tuple[float, float] = (0.005, 0.05)
    contrast: tuple[float, float] = (0.2, 0.08)
    sharpness_px: tuple[float, float] = (1.6, 3.0)
    blur_share: tuple[float, float] = (0.12, 0.2)
    decoded: tuple[float, float] = (0.4, 0.2)
    corners: tuple[float, float] = (0.5, 0.2)
    fewest_corners: int = 12
    filled: tuple[float, float] = (0.05, 0.02)
    steep_deg: tuple[float, float] = (52.0, 60.0)
    same: tuple[float, float] = (0.02, 0.006)
    parallel_deg: float = 5.0


LIMITS = PoseLimits()


@dataclass(frozen=True, slots=True)
class PoseAnswer:
    """What a person is told after a pose.

    refusals, warnings : sentences, each with its cause and what to do; a pose is accepted when nothing refuses it.
    corners_found, filled (share of the picture), tilt_deg (between the board's normal and the line of sight),
    distance_mm (NaN while the focal length is unknown), sharpness_px, saturated, moved_px : by camera, NaN where not
    measured. coverage, advice : of all accepted poses, this one among them if it is accepted.
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


def judge_pose(
    pose: PoseObservation, figures: Mapping[str, ViewFigures], earlier: Sequence[PoseObservation], board: Board,
    sizes: Mapping[str, Size],
) -> PoseAnswer:  # fmt: skip
    """Return the answer to one pose.

    figures : by camera, of this pose. earlier : the poses that were accepted before. sizes : cameras by name, and
    PROJECTOR where one is calibrated.
    """
    known = rig_guess([*earlier, pose], board, sizes)
    seen = {name: view for name, view in pose.views.items() if len(view.corner)}
    stood = {name: _attitude(known, name, pose, board) for name in seen}
    steep = {name: _foreshortened_deg(seen[name], board) if at is None else at.steep_deg for name, at in stood.items()}
    judging = _Judging(pose, board, [], [])
    for camera in (name for name in sizes if name != PROJECTOR):
        if camera in seen:
            judging.view(camera, seen[camera], sizes[camera], steep[camera])
            if camera in figures:
                judging.figures(camera, figures[camera], seen[camera])
        elif len(pose.views) > (camera in pose.views):
            judging.warn(camera, "does not see the board", "a pose that all cameras see also ties them together")
    if not seen:
        judging.refusals.append("no camera sees the board: move it into the picture, and shoot again")
    if PROJECTOR in sizes and not pose.correspondences:
        judging.refusals.append(
            "no light of the projector was decoded on the board: let the projector's picture fall on it, dim the "
            "room's light, and shoot again"
        )
    judging.same(earlier, sizes)
    judging.parallel(known, earlier)
    accepted = not judging.refusals
    counted = [*earlier, pose] if accepted else list(earlier)
    guess = known if accepted else rig_guess(counted, board, sizes)
    covered = coverage(counted, board, sizes, guess=guess)

    def figure(field: str) -> dict[str, float]:
        return {name: getattr(figures[name], field) if name in figures else np.nan for name in seen}

    return PoseAnswer(
        name=pose.name,
        accepted=accepted,
        refusals=tuple(judging.refusals),
        warnings=tuple(judging.warnings),
        corners_found={name: len(view.corner) for name, view in pose.views.items()},
        corners_expected=board.corner_count,
        filled={name: _filled(view.points_px, sizes[name]) for name, view in seen.items()},
        tilt_deg=steep,
        distance_mm={name: np.nan if at is None else at.distance_mm for name, at in stood.items()},
        sharpness_px=figure("sharpness_px"),
        saturated=figure("saturated"),
        moved_px=figure("moved_px"),
        coverage=covered,
        advice=next_move(counted, board, sizes, guess=guess, covered=covered),
    )


def check_same_devices(capture: str, found: Mapping[str, Size], expected: Mapping[str, Size]) -> None:
    """Raise CalibrationError where a capture comes from another rig: other cameras, or devices of another size.

    capture : names it. found, expected : its devices, and those of the poses so far; PROJECTOR where there is one.
    """
    faults = [
        f"{device_title(name)} has {found[name]} pixels, expected {size}"
        for name, size in expected.items()
        if name in found and found[name] != size
    ]
    faults += [f"{device_title(name)} is missing" for name in expected if name not in found]
    faults += [f"{device_title(name)} is not one of the rig's" for name in found if name not in expected]
    if faults:
        message = (
            f"{capture} was captured with another rig: {'; '.join(faults)}. Use poses of one rig only, all with the "
            "same cameras, the same projector and the same resolutions"
        )
        raise CalibrationError(message)


def _filled(points_px: FloatArray, size: Size) -> float:
    """Return the share of an image that lies inside the hull of some points."""
    return _hull_area(points_px) / (size.width_px * size.height_px)


def _hull_area(points: FloatArray) -> float:
    return float(cv2.contourArea(cv2.convexHull(points.astype(np.float32)))) if len(points) > 2 else 0.0


@dataclass
class _Judging:
    """Gathers what is wrong with one pose."""

    pose: PoseObservation
    board: Board
    refusals: list[str]
    warnings: list[str]

    def warn(self, camera: str, what: str, do: str) -> None:
        self.warnings.append(f"camera '{camera}' {what}: {do}")

    def judge(self, value: float, pair: tuple[float, float], camera: str, what: str, do: str) -> None:
        """Warn or refuse where a value lies past a limit; which side is bad, the order of the pair tells."""
        warn, refuse = pair
        side = 1 if refuse >= warn else -1
        if side * value > side * refuse:
            self.refusals.append(f"camera '{camera}' {what}: {do}")
        elif side * value > side * warn:
            self.warn(camera, what, do)

    def view(self, camera: str, view: BoardView, size: Size, steep_deg: float) -> None:
        limits, board = LIMITS, self.board
        count, whole = len(view.corner), board.corner_count
        found = f"sees {count} of the board's {whole} corners"
        if count < min(limits.fewest_corners, whole):
            self.refusals.append(f"camera '{camera}' {found}, too few: show more of the board")
        else:
            self.judge(count / whole, limits.corners, camera, found, "show more of the board")
        share = _filled(view.points_px, size) * whole / max(count, 1)
        self.judge(
            share, limits.filled, camera, f"sees the board small, on {share:.1%} of its picture", "bring it nearer"
        )
        self.judge(
            steep_deg, limits.steep_deg, camera, f"sees the board too steeply, {steep_deg:.0f}° from facing it",
            f"tilt it back to 15–45°, at most {limits.steep_deg[1]:.0f}°",
        )  # fmt: skip

    def figures(self, camera: str, figures: ViewFigures, view: BoardView) -> None:
        limits, blur_px, moved_px = LIMITS, figures.sharpness_px, figures.moved_px
        still = f"at most {limits.moved_px[1]:g} px: rest the board on something, let go of it, and shoot again"
        what = f"saw the board move by {moved_px:.2g} px while the pose was shot"
        if np.isinf(moved_px):
            # A frame of late light shows two patterns at once, and no board.
            what = "saw the board in the first frame and not in a later one, where it moved or the light came late"
            still = "rest the board on something, let go of it, and shoot again; slrig doctor measures the light"
        self.judge(moved_px, limits.moved_px, camera, what, still)
        self.judge(
            figures.saturated, limits.saturated, camera, f"has {figures.saturated:.1%} of the board's pixels saturated",
            "expose for a shorter time, close the aperture, or tilt the board out of the reflection",
        )  # fmt: skip
        self.judge(
            figures.contrast, limits.contrast, camera,
            f"sees too little light on the board, {figures.contrast:.0%} of full scale on its white squares",
            "expose for a longer time, dim the room's light, or move the board into the projector's light",
        )  # fmt: skip
        square_px = self._square_px(view)
        # Both limits hold, that in pixels and that in squares: the stricter one counts.
        warn, refuse = (
            np.fmin(px, share * square_px) for px, share in zip(limits.sharpness_px, limits.blur_share, strict=True)
        )
        self.judge(
            blur_px, (warn, refuse), camera,
            f"sees the board too blurred, {blur_px:.1f} px across an edge with squares of {square_px:.0f} px",
            "bring it nearer to where the lens is focused, or focus the camera",
        )  # fmt: skip
        self.judge(
            figures.decoded, limits.decoded, camera, f"decoded light on only {figures.decoded:.0%} of the lit board",
            "light it more evenly, dim the room's light, focus the projector on it, or tilt it out of a reflection",
        )  # fmt: skip

    def same(self, earlier: Sequence[PoseObservation], sizes: Mapping[str, Size]) -> None:
        """Refuse a pose in which every camera that can tell sees the board where it was in one earlier pose."""
        for other in earlier:
            shares = []
            for camera, view in self.pose.views.items():
                share = _displacement(view, other.views[camera], sizes[camera]) if camera in other.views else None
                if share is not None:
                    shares.append(share)
            if shares and max(shares) <= LIMITS.same[1]:
                self.refusals.append(
                    f"the pose adds nothing: it is the same as {other.name}. Move the board, and shoot"
                )
                return
            if shares and max(shares) <= LIMITS.same[0]:
                self.warnings.append(
                    f"the pose adds little: it is nearly the same as {other.name}; move the board more"
                )
                return

    def parallel(self, known: RigGuess, earlier: Sequence[PoseObservation]) -> None:
        """Warn of a board that stands parallel to all earlier ones: such poses leave the focal length open."""
        for name, device in known.devices.items():
            others = [device.poses[each.name] for each in earlier if each.name in device.poses]
            if name == PROJECTOR or self.pose.name not in device.poses or not others:
                continue
            normal = device.poses[self.pose.name].rotation[:, 2]
            angles = [np.degrees(np.arccos(min(1.0, abs(float(normal @ each.rotation[:, 2]))))) for each in others]
            which = f"all {len(others)} earlier poses" if len(others) > 1 else "the earlier pose"
            if max(angles) < LIMITS.parallel_deg:
                self.warn(
                    name, f"sees the board parallel to {which}, within {max(angles):.0f}°",
                    "parallel poses alone do not determine the lens, and none is solved from them; tilt it by 30°",
                )  # fmt: skip
                return

    def _square_px(self, view: BoardView) -> float:
        """Return the side of a square in the picture, px, from the areas that the corners span in both."""
        area_mm, area_px = _hull_area(self.board.points_mm[view.corner, :2]), _hull_area(view.points_px)
        return self.board.square_mm * float(np.sqrt(area_px / area_mm)) if area_mm > 0 else float("nan")


def _displacement(view: BoardView, other: BoardView, size: Size) -> float | None:
    """Return the rms displacement of common corners over the picture's diagonal, or None where too few are common."""
    common, here, there = np.intersect1d(view.corner, other.corner, return_indices=True)
    if len(common) < 4 or 2 * len(common) < max(len(view.corner), len(other.corner)):
        return None
    off = view.points_px[here] - other.points_px[there]
    return float(np.sqrt((off**2).sum(axis=1).mean()) / np.hypot(size.width_px, size.height_px))


def _attitude(known: RigGuess, camera: str, pose: PoseObservation, board: Board) -> Attitude | None:
    """Return how the board stands before a camera; None while the focal length is not known, or no pose was found."""
    device = known.devices[camera]
    if pose.name not in device.poses or device.focal_sigma > FOCAL_KNOWN:
        return None
    return attitude(device.poses[pose.name], board.points_mm.mean(axis=0))


def _foreshortened_deg(view: BoardView, board: Board) -> float:
    """Return the angle between the board's normal and the line of sight, from how much it is foreshortened at its
    middle, degrees; NaN where nothing tells.
    """
    flat = board.points_mm[view.corner, :2]
    plane = cv2.findHomography(flat, view.points_px)[0] if len(view.corner) >= 4 else None
    if plane is None:
        return float("nan")
    x, y, w = plane @ np.append(flat.mean(axis=0), 1.0)
    affine = (plane[:2, :2] - np.outer([x / w, y / w], plane[2, :2])) / w
    wide, narrow = np.linalg.svd(affine, compute_uv=False)
    return float(np.degrees(np.arccos(min(1.0, narrow / wide))))
