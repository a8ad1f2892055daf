"""The service through `slrig.client`: as its README says, and as a program does that waits and one that awaits."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from slrig.client import Client
from slrig.client.errors import ConflictError, InvalidRequestError, NotFoundError
from slrig.client.events import Captured, FileReady, Progress, StateChange
from slrig.errors import ScanCancelledError
from tests.e2e.conftest import KEY, ServiceProcess, write_rig

pytestmark = pytest.mark.slow

README = Path(__file__).parents[2] / "slrig" / "client" / "README.md"
SIZE = (192, 240)
BOARD = {"kind": "chessboard", "corners": [8, 5], "square_mm": 20.0}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    folder = tmp_path_factory.mktemp("client")
    service = ServiceProcess(write_rig(folder / "rig"), folder / "data")
    yield service
    assert service.stop() == 0


def test_the_examples_of_the_readme_run_in_their_order(service: ServiceProcess, tmp_path: Path) -> None:
    examples = re.findall(r"^```python\n(.*?)^```$", README.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert len(examples) == 3
    # A notebook shows what its last line is.
    first = f"{examples[0]}\nopen('shown.html', 'w').write(result._repr_html_())\n"
    environment = {**os.environ, "SLRIG_URL": service.url, "SLRIG_API_KEY": KEY}
    ran = subprocess.run(  # noqa: S603 - our own examples
        [sys.executable, "-W", "error", "-c", "\n".join([first, *examples[1:]])],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    flat, stated = map(
        float, re.findall(r"flat to ([\d.]+) mm; a point is stated to be within ([\d.]+) mm", ran.stdout)[0]
    )
    assert 0.3 * stated < flat < 3 * stated
    assert (tmp_path / "mesh.ply").read_bytes().startswith(b"ply")
    assert "<iframe" in (tmp_path / "shown.html").read_text(encoding="utf-8")
    assert "the rig is free: move the part" in ran.stdout
    assert ran.stdout.splitlines()[-1] == str((*SIZE, 3))


def test_a_scan_comes_as_arrays_that_say_what_its_files_say(service: ServiceProcess) -> None:
    with Client(service.url, KEY) as client:
        job = client.start_scan(label="arrays")
        told = list(job)
        assert [type(event) for event in told if not isinstance(event, Progress | FileReady)] == [
            StateChange, StateChange, Captured, StateChange, StateChange,
        ]  # fmt: skip
        assert "mesh.ply" in [event.name for event in told if isinstance(event, FileReady)]
        result = job.result()
        assert "points-left.npz" in result.files
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
        result.pin()
        assert client.scans.get(result.id)["pinned"]
        again = client.result(result.id)
        assert again.files == result.files
        again.delete()
        with pytest.raises(NotFoundError) as gone:
            client.scans.get(result.id)
        assert gone.value.code == "job-not-found"


def test_one_of_two_scans_is_cancelled(service: ServiceProcess) -> None:
    with Client(service.url, KEY) as client:
        first, second = client.start_scan(label="first"), client.start_scan(label="second")
        second.cancel()
        with pytest.raises(ScanCancelledError):
            second.result()
        result = first.result()
        assert len(result.mesh.faces) == result.report["mesh"]["figures"]["triangles"]
        assert next(client.rig.pictures("left", light="white")).shape == SIZE


def test_the_rest_of_the_interface_answers(service: ServiceProcess) -> None:
    with Client(service.url, KEY) as client:
        session = client.calibration.open(board=BOARD, label="by Python")
        assert client.calibration.get(session["id"])["label"] == "by Python"
        assert [each["id"] for each in client.calibration.list()["calibrations"]] == [session["id"]]
        with pytest.raises(ConflictError) as unsolved:
            client.calibration.activate(session["id"])
        assert unsolved.value.code == "calibration-state"
        client.calibration.delete(session["id"])
        assert client.calibration.board(kind="chessboard", columns=8, rows=5, square_mm=20.0).startswith(b"%PDF")

        schedule = client.schedules.add("30 6 * * mon-fri", "verification", options={"board": BOARD}, enabled=False)
        assert client.schedules.resume(schedule["id"])["enabled"]
        assert client.schedules.runs(schedule["id"])["runs"] == []
        client.schedules.remove(schedule["id"])
        assert client.schedules.list()["schedules"] == []

        asked = client.health.verify(board=BOARD, if_busy="queue")
        *_, last = client.health.follow(asked["id"])
        assert isinstance(last, StateChange)
        # There is a plate before the rig, and no board.
        assert last.state == client.health.verification(asked["id"])["state"] == "failed"
        with pytest.raises(InvalidRequestError, match="no_such"):
            client.health.verify(board={**BOARD, "no_such": 1})
        assert client.health.plot().startswith("<svg")

        tested = client.accept.open()
        assert client.accept.get(tested["id"])["state"] == "open"
        client.accept.delete(tested["id"])

        picture = next(client.rig.pictures("left"))
        assert picture.shape == SIZE
        assert client.system.readiness()["checks"]["rig"] == "ok"
        assert client.system.explain("rig-busy")["title"] == "Rig busy"
        assert "slrig" in client.system.metrics()
        assert client.system.audit(limit=1)["entries"]


def test_exposures_proposed_and_kept_as_a_preset_are_those_of_the_scan(service: ServiceProcess) -> None:
    with service.client() as client:
        found = client.scans.exposure(budget_s=20.0)
        assert found["completeness"] > 0.95
        assert found["lit"] > 0.2
        (cover,) = found["exposures"]
        assert found["scan"] == {"exposure_s": cover["exposure_s"]}
        assert {each["exposure_s"] for each in found["others"]}.isdisjoint({cover["exposure_s"]})
        with pytest.raises(InvalidRequestError, match=r"budget_s: found 0\.01 s"):
            client.scans.exposure(budget_s=0.01, patterns={"rows": True})
        # The rig is free again at once.
        client.presets.put("plate", {"format": "slrig-preset", "version": 1, "scan": found["scan"]})
        result = client.scan(preset="plate", if_busy="reject")
        assert result.scan["plan"]["exposure_s"] == cover["exposure_s"]
        use = result.scan["plan"]["preset"]
        assert (use["name"], use["version"]) == ("plate", 1)
        assert f"the scan was asked for by preset 'plate' (version 1, {use['digest']})" in result.report["notes"]
        factors = {"exposure_factors": [1.0, 0.25], "line_shift": False}
        client.presets.put("plate", {"format": "slrig-preset", "version": 1, "scan": factors})
        bracket = client.scan(preset="plate", reconstruction={"smooth_boundary": False})
        exposures_s = [each["exposure_s"] for each in bracket.report["cameras"]["left"]["exposures"]]
        assert exposures_s == pytest.approx([0.25 / 60, 1 / 60])
        client.presets.delete("plate")
        assert "plate" not in {each["name"] for each in client.presets.list()["presets"]}
