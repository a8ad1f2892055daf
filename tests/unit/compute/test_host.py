"""A machine of a pool: what it refuses, and when it stops."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("obstore", reason="needs a pool's libraries: pip install 'slrig[pool]'")
pytest.importorskip("distributed", reason="needs a pool's libraries: pip install 'slrig[pool]'")

import obstore

from slrig.compute.host import BEAT_S, POOL_FAULT, TELL_S, Answer, Order
from slrig.errors import WorkerLostError
from slrig.jobs.versions import versions
from slrig.jobs.worker_process import Task
from tests.unit.compute.tame_pool import Pool, job


@pytest.fixture
def pool() -> Pool:
    return Pool()


def order(pool: Pool, folder: Path, what: str = "finish") -> Order:
    task = job(folder, what)
    key = pool.store.put_bundle(task.given[0], lambda: None)
    return Order("job", key, replace(task, given=task.given[2:]), "rig", versions())


def fault(answer: Answer) -> tuple[str, str]:
    assert answer.fault is not None
    assert (answer.result, dict(answer.files)) == (None, {})
    return answer.fault.code, answer.fault.message


def test_a_machine_of_other_versions_computes_nothing(pool: Pool, tmp_path: Path) -> None:
    newer = replace(order(pool, tmp_path), versions={**versions(), "numba": "0"})
    code, message = fault(pool.cluster.host.done(newer, lambda _: None))
    assert (code, "have changed" in message) == (POOL_FAULT, True)
    assert [task.what for task in pool.remote.done] == ["statement of versions"]


def test_a_bundle_that_was_changed_in_the_store_is_not_computed(pool: Pool, tmp_path: Path) -> None:
    given = order(pool, tmp_path)
    obstore.put(pool.objects, f"bundles/{given.bundle}.tar", b"another bundle")
    assert "not what was put there" in fault(pool.cluster.host.done(given, lambda _: None))[1]


@pytest.mark.parametrize(("what", "code"), [("fail", "nothing-to-reconstruct"), ("break", "unexpected")])
def test_whatever_goes_wrong_is_answered(pool: Pool, tmp_path: Path, what: str, code: str) -> None:
    assert fault(pool.cluster.host.done(order(pool, tmp_path, what), lambda _: None))[0] == code


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


def test_a_stage_is_told_now_and_then(pool: Pool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given, heard = order(pool, tmp_path), list[Mapping[str, Any]]()

    def run(task: Task, *, progress: Callable[[str, float, str], None] = lambda *_: None, **_: object) -> object:
        if not task.movable:
            return versions()
        for number in range(10):
            progress("read bundle", number / 10, "")
            pool.clock.now_s += TELL_S / 3.9
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
        (task.given[1] / "mesh.ply").write_bytes(b"ply")
        made("mesh.ply")
        assert gone.wait(30)
        (task.given[1] / "report.json").write_bytes(b"{}")
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
        pool.clock.now_s += BEAT_S
        heard.append(each)
        if len(heard) == 4:
            pool.store.stop("job")

    code, _ = fault(pool.cluster.host.done(order(pool, tmp_path, "hang"), told))
    assert code == "scan-cancelled"
    assert {"job": "job"} in heard[1:]
    assert not [each for each in pool.objects.list().collect() if each["path"].startswith("results/")]


def test_a_job_ends_when_its_machine_leaves_the_pool(pool: Pool, tmp_path: Path) -> None:
    leave: Any = pool.cluster.host.teardown
    code, _ = fault(pool.cluster.host.done(order(pool, tmp_path, "hang"), lambda _: leave(None)))
    assert code == "scan-cancelled"
