"""Calibration without a service: `slrig calibrate solve` and `check` of a folder with one bundle per pose, `slrig
verify`, and boards to print.
"""

from __future__ import annotations

import platform
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.markup import escape

from slrig.bundle import read_calibration, write_calibration, write_file, write_opencv_calibration
from slrig.calibrate.pose_reading import bundle_device_sizes
from slrig.calibrate.verification import VerificationJob, verify_bundle
from slrig.calibration import DEFAULT_BOARD, PROJECTOR, Board, BoardKind, BoardShape
from slrig.calibration.health import Health, HealthState, Verification, judge_health, verification_from_document
from slrig.calibration.poses import check_same_devices
from slrig.cli.calibrate_walk import checked, print_check, print_result
from slrig.cli.display import ProgressDisplay, counted, print_json, progress_shown
from slrig.cli.local import run_job
from slrig.cli.options import BoardArguments
from slrig.cli.reconstruct import keep_kernels
from slrig.config import read_rig
from slrig.disk import storage_errors
from slrig.errors import BundleError, CalibrationError, ConfigError, PatternError, PoseRefusedError, SolveRefusedError
from slrig.jobs.listener import Listener
from slrig.logs import set_up_console_logs
from slrig.model import Calibration, Size

if TYPE_CHECKING:
    from slrig.calibrate.store import CalibrationResult, ReadPose, Setting

DESCRIPTION = "bundle.json"
ENDINGS = (".json", ".yml", ".yaml", ".xml")
_READING_SHARE = 0.5
_MOST_LISTED = 5


@dataclass(slots=True)
class Readings:
    """Poses that were read. refused : by pose, why it was left out; remarks : by pose, possible improvements."""

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
    be bowed. tolerance_mm : largest error of a point of a scan.

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
    print_result(document, Console())
    typer.echo(f"\n{'written':<10}{output}")
    if report is not None:
        typer.echo(f"{'report':<10}{report}")


def check_folder(folder: Path, board: Board, *, board_shape: BoardShape, as_json: bool) -> None:
    """Read the poses, solve odd and even ones apart, and print what they differ by.

    Raises as `solve_folder` does, and ConfigError where the poses are too few to be halved.
    """
    document = _solved(folder, board, None, report=None, earlier=None, board_shape=board_shape, tolerance_mm=None)
    (print_json if as_json else print_check)(checked(document))


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
    """Solve, write the calibration and its report where a file is named, and return the document of the result."""
    set_up_console_logs()
    bundles = pose_bundles(folder)
    before = None if earlier is None else read_calibration(earlier)
    keep_kernels()
    with progress_shown() as display:
        display("loading", 0.0, "")
        # numba and its kernels: a second or two, and many the first time.
        from slrig.calibrate.report import summary
        from slrig.calibrate.store import Setting, solve_poses

        found = Readings()
        cameras = _one_rig(bundles, found)
        projector = cameras.pop(PROJECTOR, None)
        setting = Setting(board, cameras, projector)
        _read(bundles, setting, found, display)
        if not found.poses:
            raise PoseRefusedError(_none_left(folder, board, found.refused))

        try:
            result = solve_poses(
                board,
                cameras,
                projector,
                found.poses,
                Listener(report=display).within(_READING_SHARE, 1.0),
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
    """The devices of most of the bundles. Those without a readable description are refused in `found`.

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
    from slrig.calibrate.pose_reading import read_pose
    from slrig.calibrate.report import judgement

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
    """Message for the case that no pose can be used: the causes, each with its poses."""
    causes: dict[str, list[str]] = {}
    for name, cause in refused.items():
        causes.setdefault(cause, []).append(name)
    lines = [f"{folder}: none of its poses ({len(refused)}) shows a {board.title} that can be used:"]
    lines += [f"  {_listed(names)}: {cause}" for cause, names in list(causes.items())[:_MOST_LISTED]]
    if len(causes) > _MOST_LISTED:
        lines.append(f"  and {len(causes) - _MOST_LISTED} causes more")
    lines.append(
        "Is this the board? --corners counts inner corners, across x down (where four squares meet), and of circles "
        "those of one row x rows."
    )
    return "\n".join(lines)


def _with_refused(message: str, refused: Mapping[str, str]) -> str:
    if not refused:
        return message
    lines = [f"  {name}: {cause}" for name, cause in list(refused.items())[:_MOST_LISTED]]
    more = [f"  and {len(refused) - _MOST_LISTED} more"] if len(refused) > _MOST_LISTED else []
    verb = "was" if len(refused) == 1 else "were"
    return "\n".join([message, f"{counted(len(refused), 'pose')} {verb} not used:", *lines, *more])


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 3 else f"{names[0]} to {names[-1]} ({len(names)})"


def _first_lines(error: Exception) -> str:
    return " ".join(line.strip() for line in str(error).splitlines()[:3])


def _report(
    result: CalibrationResult, found: Readings, folder: Path, bundles: Mapping[str, Path], setting: Setting
) -> str:
    from slrig.calibrate.report import report_html, white_frame

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


_COLOURS = {HealthState.GOOD: "green", HealthState.WATCH: "yellow", HealthState.STALE: "bold red"}


def verify(source: Path, board: Board, calibration_file: Path | None, *, position: int | None, as_json: bool) -> bool:
    """Verify, print the findings, and return whether the calibration still holds (good or watch).

    source : a bundle (a folder), or a rig file; its own calibration is verified unless another one is named.

    Raises
    ------
    SlrigError
        There is no calibration, the rig cannot be opened, or the board is not visible.
    """
    set_up_console_logs()
    with progress_shown() as display:
        if source.is_dir():
            calibration = _calibration(calibration_file or source / "calibration.json")
            display("reading", 0.0, "")
            verification = verify_bundle(source, board, calibration)
        else:
            given = None if calibration_file is None else _calibration(calibration_file)
            record = run_job(read_rig(source), VerificationJob(board, position), Listener(report=display), given)
            verification = verification_from_document((record.summary or {})["found"])
    health = judge_health([verification])
    if as_json:
        found = {"state": str(health.state), "reasons": list(health.reasons), "remedy": health.remedy}
        print_json({**found, **verification.document()})
    else:
        print_verification(verification, health, Console())
    return health.state is not HealthState.STALE


def print_verification(verification: Verification, health: Health, console: Console) -> None:
    """Print a verification for people."""
    console.print(f"[{_COLOURS[health.state]}]{health.state}[/{_COLOURS[health.state]}]  {escape(health.reasons[0])}")
    for reason in health.reasons[1:]:
        console.print(f"       {escape(reason)}")
    if health.remedy:
        console.print(f"[bold]do[/bold]     {escape(health.remedy)}")
    for pair in verification.pairs:
        console.print(
            f"{escape(pair.first)} - {escape(pair.second)}: mean {pair.mean_px:+.3f} ± {pair.mean_sigma_px:.3f} px, "
            f"rms {pair.rms_px:.3f} px, predicted {pair.predicted_px:.3f} px, {pair.count:,} points"
        )
    if verification.scale_percent is not None and verification.scale_mm is not None:
        console.print(
            f"board: measures {verification.scale_percent:+.3f} ± {verification.scale_sigma_percent:.3f} % against its "
            "true size, "
            f"{verification.scale_mm:+.3f} mm over its diagonal"
        )


def _calibration(path: Path) -> Calibration:
    if not path.is_file():
        message = f"{path}: there is no calibration; name one with --calibration FILE"
        raise CalibrationError(message)
    return read_calibration(path)


def chosen_board(given: BoardArguments) -> Board:
    """The board that a command's options describe; without any, the usual one, which is then named on stderr.

    The usual board may be named in part, so that a print that measures 11.94 mm is `--square-mm 11.94`. Any other board
    is named whole: a square's side that is guessed would scale every scan.

    Raises
    ------
    CalibrationError
        The options describe no board, or another than the usual one and not the whole of it.
    """
    needed = {"--board": given.kind, "--corners": given.corners, "--square-mm": given.square_mm}
    missing = [name for name, value in needed.items() if value is None]
    if not missing:
        return _as_printed(
            board_option(
                str(given.kind), str(given.corners), float(given.square_mm or 0), given.marker_mm, given.dictionary
            ),
            given,
        )
    usual = (DEFAULT_BOARD.columns, DEFAULT_BOARD.rows)
    if given.kind not in (None, DEFAULT_BOARD.kind) or (given.corners is not None and _counted(given.corners) != usual):
        message = (
            f"Which board? Missing: {', '.join(missing)}. Name all of it, as --board chessboard --corners 9x6 "
            f"--square-mm 20, or nothing for the usual one: {DEFAULT_BOARD.description}"
        )
        raise CalibrationError(message)
    square_mm = DEFAULT_BOARD.square_mm if given.square_mm is None else given.square_mm
    corners = f"{DEFAULT_BOARD.columns}x{DEFAULT_BOARD.rows}"
    board = _as_printed(board_option(DEFAULT_BOARD.kind, corners, square_mm, given.marker_mm, given.dictionary), given)
    typer.echo(f"board     {board.description} (--board, --corners and --square-mm name another)", err=True)
    return board


def _as_printed(board: Board, given: BoardArguments) -> Board:
    """The board with the size of its print as given."""
    if given.square_sigma is not None:
        board = replace(board, square_sigma=given.square_sigma)
    return (
        board if given.measured_mm is None else board.as_measured(*given.measured_mm, square_sigma=given.square_sigma)
    )


def board_option(
    kind: str, corners: str, square_mm: float, marker_mm: float | None = None, dictionary: str | None = None
) -> Board:
    """The board of a command's options. kind : of `BoardKind`; corners : COLUMNSxROWS, `11x8`.

    Raises
    ------
    CalibrationError
        The options describe no board, with all that is wrong, or one that OpenCV has no markers for.
    """
    faults = []
    counted = _counted(corners)
    if counted is None:
        faults.append(
            f"--corners: expected COLUMNSxROWS, 11x8 for one (inner corners, where four squares meet; of circles those "
            f"in a row, then rows), found {corners!r}"
        )
    if not square_mm > 0:
        faults.append(f"--square-mm: expected a length in mm, found {square_mm:g}")
    if faults or counted is None:
        raise CalibrationError("; ".join(faults))
    board = Board(BoardKind(kind), *counted, square_mm, marker_mm, dictionary)
    if board.kind is BoardKind.CHARUCO:
        # OpenCV knows whether there is such a dictionary, with markers enough. Late, for it takes a while to load.
        from slrig.calibration.printing import charuco_board

        charuco_board(board)
    return board


def _counted(corners: str) -> tuple[int, int] | None:
    """Columns and rows of `11x8`; None where the text is none such."""
    found = re.fullmatch(r"\s*(\d{1,4})\s*[xX×]\s*(\d{1,4})\s*", corners)
    return None if found is None else (int(found[1]), int(found[2]))


def write_board(board: Board, output: Path, *, page: str) -> None:
    """Write the page with the board as PDF or SVG, by the name of the file, and say how to use it.

    Raises
    ------
    CalibrationError
        The file's name ends in neither .pdf nor .svg, or the board does not fit on the page.
    StorageError
        The file cannot be written.
    """
    from slrig.calibration.printing import board_pdf, board_svg, solve_command

    kind = output.suffix.lower()
    if kind not in (".pdf", ".svg"):
        message = f"--output: expected a name that ends in .pdf or .svg, found {output}"
        raise CalibrationError(message)
    content = board_pdf(board, page=page) if kind == ".pdf" else board_svg(board, page=page).encode()
    with storage_errors(output.parent):
        output.parent.mkdir(parents=True, exist_ok=True)
    write_file(output, content)
    typer.echo(f"written   {output}: {board.description}")
    typer.echo("Print it at 100 % (actual size), glue it on something flat and stiff, and check both of its scales.")
    typer.echo(f"Then:     {solve_command(board)}")
