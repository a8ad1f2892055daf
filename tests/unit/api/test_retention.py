"""What is old is removed when a service starts."""

from __future__ import annotations

import threading
from pathlib import Path

from fastapi.testclient import TestClient

from tests.unit.api.conftest import KEY, ServedBench
from tests.unit.calibrate.calibration_bench import BOARD
from tests.unit.scan.fakes import WAIT_S


def test_old_calibrations_are_removed_when_the_service_starts(tmp_path: Path) -> None:
    bench = ServedBench(tmp_path, keep_calibrations=1)
    old, new = (bench.service.calibrations.open(BOARD).id for _ in range(2))
    removed = threading.Event()
    bench.service.calibrations.register.watch(old, removed.set)
    headers = {"Authorization": f"Bearer {KEY}"}
    with TestClient(bench.app, base_url="http://127.0.0.1", headers=headers) as client:
        assert removed.wait(WAIT_S)
        assert [each["id"] for each in client.get("/calibration").json()["calibrations"]] == [str(new)]
