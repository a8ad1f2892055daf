"""/rig and /device: the rig as it is held, and what else is installed and plugged in."""

from __future__ import annotations

from datetime import datetime
from uuid import UUID

from fastapi import APIRouter

from slrig.api.schemas import CalibrationInUse, CameraBody, DeviceList, ProjectorBody, RigBody, filled
from slrig.api.service import Serving
from slrig.devices import CameraInfo
from slrig.discovery import found_devices, installed_drivers
from slrig.jobs.records import utc_now
from slrig.model import Size
from slrig.scan.runner import RunnerStatus

router = APIRouter(tags=["rig"])


@router.get("/rig")
def look_at_rig(service: Serving) -> RigBody:
    """Return the rig: its devices, who holds it, and how many scans wait. Touches no device."""
    status = service.runner.status()
    facts = status.facts
    return filled(
        RigBody,
        status,
        name=status.rig,
        open=facts is not None and status.fault is None,
        error=status.fault,
        calibrated=None if facts is None else (status.active is not None or facts.calibration is not None),
        calibration=_in_use(status),
        positions=[] if facts is None else facts.positions,
        cameras=[] if facts is None else [_camera(name, camera) for name, camera in facts.cameras.items()],
        projector=None
        if facts is None
        else filled(ProjectorBody, facts.projector, size_px=_extent(facts.projector.size)),
        scan_defaults=service.scan_defaults.model_dump(exclude_none=True),
    )


@router.get("/device")
def list_devices() -> DeviceList:
    """Return the drivers that are installed, the devices that are plugged in, and the libraries that are missing."""
    found = found_devices()
    return filled(DeviceList, found, drivers=installed_drivers(), faults=[str(fault) for fault in found.faults])


def _in_use(status: RunnerStatus) -> CalibrationInUse | None:
    active, facts = status.active, status.facts
    calibration = active.calibration if active is not None else None if facts is None else facts.calibration
    if calibration is None:
        return None
    solved = calibration.solved
    solved_at = None if solved is None else datetime.fromisoformat(solved.solved_at)
    return CalibrationInUse(
        source="rig" if active is None else "session",
        id=None if active is None else UUID(active.name),
        solve=None if solved is None else solved.id,
        solved_at=solved_at,
        age_s=None if solved_at is None else round((utc_now() - solved_at).total_seconds(), 1),
        expected_error_mm=None if solved is None else solved.expected_error_mm,
        error=status.misfit,
    )


def _camera(name: str, camera: CameraInfo) -> CameraBody:
    form = camera.format
    triggers = sorted(camera.triggers)
    return filled(
        CameraBody, camera, name=name, size_px=_extent(form.size), bit_depth=form.bit_depth, triggers=triggers
    )


def _extent(size: Size) -> tuple[int, int]:
    return (size.width_px, size.height_px)
