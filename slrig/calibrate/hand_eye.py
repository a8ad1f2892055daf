"""Hand-eye calibration from bundles or scans: the rig's observations, hand_eye.json, and the check against drift."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from slrig.bundle import FreeText, PoseEntry, Strict, json_bytes, read_json_model, write_file
from slrig.calibration import Board, PoseObservation, find_balls, fit_sphere
from slrig.disk import storage_errors
from slrig.errors import CalibrationError, CalibrationNotFoundError, PoseRefusedError, SlrigError
from slrig.model import Calibration, FloatArray
from slrig.scan.artefacts import MESH, decode_mesh_ply

if TYPE_CHECKING:
    from slrig.calibration.hand_eye import HandEye, RobotPoses, TargetPoses

HAND_EYE = "hand_eye.json"
_MAX_BYTES = 2**22
_INDEPENDENT_POINTS = 100
"""Independent errors among the points of a sphere, as assumed: those of neighbours in a scan are alike."""
_MAX_POSES = 300


def _check_covariance(rows: list[list[float]]) -> list[list[float]]:
    square = all(len(row) == len(rows) for row in rows)
    matrix = np.array(rows) if square else np.zeros((0, 0))
    # Turns are small numbers compared with shifts.
    scale = np.sqrt(np.abs(np.diagonal(matrix))) + 1e-300
    if not square or not (np.linalg.eigvalsh(matrix / np.outer(scale, scale)) > -1e-6).all():
        raise ValueError("expected a covariance, square and without negative variances, found another matrix")
    return rows


Covariance = Annotated[
    list[Annotated[list[float], Field(max_length=12)]],
    Field(min_length=6, max_length=12, description="of a small turn (x, y, z, rad) and the translation (mm)"),
    AfterValidator(_check_covariance),
]


class PoseResidual(Strict):
    """Residual of one pose: deviation of the target from its expected pose."""

    name: str
    residual_mm: float
    residual_deg: float | None = Field(description="null of a sphere, which shows no turns")


class NextPose(Strict):
    """The most informative next pose."""

    words: str
    flange: PoseEntry = Field(description="of the flange in the base, mm")
    sigma_mm: float = Field(description="deviation of the rig's place then, along its worst axis")


class HandEyeDocument(Strict):
    """hand_eye.json: pose of the rig on or before a robot. Matrices take points of one frame to another."""

    format: Literal["slrig-hand-eye"] = "slrig-hand-eye"
    version: Literal[1] = 1
    kind: Literal["in-hand", "fixed"] = Field(description="in-hand: the rig is on the flange. fixed: it does not move")
    calibration: str | None = Field(description="the solve of the rig that it belongs to: its frame is the rig's")
    base_frame: FreeText = Field(default="base_link", description="name of the robot's base, for ROS")
    flange_frame: FreeText = Field(default="tool0", description="name of the frame of the robot's poses, for ROS")
    rig: PoseEntry = Field(description="rig to flange (in-hand) or to base (fixed)")
    covariance: Covariance
    inverse: PoseEntry = Field(description="flange or base to rig")
    inverse_covariance: Covariance
    target: PoseEntry = Field(description="board to base (in-hand) or to flange (fixed); of a sphere, its centre")
    joint_covariance: Covariance = Field(
        description="of rig and target together; of a sphere's centre, its place alone"
    )
    robot_sigma_mm: Annotated[float, Field(gt=0)]
    robot_sigma_deg: Annotated[float, Field(gt=0)]
    robot_sigma_estimated: bool = Field(description="from the residuals, and not stated")
    poses: list[PoseResidual] = Field(min_length=4, max_length=_MAX_POSES)
    left_out: dict[str, str] = Field(description="by pose, why it does not count")
    remarks: list[str]
    next_pose: NextPose | None

    @model_validator(mode="after")
    def _of_one_target(self) -> Self:
        sizes = len(self.covariance), len(self.inverse_covariance), len(self.joint_covariance)
        if sizes not in ((6, 6, 12), (6, 6, 9)):
            message = f"expected covariances of 6, 6 and 12 rows (9 by a sphere), found {sizes}"
            raise ValueError(message)
        return self

    def rig_in_base(self, robot_pose: Sequence[Sequence[float]] | None) -> FloatArray:
        """(4, 4): rig to base. robot_pose : of the flange in the base, which a rig on the flange needs.

        Raises CalibrationError if there is none.
        """
        if self.kind == "fixed":
            return np.array(self.rig)
        if robot_pose is None:
            message = (
                "the rig is on the robot's flange, and has a pose in the robot's frame only where the flange's pose is "
                "known: give robot_pose (4 x 4, flange in base, mm) with the scan"
            )
            raise CalibrationError(message)
        return np.asarray(np.array(robot_pose) @ np.array(self.rig))


def hand_eye_document(
    found: HandEye,
    calibration: str | None,
    *,
    base_frame: str = "base_link",
    flange_frame: str = "tool0",
    refused: Mapping[str, str] | None = None,
) -> HandEyeDocument:
    """The document of a solved one. calibration : identifier of the rig's; refused : poses that could not be used."""
    inverse, inverse_covariance = found.inverse
    rows = zip(found.names, found.residual_mm.tolist(), found.residual_deg.tolist(), strict=True)
    move = found.next_move
    return HandEyeDocument(
        kind=found.kind.value, calibration=calibration, base_frame=base_frame, flange_frame=flange_frame,
        rig=found.rig.tolist(), covariance=found.rig_covariance.tolist(), inverse=inverse.tolist(),
        inverse_covariance=inverse_covariance.tolist(), target=found.target.tolist(),
        joint_covariance=found.covariance.tolist(), robot_sigma_mm=found.robot_sigma[0],
        robot_sigma_deg=found.robot_sigma[1], robot_sigma_estimated=found.estimated,
        poses=[
            PoseResidual(name=name, residual_mm=mm, residual_deg=None if np.isnan(deg) else deg)
            for name, mm, deg in rows
        ],
        left_out={**(refused or {}), **found.left_out}, remarks=list(found.remarks),
        next_pose=None if move is None
        else NextPose(words=move.text, flange=move.flange.tolist(), sigma_mm=move.sigma_mm),
    )  # fmt: skip


def hand_eye_of(document: HandEyeDocument) -> HandEye:
    """The result in a document, for `check_hand_eye`."""
    from slrig.calibration.hand_eye import HandEye, HandEyeKind

    return HandEye(
        HandEyeKind(document.kind), np.array(document.rig), np.array(document.target),
        np.array(document.joint_covariance), (document.robot_sigma_mm, document.robot_sigma_deg),
        document.robot_sigma_estimated, tuple(each.name for each in document.poses),
        np.array([each.residual_mm for each in document.poses]),
        np.array([np.nan if each.residual_deg is None else each.residual_deg for each in document.poses]),
    )  # fmt: skip


def write_hand_eye(path: Path, document: HandEyeDocument) -> None:
    """Write hand_eye.json. Raises StorageError."""
    write_file(path, json_bytes(document.model_dump(mode="json")))


def read_hand_eye(path: Path) -> HandEyeDocument:
    """Read hand_eye.json. Raises CalibrationError, with every fault."""
    return read_json_model(path, HandEyeDocument, "hand-eye calibration", max_bytes=_MAX_BYTES, error=CalibrationError)


@dataclass(frozen=True, slots=True)
class ObservedTargets:
    """The rig's observations, in pairs with the robot's poses. refused : by pose, why it could not be used."""

    robot: RobotPoses
    observed: TargetPoses
    refused: Mapping[str, str]


def observe_boards(
    robot: RobotPoses,
    bundles: Mapping[str, Path],
    board: Board,
    calibration: Calibration,
    report: Callable[[float, str], None],
) -> ObservedTargets:
    """The board's poses in bundles of the same names.

    Raises PoseRefusedError if none can be used; CalibrationError: the calibration is of other cameras.
    """
    from slrig.calibrate.pose_reading import read_pose

    def observed(name: str) -> Any:
        return read_pose(bundles[name], board, name).observation

    chosen, poses, refused = _each_read(robot, observed, report)
    return ObservedTargets(robot.select(chosen), _posed(poses, board, calibration), refused)


def observe_spheres(
    robot: RobotPoses, scans: Mapping[str, Path], diameter_mm: float, report: Callable[[float, str], None]
) -> ObservedTargets:
    """The sphere's centres in scans (folders with a mesh.ply) of the same names. Raises PoseRefusedError."""
    from scipy.linalg import block_diag

    from slrig.calibration.hand_eye import TargetPoses

    def centre(name: str) -> tuple[FloatArray, FloatArray]:
        mesh = decode_mesh_ply((scans[name] / MESH).read_bytes())
        points = mesh.vertices_mm.astype(np.float64)
        (ball,) = find_balls(points, mesh.normals.astype(np.float64), diameter_mm, 1)
        fit = fit_sphere(points[ball.points])
        outwards = (points[ball.points] - fit.centre_mm) / fit.radius_mm
        system = np.column_stack([outwards, np.ones(len(outwards))])
        spread = float(np.mean(fit.distances_mm**2)) * max(len(system) / _INDEPENDENT_POINTS, 1.0)
        return fit.centre_mm, spread * np.linalg.inv(system.T @ system)[:3, :3]

    chosen, found, refused = _each_read(robot, centre, report)
    poses = np.tile(np.eye(4), (len(found), 1, 1))
    poses[:, :3, 3] = [place for place, _ in found]
    kept = robot.select(chosen)
    return ObservedTargets(kept, TargetPoses(kept.names, poses, block_diag(*(each for _, each in found))), refused)


def _each_read(
    robot: RobotPoses, read: Callable[[str], Any], report: Callable[[float, str], None]
) -> tuple[Any, list[Any], dict[str, str]]:
    """Numbers of the poses that could be read, what was read, and why others were refused."""
    chosen, found, refused = [], [], {}
    for number, name in enumerate(robot.names):
        report(number / len(robot.names), f"{number + 1} of {len(robot.names)}")
        try:
            found.append(read(name))
        except (SlrigError, OSError) as error:
            refused[name] = str(error).splitlines()[0]
        else:
            chosen.append(number)
    if not found:
        cause = next(iter(refused.values()), "there are none")
        message = f"none of the {len(robot.names)} poses can be used: {cause}"
        raise PoseRefusedError(message)
    return np.array(chosen, dtype=np.intp), found, refused


def pair_poses(robot: RobotPoses, folders: Mapping[str, Path]) -> RobotPoses:
    """The robot's poses by the names of folders that belong to them: in order, if they are numbered, or by their names.

    Raises CalibrationError if none or not all belong together.
    """
    numbered = robot.names == tuple(str(number) for number in range(1, len(robot.names) + 1))
    if numbered and len(robot.names) == len(folders):
        return replace(robot, names=tuple(folders))
    common = [number for number, name in enumerate(robot.names) if name in folders]
    if common and not numbered:
        return robot.select(np.array(common, dtype=np.intp))
    message = (
        f"expected a robot pose for each of {len(folders)} folders ({', '.join(list(folders)[:3])}, …), found "
        f"{len(robot.names)} ({', '.join(robot.names[:3])}, …): name each pose as its folder, in a column 'name'"
    )
    raise CalibrationError(message)


class HandEyeStore:
    """Hand-eye calibrations of a data folder, DATA/hand_eye: one for each calibration of the rig, in its frame."""

    def __init__(self, root: Path) -> None:
        self._folder = root / "hand_eye"

    def get(self, calibration: str) -> HandEyeDocument:
        """The one for a calibration, by its identifier. Raises CalibrationNotFoundError, CalibrationError."""
        path = self._path(calibration)
        if not path.is_file():
            message = (
                f"There is no hand-eye calibration for calibration {calibration}, which is in use: POST /hand-eye, or "
                "slrig calibrate hand-eye and PUT /hand-eye."
            )
            raise CalibrationNotFoundError(message)
        return read_hand_eye(path)

    def put(self, document: HandEyeDocument) -> None:
        """Keep one in place of the last. Raises StorageError."""
        with storage_errors(self._folder):
            self._folder.mkdir(exist_ok=True)
        write_hand_eye(self._path(str(document.calibration)), document)

    def remove(self, calibration: str) -> None:
        """Idempotent. Raises StorageError."""
        with storage_errors(self._folder):
            self._path(calibration).unlink(missing_ok=True)

    def _path(self, calibration: str) -> Path:
        # Identifiers of imported calibrations are any text.
        return self._folder / f"{hashlib.sha256(calibration.encode()).hexdigest()[:16]}.json"


@dataclass(frozen=True, slots=True)
class ReadBoards:
    """Poses of a board that were read already."""

    observations: Sequence[PoseObservation]
    board: Board
    calibration: Calibration

    def targets(self, robot: Sequence[Any]) -> ObservedTargets:
        """The board's poses, in pairs with the robot's. Raises CalibrationError."""
        observed = _posed(self.observations, self.board, self.calibration)
        return ObservedTargets(_named(observed.names, robot), observed, {})


@dataclass(frozen=True, slots=True)
class ScannedSpheres:
    """Scans of a sphere, by their names: folders with a mesh.ply."""

    scans: Mapping[str, Path]
    diameter_mm: float
    calibration: Calibration

    def targets(self, robot: Sequence[Any]) -> ObservedTargets:
        """The sphere's centres, in pairs with the robot's poses. Raises PoseRefusedError."""
        return observe_spheres(_named(tuple(self.scans), robot), self.scans, self.diameter_mm, lambda *_: None)


# Short tasks of the worker


def solved_poses(
    source: ReadBoards | ScannedSpheres, robot: Sequence[Any], options: Mapping[str, Any]
) -> HandEyeDocument:
    """Solve by the rig's observations in poses of a robot. options : of a request."""
    from slrig.calibration.hand_eye import HandEyeKind, solve_hand_eye

    given, kind = source.targets(robot), HandEyeKind(options["kind"])
    found = solve_hand_eye(given.robot, given.observed, kind, robot_sigma=options["robot_sigma"])
    frames = {key: options[key] for key in ("base_frame", "flange_frame")}
    return hand_eye_document(found, source.calibration.solve_id, **frames, refused=given.refused)


def checked_poses(
    source: ReadBoards | ScannedSpheres, robot: Sequence[Any], document: HandEyeDocument
) -> dict[str, Any]:
    """Check of a hand-eye calibration by poses of a robot and the rig's observations in them."""
    from slrig.calibration.hand_eye import check_hand_eye

    given = source.targets(robot)
    drift = check_hand_eye(hand_eye_of(document), given.robot, given.observed)
    return {**drift._asdict(), "holds": drift.holds, "residual_mm": drift.residual_mm.tolist()}


def _posed(observations: Sequence[PoseObservation], board: Board, calibration: Calibration) -> TargetPoses:
    """The board's poses, with the error of its print's size, which scales all distances of the rig alike.

    Raises CalibrationError: the calibration is of other cameras.
    """
    from slrig.calibration.hand_eye import TargetPoses
    from slrig.calibration.health.drift import estimate_board_poses

    observed = TargetPoses(*estimate_board_poses(observations, board, calibration))
    sigma = 0.0 if calibration.solved is None else calibration.solved.scale_sigma
    longer = sigma * np.hstack([np.zeros((len(observed.poses), 3)), observed.poses[:, :3, 3]]).ravel()
    return replace(observed, covariance=observed.covariance + np.outer(longer, longer))


def _named(names: tuple[str, ...], robot: Sequence[Any]) -> RobotPoses:
    from slrig.calibration.hand_eye import RobotPoses

    return RobotPoses(names, np.array(robot))
