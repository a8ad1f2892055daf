"""The client of a service, a scan that runs, and the result of a scan that is done."""

from __future__ import annotations

import io
import json
import time
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from email.message import EmailMessage
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeAlias, TypeVar

import httpx2

from slrig.client.connection import Connection, Event, Json, Progress, StateChange, given
from slrig.client.errors import ScanFailedError
from slrig.client.live import Live
from slrig.client.resources import (
    Acceptance,
    CalibrationResource,
    Examinations,
    HandEyeResource,
    IfBusy,
    Models,
    Notices,
    PresetResource,
    ProgressCallback,
    RigHealth,
    RigState,
    Scans,
    Schedules,
    System,
    TurntableResource,
)
from slrig.errors import ScanCancelledError, ServiceError

if TYPE_CHECKING:
    import numpy as np
    import trimesh
    from numpy.typing import NDArray

    from slrig.client.connection import Picture

    Floats: TypeAlias = NDArray[np.float32]
    Bytes: TypeAlias = NDArray[np.uint8]

_VIEWER = Path(__file__).with_name("viewer.html")
_HEIGHT_PX = 420


def shown(scan: Mapping[str, Any], coarse: bytes | None) -> str:
    """HTML of a finished scan. coarse : coarse.glb, where it is available."""
    rows = "".join(
        f"<tr><th style='text-align:left'>{escape(name)}</th><td style='text-align:left'>{escape(value)}</td></tr>"
        for name, value in _facts(scan)
    )
    table = f"<table>{rows}</table>"
    if coarse is None:
        return table
    page = _VIEWER.read_text(encoding="utf-8").replace("@GLB@", b64encode(coarse).decode())
    style = f"width:100%;height:{_HEIGHT_PX}px;border:0"
    # An origin of its own, without the rights of the notebook's page.
    return f"{table}<iframe sandbox='allow-scripts' style='{style}' srcdoc='{escape(page)}'></iframe>"


def _facts(scan: Mapping[str, Any]) -> list[tuple[str, str]]:
    mesh = (scan["summary"] or {}).get("mesh") or {}
    figures, sigma, covers = mesh.get("figures"), mesh.get("sigma_mm"), mesh.get("covers_of_decoded")
    parts = [
        name.partition("-")[2].removesuffix(".png") for name in scan["links"]["files"] if name.startswith("causes-")
    ]
    facts = [("scan", f"{scan['label'] or ''} {scan['id']}".strip()), ("rig", f"{scan['rig']}: {', '.join(parts)}")]
    if figures:
        facts.append(("points", f"{figures['vertices']:,}"))
        facts.append(("triangles", f"{figures['triangles']:,} on {figures['area_mm2'] / 100:,.1f} cm²"))
    if sigma and sigma["p50"] is not None:
        facts.append(("standard deviation", f"{sigma['p50']:.4f} mm, of 5 in 100 points above {sigma['p95']:.4f} mm"))
        if mesh.get("sigma_holds"):
            facts.append(("it holds", mesh["sigma_holds"]))
    if covers is not None:
        facts.append(("of the decoded pixels", f"{covers:.1%} are on the mesh"))
    return [*facts, *(("note", note) for note in (scan["summary"] or {}).get("notes", ()))]


T = TypeVar("T")
_WAITING = {"queued": "waiting for the rig", "capturing": "preparing the rig", "computing": "reconstructing"}
_COARSE = "coarse.glb"


@dataclass(frozen=True)
class Cloud:
    """The point of each pixel (row, column) of a camera: `points-CAMERA.npz` as arrays. NaN where there is none.

    points_mm : (H, W, 3) float32, in the axes of the mesh. normals : (H, W, 3) float32. sigma_mm : (H, W) float32,
    standard deviation along the normal. colour : (H, W, 3) uint8, sRGB. mark : (H, W) uint8, as albedo_mark of
    mesh.ply. cause : (H, W) uint8, why a pixel has no point, 0 where it has one. causes : the name of each cause, by
    its number.
    """

    camera: str
    points_mm: Floats
    normals: Floats
    sigma_mm: Floats
    colour: Bytes
    mark: Bytes
    cause: Bytes
    causes: tuple[str, ...]

    @classmethod
    def read(cls, npz: bytes) -> Self:
        """A cloud from the bytes of its file."""
        import numpy as np

        with np.load(io.BytesIO(npz), allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in cls.__dataclass_fields__}
        camera, causes = str(arrays.pop("camera")), tuple(map(str, arrays.pop("causes")))
        return cls(camera=camera, causes=causes, **arrays)

    @cached_property
    def albedo(self) -> Floats:
        """(H, W, 3) float32: `colour` as light, 0 to 1 (IEC 61966-2-1), NaN without a point."""
        import numpy as np

        value = np.arange(256) / 255
        light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)
        return np.where(self.cause[..., None] == 0, light[self.colour], np.float32(np.nan))


class ScanResult:
    """A finished scan. Files are fetched when they are first needed; arrays and the mesh are kept.

    scan : its record. id : its id.
    """

    def __init__(self, connection: Connection, scan: Json) -> None:
        self._connection = connection
        self.scan = scan
        self.id: str = scan["id"]
        self._kept: dict[str, Any] = {}

    @property
    def files(self) -> tuple[str, ...]:
        """The names of the files that can be fetched."""
        return tuple(self.scan["links"]["files"])

    def cloud(self, camera: str | None = None) -> Cloud:
        """The points of a camera; of the first camera of the rig unless one is named."""
        found = [name for name in self.files if name.startswith("points-") and name.endswith(".npz")]
        if camera is None and len(found) > 1:
            # In the order of the rig.
            found = [name for name in map(_cloud_file, self.report["cameras"]) if name in found]
        return self._read(found[0] if camera is None and found else _cloud_file(camera or "CAMERA"), Cloud.read)

    @property
    def points_mm(self) -> Floats:
        """(H, W, 3) float32, NaN where a pixel has no point; of the first camera, see `cloud`."""
        return self.cloud().points_mm

    @property
    def normals(self) -> Floats:
        """(H, W, 3) float32, of the first camera; see `cloud`."""
        return self.cloud().normals

    @property
    def sigma_mm(self) -> Floats:
        """(H, W) float32, standard deviation along the normal; of the first camera, see `cloud`."""
        return self.cloud().sigma_mm

    @property
    def colour(self) -> Bytes:
        """(H, W, 3) uint8, sRGB, of the first camera; see `cloud`."""
        return self.cloud().colour

    @property
    def albedo(self) -> Floats:
        """(H, W, 3) float32, light from 0 to 1, of the first camera; see `cloud`."""
        return self.cloud().albedo

    @property
    def cause(self) -> Bytes:
        """(H, W) uint8: why a pixel of the first camera has no point, 0 where it has one; see `causes`."""
        return self.cloud().cause

    @property
    def causes(self) -> tuple[str, ...]:
        """The names of the numbers in `cause`."""
        return self.cloud().causes

    @property
    def mesh(self) -> trimesh.Trimesh:
        """The mesh in mm, in the axes of the calibration as `points_mm`, with `vertex_attributes` such as sigma_mm."""
        return self._read("mesh.ply", _read_mesh)

    @property
    def report(self) -> Json:
        """report.json: figures, faults and causes."""
        report: Json = self._read("report.json", json.loads)
        return report

    def image(self, name: str) -> Picture:
        """A PNG of the scan as an array, such as preview.png."""
        return self._connection.picture(self._path(name))

    def fetch(self, name: str, path: str | Path) -> None:
        """Write a file of the scan to a path, whole or not at all."""
        self._connection.fetch(self._path(name), Path(path))

    def save(self, name: str, folder: str | Path) -> Path:
        """Write a file of the scan into a folder, and return its path."""
        target = Path(folder) / Path(name).name
        self._connection.fetch(self._path(name), target)
        return target

    def pin(self, *, pinned: bool = True) -> None:
        """Keep the scan, even where the settings delete old ones; with pinned=False, no longer."""
        self._connection.send("PUT" if pinned else "DELETE", f"{self.scan['links']['self']}/pin")

    def delete(self) -> None:
        """Delete the scan with all its files."""
        self._connection.send("DELETE", self.scan["links"]["self"])

    def _read(self, name: str, read: Callable[[bytes], T]) -> T:
        if name not in self._kept:
            self._kept[name] = read(self._connection.send("GET", self._path(name)).content)
        kept: T = self._kept[name]
        return kept

    def _path(self, name: str) -> str:
        files = self.scan["links"]["files"]
        if name not in files:
            message = f"The scan has no {name}. It has: {', '.join(files)}."
            raise ServiceError(message)
        return str(files[name])

    def __repr__(self) -> str:
        return f"<scan {self.id}, {self.scan['state']}>"

    def _repr_html_(self) -> str:
        """For a notebook: a table, and the mesh in 3-D, which loads nothing from elsewhere."""
        return shown(self.scan, self._read(_COARSE, bytes) if _COARSE in self.files else None)


class ScanJob:
    """A scan that was started. Iterating yields its events, until it is done.

    scan : its record when it was started. id : its id.
    """

    def __init__(self, connection: Connection, scan: Json) -> None:
        self._connection = connection
        self.scan = scan
        self.id: str = scan["id"]

    def __iter__(self) -> Iterator[Event]:
        return self._connection.follow(self.scan["links"]["events"])

    def cancel(self) -> None:
        """Stop the scan between two frames."""
        self._connection.send("POST", self.scan["links"]["cancel"])

    def result(self, progress: ProgressCallback | None = None) -> ScanResult:
        """Wait for the end, and return the result.

        Raises
        ------
        ScanFailedError
            The scan ended without a mesh.
        ScanCancelledError
            Another client cancelled it.
        ServiceError
            The service is gone, or refused.
        """
        fraction = 0.0
        for event in self:
            if progress and isinstance(event, Progress):
                fraction = event.fraction
                progress(event.stage, fraction, event.detail)
            elif progress and isinstance(event, StateChange) and event.state in _WAITING:
                progress(_WAITING[event.state], fraction, "")
        scan = self._connection.json("GET", self.scan["links"]["self"])
        if scan["state"] == "cancelled":
            message = f"Scan {self.id} was cancelled by another client."
            raise ScanCancelledError(message)
        if scan["state"] != "succeeded":
            raise ScanFailedError(scan)
        return ScanResult(self._connection, scan)

    def series(self) -> list[ScanJob]:
        """All scans of its series, itself included."""
        series = self.scan["links"].get("series")
        if series is None:
            return [self]
        return [ScanJob(self._connection, scan) for scan in self._connection.json("GET", series)["scans"]]

    def __repr__(self) -> str:
        return f"<scan {self.id}>"


def _cloud_file(camera: str) -> str:
    return f"points-{camera}.npz"


def _read_mesh(ply: bytes) -> trimesh.Trimesh:
    import numpy as np
    import trimesh

    mesh = trimesh.load_mesh(io.BytesIO(ply), file_type="ply", process=False)
    stored = mesh.metadata.pop("_ply_raw")["vertex"]["data"]
    for name in ("sigma_mm", "stripe", "albedo_mark"):
        mesh.vertex_attributes[name] = stored[name].reshape(-1)
    mesh.units = "mm"
    head = ply[: ply.find(b"\nend_header")].decode("ascii", "replace")
    axes = next((line for line in head.split("\n") if line.startswith("comment axes ")), "")
    if axes.startswith("comment axes x right, y up,"):
        mesh.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))
    elif axes.startswith("comment axes those of the robot's base"):
        pose = np.vstack([np.array(axes.split()[-12:], dtype=np.float64).reshape(3, 4), (0, 0, 0, 1)])
        mesh.apply_transform(np.linalg.inv(pose))
    return mesh


class Client:
    """A running service: scans as objects, and each of its requests as a method. A context manager.

    url, key : None: as SLRIG_URL and SLRIG_API_KEY say; without the first, the service of this machine; without the
    second, what a service of the same user on this machine left for its programs. pause : waits between two tries.
    transport : httpx2's, in place of the network.

    Raises
    ------
    ConfigError
        The address is not a URL, or the key holds a character that no key has.
    """

    def __init__(
        self,
        url: str | None = None,
        key: str | None = None,
        *,
        pause: Callable[[float], None] = time.sleep,
        transport: httpx2.BaseTransport | None = None,
    ) -> None:
        self.connection = Connection(url, key, pause=pause, transport=transport)
        self.scans = Scans(self.connection)
        self.models = Models(self.connection)
        self.presets = PresetResource(self.connection)
        self.rig = RigState(self.connection)
        self.live = Live(self.connection)
        self.examinations = Examinations(self.connection)
        self.calibration = CalibrationResource(self.connection)
        self.health = RigHealth(self.connection)
        self.turntable = TurntableResource(self.connection)
        self.hand_eye = HandEyeResource(self.connection)
        self.accept = Acceptance(self.connection)
        self.schedules = Schedules(self.connection)
        self.notices = Notices(self.connection)
        self.system = System(self.connection)

    def scan(
        self,
        *,
        progress: ProgressCallback | None = None,
        label: str | None = None,
        preset: str | None = None,
        exposure_s: float | None = None,
        exposures_s: Sequence[float] | None = None,
        exposure_factors: Sequence[float] | None = None,
        patterns: Mapping[str, Any] | None = None,
        reconstruction: Mapping[str, Any] | None = None,
        colour: bool | None = None,
        coloured_light: bool | None = None,
        turn_deg: float | None = None,
        turned_by: str | None = None,
        robot_pose: Sequence[Sequence[float]] | None = None,
        if_busy: IfBusy | None = "queue",
        repeat: int | None = None,
        every_s: float | None = None,
    ) -> ScanResult:
        """Scan, wait for the end, and return the result; of a series, that of its first scan. Ctrl-C cancels the scan.

        Parameters
        ----------
        progress
            Called with the stage, 0 to 1 of the whole, and a detail.
        label
            A name for people.
        preset
            The name of options that the service knows; those given here go first.
        exposure_s, exposures_s
            Of every frame, in seconds; several make a bracket, from which each pixel takes its best.
        exposure_factors
            A bracket as multiples of the rig's exposure.
        patterns, reconstruction
            Options of the patterns and of the reconstruction, such as {"rows": True} and {"region": ...}.
        colour, coloured_light
            Take the colour of the surface by a colour camera; by red, green and blue light.
        turn_deg, turned_by
            The angle of the turntable, in degrees, and what turns it, "table" or "hand".
        robot_pose
            Of the robot's flange in its base, 4 x 4, mm, for {"mesh_axes": "robot"} of a rig in its hand.
        if_busy
            "queue": wait while the rig is held; "reject": fail. None: as the service is set up.
        repeat, every_s
            A series of so many scans, one every so many seconds.

        Raises
        ------
        ScanFailedError
            The scan ended without a mesh.
        ScanCancelledError
            Another client cancelled it.
        ServiceError
            The service refused, or is gone.
        """
        job = self.start_scan(
            label=label,
            preset=preset,
            exposure_s=exposure_s,
            exposures_s=exposures_s,
            exposure_factors=exposure_factors,
            patterns=patterns,
            reconstruction=reconstruction,
            colour=colour,
            coloured_light=coloured_light,
            turn_deg=turn_deg,
            turned_by=turned_by,
            robot_pose=robot_pose,
            if_busy=if_busy,
            repeat=repeat,
            every_s=every_s,
        )
        try:
            return job.result(progress)
        except Exception:
            raise
        except BaseException:
            with suppress(ServiceError):
                job.cancel()
            raise

    def start_scan(
        self,
        *,
        label: str | None = None,
        preset: str | None = None,
        exposure_s: float | None = None,
        exposures_s: Sequence[float] | None = None,
        exposure_factors: Sequence[float] | None = None,
        patterns: Mapping[str, Any] | None = None,
        reconstruction: Mapping[str, Any] | None = None,
        colour: bool | None = None,
        coloured_light: bool | None = None,
        turn_deg: float | None = None,
        turned_by: str | None = None,
        robot_pose: Sequence[Sequence[float]] | None = None,
        if_busy: IfBusy | None = "queue",
        repeat: int | None = None,
        every_s: float | None = None,
    ) -> ScanJob:
        """Start a scan, and return at once. The options are those of `scan`. Raises ServiceError."""
        options = given(
            label=label,
            preset=preset,
            exposure_s=exposure_s,
            exposures_s=exposures_s,
            exposure_factors=exposure_factors,
            patterns=patterns,
            reconstruction=reconstruction,
            colour=colour,
            coloured_light=coloured_light,
            turn_deg=turn_deg,
            turned_by=turned_by,
            robot_pose=robot_pose,
            if_busy=if_busy,
            repeat=repeat,
            every_s=every_s,
        )
        return ScanJob(self.connection, self.scans.start(**options))

    def job(self, scan_id: str) -> ScanJob:
        """A scan on record, to follow."""
        return ScanJob(self.connection, self.scans.get(scan_id))

    def result(self, scan_id: str) -> ScanResult:
        """The result of a scan on record; waits for its end."""
        return self.job(scan_id).result()

    def get(self, link: str) -> Json:
        """The JSON behind a link of an answer, such as `next` of a page."""
        return self.connection.json("GET", link)

    def post(self, link: str, request: Mapping[str, Any] | None = None) -> Json:
        """Send a POST to a link of an answer, such as `cancel`, and return the answer."""
        body = {} if request is None else {"json": request}
        return self.connection.json("POST", link, **body)

    def delete(self, link: str) -> None:
        """Send a DELETE to a link of an answer."""
        self.connection.send("DELETE", link)

    def fetch(self, link: str, path: str | Path) -> None:
        """Write the file behind a link of an answer, whole or not at all."""
        self.connection.fetch(link, Path(path))

    def save(self, link: str, folder: str | Path) -> Path:
        """Write the file behind a link into a folder, by the name that the service gives it, and return its path."""
        about = EmailMessage()
        about["Content-Disposition"] = self.connection.send("HEAD", link).headers["Content-Disposition"]
        target = Path(folder) / Path(about.get_filename(link)).name
        self.connection.fetch(link, target)
        return target

    def follow(self, link: str) -> Iterator[Event]:
        """The events of a job, by its `events` link, until it is done."""
        return self.connection.follow(link)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close its connections."""
        self.connection.http.close()
