"""How both clients bear a bad connection, and what they say of a refusal."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx2
import pytest

from slrig.client import AsyncClient, Client, core, wire
from slrig.client.errors import (
    ConflictError,
    ForeignAnswerError,
    InvalidRequestError,
    RefusedError,
    TooManyError,
    UnauthorizedError,
    UnreachableError,
)
from slrig.client.events import Captured, Progress, StateChange
from slrig.errors import ConfigError, ServiceError, StorageError
from tests.unit.client.service import URL, Broken, client_of, each, event_answer, run, settled, stream

Kind = type[Client] | type[AsyncClient]
both = pytest.mark.parametrize("kind", [Client, AsyncClient])


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """What the clients waited, which takes no time."""
    found: list[float] = []

    async def pause(_wire: object, seconds: float) -> None:
        found.append(seconds)

    monkeypatch.setattr(wire.Blocking, "pause", pause)
    monkeypatch.setattr(wire.Awaited, "pause", pause)
    return found


@both
def test_a_start_is_repeated_once_by_the_same_key(kind: Kind) -> None:
    seen: list[httpx2.Request] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        seen.append(request)
        if len(seen) == 1:
            message = "the connection broke"
            raise httpx2.ReadError(message)
        return httpx2.Response(202, json={"id": "5f"})

    assert run(settled(client_of(kind, handler).scans.start(label="cup")))["id"] == "5f"
    assert [request.headers["Authorization"] for request in seen] == ["Bearer key"] * 2
    first, second = (request.headers["Idempotency-Key"] for request in seen)
    assert first == second
    assert json.loads(seen[1].content) == {"label": "cup"}


@both
def test_what_the_service_would_do_twice_is_not_repeated(kind: Kind) -> None:
    seen: list[httpx2.Request] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        seen.append(request)
        message = "the connection broke"
        raise httpx2.ReadError(message)

    with pytest.raises(UnreachableError):
        run(settled(client_of(kind, handler).schedules.run("7")))
    assert len(seen) == 1
    assert "Idempotency-Key" not in seen[0].headers


@both
def test_a_broken_stream_goes_on_after_the_last_event_seen(kind: Kind, pauses: list[float]) -> None:
    asked: list[str] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        asked.append(request.headers["Last-Event-ID"])
        if len(asked) == 1:
            first = {"id": 1, "kind": "state", "state": "queued"}, {"id": 2, "kind": "progress", "fraction": 0.5}
            return event_answer(Broken(stream(*first)))
        if len(asked) == 2:
            return event_answer(stream({"id": 3, "kind": "state", "state": "succeeded"}))
        return httpx2.Response(204)

    async def case() -> list[Any]:
        return [event async for event in each(client_of(kind, handler).scans.follow("5f"))]

    assert run(case()) == [
        StateChange(number=1, state="queued"),
        Progress(number=2, fraction=0.5),
        StateChange(number=3, state="succeeded"),
    ]
    assert asked == ["0", "2", "3"]
    assert len(pauses) == 1


@both
def test_all_jobs_are_followed_from_where_the_stream_began(kind: Kind, pauses: list[float]) -> None:
    asked: list[tuple[str, str | None]] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        asked.append((request.url.query.decode(), request.headers.get("Last-Event-ID")))
        if len(asked) == 1:
            # Where it begins, and nothing else before the connection breaks.
            return event_answer(Broken(b"id: 41\n\n" + stream({"id": 42, "kind": "captured", "job": {"id": "5f"}})))
        return event_answer(stream({"id": 50, "kind": "state", "state": "succeeded", "job": {"id": "5f"}}))

    async def case() -> list[Any]:
        found = []
        async for event in each(client_of(kind, handler).system.follow(after=7)):
            found.append(event)
            if len(found) == 2:
                break
        return found

    job = {"id": "5f"}
    assert run(case()) == [Captured(number=42, job=job), StateChange(number=50, state="succeeded", job=job)]
    assert asked == [("after=7", None), ("after=7", "42")]
    assert len(pauses) == 1


@both
def test_a_service_that_stays_away_is_given_up(kind: Kind, pauses: list[float]) -> None:
    def handler(_request: httpx2.Request) -> httpx2.Response:
        message = "refused"
        raise httpx2.ConnectError(message)

    async def case() -> None:
        async for _ in each(client_of(kind, handler).scans.follow("5f")):
            pass

    with pytest.raises(UnreachableError, match="slrig serve RIG"):
        run(case())
    assert sum(pauses) == pytest.approx(core.PATIENCE_S)


@both
def test_a_stream_that_is_refused_says_why(kind: Kind) -> None:
    problem = {"type": "/problems/too-many-requests", "detail": "64 streams are open."}

    async def case() -> None:
        refused = httpx2.Response(429, json=problem, headers={"Retry-After": "5"})
        async for _ in each(client_of(kind, lambda _request: refused).scans.follow("5f")):
            pass

    with pytest.raises(TooManyError, match="64 streams are open") as found:
        run(case())
    assert found.value.retry_after_s == 5.0


@both
def test_a_problem_is_told_with_every_fault(kind: Kind) -> None:
    problem = {
        "type": "/problems/invalid-request",
        "status": 422,
        "detail": "The request has 2 faults.",
        "errors": [{"field": "exposure_s", "message": "too long"}, {"field": "if_busy", "message": "unknown\x1b[2J"}],
    }
    client = client_of(kind, lambda _request: httpx2.Response(422, json=problem))
    with pytest.raises(InvalidRequestError) as refused:
        run(settled(client.scans.start()))
    assert str(refused.value).splitlines() == [
        "The request has 2 faults.",
        "  exposure_s: too long",
        r"  if_busy: unknown\u001b[2J",
    ]
    assert (refused.value.code, refused.value.status) == ("invalid-request", 422)
    assert refused.value.fields == problem["errors"]


def test_who_holds_the_rig_is_in_the_problem() -> None:
    problem = {"type": "/problems/rig-busy", "detail": "The rig is held.", "holder": "5f", "since": "2026-11-20T06:00Z"}
    with pytest.raises(ConflictError) as refused:
        client_of(Client, lambda _request: httpx2.Response(409, json=problem)).scans.start()
    assert (refused.value.code, refused.value.problem["holder"]) == ("rig-busy", "5f")


def test_a_refused_key_is_told_with_where_to_put_it() -> None:
    client = client_of(Client, lambda _request: httpx2.Response(401, json={"detail": "another key"}))
    with pytest.raises(
        UnauthorizedError, match="another key\nSet SLRIG_API_KEY, or name its file with --key-file"
    ) as refused:
        client.rig.look()
    assert refused.value.code == "unknown"


@both
@pytest.mark.parametrize(
    "answer",
    [
        (404, "<html>nginx</html>"),
        (404, '["of another service"]'),
        (200, "<html>nginx</html>"),
    ],
)
def test_another_program_on_the_port_is_recognised(kind: Kind, answer: tuple[int, str]) -> None:
    status, text = answer
    client = client_of(kind, lambda _request: httpx2.Response(status, text=text))

    async def settled_look() -> None:
        await settled(client.rig.look())

    async def stream_case() -> None:
        async for _ in each(client.scans.follow("5f")):
            pass

    for case in (settled_look, stream_case):
        with pytest.raises(ForeignAnswerError, match="Is another program listening there"):
            run(case())


@both
def test_a_file_is_fetched_whole_or_not_at_all(kind: Kind, tmp_path: Path) -> None:
    target = tmp_path / "mesh.ply"
    cut = client_of(kind, lambda _request: httpx2.Response(200, stream=Broken(b"half")))
    with pytest.raises(UnreachableError):
        run(settled(cut.fetch("/scan/5f/mesh.ply", target)))
    refused = client_of(kind, lambda _request: httpx2.Response(409, json={"detail": "not ready"}))
    with pytest.raises(RefusedError, match="not ready"):
        run(settled(refused.fetch("/scan/5f/mesh.ply", target)))
    assert list(tmp_path.iterdir()) == []
    whole = client_of(kind, lambda _request: httpx2.Response(200, content=b"whole"))
    run(settled(whole.fetch("/scan/5f/mesh.ply", target)))
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("mesh.ply", b"whole")]
    with pytest.raises(StorageError, match="create the folder first"):
        run(settled(whole.fetch("/scan/5f/mesh.ply", tmp_path / "absent" / "mesh.ply")))


@both
@pytest.mark.parametrize(("busy", "fetched"), [(2, True), (1000, False)])
def test_a_file_that_has_to_wait_is_asked_for_again(
    kind: Kind, tmp_path: Path, pauses: list[float], busy: int, fetched: bool
) -> None:
    asked: list[str] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        asked.append(request.url.path)
        if len(asked) <= busy:
            return httpx2.Response(503, headers={"Retry-After": "5"}, json={"detail": "Another job is computed."})
        return httpx2.Response(200, content=b"npz")

    async def case() -> None:
        await settled(client_of(kind, handler).fetch("/scan/1/points-left.npz", tmp_path / "points-left.npz"))

    if fetched:
        run(case())
    else:
        with pytest.raises(RefusedError, match="Another job is computed"):
            run(case())
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"npz"] * fetched
    assert pauses == [5.0] * (len(asked) - 1)
    assert 2 < len(asked) < 50


@both
def test_pictures_come_as_arrays_however_the_stream_is_cut(kind: Kind) -> None:
    import io

    import numpy as np
    from PIL import Image

    wanted = [np.full((6, 8), value, np.uint8) for value in (40, 200)]
    sent = b"\r\n\r\n"
    for picture in wanted:
        file = io.BytesIO()
        Image.fromarray(picture).save(file, "png")
        png = file.getvalue()
        sent += b"--picture\r\nContent-Type: image/png\r\nContent-Length: %d\r\n\r\n%b\r\n\r\n" % (len(png), png)

    class Pieces(httpx2.SyncByteStream, httpx2.AsyncByteStream):
        def __iter__(self) -> Any:
            return iter([sent[at : at + 7] for at in range(0, len(sent), 7)])

        async def __aiter__(self) -> Any:
            for piece in self:
                yield piece

    asked: list[str] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        asked.append(request.url.raw_path.decode())
        return httpx2.Response(200, stream=Pieces())

    async def case() -> list[Any]:
        return [
            picture async for picture in each(client_of(kind, handler).rig.pictures("left", light="white", marks=True))
        ]

    np.testing.assert_array_equal(run(case()), wanted)
    assert asked == ["/preview/left?light=white&marks=true"]


@both
@pytest.mark.parametrize("url", ["http://[", "foo", "127.0.0.1:8731", "ftp://127.0.0.1", "http://"])
def test_an_address_that_is_no_url_is_refused(kind: Kind, url: str) -> None:
    with pytest.raises(ConfigError, match=r"is no URL of a service: .*http://127\.0\.0\.1:8731"):
        kind(url, None)


@both
@pytest.mark.parametrize("key", ["schlüssel", "two\nlines"])
def test_a_key_that_cannot_be_sent_is_refused_by_its_name(kind: Kind, key: str) -> None:
    with pytest.raises(ConfigError, match="The API key holds a character that no key has") as refused:
        kind(URL, key)
    assert "URL" not in str(refused.value)


def test_an_operation_that_waits_for_a_loop_is_no_operation_of_a_blocking_client() -> None:
    with pytest.raises(RuntimeError, match="event loop"):
        wire.Blocking(httpx2.Client()).drive(asyncio.sleep(0))


def test_all_that_a_client_raises_is_a_service_error() -> None:
    kinds: list[Callable[..., Exception]] = [UnreachableError, ForeignAnswerError, RefusedError, ConflictError]
    assert all(issubclass(kind, ServiceError) for kind in kinds)  # type: ignore[arg-type]
