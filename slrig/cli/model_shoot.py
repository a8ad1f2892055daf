"""`slrig model --shoot`: the views of an object shot around it, by a rig of this process or by a running service."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import typer

from slrig.api.schemas import ScanRequest, scan_plan
from slrig.bundle import DESCRIPTION, read_turntable_angle
from slrig.cli.display import answered, progress_shown
from slrig.cli.reconstruct import prepare_kernels
from slrig.client import Client
from slrig.client.connection import Progress
from slrig.config import read_rig
from slrig.devices import Rig, Turntable
from slrig.discovery import open_rig
from slrig.errors import ConfigError, ServiceError, SlrigError, ViewsFailedError
from slrig.jobs.listener import Listener
from slrig.jobs.records import utc_now
from slrig.model_jobs.job import TURN
from slrig.model_jobs.plan import ShootPlan, StartingPoses, StatedAxis, TurntablePoses
from slrig.rig.session import CountedTurntable
from slrig.scan.acquisition import capture_frames
from slrig.scan.artefacts import MESH
from slrig.scan.plan import ScanPlan, no_turntable
from slrig.scan.reconstruct import reconstruct_bundle


def views_here(
    rig_file: Path,
    count: int,
    output: Path,
    *,
    manual: bool,
    axis: StatedAxis | None,
    found: StartingPoses | None = None,
) -> tuple[dict[str, Path], StartingPoses, list[str]]:
    """Shoot the views that `output` lacks, each into view-N with its frames in bundle-N. Return the meshes by name,
    the start of their alignment, and notes on views that failed. Ctrl-C leaves what was shot.

    axis : None for the turntable's own. found : unknown, or by markers: no angle and no axis is needed.

    Raises
    ------
    ConfigError
        The rig file is wrong, or the axis is not known.
    UnsupportedByDeviceError
        The rig has no turntable, and `manual` is not set.
    ViewsFailedError
        Fewer than two views succeeded.
    """
    config = read_rig(rig_file)
    shoot, model_id, notes = ShootPlan(count, scan_plan(ScanRequest(), config.scan), manual), uuid4(), []
    meshes = {number: output / f"view-{number}" / MESH for number in range(1, count + 1)}
    with open_rig(config) as rig:
        table = rig.positioner if isinstance(rig.positioner, Turntable) else None
        if table is None and not manual:
            raise no_turntable(0.0)
        if table is not None:
            rig = replace(rig, positioner=CountedTurntable(table, output / "table.json"))
        if axis is None and table is not None and table.axis is not None:
            axis = StatedAxis.of(table.axis.point_mm, table.axis.direction)
        if axis is None and found is None:
            raise ConfigError(
                "expected the turntable's axis, which the rig does not know: say --axis, --axis-point, --markers or "
                "--unknown"
            )
        for number in [number for number, mesh in meshes.items() if not mesh.is_file()]:
            prompt = f"turn the object by about {shoot.step_deg:g}°, to {shoot.angle_deg(number):g}° in all,"
            while not manual or number == 1 or answered(f"{prompt} then press Enter (q: no more) > ") != "q":
                try:
                    _shot(rig, shoot.view(number, model_id, utc_now()), output, number)
                    break
                except SlrigError as error:
                    typer.secho(f"view-{number}: {error}", fg="red", err=True)
                    prompt = "to shoot it again, turn nothing,"
                    if not manual or number == 1:
                        notes.append(f"view-{number}, at {shoot.angle_deg(number):g}°, is not in it: {error}")
                        break
            else:
                break
    good = {number: mesh for number, mesh in meshes.items() if mesh.is_file()}
    if len(good) < 2:
        message = f"{len(good)} of {count} views succeeded, and a model takes two. The same command shoots the others."
        raise ViewsFailedError(message)
    turntables = [
        turntable
        for turntable in map(read_turntable_angle, (output / f"bundle-{number}" for number in good))
        if turntable is not None
    ]
    if found is None and (len(turntables) < len(good) or len({turntable.count for turntable in turntables}) > 1):
        message = (
            f"{output}: expected angles of one zero in all views, found some without one, or that the turntable lost "
            "its place between them; shoot into another folder, or say --unknown"
        )
        raise ConfigError(message)
    # As they were shot, perhaps by a command with another number of views.
    angles_deg = tuple(turntable.angle_deg for turntable in turntables)
    poses = TurntablePoses(axis, angles_deg) if found is None else found
    return {mesh.parent.name: mesh for mesh in good.values()}, poses, notes


def _shot(rig: Rig, plan: ScanPlan, output: Path, number: int) -> None:
    """One view; of frames that an earlier call has left, only the mesh is made."""
    bundle = output / f"bundle-{number}"
    with progress_shown() as display:
        prepare_kernels(display)
        if not (bundle / DESCRIPTION).is_file():
            try:
                capture_frames(rig, plan, bundle, Listener(report=display)).finish()
            except BaseException:
                shutil.rmtree(bundle, ignore_errors=True)
                raise
        folder = output / f"view-{number}"
        reconstruct_bundle(bundle, folder, Listener(report=display), plan=plan.reconstruction)


def views_there(client: Client, request: Mapping[str, Any], output: Path) -> None:
    """Shoot the views and make the model by a service, and fetch its files into `output`. Ctrl-C cancels; finished
    scans stay with the service.

    Raises ServiceError: it refused, is gone, or the model failed.
    """
    model: dict[str, Any] = client.models.shoot(**request, if_busy="queue")
    here, events, turn = model["id"], client.models.follow(model["id"]), "begin"
    try:
        while turn:
            turn = ""
            with progress_shown() as display:
                for event in events:
                    if isinstance(event, Progress):
                        display(event.stage, event.fraction, event.detail)
                        if event.stage == TURN:
                            turn = event.detail
                            break
            if turn:
                answer = answered(f"{turn}, then press Enter (a: shoot the last one again, q: no more) > ")
                _ = (
                    client.models.combine(here)
                    if answer == "q"
                    else client.models.view(here, again=answer == "a", if_busy="queue")
                )
    except (KeyboardInterrupt, ServiceError):
        # The person would no longer turn the object for it.
        with suppress(ServiceError):
            client.models.cancel(here)
        raise
    model = client.models.get(here)
    if model["state"] != "succeeded":
        raise ServiceError(f"Model {here} {model['state']}: {model['error']['detail']}")
    output.mkdir(parents=True, exist_ok=True)
    for name, link in model["links"]["files"].items():
        client.fetch(link, output / name)
