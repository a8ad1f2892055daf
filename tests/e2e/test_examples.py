"""The programs in config/examples, each run as a person runs it."""

from __future__ import annotations

import base64
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e.conftest import KEY, ServiceProcess, serving
from tests.e2e.test_calibration_walk import write_rig
from tests.e2e.test_import import Recorded, lay_out

CONFIG = Path(__file__).resolve().parents[2] / "config"
EXAMPLES = CONFIG / "examples"
SECRET = "whsec_" + base64.b64encode(bytes(range(32))).decode()

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def receiver() -> Iterator[subprocess.Popen[str]]:
    """The receiver of notices, as a process; its first line names its port."""
    process = subprocess.Popen(  # noqa: S603 - our own program
        [sys.executable, EXAMPLES / "webhook_receiver.py", "0"],
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
    with serving(CONFIG / "rigs" / "turntable.toml", tmp_path_factory.mktemp("data") / "data", **settings) as service:
        yield service


def run(name: str, *words: object, folder: Path, service: ServiceProcess | None = None) -> str:
    reached = {} if service is None else {"SLRIG_URL": service.url, "SLRIG_API_KEY": KEY}
    done = subprocess.run(  # noqa: S603 - our own program
        [sys.executable, EXAMPLES / name, *map(str, words)],
        cwd=folder,
        env={**os.environ, **reached},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_scan_and_plot(service: ServiceProcess, receiver: subprocess.Popen[str], tmp_path: Path) -> None:
    said = run("scan_and_plot.py", "depth.png", folder=tmp_path, service=service)
    assert "median standard deviation" in said
    assert {path.name for path in tmp_path.iterdir()} == {"depth.png", "mesh.ply"}
    # The service tells the receiver, which checks the signature.
    assert receiver.stdout is not None
    assert "job.ended" in receiver.stdout.readline()


def test_region_and_preset(service: ServiceProcess, tmp_path: Path) -> None:
    said = run("region_and_preset.py", -30, -10, -60, 30, 10, 60, folder=tmp_path, service=service)
    whole, part = (int(line.split()[1].replace(",", "")) for line in said.splitlines())
    assert 0 < part < 0.8 * whole


def test_several_views(service: ServiceProcess, tmp_path: Path) -> None:
    run("several_views.py", 8, "model.ply", 2, 0, 1.5, 0.03, -1, -0.05, folder=tmp_path, service=service)
    assert (tmp_path / "model.ply").read_bytes().startswith(b"ply")


def test_calibrate_by_script(tmp_path: Path) -> None:
    with serving(write_rig(tmp_path / "rig"), tmp_path / "data") as service:
        with service.client() as client:
            # The positions are known once the rig is open.
            while not client.rig.get()["positions"]:
                pass
        board = ("chessboard", 8, 5, 20, "--most-error-mm", 1)
        said = run("calibrate_by_script.py", *board, folder=tmp_path, service=service)
        assert said.count("succeeded") == 10
        assert "is in use" in said


def test_import_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scan = Recorded(tmp_path / "rig", "opencv", monkeypatch)
    images = lay_out(tmp_path / "images", scan.images, "pattern_cam1_im{}.png", first=1)
    calibration = scan.folder / "calibration.json"
    said = run("import_folder.py", images, "200x160", calibration, "mesh", "left", folder=tmp_path)
    assert "vertices" in said
    assert (tmp_path / "mesh" / "mesh.ply").exists()
