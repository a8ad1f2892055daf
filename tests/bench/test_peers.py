"""Our method against what people use today, on the same frames.

    pip install '.[test,bench]'                          # in a virtual environment of its own
    pytest tests/bench/test_peers.py -s -p no:dash

Open3D brings the pytest plugin of `dash`, which warns at once, and our tests take warnings as errors. OpenCV with its
contrib modules overwrites the wheel without them; whoever wants that one back deletes the environment. The sample
bundles are needed for two of the three scenes. The tables go to standard output and to the folder that
SLRIG_BENCH_OUTPUT names. SLRIG_BENCH_LIMIT_S is how long one method may take: 600 s unless set.
"""

from __future__ import annotations

import importlib.util
import os
import platform
from pathlib import Path

import cv2
import pytest

from slrig.bundle import read_bundle, read_truth
from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import PatternPlan, ReconstructionPlan, ScanPlan
from slrig.scan.reconstruct import reconstruct_bundle
from tests.bench.peers.catalogue import METHODS, OURS
from tests.bench.peers.figures import figures_of
from tests.bench.peers.measuring import Phase
from tests.bench.peers.table import Row, as_markdown
from tests.bench.peers.worker import run_apart

RIGS = Path(__file__).parents[2] / "config" / "rigs"
LIMIT_S = float(os.environ.get("SLRIG_BENCH_LIMIT_S", "600"))
CLOUD_MESHERS_BEATEN = ("ball_pivoting", "poisson", "image_delaunay")


@pytest.fixture(scope="module", autouse=True)
def _extra() -> None:
    """The peers. Skips where they are not installed."""
    missing = [] if importlib.util.find_spec("open3d") else ["open3d"]
    if not hasattr(cv2, "structured_light"):
        missing.append("opencv-contrib-python-headless (cv2.structured_light)")
    if missing:
        pytest.skip(f"the peers are not installed: {', '.join(missing)}; pip install '.[test,bench]' in a fresh venv")


def compared(bundle: Path, work: Path) -> list[Row]:
    """Run every method on the bundle, one after the other, each in its own process."""
    reconstruct_bundle(
        bundle, work / "scan", plan=ReconstructionPlan(), progress=lambda *_: None, cancelled=lambda: False
    )
    recorded, truth = read_bundle(bundle), read_truth(bundle)
    assert truth is not None
    assert recorded.calibration is not None
    eye_mm = recorded.calibration.cameras[next(iter(recorded.capture.cameras))].centre_mm
    rows = []
    for name in METHODS:
        outcome = run_apart(name, bundle, work / "scan" / "points.ply", work / name, limit_s=LIMIT_S)
        figures = None if outcome.mesh is None else figures_of(outcome.mesh, truth, eye_mm)
        rows.append(Row(name, outcome.cost, figures, outcome.reason))
    return rows


def shown(rows: list[Row], scene: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Print the table, and keep it where SLRIG_BENCH_OUTPUT says."""
    title = f"{scene}: all methods on the same frames ({os.cpu_count()} cores, {platform.machine()})"
    table = as_markdown(rows, title=title)
    with capsys.disabled():
        print("\n\n" + table)  # noqa: T201
    folder = os.environ.get("SLRIG_BENCH_OUTPUT")
    if folder:
        Path(folder).mkdir(parents=True, exist_ok=True)
        (Path(folder) / f"peers-{scene}.md").write_text(table, encoding="utf-8")


def check(rows: list[Row]) -> None:
    """What has to hold for the comparison to speak for us; where a peer wins, the table shows it."""
    by_name = {row.method: row for row in rows}
    ours, gray = by_name[OURS], by_name["gray_arrays"]
    assert ours.figures is not None, ours.reason
    assert ours.cost is not None
    assert gray.figures is not None, gray.reason
    assert ours.figures.nonmanifold_edges == 0
    assert ours.figures.error.rms_mm < gray.figures.error.rms_mm / 2
    assert ours.figures.error.complete_01mm > gray.figures.error.complete_01mm
    for name in CLOUD_MESHERS_BEATEN:
        cost = by_name[name].cost
        assert cost is None or ours.cost.warm_s[Phase.MESH] < cost.warm_s[Phase.MESH], name
    by_module = by_name["gray_opencv"].figures
    assert by_module is not None, by_name["gray_opencv"].reason
    # The two decoders follow one rule, so their meshes are the same.
    assert by_module.triangles == gray.figures.triangles


@pytest.mark.shared
@pytest.mark.parametrize("scene", ["vase", "terrace"])
def test_peers_on_a_sample_bundle(shared: Path, tmp_path: Path, scene: str, capsys: pytest.CaptureFixture[str]) -> None:
    rows = compared(shared / "bundles" / scene, tmp_path)
    shown(rows, scene, capsys)
    check(rows)


def test_peers_on_a_rendered_scan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # A code of single columns, as OpenCV's module has it; ours would ask for four frames less.
    plan = ScanPlan(patterns=PatternPlan(gray_cell_px=1))
    with open_rig(read_rig(RIGS / "demo.toml")) as rig:
        capture_frames(rig, plan, tmp_path / "bundle", progress=lambda *_: None, cancelled=lambda: False).finish()
    rows = compared(tmp_path / "bundle", tmp_path)
    shown(rows, "demo", capsys)
    check(rows)
