"""`slrig calibrate hand-eye`: solve from files, and check new poses against drift."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from slrig.bundle import CALIBRATION, read_calibration
from slrig.calibrate.hand_eye import (
    ObservedTargets,
    hand_eye_document,
    hand_eye_of,
    observe_boards,
    observe_spheres,
    pair_poses,
    read_hand_eye,
    write_hand_eye,
)
from slrig.calibration.hand_eye import HandEyeKind, TargetPoses, check_hand_eye, solve_hand_eye
from slrig.cli.calibrate_local import chosen_board, pose_bundles
from slrig.cli.display import print_json, print_table, progress_shown
from slrig.cli.options import BoardArguments, RobotOptions
from slrig.cli.reconstruct import keep_kernels
from slrig.errors import CalibrationError
from slrig.importers import read_robot_poses
from slrig.logs import set_up_console_logs
from slrig.scan.artefacts import MESH


def observed_by_rig(
    poses: Path, seen: Path, rotation: str | None, board: BoardArguments, calibration: Path | None, sphere: float | None
) -> tuple[ObservedTargets, str | None]:
    """The robot's poses with the rig's observations, and the identifier of the rig's calibration.

    Raises CalibrationError, BundleError, PoseRefusedError.
    """
    set_up_console_logs()
    robot = read_robot_poses(poses, rotation)
    if seen.is_file():
        body = read_robot_poses(seen, rotation)
        kept = pair_poses(robot, dict.fromkeys(body.names, seen))
        chosen = np.array([body.names.index(name) for name in kept.names], dtype=np.intp)
        exact = np.zeros((6 * len(chosen),) * 2)
        identifier = None if calibration is None else read_calibration(calibration).solve_id
        return ObservedTargets(kept, TargetPoses(kept.names, body.poses[chosen], exact), {}), identifier
    scans: dict[str, Path] = {}
    if sphere is not None:
        scans = {path.name: path for path in sorted(seen.iterdir() if seen.is_dir() else ()) if (path / MESH).is_file()}
        if not scans:
            message = f"{seen}: expected a folder with one scan per pose, each a folder with {MESH}; found none"
            raise CalibrationError(message)
        folders = {name: path / "bundle" for name, path in scans.items()}
    else:
        folders = pose_bundles(seen)
    own = next((path / CALIBRATION for path in folders.values() if (path / CALIBRATION).is_file()), None)
    file = calibration or own
    if file is None and sphere is None:
        message = f"{seen}: its bundles hold no calibration: name that of the rig with --calibration FILE"
        raise CalibrationError(message)
    of_rig = None if file is None else read_calibration(file)
    keep_kernels()
    with progress_shown() as display:

        def report(fraction: float, detail: str) -> None:
            display("reading", fraction, detail)

        if of_rig is None or sphere is not None:
            given = observe_spheres(pair_poses(robot, scans), scans, sphere or 0.0, report)
        else:
            given = observe_boards(pair_poses(robot, folders), folders, chosen_board(board), of_rig, report)
        display("done", 1.0, "")
    return given, None if of_rig is None else of_rig.solve_id


def solve_poses(
    given: ObservedTargets, identifier: str | None, kind: str, robot: RobotOptions, output: Path, *, as_json: bool
) -> dict[str, Any]:
    """Solve, write the file, print and return it. Raises SolveRefusedError, StorageError."""
    found = solve_hand_eye(given.robot, given.observed, HandEyeKind(kind), robot_sigma=robot.robot_sigma)
    document = hand_eye_document(
        found, identifier, base_frame=robot.base_frame, flange_frame=robot.flange_frame, refused=given.refused
    )
    write_hand_eye(output, document)
    plain = document.model_dump(mode="json")
    if as_json:
        print_json(plain)
        return plain
    sigma = np.sqrt(np.diagonal(found.rig_covariance))
    place = ", ".join(f"{mm:.2f} ± {error:.2f}" for mm, error in zip(found.rig[:3, 3], sigma[3:], strict=True))
    noise = "estimated" if found.estimated else "stated"
    console = Console(highlight=False)
    console.print(f"rig in the {found.kind.frame}: {place} mm, turned to ± {np.degrees(sigma[:3].max()):.3f}°")
    console.print(f"robot: {found.robot_sigma[0]:.3f} mm, {found.robot_sigma[1]:.3f}° per coordinate ({noise})")
    rows = [
        (each.name, f"{each.residual_mm:.3f} mm", "" if each.residual_deg is None else f"{each.residual_deg:.3f}°")
        for each in document.poses
    ]
    print_table(["pose", "off by", "turned by"], rows)
    for name, why in document.left_out.items():
        console.print(f"[yellow]left out[/yellow]  {escape(f'{name}: {why}')}")
    for remark in document.remarks:
        console.print(f"[yellow]note[/yellow]      {escape(remark)}")
    if document.next_pose is not None:
        worst = float(np.sqrt(np.linalg.eigvalsh(found.rig_covariance[3:, 3:])[-1]))
        console.print(
            f"next      {escape(document.next_pose.words)}: {worst:.3f} mm become {document.next_pose.sigma_mm:.3f}"
        )
    console.print(f"written   {escape(str(output))}")
    return plain


def check_poses(given: ObservedTargets, identifier: str | None, file: Path, *, as_json: bool) -> bool:
    """Print the drift of new poses from a hand-eye calibration; return whether it holds. Raises CalibrationError."""
    document = read_hand_eye(file)
    drift = check_hand_eye(hand_eye_of(document), given.robot, given.observed)
    other = document.calibration != identifier and None not in (document.calibration, identifier)
    rows = list(zip(given.observed.names, drift.residual_mm.tolist(), drift.residual_deg.tolist(), strict=True))
    if as_json:
        print_json({
            "holds": drift.holds, "probability": drift.probability, "shift_mm": drift.shift_mm,
            "turn_deg": drift.turn_deg, "sigma_mm": drift.sigma_mm, "sigma_deg": drift.sigma_deg,
            "other_calibration": other, "refused": dict(given.refused),
            "poses": [
                {"name": name, "residual_mm": mm, "residual_deg": None if np.isnan(deg) else deg}
                for name, mm, deg in rows
            ],
        })  # fmt: skip
        return drift.holds
    console = Console(highlight=False)
    result = "[green]holds[/green]" if drift.holds else "[bold red]drifted[/bold red]"
    console.print(
        f"{result}: as if the rig had moved by {drift.shift_mm:.3f} ± {drift.sigma_mm:.3f} mm and {drift.turn_deg:.3f} "
        f"± {drift.sigma_deg:.3f}°; so much by chance: {drift.probability:.2g}"
    )
    for name, mm, degrees in rows:
        console.print(f"{escape(name)}: off by {mm:.3f} mm" + ("" if np.isnan(degrees) else f" and {degrees:.3f}°"))
    for name, why in given.refused.items():
        console.print(f"[yellow]not used[/yellow]  {escape(f'{name}: {why}')}")
    if other:
        console.print("The rig was calibrated again since: its own frame may have moved. Solve hand-eye again.")
    elif not drift.holds:
        console.print(
            "do        check whether the rig, the target, or the tool that the robot reports changed since; then solve "
            "hand-eye again"
        )
    return drift.holds
