"""The service through `slrig.client`: as its README says, and as arrays."""

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
from slrig.client.errors import NotFoundError
from slrig.client.events import Captured, FileReady, Progress, StateChange
from tests.e2e.conftest import KEY, ServiceProcess, serving, write_rig

pytestmark = pytest.mark.slow

README = Path(__file__).parents[2] / "slrig" / "client" / "README.md"
SIZE = (192, 240)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    folder = tmp_path_factory.mktemp("client")
    with serving(write_rig(folder / "rig"), folder / "data") as service:
        yield service


def test_the_examples_of_the_readme_run_in_their_order(service: ServiceProcess, tmp_path: Path) -> None:
    examples = re.findall(r"^```python\n(.*?)^```$", README.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert len(examples) == 2
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
    with Client(service.url, KEY) as client:
        assert client.scans.get(ran.stdout.splitlines()[-1])["label"] == "next"


def test_a_scan_comes_as_arrays_that_say_what_its_files_say(service: ServiceProcess) -> None:
    with Client(service.url, KEY) as client:
        job = client.start_scan(label="arrays")
        events = list(job)
        assert [type(event) for event in events if not isinstance(event, Progress | FileReady)] == [
            StateChange, StateChange, Captured, StateChange, StateChange,
        ]  # fmt: skip
        assert "mesh.ply" in [event.name for event in events if isinstance(event, FileReady)]
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
