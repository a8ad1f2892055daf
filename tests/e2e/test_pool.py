"""A pool of real processes over TLS, and an S3 server that is not ours: whatever is lost, a scan has one result."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from slrig.cli.commands import app
from slrig.jobs.worker import Worker
from slrig.scan.job import PIPELINE, reconstruction
from slrig.scan.plan import ReconstructionPlan
from tests.e2e.conftest import Start, write_rig
from tests.e2e.pool_processes import Process, S3Server, Wire
from tests.listening import free_port, listening_at
from tests.npm import lacking

SECRET = "the-secret-of-the-store"  # noqa: S105 - nothing but a test's
BUCKET = "s3://scans/hall-3"
FOUND_LIMIT_S = 60.0
"""So long a service may take to find its pool."""


class Pool:
    """A scheduler, two workers and a store; the rig reaches the scheduler by `wire`."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        certificates, port = folder / "certificates", free_port()
        made = CliRunner().invoke(app, ["pool", "certificates", str(certificates)])
        assert made.exit_code == 0, made.output
        self.certificates = certificates / "rig"
        self.logs = [folder / f"{name}.log" for name in ("store", "scheduler", "one", "two")]
        self.store = S3Server(self.logs[0])
        self.environment = {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self.store.port}",
            "AWS_ACCESS_KEY_ID": "somebody",
            "AWS_SECRET_ACCESS_KEY": SECRET,
        }
        scheduler = ["slrig.cli", "pool", "--port", str(port), "--certificates", str(certificates / "scheduler")]
        worker = ["slrig.cli", "worker", "--scheduler", f"tls://127.0.0.1:{port}", "--store", BUCKET, "--certificates"]
        worker = [*worker, str(certificates / "worker")]
        self.scheduler = Process(scheduler, {}, self.logs[1], said="scheduler is at tls://")
        self.workers = [Process(worker, self.environment, log, said="computes for") for log in self.logs[2:]]
        self.wire = Wire(port)
        self.address = f"tls://127.0.0.1:{self.wire.port}"
        for each in (self.store, self.scheduler, *self.workers):
            stack.callback(each.kill)
        stack.callback(self.wire.close)
        self.store.make_bucket("scans")
        for each in (self.scheduler, *self.workers):
            each.wait_until_it_works()
            assert {at.rpartition(":")[0] for at in listening_at(each.process.pid)} == {"127.0.0.1"}


@pytest.fixture
def pool(tmp_path: Path) -> Iterator[Pool]:
    try:
        import distributed
        import flask_cors
        import moto
        import obstore
    except ImportError:
        lacking("needs a pool's libraries, and an S3 server: pip install -e '.[pool,s3]'")
    del distributed, flask_cors, moto, obstore
    with ExitStack() as stack:
        yield Pool(tmp_path, stack)


class Rig:
    """What a service has bundles reconstructed by, and what came of one."""

    def __init__(self, pool: Pool, bundle: Path, local: Worker) -> None:
        from slrig.compute.cluster import DaskCluster
        from slrig.compute.pooled import PooledWorker
        from slrig.compute.security import pool_security
        from slrig.compute.store import open_store

        self.bundle = bundle
        self.cluster = DaskCluster(pool.address, pool_security(pool.address, pool.certificates))
        self.worker = PooledWorker(local, self.cluster, open_store(BUCKET))
        self.worker.start()

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
    for name, value in pool.environment.items():
        monkeypatch.setenv(name, value)
    with monkeypatch.context() as of_the_service:
        of_the_service.setenv("SLRIG_COMPUTE", pool.address)
        of_the_service.setenv("SLRIG_COMPUTE_STORE", BUCKET)
        of_the_service.setenv("SLRIG_COMPUTE_CERTIFICATES", str(pool.certificates))
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
            assert "because" in right("network", pool.wire.cut)
        pool.wire.mend()
        assert rig.cluster.usable(30)

        assert "lost" in right("scheduler", pool.scheduler.kill)["because"]
        pool.scheduler.start_again()
        assert rig.cluster.usable(30)
        assert right("again", lambda: None)["where"] == "pool"

        assert "store s3://scans/hall-3 failed" in right("store", pool.store.kill)["because"]
    finally:
        rig.worker.close()
    told = "".join(log.read_text() for log in [*pool.logs, service.log])
    assert SECRET not in told
    assert os.environ["AWS_SECRET_ACCESS_KEY"] == SECRET
