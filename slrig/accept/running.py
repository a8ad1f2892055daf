"""An acceptance test, run: each prescribed position captured, reconstructed and evaluated, and the decision.

In the manner of VDI/VDE 2634 part 2 and ISO 10360-13; no conformity is claimed.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from slrig.accept.evaluation import Reading, reading
from slrig.accept.plan import AcceptancePlan, Step
from slrig.accept.store import keep_points
from slrig.accept.verdicts import AcceptanceResult, verdicts
from slrig.devices import Rig
from slrig.disk import storage_errors
from slrig.errors import (
    CalibrationError,
    InvalidInputError,
    NothingToReconstructError,
    ScanCancelledError,
    ScanEvidenceError,
    SlrigError,
    UnsupportedByDeviceError,
    setting,
)
from slrig.jobs.records import utc_now
from slrig.model import Calibration
from slrig.scan.acquisition import capture_frames
from slrig.scan.artefacts import MESH, decode_mesh_ply
from slrig.scan.plan import ProgressCallback, ReconstructionPlan, ScanPlan

Place = Callable[[Rig, Step], None]
"""Brings the artefact of a step to its place, before each capture but those that repeat one without a move; returns
when it stands there and is still."""


def bundle_name(step: Step, take: int) -> str:
    """The folder of a capture's frames."""
    return f"{step.name}-{take + 1}"


def capture_take(
    rig: Rig, plan: AcceptancePlan, bundle: Path, *, progress: ProgressCallback, cancelled: Callable[[], bool]
) -> None:
    """Record a bundle of the artefact that stands before the rig. Raises CalibrationError, and as a scan."""
    calibration = required_calibration(rig)
    # The test must not use what a rendered rig knows of its scene; and the noise of a point, stated next to its form,
    # leaves out the calibration's own error, which the form shows.
    blind = replace(rig, head=None, calibration=replace(calibration, solved=None))
    scan = ScanPlan(exposure_s=plan.exposure_s)
    capture_frames(blind, scan, bundle, progress=progress, cancelled=cancelled).finish()


def evaluated(
    bundle: Path,
    folder: Path,
    plan: AcceptancePlan,
    step: Step,
    take: int,
    /,
    *,
    progress: ProgressCallback,
    cancelled: Callable[[], bool],
) -> Reading:
    """Reconstruct a bundle, measure the artefact in its mesh, and keep its points in `folder`."""
    # The process that owns the rig loads the mathematics only if it has to do it itself.
    from slrig.scan.reconstruct import reconstruct_bundle

    with TemporaryDirectory(dir=bundle.parent, prefix=".mesh-") as scratch:
        made = Path(scratch) / "mesh"
        reconstruct_bundle(bundle, made, plan=ReconstructionPlan(), progress=progress, cancelled=cancelled)
        with storage_errors(made):
            mesh = decode_mesh_ply((made / MESH).read_bytes())
    found, evidence = reading(mesh, step, take, plan)
    keep_points(evidence, folder, step.name, take)
    return found


def run_acceptance(
    rig: Rig,
    plan: AcceptancePlan,
    folder: Path,
    *,
    progress: ProgressCallback,
    cancelled: Callable[[], bool],
    place: Place | None = None,
    again: Callable[[Step, SlrigError], bool] | None = None,
) -> AcceptanceResult:
    """Measure every position of a plan, evaluate, and write report.html, report.json and the points into `folder`.

    `place` None has the rig's positioner move the artefacts: its poses are called as the steps are. The points of each
    capture stay in `folder`/positions, as they come; the reports appear at the end. `again` is asked where an artefact
    was not found or a frame contradicted its pattern: whether to place it anew and capture once more.

    Raises CalibrationError if the rig has no calibration; InvalidInputError if `folder` holds something else;
    UnsupportedByDeviceError if `place` is None, and the rig has no positioner, or one that does not know a position;
    NothingToReconstructError if an artefact is not where it should be, and what was measured before is kept;
    ScanCancelledError; DeviceError, ScanEvidenceError, StorageError as a scan.
    """
    # Late: the service measures position by position, and has the worker write the reports.
    from slrig.accept.report import write_reports

    calibration = required_calibration(rig)
    mover = by_positioner(rig, plan) if place is None else place
    _require_free(folder)
    begun = utc_now()
    readings = tuple(_measured(rig, plan, folder, progress, cancelled, mover, again))
    result = AcceptanceResult(rig.name, begun, utc_now(), plan, calibration, readings, verdicts(readings, plan))
    write_reports(result, folder)
    return result


def _measured(
    rig: Rig,
    plan: AcceptancePlan,
    folder: Path,
    progress: ProgressCallback,
    cancelled: Callable[[], bool],
    place: Place,
    again: Callable[[Step, SlrigError], bool] | None,
) -> Iterator[Reading]:
    """Capture and evaluate each step, one capture after the other, and keep its points in `folder`. A repeat is
    captured without a move, so that it shows the scanner's scatter alone.
    """
    takes = plan.takes
    for index, (step, take) in enumerate(takes):

        def told(stage: str, fraction: float, detail: str, /, name: str = step.name, index: int = index) -> None:
            progress(f"{name}: {stage}", (index + min(max(fraction, 0.0), 1.0)) / len(takes), detail)

        if cancelled():
            message = f"the acceptance test was cancelled before {step.name}; what was measured before is kept"
            raise ScanCancelledError(message)
        while True:
            if take == 0:
                told("place", 0.0, step.words)
                place(rig, step)
            try:
                found = _captured(rig, plan, step, take, folder, told, cancelled)
                break
            except (NothingToReconstructError, ScanEvidenceError) as error:
                if again is None or not again(step, error):
                    raise
        yield found


def _captured(
    rig: Rig,
    plan: AcceptancePlan,
    step: Step,
    take: int,
    folder: Path,
    progress: ProgressCallback,
    cancelled: Callable[[], bool],
) -> Reading:
    work = folder / f".{step.name}-{take + 1}"
    shutil.rmtree(work, ignore_errors=True)
    try:
        with storage_errors(work):
            work.mkdir(parents=True)
        bundle = work / bundle_name(step, take)
        capture_take(rig, plan, bundle, progress=progress, cancelled=cancelled)
        return evaluated(bundle, folder, plan, step, take, progress=progress, cancelled=cancelled)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def by_positioner(rig: Rig, plan: AcceptancePlan) -> Place:
    """A `Place` that has the rig's positioner move. Raises UnsupportedByDeviceError if it does not know a position."""
    poses = () if rig.positioner is None else tuple(rig.positioner.poses)
    missing = [step.name for step in plan.steps if step.name not in poses]
    if missing:
        has = f"a positioner with {', '.join(poses)}" if poses else "no positioner"
        message = (
            f"rig '{rig.name}' has {has}, and the test needs the positions {', '.join(missing)}; place the artefacts "
            f"by hand (without {setting('scripted')}), or name the positioner's poses so"
        )
        raise UnsupportedByDeviceError(message)

    def move(rig: Rig, step: Step, /) -> None:
        if rig.positioner is not None:
            rig.positioner.move(poses.index(step.name))

    return move


def required_calibration(rig: Rig) -> Calibration:
    """The rig's calibration. Raises CalibrationError if it has none."""
    if rig.calibration is None:
        message = f"rig '{rig.name}' has no calibration, and nothing can be measured; calibrate it first"
        raise CalibrationError(message)
    return rig.calibration


def _require_free(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        message = f"{folder}: the results of an acceptance test go into a new folder, and this one is not empty"
        raise InvalidInputError(message)
