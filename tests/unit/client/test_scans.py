"""Scans through the client: followed, their results and what a notebook shows of them; and what the client loads."""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
from base64 import b64encode
from html import unescape
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pytest

from slrig.client import Cloud
from slrig.client.client import shown
from slrig.client.connection import Captured, Event, FileReady, Progress, StateChange
from slrig.client.errors import ScanFailedError
from slrig.errors import ScanCancelledError, ServiceError
from slrig.model.surface import MeshAxes, srgb_to_linear
from slrig.scan.artefacts import FileAxes, encode_mesh_ply
from tests.unit.client.service import HERE, SCAN, Walk, client_of
from tests.unit.scan.test_mesh_formats import IN_BASE, half_ball


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


def test_a_scan_is_started_followed_and_returned() -> None:
    walk = Walk(report_json=b'{"cameras": {}}')
    steps: list[tuple[str, float, str]] = []
    result = client_of(walk).scan(label="cup", exposure_s=0.01, progress=lambda *step: steps.append(step))
    assert (result.id, result.files, result.report) == ("5f", ("report.json",), {"cameras": {}})
    assert result.report is result.report
    assert walk.asked[0] == ("POST", "/scan", {"if_busy": "queue", "label": "cup", "exposure_s": 0.01})
    assert [path for _, path, _ in walk.asked].count(f"{HERE}/report.json") == 1
    assert steps == [("waiting for the rig", 0.0, ""), ("capture", 0.25, "frame 1 of 4")]


def test_a_job_yields_its_events_and_its_result() -> None:
    job = client_of(Walk()).start_scan()
    assert [*job] == [
        StateChange(number=1, state="queued"),
        Progress(number=2, stage="capture", fraction=0.25, detail="frame 1 of 4"),
        Captured(number=3),
        FileReady(number=4, name="mesh.ply"),
        Event(number=5),
        StateChange(number=6, state="succeeded"),
    ]
    assert job.result().id == job.id == "5f"
    assert [each.id for each in job.series()] == ["5f"]


def test_a_scan_without_a_mesh_raises_its_cause() -> None:
    fault = {"type": "/problems/scan-evidence", "status": 502, "detail": "No stripe was found."}
    with pytest.raises(ScanFailedError, match=r"Scan 5f failed: No stripe was found\.") as failed:
        client_of(Walk("failed", fault)).scan()
    assert (failed.value.code, failed.value.scan["state"]) == ("scan-evidence", "failed")
    with pytest.raises(ScanCancelledError):
        client_of(Walk("cancelled")).scan()


def test_ctrl_c_cancels_the_scan() -> None:
    walk = Walk()

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        client_of(walk).scan(progress=interrupt)
    assert walk.asked[-1][:2] == ("POST", f"{HERE}/cancel")


def test_arrays_are_those_of_the_first_camera_of_the_rig() -> None:
    files: dict[str, bytes] = {
        "points__right_npz": npz("right", 188),
        "points__left_npz": npz("left", 255),
        "report_json": b'{"cameras": {"right": {}, "left": {}}}',
    }
    walk = Walk(**files)  # type: ignore[arg-type]
    result = client_of(walk).result("5f")
    points, sigma = result.points_mm, result.sigma_mm
    assert (points.shape, sigma.shape) == ((2, 3, 3), (2, 3))
    assert points.dtype == np.float32
    np.testing.assert_array_equal(np.isfinite(points).all(axis=-1), result.cause == 0)
    assert result.causes[result.cause[0, 0]] == "not lit"
    assert result.albedo.dtype == np.float32
    assert np.isnan(result.albedo[0, 0]).all()
    assert result.albedo[1, 1, 0] == pytest.approx(srgb_to_linear(np.array([188], np.uint8))[0] / 65535, abs=1e-5)
    left = result.cloud("left")
    assert isinstance(left, Cloud)
    assert (left.camera, left.albedo[1, 1, 0]) == ("left", 1.0)
    with pytest.raises(ServiceError, match=r"has no points-top\.npz\. It has: points-right\.npz, "):
        result.cloud("top")
    # What was fetched is kept.
    assert len([path for _, path, _ in walk.asked if path.endswith(".npz")]) == 2


def test_an_array_of_objects_is_not_unpickled() -> None:
    walk = Walk(points__left_npz=npz("left", 0, points_mm=np.array([{}], dtype=object)))
    with pytest.raises(ValueError, match="allow_pickle"):
        _ = client_of(walk).result("5f").points_mm


@pytest.mark.parametrize("axes", MeshAxes)
def test_the_mesh_is_in_millimetres_with_values_of_its_vertices(axes: MeshAxes) -> None:
    mesh = half_ball()
    found = client_of(Walk(mesh_ply=bytes(encode_mesh_ply(mesh, axes=FileAxes.of(axes, IN_BASE))))).result("5f").mesh
    np.testing.assert_allclose(found.vertices, mesh.vertices_mm, rtol=0, atol=3e-4 if axes is MeshAxes.ROBOT else 0)
    assert ((found.vertex_normals * mesh.normals).sum(axis=1) > 0.9).all()
    np.testing.assert_array_equal(found.faces, mesh.faces)
    np.testing.assert_array_equal(found.vertex_attributes["sigma_mm"], mesh.sigma_mm)
    assert found.units == "mm"


def test_files_are_saved_and_a_scan_is_pinned_and_deleted(tmp_path: Path) -> None:
    walk = Walk(mesh_ply=b"ply")
    result = client_of(walk).result("5f")
    assert result.save("mesh.ply", tmp_path) == tmp_path / "mesh.ply"
    result.fetch("mesh.ply", tmp_path / "other.ply")
    with pytest.raises(ServiceError, match=r"has no mesh\.obj\. It has: mesh\.ply"):
        result.save("mesh.obj", tmp_path)
    result.pin()
    result.pin(pinned=False)
    result.delete()
    assert [path.read_bytes() for path in sorted(tmp_path.iterdir())] == [b"ply", b"ply"]
    assert [asked[:2] for asked in walk.asked[-3:]] == [
        ("PUT", f"{HERE}/pin"),
        ("DELETE", f"{HERE}/pin"),
        ("DELETE", HERE),
    ]


def test_the_name_of_a_file_leads_out_of_no_folder(tmp_path: Path) -> None:
    walk = Walk(mesh_ply=b"ply")
    walk.scan["links"]["files"]["../../mesh.ply"] = f"{HERE}/mesh.ply"
    folder = tmp_path / "deep" / "folder"
    folder.mkdir(parents=True)
    assert client_of(walk).result("5f").save("../../mesh.ply", folder) == folder / "mesh.ply"


GLB = b"glTF of a scan"
SUMMARY = {
    "notes": ["camera 'left': <slow>"],
    "mesh": {
        "figures": {"vertices": 42734, "triangles": 84632, "area_mm2": 14241.6},
        "sigma_mm": {"p50": 0.0171, "p95": 0.0183},
        "covers_of_decoded": 0.978,
    },
}
FULL: dict[str, Any] = {
    **SCAN,
    "label": "<b>cup</b>",
    "summary": SUMMARY,
    "links": {**SCAN["links"], "files": {"causes-left.png": "", "causes-right.png": ""}},
}


def test_table_shows_the_figures_and_escapes_labels() -> None:
    found = shown(FULL, None)
    text = unescape(re.sub(r"<[^>]*>", "|", found))
    for words in (
        "<b>cup</b> 5f",
        "bench: left, right",
        "42,734",
        "84,632 on 142.4 cm²",
        "0.0171 mm",
        "97.8%",
        "<slow>",
    ):
        assert words in text, words
    assert "<b>" not in found


def test_a_scan_of_which_little_is_known_is_shown_too() -> None:
    assert "5f" in shown(SCAN, None)
    unknown = {"notes": [], "mesh": {"sigma_mm": {"p50": None, "p95": None}}}
    assert "deviation" not in shown({**FULL, "summary": unknown}, None)


def test_the_view_is_whole_and_asks_for_nothing() -> None:
    found = shown(FULL, GLB)
    (page,) = re.findall(r"srcdoc='([^']*)'", found)
    page = unescape(page)
    assert b64encode(GLB).decode() in page
    assert not re.findall(r"https?:|//|\bimport\b|\bfetch\b|src=", re.sub(r"^ *//.*$", "", page, flags=re.MULTILINE))
    assert "sandbox='allow-scripts'" in found


def test_a_result_is_shown_with_its_mesh() -> None:
    assert "<iframe" in client_of(Walk(coarse_glb=GLB)).result("5f")._repr_html_()
    assert "<iframe" not in client_of(Walk()).result("5f")._repr_html_()


HEAVY = {
    "numba",
    "numpy",
    "cv2",
    "scipy",
    "fastapi",
    "starlette",
    "pydantic",
    "trimesh",
    "sqlalchemy",
    "asyncio",
}
MOST_S = 0.3
_TOLD = """
import sys, time
begun_s = time.process_time()
import slrig.client
taken_s = time.process_time() - begun_s
import json
loaded = {name.partition(".")[0] for name in sys.modules}
own = {name for name in sys.modules if name.startswith("slrig.")}
print(json.dumps([taken_s, sorted(loaded), sorted(own)]))
"""


def test_the_client_loads_neither_mathematics_nor_the_service() -> None:
    taken: list[float] = []
    for _ in range(3):
        told = subprocess.run([sys.executable, "-c", _TOLD], capture_output=True, text=True, check=True)  # noqa: S603
        taken_s, loaded, own = json.loads(told.stdout)
        taken.append(taken_s)
    assert HEAVY & set(loaded) == set()
    rooms = {name.split(".")[1] for name in own}
    assert rooms == {"client", "disk", "errors", "printable"}
    assert median(taken) <= MOST_S
