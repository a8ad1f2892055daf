"""What the process that holds the rig loads: no compiler, no solver; whatever they do to a process is the worker's."""

from __future__ import annotations

from pathlib import Path

import pytest

from slrig.calibrate.records import USUAL_PATTERNS
from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import ScanPlan
from tests.e2e.conftest import ServiceProcess, Start
from tests.e2e.test_calibration_walk import BOARD, Caller, scanned, write_rig

MATHEMATICS = ("numba", "llvmlite", "scipy/optimize", "scipy/linalg", "scipy/sparse", "scipy/spatial")


def libraries(process: int) -> set[str]:
    """Which of `MATHEMATICS` a process has code of."""
    mapped = Path(f"/proc/{process}/maps").read_text()
    return {name for name in MATHEMATICS if f"/{name}/" in mapped}


def recorded(folder: Path) -> Path:
    """A rig file that replays one pose of a board, with both axes and its calibration."""
    with open_rig(read_rig(write_rig(folder / "rendered", head="", carries="true"))) as rig:
        assert rig.positioner is not None
        rig.positioner.move(1)
        capture_frames(
            rig, ScanPlan(patterns=USUAL_PATTERNS), folder / "pose", progress=lambda *_: None, cancelled=lambda: False
        ).finish()
    rig_file = folder / "replayed.toml"
    rig_file.write_text('name = "replayed"\n[head]\ndriver = "replay"\nbundle = "pose"\n')
    return rig_file


def worked(service: ServiceProcess) -> None:
    """All kinds of work, each to its end."""
    scan = scanned(service)
    assert scan["state"] == "succeeded"
    with Caller(service) as caller:
        for name in (each for each in scan["links"]["files"] if each.startswith(("points-", "depth-", "mesh."))):
            assert caller.http.get(scan["links"]["files"][name]).status_code == 200, name
        assert caller.http.get("/calibration/board.pdf").content[:4] == b"%PDF"
        still = [[float(row == column) for column in range(4)] for row in range(4)]
        model = caller.post("/model", 202, scans=[scan["id"], scanned(service)["id"]], poses=[still, still])
        caller.http.get(model["links"]["events"])
        assert caller.get(model["links"]["self"])["state"] == "succeeded", caller.get(model["links"]["self"])["error"]
        made = caller.post("/calibration", 201, board=BOARD)
        caller.post(made["links"]["pose"], 202)
        (pose,) = caller.settled(made)["shot"]
        assert pose["state"] == "succeeded", pose["error"]
        caller.post(made["links"]["solve"], 202)
        assert caller.settled(made)["error"]["type"] == "/problems/solve-refused"
        assert caller.http.get(caller.settled(made)["links"]["coverage"]["left"]).content[:4] == b"\x89PNG"
        text = (service.data / "scans").glob("*/bundle/calibration.json").__next__().read_bytes()
        imported = [
            caller.http.post("/calibration/import", content=text, headers={"Content-Type": "application/json"}).json()
            for _ in range(2)
        ]
        first, second = (each["id"] for each in imported)
        assert caller.get(f"/calibration/compare?first={first}&second={second}")["words"]
        begun = caller.post("/rig/verification", 202, board=BOARD)
        # The stream ends when the verification has.
        assert '"succeeded"' in caller.http.get(begun["links"]["events"]).text, caller.get(begun["links"]["self"])


@pytest.mark.slow
def test_the_process_that_holds_the_rig_loads_no_mathematics(start: Start, tmp_path: Path) -> None:
    service = start(recorded(tmp_path), fresh=True)
    worked(service)
    assert "numba" in libraries(service.worker_id())
    assert libraries(service.process.pid) == set()
    assert service.stop() == 0
