"""`slrig calibrate solve`: a folder with one bundle per pose becomes a calibration, in this process."""

from __future__ import annotations

import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console

from slrig.bundle import read_calibration, write_calibration, write_file, write_opencv_calibration
from slrig.calibrate.pose_frames import bundle_device_sizes
from slrig.calibration import PROJECTOR, Board, BoardShape
from slrig.calibration.poses import check_same_devices
from slrig.cli.calibration_screen import checked, tell_check, tell_result
from slrig.cli.display import ProgressDisplay, counted, print_json, progress_shown
from slrig.cli.reconstruct import keep_kernels
from slrig.errors import BundleError, ConfigError, PatternError, PoseRefusedError, SolveRefusedError
from slrig.logs import set_up_console_logs
from slrig.model import Size

if TYPE_CHECKING:
    from slrig.calibrate.records import Setting
    from slrig.calibrate.solving import CalibrationResult, ReadPose

DESCRIPTION = "bundle.json"
ENDINGS = (".json", ".yml", ".yaml", ".xml")
_READING_SHARE = 0.5
_MOST_TOLD = 5


@dataclass(slots=True)
class Readings:
    """What was read. refused : by pose, why it was left out; remarks : by pose, what could be better about it."""

    poses: list[ReadPose] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)
    remarks: dict[str, Sequence[str]] = field(default_factory=dict)


def solve_folder(
    folder: Path,
    board: Board,
    output: Path,
    *,
    report: Path | None,
    earlier: Path | None,
    board_shape: BoardShape,
    tolerance_mm: float | None,
    as_json: bool,
) -> None:
    """Read the poses, solve, print how good the calibration is, and write it and its report.

    earlier : file of a calibration of the same devices, to compare the scale with. board_shape : whether the board may
    be bowed. tolerance_mm : what a point of a scan may be wrong by.

    Raises ConfigError or StorageError where the output cannot be written, BundleError where there are no bundles,
    CalibrationError where the poses are of different rigs or the earlier calibration cannot be read, PoseRefusedError
    where none of the poses can be used, SolveRefusedError where they determine no calibration.
    """
    _require_writable(output, report)
    document = _solved(
        folder, board, output, report=report, earlier=earlier, board_shape=board_shape, tolerance_mm=tolerance_mm
    )
    if as_json:
        print_json({**document, "output": str(output), "report": report and str(report)})
        return
    tell_result(document, Console())
    typer.echo(f"\n{'written':<10}{output}")
    if report is not None:
        typer.echo(f"{'report':<10}{report}")


def check_folder(folder: Path, board: Board, *, board_shape: BoardShape, as_json: bool) -> None:
    """Read the poses, solve odd and even ones apart, and print what they differ by.

    Raises as `solve_folder` does, and ConfigError where the poses are too few to be halved.
    """
    document = _solved(folder, board, None, report=None, earlier=None, board_shape=board_shape, tolerance_mm=None)
    (print_json if as_json else tell_check)(checked(document))


def _solved(
    folder: Path,
    board: Board,
    output: Path | None,
    *,
    report: Path | None,
    earlier: Path | None,
    board_shape: BoardShape,
    tolerance_mm: float | None,
) -> dict[str, Any]:
    """Solve, write the calibration and its report where a file is named, and return what is told of it."""
    set_up_console_logs()
    bundles = pose_bundles(folder)
    before = None if earlier is None else read_calibration(earlier)
    keep_kernels()
    with progress_shown() as display:
        display("loading", 0.0, "")
        # numba and its kernels: a second or two, and many the first time.
        from slrig.calibrate.pose_judging import summary
        from slrig.calibrate.records import Setting
        from slrig.calibrate.solving import solve_poses

        found = Readings()
        cameras = _one_rig(bundles, found)
        projector = cameras.pop(PROJECTOR, None)
        setting = Setting(board, cameras, projector)
        _read(bundles, setting, found, display)
        if not found.poses:
            raise PoseRefusedError(_none_left(folder, board, found.refused))

        def solving(stage: str, fraction: float, detail: str) -> None:
            display(stage, _READING_SHARE + (1 - _READING_SHARE) * fraction, detail)

        try:
            result = solve_poses(
                board,
                cameras,
                projector,
                found.poses,
                progress=solving,
                earlier=before,
                board_shape=board_shape,
                tolerance_mm=tolerance_mm,
            )
        except SolveRefusedError as error:
            raise SolveRefusedError(_with_refused(str(error), found.refused)) from error
        document = {**summary(result), "refused": found.refused, "remarks": found.remarks}
        if output is not None:
            write = write_calibration if output.suffix.lower() == ".json" else write_opencv_calibration
            write(output, result.calibration)
        if report is not None:
            display("writing the report", 1.0, "")
            write_file(report, _report(result, found, folder, bundles, setting).encode())
        display("done", 1.0, "")
    return document


def pose_bundles(folder: Path) -> dict[str, Path]:
    """The bundles in a folder, one per pose, by name and in the order of their names.

    Each is a folder with a bundle.json, or has it in a folder `bundle`, as the service keeps the poses of a session.
    Raises BundleError where there is no such folder, or no folder with a bundle.json in it.
    """
    what = "expected a folder with one bundle per pose, each a folder with a bundle.json"
    if not folder.is_dir():
        message = f"{folder}: {what}; found {'a file' if folder.exists() else 'nothing'} there"
        raise BundleError(message)
    found = {
        path.name: bundle
        for path in sorted(folder.iterdir())
        for bundle in (path, path / "bundle")
        if (bundle / DESCRIPTION).is_file()
    }
    if not found:
        inside = sum(path.is_dir() for path in folder.iterdir())
        remedy = f"it holds {counted(inside, 'folder')} without a bundle.json" if inside else "it holds no folders"
        if (folder / DESCRIPTION).is_file():
            remedy = "this is one bundle itself: name the folder that holds it and those of the other poses"
        message = f"{folder}: {what}; {remedy}"
        raise BundleError(message)
    return found


def _require_writable(output: Path, report: Path | None) -> None:
    """Find out before minutes of work what would spoil them."""
    if output.suffix.lower() not in ENDINGS:
        message = (
            f"--output {output}: expected a name that ends in .json (slrig's own) or .yml, .yaml or .xml (OpenCV's), "
            f"found '{output.suffix}'"
        )
        raise ConfigError(message)
    for option, file in [("--output", output), *([] if report is None else [("--report", report)])]:
        if file.is_dir():
            message = f"{option} {file}: expected the name of a file, found a folder; name a file in it"
            raise ConfigError(message)
        if not file.absolute().parent.is_dir():
            message = f"{option} {file}: there is no folder {file.absolute().parent}; create it first"
            raise ConfigError(message)


def _one_rig(bundles: Mapping[str, Path], found: Readings) -> dict[str, Size]:
    """The devices that most of the bundles are of. Those whose description cannot be read are refused in `found`.

    Raises CalibrationError where a bundle is of another rig than most.
    """
    sizes: dict[str, Mapping[str, Size]] = {}
    for name, path in bundles.items():
        try:
            sizes[name] = bundle_device_sizes(path)
        except BundleError as error:
            found.refused[name] = _first_lines(error)
    if not sizes:
        return {}
    usual = Counter(frozenset(each.items()) for each in sizes.values()).most_common(1)[0][0]
    ordered = next(each for each in sizes.values() if each.items() == usual)
    for name, each in sizes.items():
        check_same_devices(f"pose '{name}'", each, ordered)
    return dict(ordered)


def _read(bundles: Mapping[str, Path], setting: Setting, found: Readings, display: ProgressDisplay) -> None:
    """Read the bundles that are not refused yet."""
    from slrig.calibrate.pose_judging import judgement
    from slrig.calibrate.pose_reading import read_pose

    readable = [name for name in bundles if name not in found.refused]
    for at, name in enumerate(readable):
        display(f"reading {name}", _READING_SHARE * at / len(readable), f"{at + 1} of {len(readable)}")
        try:
            pose = read_pose(bundles[name], setting.board, name)
        except (PoseRefusedError, PatternError, BundleError) as error:
            found.refused[name] = _first_lines(error).removeprefix(f"pose '{name}': ")
            continue
        judged = judgement(pose, found.poses, setting)
        if judged.refusals:
            found.refused[name] = "; ".join(judged.refusals)
            continue
        found.poses.append(pose)
        if judged.answer["warnings"]:
            found.remarks[name] = list(judged.answer["warnings"])


def _none_left(folder: Path, board: Board, refused: Mapping[str, str]) -> str:
    """Words for the case that no pose can be used: the causes, each with the poses that it is of."""
    causes: dict[str, list[str]] = {}
    for name, cause in refused.items():
        causes.setdefault(cause, []).append(name)
    lines = [f"{folder}: none of its poses ({len(refused)}) shows a {board.title} that can be used:"]
    lines += [f"  {_listed(names)}: {cause}" for cause, names in list(causes.items())[:_MOST_TOLD]]
    if len(causes) > _MOST_TOLD:
        lines.append(f"  and {len(causes) - _MOST_TOLD} causes more")
    lines.append(
        "Is this the board? --corners counts inner corners, across x down (where four squares meet), and of circles "
        "those of one row x rows."
    )
    return "\n".join(lines)


def _with_refused(message: str, refused: Mapping[str, str]) -> str:
    if not refused:
        return message
    lines = [f"  {name}: {cause}" for name, cause in list(refused.items())[:_MOST_TOLD]]
    more = [f"  and {len(refused) - _MOST_TOLD} more"] if len(refused) > _MOST_TOLD else []
    verb = "was" if len(refused) == 1 else "were"
    return "\n".join([message, f"{counted(len(refused), 'pose')} {verb} not used:", *lines, *more])


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 3 else f"{names[0]} to {names[-1]} ({len(names)})"


def _first_lines(error: Exception) -> str:
    return " ".join(line.strip() for line in str(error).splitlines()[:3])


def _report(
    result: CalibrationResult, found: Readings, folder: Path, bundles: Mapping[str, Path], setting: Setting
) -> str:
    from slrig.calibrate.pose_pictures import white_frame
    from slrig.calibrate.report import report_html

    pictures = {
        pose.observation.name: {
            camera: white_frame(bundles[pose.observation.name], camera) for camera in pose.observation.views
        }
        for pose in found.poses
    }
    return report_html(
        result,
        found.poses,
        pictures,
        board=setting.board,
        title=f"Calibration from {folder.absolute().name}",
        remarks=found.remarks,
        refused=found.refused,
        machine=f"on {platform.node()} ({platform.system()} {platform.machine()}), slrig {version('slrig')}",
    )
