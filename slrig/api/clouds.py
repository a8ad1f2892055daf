"""The files of a finished scan that the worker makes when they are first asked for: its surface in cameras' grids."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from uuid import UUID

from slrig.api.service import Service
from slrig.bundle import CALIBRATION, DESCRIPTION, write_file
from slrig.errors import InvalidInputError, JobNotFoundError, StorageError, WorkerBusyError
from slrig.jobs.data_folder import BUNDLE, DataFolder
from slrig.jobs.worker_process import Task
from slrig.scan.artefacts import MESH, REPORT
from slrig.scan.job import cloud_bytes
from slrig.scan.offered import causes_picture, missing_for, requested_forms

LONGEST_WAIT_S = 30.0
"""From when on a request that waits for the worker is told to come again: clients wait a minute for an answer."""

MOST_WAITING = 8
"""Requests that may wait for the worker: each holds one of the forty threads that answer."""

# A cloud takes the worker half a second and some hundred megabytes: one at a time, whoever asks.
_making = threading.Lock()
_places = threading.BoundedSemaphore(MOST_WAITING)


def clouds_of(folder: DataFolder, scan: Path, names: Iterable[str]) -> set[str]:
    """Names of the files that can be made of a finished scan on request, here. names : of its files."""
    given = set(names)
    prefix, suffix = causes_picture("/").split("/")
    cameras = [name.removeprefix(prefix).removesuffix(suffix) for name in given if name.startswith(prefix)]
    forms = [form for form in requested_forms() if missing_for(form) is None]
    of_cameras = [form for form in forms if "{camera}" in form]
    sources = [camera for camera in cameras if has_sources(folder, scan, camera)]
    found = {form.format(camera=camera) for camera in sources for form in of_cameras}
    if cameras and has_sources(folder, scan, None):
        found.update(form for form in forms if "{camera}" not in form)
    return found


def has_sources(folder: DataFolder, scan: Path, camera: str | None) -> bool:
    """True if the sources of a camera's cloud exist; None: those of a file of all cameras, except maps of causes."""
    further = f"{BUNDLE}/{DESCRIPTION}" if camera is None else causes_picture(camera)
    sources = MESH, REPORT, further, f"{BUNDLE}/{CALIBRATION}"
    return all(folder.owns(scan / source) for source in sources)


def make_cloud(service: Service, scan_id: UUID, form: str, camera: str | None) -> None:
    """Make one of `requested_forms` of a finished scan in the worker, and keep it, unless it exists.

    Raises
    ------
    WorkerBusyError
        It was not its turn for too long, or too many wait.
    ExtraMissingError
        The format takes a library that is not installed.
    InvalidInputError, NothingToReconstructError
        A file of the scan is not as slrig wrote it, or the camera sees nothing of the mesh.
    JobNotFoundError
        The scan was deleted meanwhile.
    StorageError
        The disk refused.
    WorkerLostError, OutOfMemoryError
        It came to nothing.
    """
    place = service.folder.scan(scan_id)
    path = place / form.format(camera=camera)
    until_s = time.monotonic() + LONGEST_WAIT_S
    if not _places.acquire(blocking=False):
        message = f"{MOST_WAITING} requests wait for the worker already. Ask again for {path.name}."
        raise WorkerBusyError(message)
    try:
        if not _making.acquire(timeout=LONGEST_WAIT_S):
            message = f"Another file is made first, and {path.name} has to wait for it. Ask again."
            raise WorkerBusyError(message)
        try:
            if os.path.lexists(path):
                return
            task = Task(cloud_bytes, (place, form, camera), what=f"making of {path.name}", remedy="Ask again.")
            data = service.worker.run(task, within_s=max(until_s - time.monotonic(), 0.0))
            # From here, not by the worker: where that is killed nothing is left half written.
            service.folder.require_space(len(data) + service.settings.min_free_bytes)
            write_file(path, data)
        finally:
            _making.release()
    except (InvalidInputError, StorageError) as error:
        if service.folder.owns(place):
            raise
        message = f"Scan {scan_id} was deleted while {path.name} was made of it."
        raise JobNotFoundError(message) from error
    finally:
        _places.release()
