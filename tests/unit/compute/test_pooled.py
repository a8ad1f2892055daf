"""A pool: its members, its machines and its store; and bundles reconstructed by it, or here if the pool fails."""

from __future__ import annotations

import asyncio
import gc
import hashlib
import os
import re
import signal
import socket
import ssl
import tempfile
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("obstore", reason="needs a pool's libraries: pip install 'slrig[pool]'")
pytest.importorskip("distributed", reason="needs a pool's libraries: pip install 'slrig[pool]'")
pytest.importorskip("cryptography", reason="needs a pool's libraries: pip install 'slrig[pool]'")

import obstore
from distributed import Scheduler, Status
from distributed.diskutils import DIR_LOCK_EXT
from obstore.store import MemoryStore

from slrig.compute.certificates import AUTHORITY_KEY, make_certificates
from slrig.compute.host import (
    BEAT_S,
    CHUNK_BYTES,
    KEPT_EVENTS,
    POOL_FAULT,
    TELL_S,
    Host,
    PoolError,
    PoolRequest,
    PoolResponse,
    PoolStore,
    _scratch,
    open_store,
    resource,
    serve_scheduler,
)
from slrig.compute.pooled import (
    BEGIN_LIMIT_S,
    SILENCE_LIMIT_S,
    TRANSFER_LIMIT_S,
    DaskCluster,
    NewsCallback,
    PooledWorker,
)
from slrig.compute.security import KEY, pool_security
from slrig.errors import (
    ConfigError,
    NothingToReconstructError,
    ScanCancelledError,
    ScanInterruptedError,
    ServiceError,
    StorageError,
    WorkerLostError,
)
from slrig.jobs.data_folder import RESULT
from slrig.jobs.database import versions
from slrig.jobs.job import FrameFeed, JobRun
from slrig.jobs.worker import READY, Task
from slrig.model import Region
from tests.listening import listening_at
from tests.unit.command import slrig
from tests.unit.scan import fake_pipeline
from tests.unit.scan.fakes import reconstruction


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
        *,
        progress: Callable[[str, float, str], None] = lambda *_: None,
        cancelled: Callable[[], bool] = lambda: False,
        made: Callable[[str], None] = lambda _: None,
        feed: FrameFeed | None = None,  # noqa: ARG002
        within_s: float | None = None,  # noqa: ARG002
    ) -> Any:
        if self.closed:
            raise ScanInterruptedError("closed")
        self.done.append(task)
        files = task.files
        if files is None:
            return task.function(*task.given)
        run = JobRun(files.id, files.folder, files.place, progress, cancelled, made, pipeline=fake_pipeline)
        return task.function(run)


class TameOrder(Future[PoolResponse]):
    """An order: `act` is asked for its answer."""

    def __init__(
        self, act: Callable[[PoolRequest], PoolResponse | None], order: PoolRequest, told: NewsCallback
    ) -> None:
        super().__init__()
        self._act = act
        self.order = order
        self.told = told

    def result(self, timeout: float | None = None) -> PoolResponse:  # noqa: ARG002
        if (answer := self._act(self.order)) is None:
            raise TimeoutError
        return answer


class TameCluster:
    """`Cluster`. acts : what becomes of the orders, one after another; without any, a machine does them."""

    topic, fault = "rig", "the pool does not answer"

    def __init__(self, host: Host) -> None:
        self.host = host
        self.there = True
        self.acts: list[Callable[[PoolRequest], PoolResponse | None]] = []
        self.orders: list[TameOrder] = []
        self.told: list[Mapping[str, Any]] = []

    def start(self) -> None:
        """Nothing to be done."""

    def close(self) -> None:
        """Nothing to be done."""

    def usable(self, timeout_s: float = 0.0) -> bool:  # noqa: ARG002
        return self.there

    def submit(self, order: PoolRequest, told: NewsCallback) -> TameOrder:
        act = self.acts.pop(0) if self.acts else lambda each: self.host.done(each, self.told.append)
        self.orders.append(TameOrder(act, order, told))
        return self.orders[-1]


class Pool:
    """A rig, a machine of a pool, and the store between them, whose objects are `objects`."""

    def __init__(self) -> None:
        self.objects = MemoryStore()
        self.store = PoolStore("memory://", self.objects)
        self.now_s = 0.0
        self.local, self.remote = TameWorker(), TameWorker()
        self.cluster = TameCluster(Host(self.store, self.remote, clock=lambda: self.now_s))
        self.worker = PooledWorker(self.local, self.cluster, self.store, clock=lambda: self.now_s)

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


ADDRESS = "tls://pool:8786"


def context(folder: Path, part: str) -> ssl.SSLContext:
    security: Any = pool_security(ADDRESS, folder)
    found: ssl.SSLContext = getattr(security, f"get_{part}_args")(
        *(["client"] if part == "connection" else ["scheduler"])
    )["ssl_context"]
    return found


def greet(client: ssl.SSLContext, server: ssl.SSLContext) -> None:
    """Let two shake hands, without a network. Raises ssl.SSLError: one of them refuses."""
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [client.wrap_bio(back, there), server.wrap_bio(there, back, server_side=True)]
    for _ in range(4):
        for end in ends:
            try:
                end.do_handshake()
            except ssl.SSLWantReadError:
                continue
    ends[0].write(b"hello")
    assert ends[1].read() == b"hello"


def test_members_of_one_pool_accept_one_another_and_no_others(tmp_path: Path) -> None:
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    made = slrig("pool", "certificates", ours)
    assert made.output.split() == [str(ours / name) for name in ("scheduler", "worker", "rig")]
    assert make_certificates(ours, ("rig", "rig-7")) == [ours / "rig-7"]
    make_certificates(theirs, ("rig",))
    server = context(ours / "scheduler", "listen")
    greet(context(ours / "rig", "connection"), server)
    greet(context(ours / "rig-7", "connection"), server)
    with pytest.raises(ssl.SSLError):
        greet(context(theirs / "rig", "connection"), server)
    with pytest.raises(ssl.SSLError):
        greet(context(ours / "rig", "connection"), context(theirs / "rig", "listen"))
    anonymous = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    anonymous.check_hostname, anonymous.verify_mode = False, ssl.CERT_NONE
    with pytest.raises(ssl.SSLError):
        greet(anonymous, server)
    keys = [*ours.glob(f"*/{KEY}"), ours / AUTHORITY_KEY]
    assert len(keys) == 5
    assert {oct(path.stat().st_mode & 0o777) for path in keys} == {"0o600"}
    assert {oct(path.parent.stat().st_mode & 0o777) for path in keys} == {"0o700"}


def test_certificates_are_needed_beyond_this_machine_and_their_key_is_private(tmp_path: Path) -> None:
    assert pool_security("tcp://127.0.0.1:8786", None) is None
    with pytest.raises(ConfigError, match=r"lacks authority\.pem, certificate\.pem, key\.pem"):
        pool_security(ADDRESS, tmp_path)
    (place,) = make_certificates(tmp_path, ("worker",))
    (place / KEY).chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        pool_security(ADDRESS, place)


@pytest.mark.parametrize(
    ("address", "why"),
    [
        ("tcp://pool:8786", "any code"),
        ("tcp://0.0.0.0:8786", "any code"),
        ("pool:8786", "no address"),
        ("tls://pool", "no address"),
        ("tls://pool:port", "no address"),
        (ADDRESS, "found none"),
    ],
)
def test_an_address_that_is_not_safe_is_refused(address: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        pool_security(address, None)


def test_certificates_are_made_in_folders_that_can_be_for_names_of_machines(tmp_path: Path) -> None:
    for name in ("../rig", "r" * 65):
        with pytest.raises(ConfigError, match=r"no name for a machine.*64"):
            make_certificates(tmp_path, (name,))
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "certificates"):
        with pytest.raises(StorageError, match="choose another folder"):
            make_certificates(folder, ("rig",))


def test_a_service_with_a_pool_needs_a_store(tmp_path: Path) -> None:
    for options in (["--compute", "tcp://127.0.0.1:1"], ["--store", "s3://scans"]):
        rig = Path(__file__).parents[3] / "config" / "rigs" / "demo.toml"
        told = slrig("serve", rig, "--data", tmp_path / "data", "--port", "0", *options)
        assert (told.exit_code, "needs a store as well" in told.stderr) == (2, True), told.output
    told = slrig("worker", "--scheduler", "tcp://127.0.0.1:1")
    assert (told.exit_code, "--store" in told.stderr) == (2, True)


def test_scheduler_listens_at_its_address_alone_and_keeps_few_events() -> None:
    found: set[str] = set()
    kept: set[int] = set()

    def say(_words: str) -> None:
        found.update(listening_at())
        (scheduler,) = (each for each in Scheduler._instances if each.status is Status.running)
        for number in range(2 * KEPT_EVENTS):
            scheduler.log_event("a rig", number)
        kept.add(len(scheduler.get_events("a rig")))
        signal.raise_signal(signal.SIGTERM)

    before = listening_at()
    serve_scheduler("tcp://127.0.0.1:0", None, say=say)
    assert kept == {KEPT_EVENTS}
    assert len(found - before) == 2
    assert {address.rpartition(":")[0] for address in found - before} == {"127.0.0.1"}


# dask leaves what it could not bind to Python's collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
def test_address_in_use_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        address = f"tcp://127.0.0.1:{holder.getsockname()[1]}"
        with pytest.raises(ServiceError, match=f"cannot listen at {address}: .*in use"):
            serve_scheduler(address, None, say=print)
    gc.collect()


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    found = tmp_path / f"slrig-workers-{os.getuid()}"
    found.mkdir()
    return found


def test_what_a_killed_worker_left_is_removed_by_the_next_one(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # dask's file is locked as long as the worker lives.
    (place / "worker-killed" / "bundle").mkdir(parents=True)
    (place / f"worker-killed{DIR_LOCK_EXT}").touch()
    with _scratch():
        bundle = Path(tempfile.mkdtemp(), "bundle")
        bundle.mkdir()
        assert [*place.rglob("bundle")] == [bundle]
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
        with _scratch():
            assert bundle.is_dir()
    assert {path.name for path in place.iterdir()} == {"global.lock", "purge.lock"}


def test_workers_use_no_folder_of_another_user(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "lstat", lambda _: os.stat_result((0o40777, 0, 0, 1, os.getuid() + 1, *[0] * 5)))
    with pytest.raises(ConfigError, match=f"{place.name} belongs to somebody else"), _scratch():
        pass


FILES = {"mesh.ply", "mesh.glb", "points.ply", "preview.png", "report.json"}


@pytest.fixture
def pool() -> Pool:
    return Pool()


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / "staged" / "result").glob("*")}


def test_the_pool_gives_what_this_machine_gives(pool: Pool, tmp_path: Path) -> None:
    made: list[str] = []
    found = pool.worker.run(job(tmp_path / "pooled"), made=made.append)
    pool.local.run(job(tmp_path / "local"))
    pooled, local = files(tmp_path / "pooled"), files(tmp_path / "local")
    # The tame report names the folder.
    assert {**pooled, "report.json": b""} == {**local, "report.json": b""}
    assert set(made) == files(tmp_path / "pooled").keys() == FILES
    assert found.summary["seconds"] == 1.5
    assert pool.remote.done[-1].where == {"where": "pool"}
    assert [told["stage"] for told in pool.cluster.told if "stage" in told] == ["decode", "done"]
    assert pool.cluster.orders[0].cancelled()
    assert pool.tidied() == set()


def gone(pool: Pool) -> None:
    pool.cluster.there = False


def never_begins(pool: Pool) -> None:
    pool.cluster.acts = [pool.passes(BEGIN_LIMIT_S + 1)]


def falls_silent(pool: Pool) -> None:
    def tells_once(order: PoolRequest) -> None:
        begun = pool.now_s > 0
        pool.now_s += SILENCE_LIMIT_S + 1 if begun else 1
        if not begun:
            pool.cluster.orders[-1].told({"job": order.job})

    pool.cluster.acts = [tells_once]
    pool.cluster.usable = lambda timeout_s=0.0: timeout_s == 0.0  # type: ignore[method-assign]


def is_lost_twice(pool: Pool) -> None:
    pool.cluster.acts = [lost, lost]


def is_lost_for_good(pool: Pool) -> None:
    def act(_order: PoolRequest) -> PoolResponse:
        pool.cluster.there = False
        raise PoolError("the pool lost the job")

    pool.cluster.acts = [act]


def answers_wrong_bytes(pool: Pool) -> None:
    def act(order: PoolRequest) -> PoolResponse:
        answer = pool.cluster.host.done(order, lambda _: None)
        obstore.put(pool.objects, f"results/{order.job}/points.ply", b"other bytes")
        return answer

    pool.cluster.acts = [act] * 2


def names_a_file_elsewhere(pool: Pool) -> None:
    pool.cluster.acts = [lambda _: PoolResponse({}, {"../../record.json": "0" * 64})] * 2


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
        (falls_silent, 1, "nothing more was heard"),
        (is_lost_twice, 2, "lost the job"),
        (is_lost_for_good, 1, "lost the job"),
        (answers_wrong_bytes, 2, "not what was put there"),
        (names_a_file_elsewhere, 2, "no name of a file"),
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
    assert len(pool.cluster.orders) == orders
    assert {path for path in pool.tidied() if not path.startswith("stops/")} == set()


def test_a_job_that_was_lost_is_given_to_the_pool_again(pool: Pool, tmp_path: Path) -> None:
    pool.cluster.acts = [lost]
    assert pool.worker.run(job(tmp_path)).summary["seconds"] == 1.5
    assert (len(pool.cluster.orders), len(pool.remote.done), pool.local.done) == (2, 2, [])
    assert pool.tidied() == {f"stops/{pool.cluster.orders[0].order.job}"}


def test_what_fails_by_itself_fails_here_in_its_own_words(pool: Pool, tmp_path: Path) -> None:
    with pytest.raises(NothingToReconstructError, match="No stripe"):
        pool.worker.run(job(tmp_path, "fail"))
    assert len(pool.cluster.orders) == 1


def test_a_job_that_is_cancelled_is_stopped_where_it_is_computed(pool: Pool, tmp_path: Path) -> None:
    pool.cluster.acts = [pool.passes(0.1)]
    with pytest.raises(ScanCancelledError, match="reconstruction was cancelled"):
        pool.worker.run(job(tmp_path), cancelled=lambda: pool.now_s > 1)
    (pending,) = pool.cluster.orders
    assert pending.cancelled()
    assert pool.tidied() == {f"stops/{pending.order.job}"}
    assert (pool.local.done, files(tmp_path)) == ([], {})


def test_frames_that_were_taken_here_are_computed_here(pool: Pool, tmp_path: Path) -> None:
    assert pool.worker.feed().receiver is None
    gone(pool)
    feed = pool.worker.feed()
    assert pool.local.feeds == [feed]
    pool.cluster.there = True
    pool.worker.run(job(tmp_path), feed=feed)
    assert pool.cluster.orders == []
    assert pool.local.done[0].where == {"where": "local", "because": "the pool does not answer when the frames came"}


def test_workers_of_other_versions_are_not_used_nor_those_of_a_pool_for_other_tasks(pool: Pool) -> None:
    assert pool.worker.run(Task(fake_pipeline.process_id, what="examination")) > 0
    assert len(pool.local.done) == 1
    cluster = DaskCluster("tcp://127.0.0.1:1", None)
    mine, newer = ({"resources": {resource(found): 1}} for found in (versions(), {**versions(), "code": "0"}))
    assert "no workers" in str(cluster._lack([]))
    assert "this machine's versions" in str(cluster._lack([newer]))
    assert cluster._lack([newer, mine]) is None


def test_workers_abilities_are_queried_when_they_change(monkeypatch: pytest.MonkeyPatch) -> None:
    members = {"one": {"resources": {resource(versions()): 1}}}
    asked: list[int] = []

    class Scheduler:
        async def identity(self, n_workers: int) -> dict[str, object]:
            asked.append(n_workers)
            if len(asked) == 10:
                members.clear()
            if len(asked) == 20:
                raise OSError("gone")
            return {"n_workers": len(members), "workers": members if n_workers else {}}

    monkeypatch.setattr("slrig.compute.pooled.LOOK_S", 0.0)
    cluster = DaskCluster("tcp://127.0.0.1:1", None)
    with pytest.raises(OSError, match="gone"):
        asyncio.run(cluster._watch(SimpleNamespace(scheduler=Scheduler())))  # type: ignore[arg-type]
    assert asked == [0, -1, *[0] * 8, -1, *[0] * 9]
    assert not cluster.usable()


def test_a_service_that_ends_interrupts_what_is_in_the_pool(pool: Pool, tmp_path: Path) -> None:
    pool.cluster.acts = [lambda _: pool.worker.close()]
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


def order(pool: Pool, folder: Path, what: str = "finish") -> PoolRequest:
    task = job(folder, what)
    key = pool.store.put_bundle(folder / "staged" / "bundle", lambda: None)
    return PoolRequest("job", key, task, "rig", versions())


def fault(answer: PoolResponse) -> tuple[str, str]:
    assert answer.fault is not None
    assert (answer.result, dict(answer.files)) == (None, {})
    return answer.fault.code, answer.fault.message


def test_a_machine_answers_what_went_wrong(pool: Pool, tmp_path: Path) -> None:
    answer = pool.cluster.host.done
    given = order(pool, tmp_path / "one")
    newer = replace(given, versions={**versions(), "numba": "0"})
    code, message = fault(answer(newer, lambda _: None))
    assert (code, "have changed" in message) == (POOL_FAULT, True)
    assert [task.what for task in pool.remote.done] == ["statement of versions"]
    obstore.put(pool.objects, f"bundles/{given.bundle}.tar", b"another bundle")
    assert "not what was put there" in fault(answer(given, lambda _: None))[1]
    for what, code in (("fail", "nothing-to-reconstruct"), ("break", "unexpected")):
        assert fault(answer(order(pool, tmp_path / what, what), lambda _: None))[0] == code


def test_a_machine_that_loses_its_process_leaves_the_job_to_another_try(
    pool: Pool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(*_given: object, **_options: object) -> None:
        raise WorkerLostError("The worker's process ended (signal SIGKILL).")

    given = order(pool, tmp_path)
    monkeypatch.setattr(pool.remote, "run", lost)
    assert fault(pool.cluster.host.done(given, lambda _: None)) == (
        POOL_FAULT,
        "The worker's process ended (signal SIGKILL).",
    )


def test_progress_is_sent_at_intervals(pool: Pool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given, heard = order(pool, tmp_path), list[Mapping[str, Any]]()

    def run(task: Task, *, progress: Callable[[str, float, str], None] = lambda *_: None, **_: object) -> object:
        if not task.movable:
            return versions()
        for number in range(10):
            progress("read bundle", number / 10, "")
            pool.now_s += TELL_S / 3.9
        progress("decode", 1.0, "")
        return None

    monkeypatch.setattr(pool.remote, "run", run)
    assert pool.cluster.host.done(given, heard.append).fault is None
    assert [each["fraction"] for each in heard if "stage" in each] == [0.0, 0.4, 0.8, 1.0]


def test_a_file_travels_while_the_next_one_is_made(pool: Pool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given, gone, put = order(pool, tmp_path), threading.Event(), pool.store.put_result

    def put_result(job: str, path: Path, check: Callable[[], None]) -> str:
        digest = put(job, path, check)
        gone.set()
        return digest

    def run(task: Task, *, made: Callable[[str], None] = lambda _: None, **_: object) -> object:
        if not task.movable:
            return versions()
        assert task.files is not None
        result = task.files.folder / RESULT
        result.mkdir()
        (result / "mesh.ply").write_bytes(b"ply")
        made("mesh.ply")
        assert gone.wait(30)
        (result / "report.json").write_bytes(b"{}")
        return "the report"

    monkeypatch.setattr(pool.store, "put_result", put_result)
    monkeypatch.setattr(pool.remote, "run", run)
    answer = pool.cluster.host.done(given, lambda _: None)
    assert answer.result == "the report"
    assert dict(answer.files) == {
        "mesh.ply": hashlib.sha256(b"ply").hexdigest(), "report.json": hashlib.sha256(b"{}").hexdigest()
    }  # fmt: skip
    assert {each["path"] for each in pool.objects.list("results").collect()} == {
        "results/job/mesh.ply", "results/job/report.json"
    }  # fmt: skip


def test_a_job_that_its_rig_gave_up_is_stopped_in_the_middle(pool: Pool, tmp_path: Path) -> None:
    heard: list[Mapping[str, Any]] = []

    def told(each: Mapping[str, Any]) -> None:
        pool.now_s += BEAT_S
        heard.append(each)
        if len(heard) == 4:
            pool.store.stop("job")

    code, _ = fault(pool.cluster.host.done(order(pool, tmp_path, "hang"), told))
    assert code == "scan-cancelled"
    assert {"job": "job"} in heard[1:]
    assert not [each for each in pool.objects.list().collect() if each["path"].startswith("results/")]
    # So is one whose machine leaves the pool.
    leave: Any = pool.cluster.host.teardown
    left = order(pool, tmp_path / "left", "hang")
    assert fault(pool.cluster.host.done(left, lambda _: leave(None)))[0] == "scan-cancelled"


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
