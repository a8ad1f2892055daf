"""A pool of real processes over TLS, and an S3 server that is not ours: whatever is lost, a scan has one result."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from slrig.jobs.worker import Worker
from slrig.scan.job import PIPELINE, reconstruction
from slrig.scan.plan import ReconstructionPlan
from tests.e2e.conftest import Start, write_rig
from tests.e2e.pool_processes import SECRET, Pool

FOUND_LIMIT_S = 60.0
"""So long a service may take to find its pool."""


class Rig:
    """What a service has bundles reconstructed by, and what came of one."""

    def __init__(self, pool: Pool, bundle: Path, local: Worker) -> None:
        self.bundle = bundle
        self.worker, self.cluster = pool.rig(local, wired=True)

    def computed(self, result: Path, *, when_begun: Callable[[], None]) -> dict[str, Any]:
        """Reconstruct, with something done in the middle; return the report's section."""
        result.mkdir()
        begun = False

        def progress(_stage: str, fraction: float, _detail: str) -> None:
            nonlocal begun
            if fraction > 0 and not begun:
                begun = True
                when_begun()

        task = reconstruction(PIPELINE, self.bundle, result, ReconstructionPlan())
        report = self.worker.run(task, progress=progress)
        assert begun
        assert report == json.loads((result / "report.json").read_text())
        section: dict[str, Any] = report["computed"]
        return section


@pytest.mark.slow
def test_whatever_is_lost_a_scan_has_its_one_result(
    pool: Pool, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in pool.service(wired=True).items():
        monkeypatch.setenv(name, value)
    service = start(write_rig(tmp_path / "rig"))
    with service.client() as client:
        # The first ones may come before the service has found its pool.
        until_s = time.monotonic() + FOUND_LIMIT_S
        while (scan := client.scan()).report["computed"]["where"] != "pool":
            assert time.monotonic() < until_s, scan.report["computed"]
        names = set(scan.files)
    bundle, pooled = (service.data / "scans" / str(scan.id) / name for name in ("bundle", "mesh.ply"))
    assert service.stop() == 0

    local = Worker(PIPELINE)
    rig = Rig(pool, bundle, local)
    assert rig.cluster.usable(30)
    try:
        alone = tmp_path / "alone"
        alone.mkdir()
        assert local.run(reconstruction(PIPELINE, bundle, alone, ReconstructionPlan()))["computed"]["where"] == "local"
        whole = {path.name for path in alone.iterdir()}
        assert (alone / "mesh.ply").read_bytes() == pooled.read_bytes()
        assert whole <= names

        def right(case: str, when_begun: Callable[[], None]) -> dict[str, Any]:
            section = rig.computed(tmp_path / case, when_begun=when_begun)
            assert {path.name for path in (tmp_path / case).iterdir()} == whole
            assert (tmp_path / case / "mesh.ply").read_bytes() == pooled.read_bytes()
            return section

        def kill_who_computes() -> None:
            (order,) = rig.cluster._told
            (found,) = (each for each, log in zip(pool.workers, pool.logs[2:], strict=True) if order in log.read_text())
            found.process.send_signal(signal.SIGKILL)

        assert right("worker", kill_who_computes)["where"] == "pool"
        assert sorted(each.process.poll() is None for each in pool.workers) == [False, True]

        with monkeypatch.context() as impatient:
            impatient.setattr("slrig.compute.pooled.SILENCE_LIMIT_S", 3.0)
            impatient.setattr("slrig.compute.pooled.BEGIN_LIMIT_S", 3.0)
            assert "because" in right("network", pool.wires[0].cut)
        pool.wires[0].mend()
        assert rig.cluster.usable(30)

        assert "lost" in right("scheduler", pool.scheduler.kill)["because"]
        pool.scheduler.start_again()
        assert rig.cluster.usable(30)
        assert right("again", lambda: None)["where"] == "pool"

        assert "store s3://scans/hall-3 failed" in right("store", pool.store.kill)["because"]
    finally:
        rig.worker.close()
    logs = "".join(log.read_text() for log in [*pool.logs, service.log])
    assert SECRET not in logs
    assert os.environ["AWS_SECRET_ACCESS_KEY"] == SECRET
