"""`slrig verify`: does a calibration still hold? By a recorded pose of the board, or by one shot now on a rig."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from slrig.bundle import read_calibration
from slrig.calibrate.records import USUAL_PATTERNS
from slrig.calibrate.verification import verify_bundle
from slrig.calibration import Board
from slrig.calibration.health import Health, HealthState, Verification, judge_health
from slrig.cli.display import print_json, progress_shown
from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.errors import CalibrationError
from slrig.logs import set_up_console_logs
from slrig.model import Calibration
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import ProgressCallback, ScanPlan

_COLOURS = {HealthState.GOOD: "green", HealthState.WATCH: "yellow", HealthState.STALE: "bold red"}


def verify(source: Path, board: Board, calibration_file: Path | None, *, position: int | None, as_json: bool) -> bool:
    """Verify, print what was found, and return whether the calibration still holds (good or watch).

    source : a bundle (a folder), or a rig file, whose own calibration is verified unless another one is named.

    Raises
    ------
    SlrigError
        There is no calibration, the rig cannot be opened, or the board is not to be seen.
    """
    set_up_console_logs()
    with progress_shown() as display:
        if source.is_dir():
            calibration = _calibration(calibration_file or source / "calibration.json")
            display("reading", 0.0, "")
            verification = verify_bundle(source, board, calibration)
        else:
            verification = _shot(source, board, calibration_file, position, display)
    health = judge_health([verification])
    if as_json:
        found = {"state": str(health.state), "reasons": list(health.reasons), "remedy": health.remedy}
        print_json({**found, **verification.document()})
    else:
        tell(verification, health, Console())
    return health.state is not HealthState.STALE


def tell(verification: Verification, health: Health, console: Console) -> None:
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


def _shot(
    source: Path, board: Board, calibration_file: Path | None, position: int | None, display: ProgressCallback
) -> Verification:
    config = read_rig(source)
    given = None if calibration_file is None else _calibration(calibration_file)
    with open_rig(config) as rig, tempfile.TemporaryDirectory(prefix="slrig-verify-") as folder:
        calibration = given or rig.calibration
        if calibration is None:
            message = f"{source}: the rig has no calibration; name one with --calibration FILE, or calibrate the rig"
            raise CalibrationError(message)
        if position is not None:
            if rig.positioner is None:
                message = f"--position {position}: the rig '{rig.name}' has no positioner; leave the option out"
                raise CalibrationError(message)
            rig.positioner.move(position)
        bare = replace(rig, calibration=None, head=None)
        place = Path(folder) / "verification"
        capture_frames(
            bare, ScanPlan(patterns=USUAL_PATTERNS), place, progress=display, cancelled=lambda: False
        ).finish()
        return verify_bundle(place, board, calibration)


def _calibration(path: Path) -> Calibration:
    if not path.is_file():
        message = f"{path}: there is no calibration; name one with --calibration FILE"
        raise CalibrationError(message)
    return read_calibration(path)
