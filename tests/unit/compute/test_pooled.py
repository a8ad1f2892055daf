"""A pool: its members, its machines and its store; and bundles reconstructed by it, or here if the pool fails."""

from __future__ import annotations

import asyncio
import hashlib
import os
import re
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("obstore", reason="needs a pool's libraries: pip install 'slrig[pool]'")
pytest.importorskip("cryptography", reason="needs a pool's libraries: pip install 'slrig[pool]'")

import obstore
from obstore.store import MemoryStore

from slrig.compute.host import CHUNK_BYTES, REPORT_S, Host, PoolStore, PoolTask, _scratch, join, open_store
from slrig.compute.link import (
    POOL_FAULT,
    PoolError,
    PoolRequest,
    PoolResponse,
    Progress,
    Workers,
)
from slrig.compute.pooled import BEGIN_LIMIT_S, TRANSFER_LIMIT_S, PoolClient, PooledWorker
from slrig.compute.security import PoolAddress
from slrig.errors import (
    ConfigError,
    NothingToReconstructError,
    ScanCancelledError,
    ScanInterruptedError,
    StorageError,
    WorkerLostError,
)
from slrig.jobs.data_folder import RESULT
from slrig.jobs.job import FrameFeed, JobRun, Outcome
from slrig.jobs.listener import SILENT, Listener
from slrig.jobs.records import versions
from slrig.jobs.worker import READY, Task
from slrig.model import Region
from slrig.scan.plan import ScanPlan
from tests.listening import listening_at
from tests.unit.compute.test_scheduler import beside_a_scheduler
from tests.unit.scan import fake_pipeline
from tests.unit.scan.fakes import never, reconstruction


class TameWorker:
    """`Compute` in this process. done : the tasks that it was given."""

    condition, loading = READY, False

    def __init__(self) -> None:
        self.done: list[Task] = []
        self.feeds: list[FrameFeed] = []
        self.closed = False

    def start(self) -> None:
        """Nothing to be done."""

    def close(self) -> None:
        self.closed = True

    def feed(self, region: Region | None = None) -> FrameFeed:
        self.feeds.append(FrameFeed(lambda _: True, receiver=self, region=region))
        return self.feeds[-1]

    def run(
        self,
        task: Task,
        listener: Listener = SILENT,
        *,
        feed: FrameFeed | None = None,  # noqa: ARG002
        within_s: float | None = None,  # noqa: ARG002
    ) -> Any:
        if self.closed:
            raise ScanInterruptedError("closed")
        self.done.append(task)
        files = task.files
        if files is None:
            return task.function(*task.given)
        run = JobRun(
            files.id, files.folder, files.place, report=listener.report, cancelled=listener.cancelled,
            file_ready=listener.file_ready, pipeline=fake_pipeline,
        )  # fmt: skip
        return task.function(run)


class TameOrder(Future[PoolResponse]):
    """An order: `act` is asked for its answer."""

    def __init__(self, act: Callable[[PoolRequest], PoolResponse | None], order: PoolRequest) -> None:
        super().__init__()
        self._act = act
        self.order = order

    def result(self, timeout: float | None = None) -> PoolResponse:  # noqa: ARG002
        if (answer := self._act(self.order)) is None:
            raise TimeoutError
        return answer


class TameClient(PoolClient):
    """acts : what becomes of the orders, one after another; without any, a machine does them, until `stop`."""

    def __init__(self, host: Host) -> None:
        self.fault = "the pool does not answer"
        self.host = host
        self.there = True
        self.acts: list[Callable[[PoolRequest], PoolResponse | None]] = []
        self.orders: list[TameOrder] = []
        self.told: list[Progress] = []
        self.stop = threading.Event()

    def start(self) -> None:
        """Nothing to be done."""

    def close(self) -> None:
        """Nothing to be done."""

    def usable(self, timeout_s: float = 0.0) -> bool:  # noqa: ARG002
        return self.there

    def submit(self, order: PoolRequest, told: object) -> TameOrder:  # noqa: ARG002
        # As it crosses connections.
        order = PoolRequest.model_validate_json(order.model_dump_json())
        act = self.acts.pop(0) if self.acts else self.done
        self.orders.append(TameOrder(act, order))
        return self.orders[-1]

    def done(self, order: PoolRequest) -> PoolResponse:
        answer = self.host.done(order, self.told.append, self.stop)
        return PoolResponse.model_validate_json(answer.model_dump_json())


class Pool:
    """A rig, a machine of a pool, and the store between them, whose objects are `objects`."""

    def __init__(self) -> None:
        self.objects = MemoryStore()
        self.store = PoolStore("memory://", self.objects)
        self.now_s = 0.0
        self.local, self.remote = TameWorker(), TameWorker()
        self.client = TameClient(Host(self.store, self.remote, clock=lambda: self.now_s))
        self.worker = PooledWorker(self.local, self.client, self.store, clock=lambda: self.now_s)

    def passes(self, seconds: float) -> Callable[[PoolRequest], None]:
        """An act: time passes without an answer."""

        def act(_order: PoolRequest) -> None:
            self.now_s += seconds

        return act

    def tidied(self) -> set[str]:
        """What the store holds, once nothing more is to be removed."""
        self.worker._tidying.shutdown(wait=True)
        return {each["path"] for each in self.objects.list().collect()}


def lost(_order: PoolRequest) -> PoolResponse | None:
    raise PoolError("the pool lost the job")


def job(folder: Path, order: str = "finish") -> Task:
    """The reconstruction of a bundle that says what is to be done: see `tests.unit.scan.fake_pipeline`."""
    bundle = folder / "staged" / "bundle"
    (bundle / "frames").mkdir(parents=True)
    (bundle / "order").write_text(order)
    (bundle / "frames" / "0.png").write_bytes(bytes(range(256)) * 100)
    return reconstruction(folder / "staged")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    found = tmp_path / f"slrig-workers-{os.getuid()}"
    found.mkdir(mode=0o700)
    return found


def test_what_a_killed_worker_left_is_removed_by_the_next_one(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / "worker-killed" / "bundle").mkdir(parents=True)
    with _scratch():
        bundle = Path(tempfile.mkdtemp(), "bundle")
        bundle.mkdir()
        assert [*place.rglob("bundle")] == [bundle]
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
        with _scratch():
            assert bundle.is_dir()
    assert [each.name for each in place.iterdir()] == ["lock"]


FILES = {"mesh.ply", "mesh.glb", "points.ply", "preview.png", "report.json"}


@pytest.fixture
def pool() -> Pool:
    return Pool()


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / "staged" / "result").glob("*")}


def test_the_pool_gives_what_this_machine_gives(pool: Pool, tmp_path: Path) -> None:
    made: list[str] = []
    found = pool.worker.run(job(tmp_path / "pooled"), Listener(file_ready=made.append))
    pool.local.run(job(tmp_path / "local"))
    pooled, local = files(tmp_path / "pooled"), files(tmp_path / "local")
    # The tame report names the folder.
    assert {**pooled, "report.json": b""} == {**local, "report.json": b""}
    assert set(made) == files(tmp_path / "pooled").keys() == FILES
    assert found.summary["seconds"] == 1.5
    assert pool.remote.done[-1].where == {"where": "pool"}
    assert [told.stage for told in pool.client.told] == ["", "decode", "done"]
    assert pool.client.orders[0].cancelled()
    assert pool.tidied() == set()


def test_members_of_one_user_find_one_another_and_listen_nowhere_else(pool: Pool, tmp_path: Path) -> None:
    def act(address: PoolAddress) -> None:
        assert {each.rpartition(":")[0] for each in listening_at() - before} == {"127.0.0.1"}
        client, said = PoolClient(address), list[str]()
        rig, joined = PooledWorker(pool.local, client, pool.store), Future[None]()

        async def joins() -> None:
            member = asyncio.ensure_future(join(address, pool.client.host, say=said.append))
            joined.add_done_callback(lambda _: member.get_loop().call_soon_threadsafe(member.cancel))
            with suppress(asyncio.CancelledError):
                await member

        machine = threading.Thread(target=asyncio.run, args=(joins(),))
        rig.start()
        machine.start()
        try:
            assert client.usable(30), client.fault
            task, stages = job(tmp_path), list[str]()
            assert rig.run(task, Listener(report=lambda stage, *_: stages.append(stage))).summary["seconds"] == 1.5
            assert files(tmp_path).keys() == FILES
            assert (stages, pool.local.done) == (["waiting for the pool", "decode", "done"], [])
            assert said == [f"computes for the pool {address}. Ctrl-C stops it."]
        finally:
            joined.set_result(None)
            machine.join(30)
            rig.close()

    before = listening_at()
    beside_a_scheduler(act)
    with pytest.raises(ConfigError, match="no slrig pool of this user has listened at port 1 "):
        PoolAddress("127.0.0.1", 1).tls(listens=False)


def gone(pool: Pool) -> None:
    pool.client.there = False


def never_begins(pool: Pool) -> None:
    pool.client.acts = [pool.passes(BEGIN_LIMIT_S + 1)]


def is_lost_twice(pool: Pool) -> None:
    pool.client.acts = [lost, lost]


def is_lost_for_good(pool: Pool) -> None:
    def act(_order: PoolRequest) -> PoolResponse:
        pool.client.there = False
        raise PoolError("the pool lost the job")

    pool.client.acts = [act]


def answers_wrong_bytes(pool: Pool) -> None:
    def act(order: PoolRequest) -> PoolResponse:
        answer = pool.client.done(order)
        obstore.put(pool.objects, f"results/{order.job}/points.ply", b"other bytes")
        return answer

    pool.client.acts = [act] * 2


def names_a_file_elsewhere(pool: Pool) -> None:
    pool.client.acts = [lambda order: PoolResponse(job=order.job, files={"../../record.json": "0" * 64})] * 2


def is_slow(pool: Pool) -> None:
    class Slow(PoolStore):
        def _has(self, path: str) -> bool:
            pool.now_s += TRANSFER_LIMIT_S + 1
            return super()._has(path)

    pool.worker._store = Slow("memory://", pool.objects)


def is_full(pool: Pool) -> None:
    class Full(PoolStore):
        def put_bundle(self, bundle: Path, check: Callable[[], None]) -> str:  # noqa: ARG002
            raise PoolError("the store memory:// failed (GenericError)")

    pool.worker._store = Full("memory://", pool.objects)


@pytest.mark.parametrize(
    ("fault", "orders", "because"),
    [
        (gone, 0, "does not answer"),
        (never_begins, 1, "has not begun"),
        (is_lost_twice, 2, "lost the job"),
        (is_lost_for_good, 1, "lost the job"),
        (answers_wrong_bytes, 2, "not what was put there"),
        (names_a_file_elsewhere, 2, "not a file name"),
        (is_slow, 0, "took longer than"),
        (is_full, 0, r"failed \(GenericError\)"),
    ],
)
def test_what_the_pool_fails_to_do_this_machine_does(
    pool: Pool, tmp_path: Path, fault: Callable[[Pool], None], orders: int, because: str
) -> None:
    fault(pool)
    assert pool.worker.run(job(tmp_path)).summary["seconds"] == 1.5
    assert files(tmp_path).keys() == FILES
    (done,) = pool.local.done
    assert done.where["where"] == "local"
    assert re.search(because, done.where["because"])
    assert len(pool.client.orders) == orders
    assert pool.tidied() == set()


def test_a_job_that_was_lost_is_given_to_the_pool_again(pool: Pool, tmp_path: Path) -> None:
    pool.client.acts = [lost]
    assert pool.worker.run(job(tmp_path)).summary["seconds"] == 1.5
    assert (len(pool.client.orders), len(pool.remote.done), pool.local.done) == (2, 2, [])
    assert pool.tidied() == set()


def test_what_fails_by_itself_fails_here_in_its_own_words(pool: Pool, tmp_path: Path) -> None:
    with pytest.raises(NothingToReconstructError, match="No stripe"):
        pool.worker.run(job(tmp_path, "fail"))
    assert len(pool.client.orders) == 1


def test_a_job_that_is_cancelled_is_stopped_where_it_is_computed(pool: Pool, tmp_path: Path) -> None:
    pool.client.acts = [pool.passes(0.1)]
    with pytest.raises(ScanCancelledError, match="reconstruction was cancelled"):
        pool.worker.run(job(tmp_path), Listener(cancelled=lambda: pool.now_s > 1))
    (pending,) = pool.client.orders
    assert pending.cancelled()
    assert pool.tidied() == set()
    assert (pool.local.done, files(tmp_path)) == ([], {})


def test_frames_that_were_taken_here_are_computed_here(pool: Pool, tmp_path: Path) -> None:
    assert pool.worker.feed().receiver is None
    gone(pool)
    feed = pool.worker.feed()
    assert pool.local.feeds == [feed]
    pool.client.there = True
    pool.worker.run(job(tmp_path), feed=feed)
    assert pool.client.orders == []
    assert pool.local.done[0].where == {"where": "local", "because": "the pool does not answer when the frames came"}


def test_other_tasks_than_scans_are_computed_here(pool: Pool) -> None:
    assert pool.worker.run(Task(fake_pipeline.process_id, what="examination")) > 0
    assert (len(pool.local.done), pool.client.orders) == (1, [])


def test_a_pool_is_used_while_a_worker_has_this_machines_versions() -> None:
    client, mine = PoolClient(PoolAddress("pool", 8786)), dict(versions())
    for found, usable, why in (
        ([], False, "no workers"), ([{**mine, "code": "0"}], False, "this machine's versions"),
        ([{**mine, "code": "0"}, mine], True, ""), ([], False, "no workers"),
    ):  # fmt: skip
        client._heard(Workers(versions=found))
        assert (client.usable(), why in client.fault) == (usable, True)


def test_workers_use_no_folder_of_another_user(place: Path) -> None:
    place.chmod(0o755)
    with pytest.raises(ConfigError, match=f"{place.name} belongs to another user"), _scratch():
        pass


def test_a_service_that_ends_interrupts_what_is_in_the_pool(pool: Pool, tmp_path: Path) -> None:
    pool.client.acts = [lambda _: pool.worker.close()]
    with pytest.raises(ScanInterruptedError):
        pool.worker.run(job(tmp_path))


def test_a_disk_that_is_full_is_no_fault_of_the_pool(
    pool: Pool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = job(tmp_path)

    def refused(*_given: object, **_options: object) -> None:
        raise StorageError("The disk is full.")

    monkeypatch.setattr(pool.local, "run", refused)
    monkeypatch.setattr(PoolStore, "fetch_result", refused)
    with pytest.raises(StorageError, match="disk is full"):
        pool.worker.run(task)


JOB = "0" * 32


def order(pool: Pool, folder: Path, what: str = "finish", **forged: Any) -> PoolRequest:
    """An order of a rig. forged : what of its task is somebody else's."""
    task = job(folder, what)
    assert task.files is not None
    key = pool.store.put_bundle(folder / "staged" / "bundle", lambda: None)
    given = PoolTask(id=task.files.id, bundle=key, plan=ScanPlan()).model_dump(mode="json")
    return PoolRequest(job=JOB, versions=dict(versions()), task={**given, **forged})


def fault(answer: PoolResponse) -> tuple[str, str]:
    assert answer.fault is not None
    assert (answer.result, answer.files) == (None, {})
    return answer.fault.code, answer.fault.message


@pytest.mark.parametrize(
    "forged",
    [
        {"name": "os.system"},
        {"name": "scan", "function": "gASVKQAAAAAAAACMBXBvc2l4lIwGc3lzdGVtlJOUjA50b3VjaCAvdG1wL3J1bpSFlFKULg=="},
        {"plan": "gASVKQAAAAAAAACMBXBvc2l4lIwGc3lzdGVtlJOUjA50b3VjaCAvdG1wL3J1bpSFlFKULg=="},
        {"plan": {"reconstruction": {"max_code_gap": 0}}},
        {"bundle": "../../../etc/passwd"},
        {"id": "../../scans"},
    ],
    ids=str,
)
def test_a_machine_refuses_what_is_no_scan_and_runs_nothing(
    pool: Pool, tmp_path: Path, forged: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    given = order(pool, tmp_path, **forged)
    monkeypatch.setattr(pool.store, "fetch_bundle", never)
    assert fault(pool.client.done(given))[0] in {POOL_FAULT, "config"}
    assert pool.remote.done == []


def test_a_machine_answers_what_went_wrong(pool: Pool, tmp_path: Path) -> None:
    answer = pool.client.done
    given = order(pool, tmp_path / "one")
    code, message = fault(answer(given.model_copy(update={"versions": {**versions(), "numba": "0"}})))
    assert (code, "have changed" in message) == (POOL_FAULT, True)
    assert [task.what for task in pool.remote.done] == ["statement of versions"]
    obstore.put(pool.objects, f"bundles/{given.task['bundle']}.tar", b"another bundle")
    assert "not what was put there" in fault(answer(given))[1]
    for what, code in (("fail", "nothing-to-reconstruct"), ("break", "unexpected")):
        assert fault(answer(order(pool, tmp_path / what, what)))[0] == code


def test_a_machine_that_loses_its_process_leaves_the_job_to_another_try(
    pool: Pool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(*_given: object, **_options: object) -> None:
        raise WorkerLostError("The worker's process ended (signal SIGKILL).")

    given = order(pool, tmp_path)
    monkeypatch.setattr(pool.remote, "run", lost)
    assert fault(pool.client.done(given)) == (POOL_FAULT, "The worker's process ended (signal SIGKILL).")


def test_a_result_that_cannot_be_sent_is_a_fault(pool: Pool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(task: Task, _listener: Listener) -> object:
        return versions() if task.files is None else Outcome({"figure": object()})

    given = order(pool, tmp_path)
    monkeypatch.setattr(pool.remote, "run", run)
    assert fault(pool.client.host.done(given, lambda _: None, threading.Event()))[0] == "unexpected"


def test_progress_is_sent_at_intervals(pool: Pool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(task: Task, listener: Listener) -> object:
        if task.files is None:
            return versions()
        for number in range(10):
            listener.report("read bundle", number / 10, "")
            pool.now_s += REPORT_S / 3.9
        listener.report("decode", 1.0, "")
        return None

    given = order(pool, tmp_path)
    monkeypatch.setattr(pool.remote, "run", run)
    assert pool.client.done(given).fault is None
    assert [each.fraction for each in pool.client.told if each.stage] == [0.0, 0.4, 0.8, 1.0]


def test_a_file_travels_while_the_next_one_is_made(pool: Pool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given, gone, put = order(pool, tmp_path), threading.Event(), pool.store.put_result

    def put_result(job: str, path: Path, check: Callable[[], None]) -> str:
        digest = put(job, path, check)
        gone.set()
        return digest

    def run(task: Task, listener: Listener) -> object:
        if task.files is None:
            return versions()
        result = task.files.folder / RESULT
        result.mkdir()
        (result / "mesh.ply").write_bytes(b"ply")
        listener.file_ready("mesh.ply")
        assert gone.wait(30)
        (result / "report.json").write_bytes(b"{}")
        return Outcome({"triangles": 1})

    monkeypatch.setattr(pool.store, "put_result", put_result)
    monkeypatch.setattr(pool.remote, "run", run)
    answer = pool.client.done(given)
    assert answer.result == Outcome({"triangles": 1})
    assert answer.files == {
        "mesh.ply": hashlib.sha256(b"ply").hexdigest(), "report.json": hashlib.sha256(b"{}").hexdigest()
    }  # fmt: skip
    assert {each["path"] for each in pool.objects.list("results").collect()} == {
        f"results/{JOB}/mesh.ply", f"results/{JOB}/report.json"
    }  # fmt: skip


def test_a_job_that_its_rig_gave_up_is_stopped_in_the_middle(pool: Pool, tmp_path: Path) -> None:
    def tell(_told: Progress) -> None:
        if len(pool.remote.done) == 2:
            pool.store.put_result(JOB, tmp_path / "staged" / "bundle" / "order", lambda: None)
            stop.set()

    stop = threading.Event()
    assert fault(pool.client.host.done(order(pool, tmp_path, "hang"), tell, stop))[0] == "scan-cancelled"
    assert not [each for each in pool.objects.list().collect() if each["path"].startswith("results/")]
    # So is one whose files are still on their way.
    assert fault(pool.client.host.done(order(pool, tmp_path / "left"), tell, stop))[0] == "scan-cancelled"
    assert len(pool.remote.done) == 3


SECRET = "the-secret-of-the-store"  # noqa: S105 - nothing but a test's


@pytest.fixture(autouse=True)
def _credentials(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [each for each in os.environ if each.startswith("AWS_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "somebody")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)


def bundle(folder: Path) -> Path:
    (folder / "frames").mkdir(parents=True)
    (folder / "frames" / "0.png").write_bytes(b"0123456789abcdef" * (CHUNK_BYTES // 10))
    (folder / "bundle.json").write_text("{}")
    return folder


def test_the_same_bundle_has_the_same_key_and_comes_back(tmp_path: Path) -> None:
    store = open_store((tmp_path / "shared").as_uri())
    first, second = bundle(tmp_path / "one"), bundle(tmp_path / "two")
    os.utime(second / "bundle.json", (1, 1))
    key = store.put_bundle(first, lambda: None)
    assert store.put_bundle(second, lambda: None) == key
    store.fetch_bundle(key, tmp_path / "back", lambda: None)
    for name in ("bundle.json", "frames/0.png"):
        assert (tmp_path / "back" / name).read_bytes() == (first / name).read_bytes()
    (second / "bundle.json").write_text("[]")
    assert store.put_bundle(second, lambda: None) != key


def test_a_transfer_that_is_to_end_leaves_nothing(tmp_path: Path) -> None:
    objects, checked = MemoryStore(), 0

    def check() -> None:
        nonlocal checked
        checked += 1
        if checked == 4:
            raise PoolError("it took too long")

    with pytest.raises(PoolError, match="too long"):
        PoolStore("memory://", objects).put_bundle(bundle(tmp_path / "bundle"), check)
    assert objects.list().collect() == []
    assert [path.name for path in tmp_path.iterdir()] == ["bundle"]


def test_a_store_that_is_tidied_holds_nothing_and_may_be_tidied_again(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    store = open_store(shared.as_uri())
    key = store.put_bundle(bundle(tmp_path / "bundle"), lambda: None)
    store.put_result("job", tmp_path / "bundle" / "frames" / "0.png", lambda: None)
    for _ in range(2):
        store.clear(bundle=key, job="job")
        assert list(shared.iterdir()) == []


def test_a_slow_line_carries_one_part_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def put(*_args: object, max_concurrency: int = 12, **_options: object) -> None:
        asked.append(max_concurrency)

    monkeypatch.setattr(obstore, "put", put)
    store = PoolStore("memory://", MemoryStore())
    store.put_bundle(bundle(tmp_path / "bundle"), lambda: None)
    store.put_result("job", tmp_path / "bundle" / "frames" / "0.png", lambda: None)
    assert asked == [1, 1]


def test_a_store_that_is_gone_is_named_and_nothing_else(tmp_path: Path) -> None:
    with pytest.raises(PoolError) as caught:
        open_store("s3://scans/hall").put_bundle(bundle(tmp_path / "bundle"), lambda: None)
    assert str(caught.value).startswith("the store s3://scans/hall failed (")
    assert caught.value.__cause__ is None
    assert SECRET not in str(caught.value)


@pytest.mark.parametrize(
    "address",
    ["https://scans/hall", "s3://", "s3://me:secret@scans/hall", "file://host/scans", "s3://scans?key=secret"],
)
def test_an_address_that_is_none_is_refused_without_being_repeated(address: str) -> None:
    with pytest.raises(ConfigError, match="expected s3://BUCKET/PREFIX") as caught:
        open_store(address)
    assert "secret" not in str(caught.value)


def test_store_that_cannot_be_used_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"file/shared: the pool's store cannot be opened \(OSError\)"):
        open_store((tmp_path / "file" / "shared").as_uri())
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://store.plant.example:9000")
    with pytest.raises(ConfigError, match="unencrypted"):
        open_store("s3://scans/hall")


def test_credentials_come_from_the_environment_or_from_a_file_of_ones_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    with pytest.raises(ConfigError, match="no credentials"):
        open_store("s3://scans/hall")
    login = tmp_path / "login"
    login.write_text(f"somebody:{SECRET}\n")
    login.chmod(0o640)
    with pytest.raises(ConfigError, match="chmod 600") as caught:
        open_store("s3://scans/hall", login)
    assert SECRET not in str(caught.value)
    login.chmod(0o600)
    assert open_store("s3://scans/hall", login).address == "s3://scans/hall"
    login.write_text(SECRET)
    with pytest.raises(ConfigError, match="does not hold KEY ID:SECRET") as caught:
        open_store("s3://scans/hall", login)
    assert SECRET not in str(caught.value)
