"""A scan as it is followed, and what came of it."""

from __future__ import annotations

import io
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from slrig.client.cloud import Cloud
from slrig.client.core import Core, Json, W
from slrig.client.errors import ScanFailedError
from slrig.client.events import Event, Progress, StateChange
from slrig.client.notebook import shown
from slrig.client.operations import Fetched, Operation, Remote
from slrig.client.wire import Awaited, Blocking
from slrig.errors import ScanCancelledError, ServiceError

if TYPE_CHECKING:
    import trimesh

    from slrig.client.cloud import Bytes, Floats
    from slrig.client.core import Picture

Told: TypeAlias = Callable[[str, float, str], object]
"""Is told how far a scan is: its stage, 0 to 1 of the whole, and a detail."""

_WAITING = {"queued": "waiting for the rig", "capturing": "preparing the rig", "computing": "reconstructing"}
_COARSE = "coarse.glb"


def _of_cloud(name: str, doc: str) -> Fetched[Any]:
    async def fetched(result: ScanResult[W]) -> Any:
        return getattr(await result.of_camera(), name)

    return Fetched(fetched, f"{doc} Of the first camera; see `Cloud`.")


class ScanResult(Remote[W]):
    """A finished scan. scan : as it is on record. Its files are fetched when they are asked for; arrays and the mesh
    are kept.
    """

    def __init__(self, core: Core[W], scan: Json) -> None:
        super().__init__(core)
        self.scan = scan
        self.id: str = scan["id"]
        self._kept: dict[str, Any] = {}

    @property
    def files(self) -> tuple[str, ...]:
        """The names of the files that can be fetched."""
        return tuple(self.scan["links"]["files"])

    points_mm: Fetched[Floats] = _of_cloud("points_mm", "(H, W, 3) float32.")
    normals: Fetched[Floats] = _of_cloud("normals", "(H, W, 3) float32.")
    sigma_mm: Fetched[Floats] = _of_cloud("sigma_mm", "(H, W) float32.")
    colour: Fetched[Bytes] = _of_cloud("colour", "(H, W, 3) uint8, sRGB.")
    albedo: Fetched[Floats] = _of_cloud("albedo", "(H, W, 3) float32, light.")
    cause: Fetched[Bytes] = _of_cloud("cause", "(H, W) uint8.")
    causes: Fetched[tuple[str, ...]] = _of_cloud("causes", "Names of `cause`.")

    async def of_camera(self, camera: str | None = None) -> Cloud:
        """The points of a camera; of the first one of the rig where none is named."""
        found = [name for name in self.files if name.startswith("points-") and name.endswith(".npz")]
        if camera is None and len(found) > 1:
            # In the order of the rig.
            cameras = (await self._report())["cameras"]
            found = [name for name in map(_file_of, cameras) if name in found]
        name = found[0] if camera is None and found else _file_of(camera or "CAMERA")
        return await self._once(name, Cloud.read)  # type: ignore[no-any-return]

    cloud = Operation(of_camera)

    async def _report(self) -> Json:
        import json

        return await self._once("report.json", json.loads)  # type: ignore[no-any-return]

    report = Fetched(_report, "report.json: how the scan went, and how good it is.")

    async def _mesh(self) -> trimesh.Trimesh:
        return await self._once("mesh.ply", _read_mesh)

    mesh = Fetched(_mesh, "The mesh, in mm, with `vertex_attributes` such as sigma_mm.")

    @Operation
    async def image(self, name: str) -> Picture:
        """A PNG of the scan as an array, such as preview.png."""
        return await self.core.content("Picture", "GET", self._path(name))  # type: ignore[no-any-return]

    @Operation
    async def fetch(self, name: str, path: str | Path) -> None:
        """Write a file of the scan to a path, whole or not at all."""
        await self.core.fetch(self._path(name), Path(path))

    @Operation
    async def save(self, name: str, folder: str | Path) -> Path:
        """Write a file of the scan into a folder, and return its path."""
        target = Path(folder) / Path(name).name
        await self.core.fetch(self._path(name), target)
        return target

    @Operation
    async def pin(self, *, pinned: bool = True) -> None:
        """Keep the scan, whatever the settings say of old ones; with pinned=False, no more."""
        await self.core.send("PUT" if pinned else "DELETE", f"{self.scan['links']['self']}/pin")

    @Operation
    async def delete(self) -> None:
        """Delete the scan with all its files."""
        await self.core.send("DELETE", self.scan["links"]["self"])

    async def _once(self, name: str, read: Callable[[bytes], Any]) -> Any:
        if name not in self._kept:
            content = await self.core.content("bytes", "GET", self._path(name))
            self._kept[name] = await self.core.wire.apart(lambda: read(content))
        return self._kept[name]

    def _path(self, name: str) -> str:
        files = self.scan["links"]["files"]
        if name not in files:
            message = f"The scan has no {name}. It has: {', '.join(files)}."
            raise ServiceError(message)
        return str(files[name])

    def __repr__(self) -> str:
        return f"<scan {self.id}, {self.scan['state']}>"

    async def _view(self) -> str:
        return shown(self.scan, await self._once(_COARSE, bytes) if _COARSE in self.files else None)

    view = Fetched(_view, "HTML for a notebook: a table, and the mesh in 3-D, which loads nothing from elsewhere.")

    def _repr_html_(self) -> str:
        wire = self.core.wire
        return wire.drive(self._view()) if isinstance(wire, Blocking) else shown(self.scan, self._kept.get(_COARSE))


class ScanJob(Remote[W]):
    """A scan that was started. scan : as it was on record then. Iterating tells what happens, until it is over."""

    def __init__(self, core: Core[W], scan: Json) -> None:
        super().__init__(core)
        self.scan = scan
        self.id: str = scan["id"]

    def _events(self) -> AsyncGenerator[Event]:
        return self.core.follow(self.scan["links"]["events"])

    events = Operation(_events)

    def __iter__(self: ScanJob[Blocking]) -> Iterator[Event]:
        return self.events()

    def __aiter__(self: ScanJob[Awaited]) -> AsyncIterator[Event]:
        return self.events()

    @Operation
    async def cancel(self) -> None:
        """Ask the scan to stop between two frames."""
        await self.core.send("POST", self.scan["links"]["cancel"])

    async def awaited(self, progress: Told | None = None) -> ScanResult[W]:
        """Wait for the end, and return what came of it.

        Raises
        ------
        ScanFailedError
            It ended without a mesh.
        ScanCancelledError
            Somebody cancelled it.
        ServiceError
            The service is gone, or refused.
        """
        fraction = 0.0
        async for event in self._events():
            if progress and isinstance(event, Progress):
                fraction = event.fraction
                progress(event.stage, fraction, event.detail)
            elif progress and isinstance(event, StateChange) and event.state in _WAITING:
                progress(_WAITING[event.state], fraction, "")
        scan: Json = await self.core.content("Json", "GET", self.scan["links"]["self"])
        if scan["state"] == "cancelled":
            message = f"Scan {self.id} was cancelled by another client."
            raise ScanCancelledError(message)
        if scan["state"] != "succeeded":
            raise ScanFailedError(scan)
        return ScanResult(self.core, scan)

    result = Operation(awaited)

    @Operation
    async def series(self) -> list[ScanJob[W]]:
        """All scans of the series that it belongs to, itself included."""
        series = self.scan["links"].get("series")
        if series is None:
            return [self]
        scans = (await self.core.content("Json", "GET", series))["scans"]
        return [ScanJob(self.core, scan) for scan in scans]

    def __repr__(self) -> str:
        return f"<scan {self.id}>"


def _file_of(camera: str) -> str:
    return f"points-{camera}.npz"


def _read_mesh(ply: bytes) -> trimesh.Trimesh:
    import trimesh

    mesh = trimesh.load_mesh(io.BytesIO(ply), file_type="ply", process=False)
    stored = mesh.metadata.pop("_ply_raw")["vertex"]["data"]
    for name in ("sigma_mm", "stripe", "albedo_mark"):
        mesh.vertex_attributes[name] = stored[name].reshape(-1)
    mesh.units = "mm"
    return mesh
