"""Scans through both clients: started, followed, and what comes of them."""

from __future__ import annotations

import asyncio
import io
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest

from slrig.client import AsyncClient, Client, Cloud
from slrig.client.errors import ScanFailedError
from slrig.client.events import Captured, Event, FileReady, Progress, StateChange
from slrig.errors import ScanCancelledError, ServiceError
from slrig.model.srgb import light_of
from slrig.scan.artefacts import encode_mesh_ply
from tests.unit.client.service import HERE, URL, Walk, client_of, each, run, settled
from tests.unit.scan.test_mesh_formats import half_ball

Kind = type[Client] | type[AsyncClient]
both = pytest.mark.parametrize("kind", [Client, AsyncClient])


def npz(camera: str, level: int, **others: Any) -> bytes:
    """A cloud of 2 x 3 pixels, as the service sends it; the first pixel has no point."""
    cause = np.zeros((2, 3), np.uint8)
    cause[0, 0] = 2
    points = np.arange(18, dtype=np.float32).reshape(2, 3, 3)
    points[0, 0] = np.nan
    arrays: dict[str, Any] = {
        "points_mm": points,
        "normals": points,
        "sigma_mm": points[..., 0],
        "colour": np.full((2, 3, 3), level, np.uint8),
        "mark": cause,
        "cause": cause,
        "causes": np.array(["has a point", "saturated", "not lit"]),
        "camera": np.array(camera),
        "unit": np.array("mm"),
    }
    file = io.BytesIO()
    np.savez(file, **{**arrays, **others})
    return file.getvalue()


@both
def test_a_scan_is_started_followed_and_returned(kind: Kind) -> None:
    walk = Walk(report_json=b'{"cameras": {}}')
    told: list[tuple[str, float, str]] = []

    async def case() -> Any:
        client = client_of(kind, walk)
        result = await settled(client.scan(label="cup", exposure_s=0.01, progress=lambda *step: told.append(step)))
        assert (result.id, result.files, await settled(result.report)) == ("5f", ("report.json",), {"cameras": {}})
        assert await settled(result.report) is await settled(result.report)

    run(case())
    assert walk.asked[0] == ("POST", "/scan", {"if_busy": "queue", "label": "cup", "exposure_s": 0.01})
    assert [path for _, path, _ in walk.asked].count(f"{HERE}/report.json") == 1
    assert told == [("waiting for the rig", 0.0, ""), ("capture", 0.25, "frame 1 of 4")]


@both
def test_a_job_tells_its_events_and_its_result(kind: Kind) -> None:
    async def case() -> list[Any]:
        client = client_of(kind, Walk())
        job = await settled(client.start_scan())
        found = [event async for event in each(aiter(job) if kind is AsyncClient else iter(job))]
        assert (await settled(job.result())).id == job.id == "5f"
        assert [each.id for each in await settled(job.series())] == ["5f"]
        return found

    assert run(case()) == [
        StateChange(number=1, state="queued"),
        Progress(number=2, stage="capture", fraction=0.25, detail="frame 1 of 4"),
        Captured(number=3),
        FileReady(number=4, name="mesh.ply"),
        Event(number=5),
        StateChange(number=6, state="succeeded"),
    ]


@both
def test_a_scan_without_a_mesh_raises_its_cause(kind: Kind) -> None:
    fault = {"type": "/problems/scan-evidence", "status": 502, "detail": "No stripe was found."}
    with pytest.raises(ScanFailedError, match=r"Scan 5f failed: No stripe was found\.") as failed:
        run(settled(client_of(kind, Walk("failed", fault)).scan()))
    assert (failed.value.code, failed.value.scan["state"]) == ("scan-evidence", "failed")
    with pytest.raises(ScanCancelledError):
        run(settled(client_of(kind, Walk("cancelled")).scan()))


def test_a_scan_that_is_interrupted_is_cancelled() -> None:
    walk = Walk()

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        client_of(Client, walk).scan(progress=interrupted)
    assert walk.asked[-1][:2] == ("POST", f"{HERE}/cancel")


def test_a_task_that_is_cancelled_cancels_its_scan() -> None:
    walk = Walk()

    async def answer(request: httpx2.Request) -> httpx2.Response:
        await asyncio.sleep(0)
        return walk(request)

    async def case() -> None:
        current = asyncio.current_task()
        assert current is not None
        async with AsyncClient(URL, transport=httpx2.MockTransport(answer)) as client:
            # It ends where it next waits.
            await client.scan(progress=lambda *_: current.cancel())

    with pytest.raises(asyncio.CancelledError):
        run(case())
    assert walk.asked[-1][:2] == ("POST", f"{HERE}/cancel")


@both
def test_arrays_are_those_of_the_first_camera_of_the_rig(kind: Kind) -> None:
    files: dict[str, bytes] = {
        "points__right_npz": npz("right", 188),
        "points__left_npz": npz("left", 255),
        "report_json": b'{"cameras": {"right": {}, "left": {}}}',
    }
    walk = Walk(**files)  # type: ignore[arg-type]

    async def case() -> None:
        result = await settled(client_of(kind, walk).result("5f"))
        points, sigma = await settled(result.points_mm), await settled(result.sigma_mm)
        assert (points.shape, points.dtype, sigma.shape) == ((2, 3, 3), np.float32, (2, 3))
        cause, causes = await settled(result.cause), await settled(result.causes)
        np.testing.assert_array_equal(np.isfinite(points).all(axis=-1), cause == 0)
        assert causes[cause[0, 0]] == "not lit"
        albedo = await settled(result.albedo)
        assert albedo.dtype == np.float32
        assert np.isnan(albedo[0, 0]).all()
        assert albedo[1, 1, 0] == pytest.approx(light_of(np.array([188], np.uint8))[0] / 65535, abs=1e-5)
        left = await settled(result.cloud("left"))
        assert isinstance(left, Cloud)
        assert (left.camera, left.albedo[1, 1, 0]) == ("left", 1.0)
        with pytest.raises(ServiceError, match=r"has no points-top\.npz\. It has: points-right\.npz, "):
            await settled(result.cloud("top"))

    run(case())
    # What was fetched is kept.
    assert len([path for _, path, _ in walk.asked if path.endswith(".npz")]) == 2


@both
def test_an_array_of_objects_is_not_unpickled(kind: Kind) -> None:
    walk = Walk(points__left_npz=npz("left", 0, points_mm=np.array([{}], dtype=object)))

    async def case() -> None:
        result = await settled(client_of(kind, walk).result("5f"))
        await settled(result.points_mm)

    with pytest.raises(ValueError, match="allow_pickle"):
        run(case())


@both
def test_the_mesh_is_in_millimetres_with_what_its_vertices_say(kind: Kind) -> None:
    mesh = half_ball()
    walk = Walk(mesh_ply=bytes(encode_mesh_ply(mesh)))

    async def case() -> Any:
        result = await settled(client_of(kind, walk).result("5f"))
        return await settled(result.mesh)

    found = run(case())
    np.testing.assert_array_equal(found.vertices, mesh.vertices_mm)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    np.testing.assert_array_equal(found.vertex_attributes["sigma_mm"], mesh.sigma_mm)
    assert found.units == "mm"


@both
def test_files_are_saved_kept_and_deleted(kind: Kind, tmp_path: Path) -> None:
    walk = Walk(mesh_ply=b"ply")

    async def case() -> None:
        result = await settled(client_of(kind, walk).result("5f"))
        assert await settled(result.save("mesh.ply", tmp_path)) == tmp_path / "mesh.ply"
        await settled(result.fetch("mesh.ply", tmp_path / "other.ply"))
        with pytest.raises(ServiceError, match=r"has no mesh\.obj\. It has: mesh\.ply"):
            await settled(result.save("mesh.obj", tmp_path))
        await settled(result.pin())
        await settled(result.pin(pinned=False))
        await settled(result.delete())

    run(case())
    assert [path.read_bytes() for path in sorted(tmp_path.iterdir())] == [b"ply", b"ply"]
    assert [asked[:2] for asked in walk.asked[-3:]] == [
        ("PUT", f"{HERE}/pin"),
        ("DELETE", f"{HERE}/pin"),
        ("DELETE", HERE),
    ]


def test_a_name_of_the_service_leads_out_of_no_folder(tmp_path: Path) -> None:
    walk = Walk(mesh_ply=b"ply")
    walk.scan["links"]["files"]["../../mesh.ply"] = f"{HERE}/mesh.ply"
    folder = tmp_path / "deep" / "folder"
    folder.mkdir(parents=True)
    assert client_of(Client, walk).result("5f").save("../../mesh.ply", folder) == folder / "mesh.ply"
