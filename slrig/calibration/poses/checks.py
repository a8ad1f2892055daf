"""Whether a pose of the board can be used, said at once: a bad one is refused with its cause and what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from slrig.calibration.board import Board
from slrig.calibration.observations import BoardView, PoseObservation
from slrig.calibration.poses.coverage import GOALS, Coverage, Goals, coverage, device_title
from slrig.calibration.poses.figures import ViewFigures
from slrig.calibration.poses.next_move import Advice, next_move
from slrig.calibration.poses.rough import RigGuess, rig_guess
from slrig.calibration.solution import PROJECTOR
from slrig.errors import CalibrationError
from slrig.model import FloatArray, Size

_FOCAL_KNOWN = 0.15


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
    pose: PoseObservation,
    figures: Mapping[str, ViewFigures],
    earlier: Sequence[PoseObservation],
    board: Board,
    sizes: Mapping[str, Size],
    *,
    limits: PoseLimits = LIMITS,
    goals: Goals = GOALS,
) -> PoseAnswer:
    """Return the answer to one pose.

    figures : by camera, of this pose. earlier : the poses that were accepted before. sizes : cameras by name, and
    PROJECTOR where one is calibrated.
    """
    cameras = [name for name in sizes if name != PROJECTOR]
    known = rig_guess([*earlier, pose], board, sizes)
    judging = _Judging(pose, board, limits, [], [])
    for camera in cameras:
        view = pose.views.get(camera)
        if view is None or not len(view.corner):
            if len(pose.views) > (camera in pose.views):
                judging.warn(camera, "does not see the board", "a pose that all cameras see also ties them together")
            continue
        judging.view(camera, view, sizes[camera], _steep(known, camera, pose, board))
        if camera in figures:
            judging.figures(camera, figures[camera], view)
    if not any(len(view.corner) for view in pose.views.values()):
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
    covered = coverage(counted, board, sizes, guess=guess, goals=goals)
    seen = {name: view for name, view in pose.views.items() if len(view.corner)}
    nan = float("nan")
    return PoseAnswer(
        pose.name,
        accepted,
        tuple(judging.refusals),
        tuple(judging.warnings),
        {name: len(view.corner) for name, view in pose.views.items()},
        board.corner_count,
        {name: filled(view.points_px, sizes[name]) for name, view in seen.items()},
        {name: _steep(known, name, pose, board) for name in seen},
        {name: _distance(known, name, pose, board) for name in seen},
        {name: figures[name].sharpness_px if name in figures else nan for name in seen},
        {name: figures[name].saturated if name in figures else nan for name in seen},
        {name: figures[name].moved_px if name in figures else nan for name in seen},
        covered,
        next_move(counted, board, sizes, guess=guess, covered=covered, goals=goals),
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


def filled(points_px: FloatArray, size: Size) -> float:
    """Return the share of an image that lies inside the hull of some points."""
    if len(points_px) < 3:
        return 0.0
    hull = cv2.convexHull(points_px.astype(np.float32))
    return float(cv2.contourArea(hull)) / (size.width_px * size.height_px)


@dataclass
class _Judging:
    """Gathers what is wrong with one pose."""

    pose: PoseObservation
    board: Board
    limits: PoseLimits
    refusals: list[str]
    warnings: list[str]

    def warn(self, camera: str, what: str, do: str) -> None:
        self.warnings.append(f"camera '{camera}' {what}: {do}")

    def judge(self, value: float, pair: tuple[float, float], camera: str, what: str, do: str) -> None:
        """Warn or refuse where a value lies past a limit; which side is bad, the order of the pair tells."""
        warn, refuse = pair
        side = 1 if refuse > warn else -1
        if side * value > side * refuse:
            self.refusals.append(f"camera '{camera}' {what}: {do}")
        elif side * value > side * warn:
            self.warn(camera, what, do)

    def view(self, camera: str, view: BoardView, size: Size, steep_deg: float) -> None:
        limits, board = self.limits, self.board
        count, whole = len(view.corner), board.corner_count
        found = f"sees {count} of the board's {whole} corners"
        if count < min(limits.fewest_corners, whole):
            self.refusals.append(f"camera '{camera}' {found}, too few: show more of the board")
        else:
            self.judge(count / whole, limits.corners, camera, found, "show more of the board")
        share = filled(view.points_px, size) * whole / max(count, 1)
        self.judge(
            share, limits.filled, camera, f"sees the board small, on {share:.1%} of its picture", "bring it nearer"
        )
        self.judge(
            steep_deg, limits.steep_deg, camera, f"sees the board too steeply, {steep_deg:.0f}° from facing it",
            f"tilt it back to 15–45°, at most {limits.steep_deg[1]:.0f}°",
        )  # fmt: skip

    def figures(self, camera: str, figures: ViewFigures, view: BoardView) -> None:
        limits, blur_px, moved_px = self.limits, figures.sharpness_px, figures.moved_px
        still = f"at most {limits.moved_px[1]:g} px: rest the board on something, let go of it, and shoot again"
        what = f"saw the board move by {moved_px:.2g} px while the pose was shot"
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
        sharp = self.judge_blur(blur_px, square_px)
        if sharp is not None:
            refuse, what = sharp
            do = "bring it nearer to where the lens is focused, or focus the camera"
            (self.refusals if refuse else self.warnings).append(f"camera '{camera}' {what}: {do}")
        self.judge(
            figures.decoded, limits.decoded, camera, f"decoded light on only {figures.decoded:.0%} of the lit board",
            "light it more evenly, dim the room's light, focus the projector on it, or tilt it out of a reflection",
        )  # fmt: skip

    def judge_blur(self, blur_px: float, square_px: float) -> tuple[bool, str] | None:
        """Return whether a blur is refused, and the words, or None where it does no harm."""
        limits = self.limits
        what = f"sees the board too blurred, {blur_px:.1f} px across an edge with squares of {square_px:.0f} px"
        if blur_px > limits.sharpness_px[1] or blur_px > limits.blur_share[1] * square_px:
            return True, what
        if blur_px > limits.sharpness_px[0] or blur_px > limits.blur_share[0] * square_px:
            return False, what
        return None

    def same(self, earlier: Sequence[PoseObservation], sizes: Mapping[str, Size]) -> None:
        """Refuse a pose in which every camera that can tell sees the board where it was in one earlier pose."""
        for other in earlier:
            shares = []
            for camera, view in self.pose.views.items():
                if camera in other.views:
                    share = _displacement(view, other.views[camera], sizes[camera])
                    if share is not None:
                        shares.append(share)
            if shares and max(shares) <= self.limits.same[1]:
                self.refusals.append(
                    f"the pose adds nothing: it is the same as {other.name}. Move the board, and shoot"
                )
                return
            if shares and max(shares) <= self.limits.same[0]:
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
            if max(angles) < self.limits.parallel_deg:
                self.warn(
                    name, f"sees the board parallel to {which}, within {max(angles):.0f}°",
                    "parallel poses alone do not determine the lens, and none is solved from them; tilt it by 30°",
                )  # fmt: skip
                return

    def _square_px(self, view: BoardView) -> float:
        """Return the side of a square in the picture, px, from the areas that the corners span in both."""
        flat = self.board.points_mm[view.corner, :2].astype(np.float32)
        area_mm = float(cv2.contourArea(cv2.convexHull(flat))) if len(flat) > 2 else 0.0
        area_px = float(cv2.contourArea(cv2.convexHull(view.points_px.astype(np.float32)))) if len(flat) > 2 else 0.0
        return self.board.square_mm * float(np.sqrt(area_px / area_mm)) if area_mm > 0 else float("nan")


def _displacement(view: BoardView, other: BoardView, size: Size) -> float | None:
    """Return the rms displacement of common corners over the picture's diagonal, or None where too few are common."""
    common, here, there = np.intersect1d(view.corner, other.corner, return_indices=True)
    if len(common) < 4 or 2 * len(common) < max(len(view.corner), len(other.corner)):
        return None
    off = view.points_px[here] - other.points_px[there]
    return float(np.sqrt((off**2).sum(axis=1).mean()) / np.hypot(size.width_px, size.height_px))


def _steep(known: RigGuess, camera: str, pose: PoseObservation, board: Board) -> float:
    """Return the angle between the board's normal and the line of sight, degrees; NaN where nothing tells.

    From the guess where it knows the focal length; before, from how much the board is foreshortened at its middle.
    """
    device, view = known.devices[camera], pose.views.get(camera)
    if pose.name in device.poses and device.focal_sigma <= _FOCAL_KNOWN:
        board_pose = device.poses[pose.name]
        centre = board_pose.rotation @ board.points_mm.mean(axis=0) + board_pose.translation_mm
        sight = abs(float(board_pose.rotation[:, 2] @ centre)) / float(np.linalg.norm(centre))
        return float(np.degrees(np.arccos(min(1.0, sight))))
    if view is None or len(view.corner) < 4:
        return float("nan")
    flat = board.points_mm[view.corner, :2]
    plane, _ = cv2.findHomography(flat, view.points_px)
    if plane is None:
        return float("nan")
    x, y, w = plane @ np.append(flat.mean(axis=0), 1.0)
    affine = (plane[:2, :2] - np.outer([x / w, y / w], plane[2, :2])) / w
    wide, narrow = np.linalg.svd(affine, compute_uv=False)
    return float(np.degrees(np.arccos(min(1.0, narrow / wide))))


def _distance(known: RigGuess, camera: str, pose: PoseObservation, board: Board) -> float:
    device = known.devices[camera]
    if pose.name not in device.poses or device.focal_sigma > _FOCAL_KNOWN:
        return float("nan")
    board_pose = device.poses[pose.name]
    return float((board_pose.rotation @ board.points_mm.mean(axis=0) + board_pose.translation_mm)[2])
