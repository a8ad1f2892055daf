"""What is old is removed when a service starts."""

from __future__ import annotations

import threading
from pathlib import Path
from uuid import UUID

from fastapi.testclient import TestClient

from tests.unit.api.conftest import KEY, ServedBench, ended
from tests.unit.calibrate.calibration_bench import BOARD
from tests.unit.scan.fakes import WAIT_S


def test_old_calibrations_are_removed_when_the_service_starts(tmp_path: Path) -> None:
    bench = ServedBench(tmp_path, keep_calibrations=1)
    old, new = (bench.service.calibrations.open(BOARD).id for _ in range(2))
    removed = threading.Event()
    bench.service.calibrations.register.jobs.watch(old, removed.set)
    headers = {"Authorization": f"Bearer {KEY}"}
    with TestClient(bench.app, base_url="http://127.0.0.1", headers=headers) as client:
        assert removed.wait(WAIT_S)
        assert [each["id"] for each in client.get("/calibration").json()["calibrations"]] == [str(new)]


def test_old_scans_are_removed_after_each_scan_but_for_pinned_ones(tmp_path: Path) -> None:
    bench = ServedBench(tmp_path, keep_scans=1)
    bench.gate.set()
    headers = {"Authorization": f"Bearer {KEY}"}
    with TestClient(bench.app, base_url="http://127.0.0.1", headers=headers) as client:
        made = []
        for number in range(3):
            made.append(client.post("/scan").json()["id"])
            assert ended(client, made[-1])["state"] == "succeeded"
            if number == 0:
                assert client.put(f"/scan/{made[0]}/pin").json()["pinned"] is True
        gone = threading.Event()
        bench.service.store.watch(UUID(made[1]), gone.set)
        left = [each["id"] for each in client.get("/scan").json()["scans"]]
        assert made[1] not in left or gone.wait(WAIT_S)
        assert [each["id"] for each in client.get("/scan").json()["scans"]] == [made[2], made[0]]
        assert client.delete(f"/scan/{made[0]}/pin").json()["pinned"] is False
        assert client.put(f"/scan/{made[1]}/pin").status_code == 404
