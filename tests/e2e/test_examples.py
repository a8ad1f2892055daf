"""Programs that use the service: config/examples, and those of the client's README; and what its arrays say."""

from __future__ import annotations

import base64
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slrig.client import Client
from slrig.examples import EXAMPLES
from tests.e2e.conftest import KEY, ServiceProcess, python, serving, write_rig
from tests.e2e.test_calibration_walk import write_rig as write_board_rig
from tests.e2e.test_import import Recorded, lay_out

pytestmark = pytest.mark.slow

SCRIPTS = Path(__file__).resolve().parents[2] / "config" / "examples"
SECRET = "whsec_" + base64.b64encode(bytes(range(32))).decode()


@pytest.fixture(scope="module")
def receiver() -> Iterator[subprocess.Popen[str]]:
    """The receiver of notices, as a process; its first line names its port."""
    process = subprocess.Popen(  # noqa: S603 - our own program
        [sys.executable, SCRIPTS / "webhook_receiver.py", "0"],
        env={**os.environ, "SLRIG_WEBHOOK_SECRET": SECRET},
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        yield process
        process.terminate()


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, receiver: subprocess.Popen[str]) -> Iterator[ServiceProcess]:
    assert receiver.stdout is not None
    port = receiver.stdout.readline().split()[-1]
    settings = {"SLRIG_WEBHOOK_URL": f"http://127.0.0.1:{port}/", "SLRIG_WEBHOOK_SECRET": SECRET}
    with serving(EXAMPLES / "rigs" / "turntable.toml", tmp_path_factory.mktemp("data") / "data", **settings) as service:
        yield service


def run(*words: object, folder: Path, service: ServiceProcess | None = None) -> str:
    reached: dict[str, Any] = {} if service is None else {"SLRIG_URL": service.url, "SLRIG_API_KEY": KEY}
    return python(*words, folder=folder, **reached).stdout


def test_scan_and_plot(service: ServiceProcess, receiver: subprocess.Popen[str], tmp_path: Path) -> None:
    said = run(SCRIPTS / "scan_and_plot.py", "depth.png", folder=tmp_path, service=service)
    assert "median standard deviation" in said
    assert {path.name for path in tmp_path.iterdir()} == {"depth.png", "mesh.ply"}
    # The service tells the receiver, which checks the signature.
    assert receiver.stdout is not None
    assert "job.ended" in receiver.stdout.readline()


def test_region_and_preset(service: ServiceProcess, tmp_path: Path) -> None:
    said = run(SCRIPTS / "region_and_preset.py", -30, -10, -60, 30, 10, 60, folder=tmp_path, service=service)
    whole, part = (int(line.split()[1].replace(",", "")) for line in said.splitlines())
    assert 0 < part < 0.8 * whole


def test_several_views(service: ServiceProcess, tmp_path: Path) -> None:
    run(SCRIPTS / "several_views.py", 8, "model.ply", 2, 0, 1.5, 0.03, -1, -0.05, folder=tmp_path, service=service)
    assert (tmp_path / "model.ply").read_bytes().startswith(b"ply")


def test_calibrate_by_script(tmp_path: Path) -> None:
    with serving(write_board_rig(tmp_path / "rig"), tmp_path / "data") as service:
        with service.client() as client:
            # The positions are known once the rig is open.
            while not client.rig.get()["positions"]:
                pass
        board = ("chessboard", 8, 5, 20, "--most-error-mm", 1)
        said = run(SCRIPTS / "calibrate_by_script.py", *board, folder=tmp_path, service=service)
        assert said.count("succeeded") == 10
        assert "is in use" in said


def test_import_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scan = Recorded(tmp_path / "rig", "opencv", monkeypatch)
    images = lay_out(tmp_path / "images", scan.images, "pattern_cam1_im{}.png", first=1)
    calibration = scan.folder / "calibration.json"
    said = run(SCRIPTS / "import_folder.py", images, "200x160", calibration, "mesh", "left", folder=tmp_path)
    assert "vertices" in said
    assert (tmp_path / "mesh" / "mesh.ply").exists()


README = Path(__file__).parents[2] / "slrig" / "client" / "README.md"
SIZE = (192, 240)


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    folder = tmp_path_factory.mktemp("client")
    with serving(write_rig(folder / "rig"), folder / "data") as plate:
        yield plate


def test_the_examples_of_the_readme_run_in_their_order(plate: ServiceProcess, tmp_path: Path) -> None:
    examples = re.findall(r"^```python\n(.*?)^```$", README.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert len(examples) == 2
    # A notebook shows what its last line is.
    first = f"{examples[0]}\nopen('shown.html', 'w').write(result._repr_html_())\n"
    said = run("-W", "error", "-c", "\n".join([first, *examples[1:]]), folder=tmp_path, service=plate)
    found = re.findall(r"flat to ([\d.]+) mm; a point is stated to be within ([\d.]+) mm", said)[0]
    flat, stated = map(float, found)
    assert 0.3 * stated < flat < 3 * stated
    assert (tmp_path / "mesh.ply").read_bytes().startswith(b"ply")
    assert "<iframe" in (tmp_path / "shown.html").read_text(encoding="utf-8")
    assert "the rig is free: move the part" in said
    with plate.client() as client:
        assert client.scans.get(said.splitlines()[-1])["label"] == "next"


def test_a_scan_comes_as_arrays_that_say_what_its_files_say(plate: ServiceProcess) -> None:
    with Client(plate.url, KEY) as client:
        result = client.scan(label="arrays")
        points_mm, cause = result.points_mm, result.cause
        assert (points_mm.shape, cause.shape) == ((*SIZE, 3), SIZE)
        np.testing.assert_array_equal(np.isfinite(points_mm).all(axis=-1), cause == 0)
        assert (cause == 0).mean() > 0.3
        assert cause.max() < len(result.causes)
        assert np.nanmedian(result.sigma_mm) == pytest.approx(result.report["mesh"]["sigma_mm"]["p50"], rel=0.3)
        np.testing.assert_allclose(np.linalg.norm(result.normals[cause == 0], axis=-1), 1, atol=1e-3)
        assert 0 < np.nanmedian(result.albedo) <= 1
        assert len(result.mesh.faces) == result.report["mesh"]["figures"]["triangles"]
        low, high = np.array([np.nanmin(points_mm, axis=(0, 1)), np.nanmax(points_mm, axis=(0, 1))])
        assert (low > result.mesh.bounds[0] - 0.5).all()
        assert (high < result.mesh.bounds[1] + 0.5).all()
        assert result.image("preview.png").ndim == 3
