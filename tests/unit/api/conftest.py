"""A service over a tame bench, and a client that holds its key."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx2
import pytest
from fastapi import APIRouter, FastAPI
from fastapi.testclient import TestClient

from slrig.api import auth, system
from slrig.api import rig as rig_routes
from slrig.api.app import create_app
from slrig.api.auth import KeyRing
from slrig.api.problems import install_problems
from slrig.api.server import KINDS
from slrig.api.service import Service, _of_request
from slrig.cli.options import ServiceOptions
from slrig.client import Client
from slrig.config import ServiceSettings, rig_of
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.manager import JobManager
from slrig.jobs.records import JobState
from slrig.jobs.store import Copies, JobStore, Outbox
from slrig.jobs.worker import Compute
from slrig.rig.session import RigSession
from tests.unit.calibrate.calibration_bench import TameCalibrating
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.model_jobs.model_bench import TameCombining
from tests.unit.scan.bench import PIPELINE
from tests.unit.scan.fakes import WAIT_S, TameBench
from tests.unit.stand_ins import stand_ins

KEY = "the key of the tests"
HERE = "http://127.0.0.1"
RIG = """# A bench.
name = "bench"
[head]
driver = "tame" # as tests open it
[scan]
line_shift_period_px = 6
exposure_s = 0.5
"""


class ServedBench(TameBench):
    """A service over a tame bench. worker : what computes, for one that needs no process."""

    def __init__(self, root: Path, *, worker: Compute | None = None, **settings: Any) -> None:
        super().__init__()
        self.free_bytes = 10**12
        chosen = ServiceSettings(
            data_dir=root, queue_length=1, max_event_streams=1, max_body_bytes=4096, requests_per_s=1e6, **settings
        )
        folder = DataFolder(root, free=lambda _: self.free_bytes)
        database = Database(folder.database)
        copies = Copies(database) if "catalogue" in settings else None
        store = JobStore(database, outbox=Outbox(database, copies=copies))
        self.worker = TameCompute(PIPELINE) if worker is None else worker
        self.tame, self.combining = TameCalibrating(), TameCombining()
        patched = ExitStack()
        functions: dict[str, Callable[..., Any]] = {
            "model_jobs.combining.combine_into": self.combining,
            # The fake reconstruction reports no residuals: each scan would log the traceback of a defect.
            "calibrate.verification.RigHealth._note_scan": lambda *_: None,
        }
        for each in (self.captures(), self.tame.patched(), stand_ins(functions)):
            patched.enter_context(each)
        waits = patched.enter_context(pytest.MonkeyPatch.context())
        for module, name in ((system, "_FRESH_S"), (rig_routes, "_FRESH_S"), (auth, "_HELD_S")):
            waits.setattr(module, name, 0.0)
        self.unpatch = patched.close
        rig = RigSession("bench", self.open_rig)
        manager = JobManager(store, folder, rig, self.worker, *KINDS, queue_length=1)
        self.service = Service(chosen, rig_of(RIG, root / "rig.toml"), manager)
        self.app: FastAPI = create_app(self.service, ring=KeyRing(root / "keys.json", given=KEY))

    def held(self, client: TestClient) -> dict[str, Any]:
        self.began.clear()
        self.gate.clear()
        scan: dict[str, Any] = client.post("/scan").json()
        assert self.began.wait(WAIT_S)
        return scan


@pytest.fixture(scope="package")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedBench]:
    served = ServedBench(tmp_path_factory.mktemp("data"))
    yield served
    served.unpatch()


@pytest.fixture(scope="package")
def session(served: ServedBench) -> Iterator[TestClient]:
    with client_of(served) as client:
        yield client


@pytest.fixture
def client(session: TestClient, served: ServedBench) -> Iterator[TestClient]:
    served.order = "finish"
    served.gate.set()
    yield session
    served.gate.set()
    for scan in session.get("/scan").json()["scans"]:
        if not JobState(scan["state"]).final:
            session.post(f"/scan/{scan['id']}/cancel")
            ended(session, scan["id"])
        session.delete(f"/scan/{scan['id']}")


@pytest.fixture
def commands(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    """The client of commands that are run in this process reaches the service."""

    def forward(request: httpx2.Request) -> httpx2.Response:
        path, headers = request.url.raw_path.decode(), dict(request.headers)
        answer = client.request(request.method, path, content=request.read(), headers=headers)
        told = {each: answer.headers.get(each, "") for each in ("content-type", "content-disposition")}
        return httpx2.Response(answer.status_code, content=answer.content, headers=told)

    def reaching(_service: ServiceOptions) -> Client:
        return Client("http://127.0.0.1:1", KEY, transport=httpx2.MockTransport(forward))

    monkeypatch.setattr(ServiceOptions, "client", reaching)


def client_of(served: ServedBench, *, key: str | None = KEY) -> TestClient:
    headers = {} if key is None else {"Authorization": f"Bearer {key}"}
    return TestClient(served.app, base_url=HERE, headers=headers, raise_server_exceptions=False)


def app_of(router: APIRouter, service: object) -> FastAPI:
    """An application with the routes of one router, over a stand-in for the service."""
    app = FastAPI()
    app.include_router(router)
    install_problems(app)
    app.dependency_overrides[_of_request] = lambda: service
    return app


def ended(client: TestClient, scan_id: str) -> dict[str, Any]:
    client.get(f"/scan/{scan_id}/events")
    scan: dict[str, Any] = client.get(f"/scan/{scan_id}").json()
    return scan


def refusal(client: TestClient, method: str, path: str, **options: Any) -> tuple[int, str]:
    """The status and the kind of the problem that a request gets."""
    answer = client.request(method, path, **options)
    return answer.status_code, answer.json()["type"]
