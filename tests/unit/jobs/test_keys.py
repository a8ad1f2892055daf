"""Idempotency keys, tied to what their first request made."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import pytest

from slrig.errors import IdempotencyError, KeyInFlightError
from slrig.jobs.database import Database
from slrig.jobs.keys import RequestKeys
from slrig.jobs.records import JobKind
from slrig.jobs.store import JobStore
from tests.unit.scan.fakes import SetClock


@pytest.fixture
def clock() -> SetClock:
    return SetClock()


@pytest.fixture
def store(tmp_path: Path) -> Iterator[JobStore]:
    store = JobStore(Database(tmp_path / "slrig.sqlite"), JobKind.SCAN)
    yield store
    store.database.close()


@pytest.fixture
def keys(store: JobStore, clock: SetClock) -> RequestKeys:
    return RequestKeys(store.database, clock=clock)


def test_idempotency_key_leads_back_to_its_scan(store: JobStore, keys: RequestKeys) -> None:
    assert keys.reserve("k", "body") is None
    with pytest.raises(KeyInFlightError):
        keys.reserve("k", "body")
    scan = store.create({}, rig="bench", label=None, key="k")
    assert keys.reserve("k", "body") == scan.id
    with pytest.raises(IdempotencyError, match="another request body"):
        keys.reserve("k", "other body")


def test_key_of_a_refused_request_is_free_again(keys: RequestKeys) -> None:
    keys.reserve("k", "body")
    keys.release("k")
    assert keys.reserve("k", "other body") is None


def test_key_of_a_scan_is_not_released(store: JobStore, keys: RequestKeys) -> None:
    keys.reserve("k", "body")
    scan = store.create({}, rig="bench", label=None, key="k")
    keys.release("k")
    keys.release_all()
    assert keys.reserve("k", "body") == scan.id


def test_key_is_forgotten_after_a_day(store: JobStore, keys: RequestKeys, clock: SetClock) -> None:
    keys.reserve("k", "body")
    store.create({}, rig="bench", label=None, key="k")
    clock.move(hours=23, minutes=59)
    with pytest.raises(IdempotencyError):
        keys.reserve("k", "other body")
    clock.move(minutes=2)
    assert keys.reserve("k", "other body") is None


def test_key_leads_back_to_what_is_no_job(keys: RequestKeys) -> None:
    keys.reserve("k", "body")
    keys.tie("k", made := uuid4())
    keys.release("k")
    assert keys.reserve("k", "body") == made
