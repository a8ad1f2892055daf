"""Shares: nobody takes from all others what requests share, and what is made for one is made for all who ask for it."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, asynccontextmanager
from types import SimpleNamespace
from typing import Any

import pytest
from fastapi.testclient import TestClient
from starlette.exceptions import HTTPException

from slrig.api import files
from slrig.api.auth import KeyRing
from slrig.api.scopes import KeyScope
from slrig.api.service import turn
from slrig.api.shares import Makings, Shares
from slrig.errors import QueueFullError
from slrig.jobs.records import ANYONE, acting_as, require_share
from tests.unit.api.conftest import ServedBench, client_of, ended, refusal
from tests.unit.looped import on_loop
from tests.unit.scan.fakes import WAIT_S


def taken(shares: Shares, held: ExitStack, name: str) -> int:
    """How many places a name gets that takes all that it can."""
    count = 0
    with acting_as(name):
        try:
            while True:
                held.enter_context(shares.take())
                count += 1
        except HTTPException:
            return count


@pytest.mark.parametrize(
    ("total", "names", "counts"),
    [
        (48, ["ann"], [24]),
        (48, ["ann", "bob", "eve"], [24, 12, 6]),
        (8, list("abcde"), [4, 2, 1, 1, 0]),
        (1, ["ann", "bob"], [1, 0]),
        # Where nobody has a key all are one.
        (8, [ANYONE], [8]),
    ],
)
def test_greedy_keys_leave_room_for_the_next(total: int, names: list[str], counts: list[int]) -> None:
    shares = Shares("places", total, "Wait.")
    with ExitStack() as held:
        assert [taken(shares, held, name) for name in names] == counts
        assert shares.taken.total() == sum(counts)
    assert not shares.taken


def test_refusal_says_what_is_taken_by_whom_and_what_to_do() -> None:
    shares = Shares("streams", 4, "Close one.", status=503, retry_s=7)
    with ExitStack() as held, acting_as("bob"):
        held.enter_context(shares.take())
        taken(shares, held, "ann")
        with acting_as("ann"), pytest.raises(HTTPException) as refused:
            held.enter_context(shares.take())
    assert (refused.value.status_code, refused.value.headers) == (503, {"Retry-After": "7"})
    assert "ann has 2 of 4 streams, others have 1" in refused.value.detail
    assert refused.value.detail.endswith("Close one.")


def test_place_is_given_back_where_the_work_fails() -> None:
    shares = Shares("places", 2, "Wait.")
    with acting_as("ann"), pytest.raises(ZeroDivisionError), shares.take():
        raise ZeroDivisionError
    assert not shares.taken


def test_line_of_jobs_has_a_share_for_each() -> None:
    with acting_as("ann"):
        require_share("in the line", 4, ["ann"])
        with pytest.raises(QueueFullError, match=r"2 of 4 places in the line are taken, 2 of them by you"):
            require_share("in the line", 4, ["ann"] * 2)
    with acting_as("bob"):
        require_share("in the line", 4, ["ann"] * 2)


@on_loop
async def test_turns_of_one_key_hold_nobody_else() -> None:
    shares, order, gate = Shares("places", 9, "Wait."), list[str](), asyncio.Event()

    async def work(name: str, number: int) -> None:
        with acting_as(name):
            async with shares.turn():
                order.append(f"{name} {number}")
                await gate.wait()

    waiting = [asyncio.ensure_future(work(name, number)) for name in ("ann", "bob") for number in range(2)]
    for _ in range(9):
        await asyncio.sleep(0)
    assert order == ["ann 0", "bob 0"]
    waiting[1].cancel()
    gate.set()
    await asyncio.wait(waiting)
    assert (order, shares.taken) == (["ann 0", "bob 0", "bob 1"], {})


@on_loop
async def test_what_many_ask_for_is_made_once_and_a_failure_is_not_kept() -> None:
    makings, gate, made = Makings(Shares("places", 1, "Ask again.")), threading.Event(), list[int]()

    def make() -> int:
        gate.wait(WAIT_S)
        made.append(len(made))
        if len(made) == 1:
            raise ZeroDivisionError
        return len(made)

    asked = [asyncio.ensure_future(makings.of("mesh", make)) for _ in range(3)]
    while not makings.shares.taken:
        await asyncio.to_thread(int)
    with pytest.raises(HTTPException, match="Ask again"):
        await makings.of("another", make)
    # One who goes away ends it for nobody else.
    asked[0].cancel()
    gate.set()
    found = await asyncio.gather(*asked, return_exceptions=True)
    assert [type(each) for each in found] == [asyncio.CancelledError, ZeroDivisionError, ZeroDivisionError]
    while "mesh" in makings._makings:
        await asyncio.to_thread(int)
    assert (await makings.of("mesh", make, fresh_s=60.0), await makings.of("mesh", make)) == (2, 2)
    assert not makings.shares.taken


@pytest.fixture
def keys(served: ServedBench) -> Iterator[Callable[..., TestClient]]:
    """Gives a client by a key of its own."""
    path = served.service.settings.key_path
    ring = KeyRing(path)
    yield lambda name, *scopes: client_of(served, key=ring.add(name, scopes))
    path.unlink(missing_ok=True)


class SlowConversions:
    """Conversions that end when `gate` is set. began : how many have begun."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.gate, self.began = threading.Event(), threading.Semaphore(0)
        self._real = files._convert
        monkeypatch.setattr(files, "_convert", self._convert)

    def _convert(self, *given: Any) -> Any:
        self.began.release()
        assert self.gate.wait(WAIT_S)
        return self._real(*given)


@pytest.mark.slow
def test_a_key_whose_conversions_hang_holds_up_nothing_else(
    client: TestClient, served: ServedBench, keys: Callable[..., TestClient], monkeypatch: pytest.MonkeyPatch
) -> None:
    places = [ended(client, client.post("/scan").json()["id"])["links"]["files"] for _ in range(2)]
    slow = SlowConversions(monkeypatch)
    names = ("mesh.stl", "mesh.obj", "mesh.3mf", "view.glb", "coarse.glb")
    look = keys("Look")
    # By the client's loop, which is the one of a service.
    headers = dict(look.headers)

    def asked(path: str) -> int:
        return client.get(path, headers=headers).status_code

    with ThreadPoolExecutor(12) as pool:
        try:
            hers = [pool.submit(asked, places[0][name]) for name in names[:4]]
            same = [pool.submit(asked, places[0][names[0]]) for _ in range(2)]
            assert slow.began.acquire(timeout=WAIT_S)
            makings, requests = served.service.makings.shares.taken, served.service.requests.taken
            while makings["Look"] < 4 or requests["Look"] < 6:
                threading.Event().wait(0.001)
            # One of hers is made, the others wait; a further one is refused at once.
            assert client.get(places[0][names[4]], headers=headers).json()["type"] == "/problems/service-unavailable"
            assert not slow.began.acquire(blocking=False)
            mine = pool.submit(client.get, places[1]["mesh.stl"])
            assert slow.began.acquire(timeout=WAIT_S), "somebody else's conversion waits for hers"
            assert [client.get(path).status_code for path in ("/livez", "/readyz")] == [200, 200]
            scan = served.held(client)
            assert client.post(scan["links"]["cancel"]).status_code == 202
        finally:
            slow.gate.set()
        assert [each.result(WAIT_S) for each in (*hers, *same)] == [200] * 6
        assert mine.result(WAIT_S).status_code == 200
    assert not served.service.makings.shares.taken


@on_loop
async def test_cancel_and_what_needs_no_key_need_no_turn() -> None:
    state = SimpleNamespace(service=SimpleNamespace(requests=Shares("places", 1, "Wait.")))

    async def answered(path: str, caller: str | None) -> int:
        request: Any = SimpleNamespace(
            app=SimpleNamespace(state=state), state=SimpleNamespace(caller=caller), url=SimpleNamespace(path=path)
        )
        try:
            async with asynccontextmanager(turn)(request):
                return 200
        except HTTPException as refused:
            return refused.status_code

    with acting_as("ann"), state.service.requests.take():
        assert await answered("/scan", "ann") == 429
        assert [await answered("/scan/1/cancel", "ann"), await answered("/livez", None)] == [200, 200]


def test_scans_of_one_key_leave_a_place_in_the_line(
    client: TestClient, served: ServedBench, keys: Callable[..., TestClient], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(served.service.manager, "queue_length", 4)
    served.held(client)
    ann, bob = keys("Ann", KeyScope.SCAN), keys("Bob", KeyScope.SCAN)
    queue = {"if_busy": "queue"}
    assert [ann.post("/scan", json=queue).status_code for _ in range(3)] == [202, 202, 429]
    assert bob.post("/scan", json=queue).status_code == 202
    assert refusal(bob, "POST", "/scan", json=queue) == (429, "/problems/queue-full")
