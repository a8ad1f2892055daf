"""A live scan whose frames fail for good: its cause is told, and its frames can be fetched."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from slrig.devices import Rig
from slrig.jobs.frame_feed import FrameSink
from slrig.scan.acquisition import Recording, capture_frames
from slrig.scan.plan import PatternPlan, ScanPlan
from tests.unit.api.conftest import KEY, ServedBench, ended
from tests.unit.capture.fake_rig import CameraFaults, fake_rig


class FaultyBench(ServedBench):
    """Captures on a rig in memory, whose camera spoils every line frame."""

    def __init__(self, root: Path) -> None:
        self.rig = fake_rig(faults={"right": CameraFaults(garbled=frozenset(range(17, 1000)))}).rig
        super().__init__(root)

    def open_rig(self) -> Rig:
        return self.rig

    def capture(
        self,
        rig: Rig,
        plan: ScanPlan,
        folder: Path,
        /,
        *,
        progress: Callable[[str, float, str], None],
        cancelled: Callable[[], bool],
        frames: FrameSink,
    ) -> Recording:
        del plan
        return capture_frames(
            rig, ScanPlan(PatternPlan()), folder, progress=progress, cancelled=cancelled, frames=frames
        )


@pytest.fixture
def failed(tmp_path: Path) -> Iterator[tuple[TestClient, dict[str, Any]]]:
    bench = FaultyBench(tmp_path)
    headers = {"Authorization": f"Bearer {KEY}"}
    with TestClient(bench.app, base_url="http://127.0.0.1", headers=headers) as client:
        yield client, ended(client, client.post("/scan").json()["id"])


def test_a_live_scan_that_failed_gives_its_frames(failed: tuple[TestClient, dict[str, Any]]) -> None:
    client, scan = failed
    assert (scan["state"], scan["error"]["type"]) == ("failed", "/problems/scan-evidence")
    assert "camera 'right', pattern 17" in scan["error"]["detail"]
    assert "The frames are kept" in scan["error"]["detail"]
    assert list(scan["links"]["files"]) == ["bundle.zip"]
    fetched = client.get(scan["links"]["files"]["bundle.zip"])
    with zipfile.ZipFile(io.BytesIO(fetched.content)) as archive:
        assert archive.testzip() is None
        listed = json.loads(archive.read("refused/refused.json"))
        assert [each["attempt"] for each in listed["frames"] if each["pattern"] == 17] == [1, 2, 3]
        assert all(each["file"] in archive.namelist() for each in listed["frames"])
        frames = json.loads(archive.read("bundle.json"))["frames"]
        assert all(frame["file"] in archive.namelist() for frame in frames)


def test_the_next_scan_finds_the_rig_free(failed: tuple[TestClient, dict[str, Any]]) -> None:
    client, first = failed
    again = ended(client, client.post("/scan").json()["id"])
    assert again["id"] != first["id"]
    assert again["error"]["type"] == "/problems/scan-evidence"
