"""The files of a scan: mesh, points, report, pictures, clouds made on request, and the bundle, or a file of several
scans, as one zip.
"""

from __future__ import annotations

import re
import threading
import time
import zipfile
from collections.abc import Awaitable, Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import quote
from uuid import UUID

import structlog
from fastapi import APIRouter, Header, Query, Response
from fastapi import Path as PathParameter
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, StreamingResponse

from slrig.api.events import Held
from slrig.api.problems import BYTES, file_of
from slrig.api.service import Service, Serving
from slrig.bundle import CALIBRATION, CAMERA_NAME, DESCRIPTION, write_file
from slrig.errors import (
    ArtefactNotReadyError,
    DamagedError,
    InvalidInputError,
    JobNotFoundError,
    StorageError,
    WorkerBusyError,
)
from slrig.failure import job_failure
from slrig.jobs.data_folder import BUNDLE, FILES, DataFolder, read_entries
from slrig.jobs.records import JobKind, JobRecord, JobState
from slrig.jobs.worker import REQUEST_WAIT_S, Task
from slrig.scan.artefacts import MESH, ON_REQUEST, REPORT, converted, write_converted
from slrig.scan.formats import (
    BUNDLE_ZIP,
    CALIBRATION_USED,
    MEDIA_TYPES,
    PREVIEW,
    THUMBNAIL,
    agreement_picture,
    causes_picture,
    missing_for,
    rejected_picture,
    requested_forms,
)
from slrig.scan.job import cloud_bytes
from slrig.scan.thumbnail import encode_thumbnail

# A cloud takes the worker half a second and some hundred megabytes: one at a time for all requests.
_making = threading.Lock()


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
    sources = MESH, REPORT, further, _calibration_used(scan)
    return all(folder.owns(scan / source) for source in sources)


def _make_cloud(service: Service, scan_id: UUID, form: str, camera: str | None, until_s: float) -> None:
    """Make one of `requested_forms` of a finished scan in the worker, and keep it, unless it exists.

    until_s : from when on, by the monotonic clock, it does not wait for the worker any more.

    Raises
    ------
    ArtefactNotReadyError
        The scan is not over, or the file cannot be made of it.
    WorkerBusyError
        It was not its turn for too long.
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
    record = _record(service, scan_id)
    if not record.state.final or not has_sources(service.folder, place, camera):
        refuse_absent(record, path.name)
    require_whole(service, record, place, *read_entries(place))
    if not _making.acquire(timeout=max(until_s - time.monotonic(), 0.0)):
        message = f"Another file is made first, and {path.name} has to wait for it. Try again."
        raise WorkerBusyError(message)
    try:
        if not service.folder.has_made(place, path.name):
            task = Task(cloud_bytes, (place, form, camera), what=f"making of {path.name}", remedy="Try again.")
            data = service.worker.run(task, within_s=max(until_s - time.monotonic(), 0.0))
            # From here, not by the worker: where that is killed nothing is left half written.
            service.folder.require_space(len(data) + service.settings.min_free_bytes)
            write_file(path, data)
            service.folder.note_made(place, path.name)
    except (InvalidInputError, StorageError) as error:
        if service.folder.owns(place):
            raise
        message = f"Scan {scan_id} was deleted while {path.name} was made of it."
        raise JobNotFoundError(message) from error
    finally:
        _making.release()


_CHUNK_BYTES = 2**20
_ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)

router = APIRouter(prefix="/scan/{scan_id}", tags=["files"])

_log = structlog.get_logger(__name__)

Camera = Annotated[str, PathParameter(pattern=CAMERA_NAME)]
KnownTag = Annotated[str | None, Header(alias="If-None-Match", description="an ETag; 304 if it still holds")]


def ready_files(folder: DataFolder, record: JobRecord) -> dict[str, str]:
    """Name to URL path of each file of a scan that can be fetched now."""
    if record.state is JobState.COMPUTING:
        names = set().union(*map(_known_files, folder.places(record.id)))
    elif record.state.final and folder.owns(folder.scan(record.id)):
        names = _known_files(folder.scan(record.id))
        names |= clouds_of(folder, folder.scan(record.id), names)
        if folder.owns(folder.scan(record.id) / BUNDLE):
            names.add(BUNDLE_ZIP)
    else:
        return {}
    if MESH in names:
        names |= set(ON_REQUEST)
        if record.state.final and folder.owns(folder.scan(record.id) / _calibration_used(folder.scan(record.id))):
            names.add(CALIBRATION_USED)
    return {name: f"/scan/{record.id}/{name}" for name in sorted(names)}


def _known_files(place: Path) -> set[str]:
    try:
        known = [path for path in place.iterdir() if path.name in MEDIA_TYPES or path.suffix == ".png"]
    except FileNotFoundError:
        return set()
    return {path.name for path in known if not path.is_symlink()}


def refuse_absent(record: JobRecord, name: str) -> None:
    """Raise ArtefactNotReadyError, which says why a scan or a model has no such file, or not yet."""
    kind, here = record.kind, f"/{record.kind}/{record.id}"
    if not record.state.final:
        message = (
            f"{name} of {kind} {record.id} is not ready: the {kind} is {record.state}. "
            f"Follow {here}/events until it is over."
        )
    elif record.state is JobState.SUCCEEDED:
        message = f"{kind.capitalize()} {record.id} has no file {name}. GET {here} names those it has."
    else:
        why = "" if record.fault is None else f" ({record.fault.message})"
        again = "Scan again." if kind is JobKind.SCAN else "Make it again."
        message = f"{kind.capitalize()} {record.id} was {record.state}, so {name} will never be made{why}. {again}"
    raise ArtefactNotReadyError(message)


def _record(service: Service, scan_id: UUID) -> JobRecord:
    """The record of a scan; notes that its files are being read."""
    record = service.store.get(scan_id, JobKind.SCAN)
    service.retention.reading(scan_id)
    return record


def _convert(service: Service, scan_id: UUID, name: str) -> tuple[JobRecord, bytes | None]:
    """Make one of `ON_REQUEST`: kept where its scan is over, returned with the record while it is under way."""
    record, place = _record(service, scan_id), service.folder.scan(scan_id)
    if record.state.final and service.folder.owns(place / MESH) and not service.folder.has_made(place, name):
        require_whole(service, record, place, MESH)
        write_converted(place, name)
        service.folder.note_made(place, name)
    return record, _made_so_far(service.folder, record, name)


def _file(
    service: Service,
    scan_id: UUID,
    name: str,
    media_type: str,
    known: str | None,
    converted_now: tuple[JobRecord, bytes | None] | None = None,
) -> Response:
    place = service.folder.scan(scan_id)
    path = place / name
    if converted_now is None:
        record = _record(service, scan_id)
        made = _made_so_far(service.folder, record, name)
    else:
        record, made = converted_now
    if made is None and record.state.final:
        require_whole(service, record, place, MESH if name in ON_REQUEST else name)
    if made is None and not (record.state.final and service.folder.owns(path)):
        refuse_absent(record, path.name)
    headers = _headers(record, name, None if made is not None else place)
    if _still_known(known, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    if made is not None:
        return Response(made, media_type=media_type, headers=headers)
    return _kept(path, media_type, headers)


def require_whole(service: Service, record: JobRecord, place: Path, *names: str) -> None:
    """Raise DamagedError unless files of a job that is over are as they were committed. The record says so, too."""
    try:
        service.folder.require_whole(place, *names)
    except DamagedError as error:
        _log.error("files are damaged", kind=str(record.kind), job=str(record.id), cause=str(error))
        if record.state is JobState.SUCCEEDED:
            service.store.lose_files(record.id, job_failure(error))
        raise


def kept_file(path: Path, media_type: str, record: JobRecord, known: str | None) -> Response:
    """A file that never changes, of a job that is over; 304 where the client knows it."""
    headers = _headers(record, path.name, path.parent)
    return (
        Response(status_code=304, headers=headers)
        if _still_known(known, headers["ETag"])
        else _kept(path, media_type, headers)
    )


class _File(FileResponse):
    chunk_size = 2**19
    """Bytes: each piece takes a thread and the loop, and a mesh has megabytes."""


def _kept(path: Path, media_type: str, headers: dict[str, str]) -> Response:
    return _File(path, media_type=media_type, headers=headers)


def _cloud(service: Service, scan_id: UUID, form: str, camera: str | None, known: str | None) -> Response:
    """One of `requested_forms`, once it is made. That is only when a scan is over: it takes all of its files."""
    place = service.folder.scan(scan_id)
    path = place / form.format(camera=camera)
    record = _record(service, scan_id)
    if not record.state.final or not has_sources(service.folder, place, camera):
        refuse_absent(record, path.name)
    headers = _headers(record, path.name, place)
    if _still_known(known, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    if not service.folder.owns(path):
        refuse_absent(record, path.name)
    return _kept(path, requested_forms()[form], headers)


def _made_so_far(folder: DataFolder, record: JobRecord, name: str) -> bytes | None:
    """A file of a scan that is being reconstructed, once it is there, or its mesh. Read as a whole: the scan may be put
    in its place at any moment; what is made of the mesh is kept only there.
    """
    if record.state is not JobState.COMPUTING:
        return None
    for place in folder.places(record.id):
        with suppress(FileNotFoundError):
            return converted(folder.read(place / MESH), name) if name in ON_REQUEST else folder.read(place / name)
    return None


_SLUG_CHARACTERS = 80


def saved_name(record: JobRecord, name: str) -> str:
    """Name of a saved file of a scan or a model: RIG-LABEL-FILE; without a label, by its time here.

    Letters and digits of all scripts stay, all else becomes a hyphen: it is one name on every system.
    """
    begun = f"{record.created_at.astimezone():%Y-%m-%d-%H%M%S}"
    return "-".join(filter(None, (_slug(record.rig), _slug(record.label or "") or begun, name.rpartition("/")[2])))


def _slug(text: str) -> str:
    return re.sub(r"[^\w.]+", "-", text).strip("-.")[:_SLUG_CHARACTERS]


def disposition(called: str, kind: Literal["inline", "attachment"] = "inline") -> str:
    """The header Content-Disposition (RFC 6266) of a file that is to be saved as `called`.

    >>> disposition("rig-cup-mesh.ply"), disposition("rig-Größe-mesh.ply")
    ('inline; filename="rig-cup-mesh.ply"', "inline; filename*=utf-8''rig-Gr%C3%B6%C3%9Fe-mesh.ply")
    """
    quoted = quote(called)
    return f'{kind}; filename="{called}"' if quoted == called else f"{kind}; filename*=utf-8''{quoted}"


def _headers(record: JobRecord, name: str, place: Path | None) -> dict[str, str]:
    # An id is never given twice, and a job's files change only where they are made once more.
    committed = None
    if place is not None:
        with suppress(OSError):
            committed = (place / FILES).stat().st_mtime_ns
    tag = f"{record.id}/{name}" if committed is None else f"{record.id}/{name}/{committed:x}"
    called = disposition(saved_name(record, name))
    return {"ETag": f'"{tag}"', "Cache-Control": "private, no-cache", "Content-Disposition": called}


def _still_known(known: str | None, tag: str) -> bool:
    if known is None:
        return False
    tags = [candidate.strip().removeprefix("W/") for candidate in known.split(",")]
    return "*" in tags or tag in tags


def _serve(name: str, media_type: str) -> Callable[..., Response | Awaitable[Response]]:
    def fetch(service: Serving, scan_id: UUID, known: KnownTag = None) -> Response:
        return _file(service, scan_id, name, media_type, known)

    async def make(service: Serving, scan_id: UUID, known: KnownTag = None) -> Response:
        made = None
        if not await run_in_threadpool(service.folder.has_made, service.folder.scan(scan_id), name):
            made = await service.makings.of((scan_id, name), partial(_convert, service, scan_id, name))
        return await run_in_threadpool(_file, service, scan_id, name, media_type, known, made)

    made = " It is made of mesh.ply when it is requested, and kept once the scan is over." if name in ON_REQUEST else ""
    fetch.__doc__ = make.__doc__ = (
        f"Return {name} of a scan that succeeded, or that is being reconstructed, as soon as it is there.{made} ETags "
        "are honoured, and ranges once the scan is over."
    )
    return make if name in ON_REQUEST else fetch


_UNCHANGED: dict[int | str, dict[str, Any]] = {304: {"description": "the file has the ETag that was sent"}}


def file_answers(media_type: str, *further: int) -> dict[int | str, dict[str, Any]]:
    """The `responses` of a route that answers with a file that never changes."""
    # A part of a JSON file is not JSON.
    part = {"description": "the requested range", "content": {media_type: {"schema": BYTES}}}
    return {**file_of(media_type, 409, 416, *further), 206: part, **_UNCHANGED}


for _name, _media_type in MEDIA_TYPES.items():
    _fetch = _serve(_name, _media_type)
    router.add_api_route(
        f"/{_name}",
        _fetch,
        methods=["GET"],
        response_class=Response,
        responses=file_answers(_media_type, *([503] if _name in ON_REQUEST else [])),
        operation_id=f"fetch_{_name.replace('.', '_')}",
        summary=f"Fetch {_name}",
    )


def _serve_cloud(form: str) -> Callable[..., Awaitable[Response]]:
    async def made(service: Service, scan_id: UUID, camera: str | None, known: str | None) -> Response:
        name = form.format(camera=camera)
        if not await run_in_threadpool(service.folder.has_made, service.folder.scan(scan_id), name):
            make = partial(_make_cloud, service, scan_id, form, camera, time.monotonic() + REQUEST_WAIT_S)
            await service.clouds.of((scan_id, name), make)
        return await run_in_threadpool(_cloud, service, scan_id, form, camera, known)

    if "{camera}" in form:

        async def fetch(service: Serving, scan_id: UUID, camera: Camera, known: KnownTag = None) -> Response:
            return await made(service, scan_id, camera, known)

        what = f"{form.format(camera='CAMERA')}, the surface of a finished scan in the grid of a camera"
    else:

        async def fetch(service: Serving, scan_id: UUID, known: KnownTag = None) -> Response:  # type: ignore[misc]
            return await made(service, scan_id, None, known)

        what = f"{form}, a finished scan with the points of all cameras"
    fetch.__doc__ = (
        f"Return {what}. It is made of the scan's files when it is first requested, and kept; 503 while others are "
        "computed for long."
    )
    return fetch


for _form, _media_type in requested_forms().items():
    router.add_api_route(
        f"/{_form}",
        _serve_cloud(_form),
        methods=["GET"],
        response_class=Response,
        responses=file_answers(_media_type, 501, 503, 507),
        operation_id=f"fetch_camera_{_form.replace('-{camera}.', '_')}"
        if "{" in _form
        else f"fetch_{_form.replace('.', '_')}",
        summary=f"Fetch {_form}",
    )


@router.get(f"/{CALIBRATION_USED}", response_class=Response, responses=file_answers("application/json"))
def fetch_calibration_used(service: Serving, scan_id: UUID, known: KnownTag = None) -> Response:
    """Return the calibration that a finished scan was made with: lenses and poses of its devices."""
    name = _calibration_used(service.folder.scan(scan_id))
    return _file(service, scan_id, name, "application/json", known)


def _calibration_used(scan: Path) -> str:
    """Place of the calibration in the folder of a scan: its own where the scan had to find one, else the rig's."""
    return CALIBRATION if (scan / CALIBRATION).is_file() else f"{BUNDLE}/{CALIBRATION}"


@router.get(f"/{rejected_picture('{camera}')}", response_class=Response, responses=file_answers("image/png"))
def fetch_rejected(
    service: Serving,
    scan_id: UUID,
    camera: Camera,
    known: KnownTag = None,
) -> Response:
    """Return the picture of a camera's refused pixels, one colour per cause."""
    return _file(service, scan_id, rejected_picture(camera), "image/png", known)


@router.get(f"/{causes_picture('{camera}')}", response_class=Response, responses=file_answers("image/png"))
def fetch_causes(
    service: Serving,
    scan_id: UUID,
    camera: Camera,
    known: KnownTag = None,
) -> Response:
    """Return why each pixel of a camera gave no point: grey values are places in report.json's `causes`."""
    return _file(service, scan_id, causes_picture(camera), "image/png", known)


@router.get(f"/{agreement_picture('{camera}')}", response_class=Response, responses=file_answers("image/png"))
def fetch_agreement(
    service: Serving,
    scan_id: UUID,
    camera: Camera,
    known: KnownTag = None,
) -> Response:
    """Return how far columns and rows disagree at each pixel of a camera; only scans that played both axes have it."""
    return _file(service, scan_id, agreement_picture(camera), "image/png", known)


@router.get(f"/{BUNDLE_ZIP}", response_class=Response, responses={**file_of("application/zip", 409), **_UNCHANGED})
async def fetch_bundle(held: Held, service: Serving, scan_id: UUID, known: KnownTag = None) -> Response:
    """Return the recorded frames and all that belongs to them; unzipped, `slrig reconstruct` reads them.

    A scan with a failed reconstruction has its bundle, too.
    """
    held.enter_context(service.streams.take())
    return await run_in_threadpool(_bundle, service, scan_id, known)


def _bundle(service: Service, scan_id: UUID, known: str | None) -> Response:
    record = _record(service, scan_id)
    bundle = service.folder.scan(scan_id) / BUNDLE
    if not record.state.final or not service.folder.owns(bundle):
        refuse_absent(record, BUNDLE_ZIP)
    recorded = [each for each in read_entries(bundle.parent) if each.startswith(f"{BUNDLE}/")]
    require_whole(service, record, bundle.parent, *recorded)
    headers = {
        **_headers(record, BUNDLE_ZIP, bundle.parent),
        "Content-Disposition": disposition(saved_name(record, BUNDLE_ZIP), "attachment"),
    }
    if _still_known(known, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    # What a link leads to was not recorded here.
    files = [path for path in sorted(bundle.rglob("*")) if path.is_file() and not path.is_symlink()]
    named = [(path.relative_to(bundle).as_posix(), path) for path in files]
    return StreamingResponse(zipped(named), media_type="application/zip", headers=headers)


MOST_TOGETHER = 50
"""Scans of which a file can be had in one zip."""

together_router = APIRouter(prefix="/scan", tags=["files"])


@together_router.get(
    "/files.zip", response_class=Response, responses={**file_of("application/zip", 404, 409, 410, 503)}
)
async def fetch_together(
    held: Held,
    service: Serving,
    scan: Annotated[list[UUID], Query(min_length=1, max_length=MOST_TOGETHER, description="ids of finished scans")],
    file: Annotated[
        Literal["mesh.ply", "mesh.glb", "mesh.stl", "mesh.obj", "mesh.3mf", "points.ply", "report.json", "preview.png"],
        Query(description="which of each"),
    ] = "mesh.ply",
) -> Response:
    """Return one file of each of several scans as a zip. Files that are made on request are made first; after 30 s the
    answer is 503 with `Retry-After`, and the next request goes on from there.
    """
    held.enter_context(service.streams.take())
    until_s = time.monotonic() + REQUEST_WAIT_S
    named: dict[str, Path] = {}
    for number, scan_id in enumerate(dict.fromkeys(scan)):
        path = service.folder.scan(scan_id) / file
        if file in ON_REQUEST and not await run_in_threadpool(service.folder.has_made, path.parent, file):
            if time.monotonic() > until_s:
                message = f"{number} of {len(scan)} files are made. Try again for the others."
                raise WorkerBusyError(message)
            await service.makings.of((scan_id, file), partial(_convert, service, scan_id, file))
        record = await run_in_threadpool(_whole_file, service, scan_id, file)
        called = saved_name(record, file)
        if called in named:
            called = saved_name(replace(record, label=f"{record.label or ''} {str(scan_id)[:8]}"), file)
        named[called] = path
    headers = {
        "Content-Disposition": disposition(f"{_slug(record.rig)}-{len(named)}-scans-{file}.zip", "attachment"),
        "Cache-Control": "no-store",
    }
    return StreamingResponse(zipped(named.items()), media_type="application/zip", headers=headers)


def _whole_file(service: Service, scan_id: UUID, name: str) -> JobRecord:
    """The record of a finished scan with an undamaged file of this name."""
    record, place = _record(service, scan_id), service.folder.scan(scan_id)
    if not record.state.final or not service.folder.owns(place / name):
        refuse_absent(record, name)
    require_whole(service, record, place, MESH if name in ON_REQUEST else name)
    return record


@router.get(f"/{THUMBNAIL}", response_class=Response, responses={**file_of("image/png", 409), **_UNCHANGED})
def fetch_thumbnail(service: Serving, scan_id: UUID, known: KnownTag = None) -> Response:
    """Return a small picture of the mesh alone, for lists."""
    record = _whole_file(service, scan_id, PREVIEW)
    place = service.folder.scan(scan_id)
    headers = _headers(record, THUMBNAIL, place)
    if _still_known(known, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    return Response(encode_thumbnail(service.folder.read(place / PREVIEW)), media_type="image/png", headers=headers)


class _Outlet(bytearray):
    """A file that only grows: what was written is taken out as it comes."""

    def write(self, data: bytes) -> int:
        self.extend(data)
        return len(data)

    def flush(self) -> None:
        """Nothing is held back."""

    def take(self) -> bytes:
        taken = bytes(self)
        self.clear()
        return taken


def zipped(named: Iterable[tuple[str, Path]]) -> Iterator[bytes]:
    """Files by their names in it as the bytes of a zip, stored (frames are compressed already), a piece at a time.

    The same files give the same bytes: all times are the zip format's first.
    """
    outlet = _Outlet()
    with zipfile.ZipFile(outlet, "w") as archive:  # type: ignore[call-overload] # write and flush are enough
        for name, path in named:
            entry = zipfile.ZipInfo(name, _ZIP_EPOCH)
            entry.external_attr = 0o644 << 16
            with path.open("rb") as source, archive.open(entry, "w", force_zip64=True) as member:
                while piece := source.read(_CHUNK_BYTES):
                    member.write(piece)
                    yield outlet.take()
            yield outlet.take()
    yield outlet.take()
