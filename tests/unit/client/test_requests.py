"""Requests: each of the service's interface has a method, and how they bear a bad connection and a refusal."""

from __future__ import annotations

import inspect
import io
import json
import re
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from PIL import Image

from slrig.client import Client
from slrig.client.connection import PATIENCE_S, Captured, Progress, Resource, StateChange
from slrig.client.errors import (
    ConflictError,
    ForeignAnswerError,
    InvalidRequestError,
    RefusedError,
    TooManyError,
    UnauthorizedError,
    UnreachableError,
)
from slrig.client.resources import ScanFields
from slrig.errors import ConfigError, ServiceError, StorageError
from tests.unit.client.service import URL, Broken, client_of, event_answer, failing, stream

DOCUMENT = json.loads((Path(__file__).parents[3] / "config" / "openapi.json").read_text(encoding="utf-8"))
NEVER_SENT = {"If-None-Match"}
"""Of files: a result keeps what it has fetched."""
COMPOSED = {"examinations.wait", "live.record", "models.wait", "system.readiness"}
"""Methods of several requests."""
KINDS = {
    "application/json": {"Json", "bytes"},
    "application/pdf": {"bytes"},
    "application/octet-stream": {"Iterator[LiveFrame]", "bytes"},
    "application/zip": {"bytes"},
    "image/png": {"Picture", "bytes"},
    "image/svg+xml": {"str"},
    "text/plain": {"str"},
    "text/event-stream": {"Iterator[Event]"},
    "multipart/x-mixed-replace; boundary=picture": {"Iterator[Picture]"},
}


@dataclass(frozen=True)
class Operation:
    """An operation of the service's document."""

    name: str
    method: str
    path: str
    about: dict[str, Any]

    def parameters(self, place: str) -> set[str]:
        return {each["name"] for each in self.about.get("parameters", ()) if each["in"] == place}

    @property
    def properties(self) -> set[str]:
        content = self.about.get("requestBody", {}).get("content", {}).get("application/json")
        if content is None:
            return set()
        schema: dict[str, Any] = content["schema"]
        reference = schema.get("$ref") or next((each["$ref"] for each in schema.get("anyOf", ())), "")
        return set(DOCUMENT["components"]["schemas"].get(reference.rpartition("/")[2], schema).get("properties", ()))


OPERATIONS = [
    Operation(about["operationId"], method.upper(), path, about)
    for path, methods in DOCUMENT["paths"].items()
    for method, about in methods.items()
]
METHODS = {
    f"{space}.{name}": method
    for space, resource in vars(Client(URL)).items()
    if isinstance(resource, Resource)
    for name, method in vars(type(resource)).items()
    if not name.startswith("_")
}


def request_of(name: str, *, file: str = "the.name") -> httpx2.Request:
    """The request that a method of the client sends, with each of its parameters given."""
    sent: list[httpx2.Request] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        sent.append(request)
        raise httpx2.ConnectError("that is all")

    _, *parameters = inspect.signature(METHODS[name]).parameters.values()
    given: dict[str, Any] = {each.name: f"<{each.name}>" for each in parameters}
    if name == "scans.start":
        given = dict.fromkeys(ScanFields.__annotations__, "given")
    if "document" in given:
        given["document"] = {"format": "any"}
    if name.endswith(".file"):
        given["name"] = file
    space, _, own = name.partition(".")
    with suppress(UnreachableError):
        answer = getattr(getattr(client_of(handler), space), own)(**given)
        for _ in answer if isinstance(answer, Iterator) else ():
            pass
    return sent[0]


def serves(request: httpx2.Request, operation: Operation) -> bool:
    pattern = re.sub(r"\{\w+\}", "%3C\\\\w+%3E", operation.path.replace(".", r"\."))
    here = request.url.raw_path.decode().partition("?")[0]
    return request.method == operation.method and re.fullmatch(pattern, here) is not None


REQUESTS = {name: request_of(name) for name in METHODS if name not in COMPOSED}


def method_of(operation: Operation) -> str:
    """The client's method for an operation; one of its own rather than `file`."""
    found = [name for name, request in REQUESTS.items() if serves(request, operation)]
    if not found:
        # The name of a file may hold that of a camera.
        file = re.sub(r"\{(\w+)\}", r"<\1>", operation.path.rpartition("/")[2])
        files = [name for name in REQUESTS if name.endswith(".file")]
        found = [name for name in files if serves(request_of(name, file=file), operation)]
    assert len(found) == 1, f"{operation.name}: {found}"
    return found[0]


def test_there_are_operations_to_check() -> None:
    assert len(OPERATIONS) > 70
    assert len(REQUESTS) > 50


@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda each: each.name)
def test_each_operation_has_a_method_with_its_parameters_and_type(operation: Operation) -> None:
    name = method_of(operation)
    request = REQUESTS[name]
    is_file = name.endswith(".file")
    if not is_file:
        body = json.loads(request.content) if request.content else {}
        assert set(request.url.params) == operation.parameters("query")
        assert set(body) == operation.properties or "document" in inspect.signature(METHODS[name]).parameters
    headers = operation.parameters("header") - NEVER_SENT
    assert ("Idempotency-Key" in request.headers) == ("idempotency-key" in headers)
    assert headers <= {"idempotency-key", "last-event-id"}
    kind = str(inspect.signature(METHODS[name]).return_annotation)
    for status, about in operation.about["responses"].items():
        if status < "400":
            assert all(is_file or kind in KINDS[content] for content in about.get("content", ()))
    has_content = any(about.get("content") for status, about in operation.about["responses"].items() if status < "400")
    assert (kind == "None") == (not has_content)


def test_the_client_has_no_other_requests() -> None:
    others = {
        name
        for name, request in REQUESTS.items()
        if not name.endswith(".file") and not any(serves(request, operation) for operation in OPERATIONS)
    }
    assert others == set()


def test_a_scan_takes_the_options_of_a_start() -> None:
    names = set(ScanFields.__annotations__)
    assert {*inspect.signature(Client.start_scan).parameters} - {"self"} == names
    assert {*inspect.signature(Client.scan).parameters} - {"self", "progress"} == names
    scan, start = inspect.signature(Client.scan).parameters, inspect.signature(Client.start_scan).parameters
    assert all(scan[name] == start[name] for name in names)
    assert all(name in (Client.scan.__doc__ or "") for name in names)


def test_options_that_are_not_given_are_not_sent() -> None:
    sent: list[httpx2.Request] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        sent.append(request)
        return httpx2.Response(200, json={})

    with client_of(handler) as client:
        client.calibration.open(label=None)
        client.scans.list(limit=5)
        client.calibration.submit({"format": "slrig-calibration"}, label="from the vendor")
        client.calibration.submit("%YAML:1.0\n---\n")
        client.calibration.submit(b'<?xml version="1.0"?>')
        client.calibration.activate("a/b")
    assert [(request.url.raw_path.decode(), request.content) for request in sent] == [
        ("/calibration", b"{}"),
        ("/scan?limit=5", b""),
        ("/calibration/import?label=from+the+vendor", b'{"format":"slrig-calibration"}'),
        ("/calibration/import", b"%YAML:1.0\n---\n"),
        ("/calibration/import", b'<?xml version="1.0"?>'),
        ("/calibration/a%2Fb/activate", b""),
    ]
    kinds = [request.headers["Content-Type"] for request in sent[2:5]]
    assert kinds == ["application/json", "application/yaml", "application/xml"]


@pytest.mark.parametrize(
    ("call", "tries"),
    [(lambda client: client.scans.start(label="cup"), 2), (lambda client: client.schedules.run("7"), 1)],
)
def test_a_request_that_moves_the_rig_is_repeated_once_with_the_same_key(
    call: Callable[[Client], Any], tries: int
) -> None:
    sent: list[httpx2.Request] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        sent.append(request)
        raise httpx2.ReadError("the connection broke")

    with pytest.raises(UnreachableError):
        call(client_of(handler))
    assert [request.headers["Authorization"] for request in sent] == ["Bearer key"] * tries
    assert len({request.headers.get("Idempotency-Key") for request in sent}) == 1
    assert ("Idempotency-Key" in sent[0].headers) == (tries == 2)
    assert len({request.content for request in sent}) == 1


def test_a_broken_stream_continues_after_its_last_event() -> None:
    after: list[str] = []
    pauses: list[float] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        after.append(request.headers["Last-Event-ID"])
        if len(after) == 1:
            first = {"id": 1, "kind": "state", "state": "queued"}, {"id": 2, "kind": "progress", "fraction": 0.5}
            return event_answer(Broken(stream(*first)))
        if len(after) == 2:
            return event_answer(stream({"id": 3, "kind": "state", "state": "succeeded"}))
        return httpx2.Response(204)

    assert [*client_of(handler, pauses=pauses).scans.follow("5f")] == [
        StateChange(number=1, state="queued"),
        Progress(number=2, fraction=0.5),
        StateChange(number=3, state="succeeded"),
    ]
    assert after == ["0", "2", "3"]
    assert len(pauses) == 1


def test_all_jobs_are_followed_from_where_the_stream_began() -> None:
    sent: list[tuple[str, str | None]] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        sent.append((request.url.query.decode(), request.headers.get("Last-Event-ID")))
        if len(sent) == 1:
            # The number that it begins after, and one event before the connection breaks.
            return event_answer(Broken(b"id: 41\n\n" + stream({"id": 42, "kind": "captured", "job": {"id": "5f"}})))
        return event_answer(stream({"id": 50, "kind": "state", "state": "succeeded", "job": {"id": "5f"}}))

    events = client_of(handler).system.follow(after=7)
    job = {"id": "5f"}
    assert next(events) == Captured(number=42, job=job)
    assert next(events) == StateChange(number=50, state="succeeded", job=job)
    assert sent == [("after=7", None), ("after=7", "42")]


def test_a_client_gives_up_on_a_service_that_stays_away() -> None:
    pauses: list[float] = []

    away = failing(httpx2.ConnectError("refused"))
    with pytest.raises(UnreachableError, match="slrig serve RIG"):
        next(client_of(away, pauses=pauses).scans.follow("5f"))
    assert sum(pauses) == pytest.approx(PATIENCE_S)


def test_a_refused_stream_says_why() -> None:
    problem = {"type": "/problems/too-many-requests", "detail": "64 streams are open."}
    refused = httpx2.Response(429, json=problem, headers={"Retry-After": "5"})
    with pytest.raises(TooManyError, match="64 streams are open") as found:
        next(client_of(lambda _request: refused).scans.follow("5f"))
    assert found.value.retry_after_s == 5.0


def test_a_problem_lists_every_fault() -> None:
    problem = {
        "type": "/problems/invalid-request",
        "status": 422,
        "detail": "The request has 2 faults.",
        "errors": [{"field": "exposure_s", "message": "too long"}, {"field": "if_busy", "message": "unknown\x1b[2J"}],
    }
    with pytest.raises(InvalidRequestError) as refused:
        client_of(lambda _request: httpx2.Response(422, json=problem)).scans.start()
    assert str(refused.value).splitlines() == [
        "The request has 2 faults.",
        "  exposure_s: too long",
        r"  if_busy: unknown\u001b[2J",
    ]
    assert (refused.value.code, refused.value.status) == ("invalid-request", 422)
    assert refused.value.fields == problem["errors"]


def test_a_conflict_names_the_holder_of_the_rig() -> None:
    problem = {"type": "/problems/rig-busy", "detail": "The rig is held.", "holder": "5f", "since": "2026-11-20T06:00Z"}
    with pytest.raises(ConflictError) as refused:
        client_of(lambda _request: httpx2.Response(409, json=problem)).scans.start()
    assert (refused.value.code, refused.value.problem["holder"]) == ("rig-busy", "5f")


def test_a_refused_key_says_where_to_put_another() -> None:
    client = client_of(lambda _request: httpx2.Response(401, json={"detail": "another key"}))
    remedy = "another key\nSet SLRIG_API_KEY, or name its file with --key-file"
    with pytest.raises(UnauthorizedError, match=remedy) as refused:
        client.rig.get()
    assert refused.value.code == "unknown"


@pytest.mark.parametrize(
    ("status", "text"), [(404, "<html>nginx</html>"), (404, '["of another service"]'), (200, "<html>nginx</html>")]
)
def test_another_program_on_the_port_is_recognised(status: int, text: str) -> None:
    client = client_of(lambda _request: httpx2.Response(status, text=text))
    for call in (client.rig.get, lambda: next(client.scans.follow("5f"))):
        with pytest.raises(ForeignAnswerError, match="Is another program listening there"):
            call()


def test_a_file_is_fetched_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "mesh.ply"
    with pytest.raises(UnreachableError):
        client_of(lambda _: httpx2.Response(200, stream=Broken(b"half"))).fetch("/scan/5f/mesh.ply", target)
    with pytest.raises(RefusedError, match="not ready"):
        client_of(lambda _: httpx2.Response(409, json={"detail": "not ready"})).fetch("/scan/5f/mesh.ply", target)
    assert list(tmp_path.iterdir()) == []
    whole = client_of(lambda _request: httpx2.Response(200, content=b"whole"))
    whole.fetch("/scan/5f/mesh.ply", target)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("mesh.ply", b"whole")]
    with pytest.raises(StorageError, match="create the folder first"):
        whole.fetch("/scan/5f/mesh.ply", tmp_path / "absent" / "mesh.ply")


@pytest.mark.parametrize(("busy", "fetched"), [(2, True), (1000, False)])
def test_a_file_that_the_service_has_no_time_for_is_requested_again(
    tmp_path: Path, busy: int, *, fetched: bool
) -> None:
    sent: list[str] = []
    pauses: list[float] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        sent.append(request.url.path)
        if len(sent) <= busy:
            return httpx2.Response(503, headers={"Retry-After": "5"}, json={"detail": "Another job is computed."})
        return httpx2.Response(200, content=b"npz")

    with nullcontext() if fetched else pytest.raises(RefusedError, match="Another job is computed"):
        client_of(handler, pauses=pauses).fetch("/scan/1/points-left.npz", tmp_path / "points-left.npz")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"npz"] * fetched
    assert pauses == [5.0] * (len(sent) - 1)
    assert 2 < len(sent) < 50


def test_live_pictures_are_arrays_however_the_stream_is_cut() -> None:
    pictures = [np.full((6, 8), 40, np.uint8), np.full((6, 8, 3), (200, 100, 50), np.uint8)]
    sent = b"\r\n\r\n"
    for picture in pictures:
        file = io.BytesIO()
        Image.fromarray(picture).save(file, "png")
        png = file.getvalue()
        sent += b"--picture\r\nContent-Type: image/png\r\nContent-Length: %d\r\n\r\n%b\r\n\r\n" % (len(png), png)

    class Pieces(httpx2.SyncByteStream):
        def __iter__(self) -> Iterator[bytes]:
            return iter([sent[at : at + 7] for at in range(0, len(sent), 7)])

    paths: list[str] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        paths.append(request.url.raw_path.decode())
        return httpx2.Response(200, stream=Pieces())

    for found, picture in zip(client_of(handler).rig.pictures("left", marks=True), pictures, strict=True):
        np.testing.assert_array_equal(found, picture)
    assert paths == ["/preview/left?marks=true"]


@pytest.mark.parametrize("url", ["http://[", "foo", "127.0.0.1:8731", "ftp://127.0.0.1", "http://"])
def test_an_address_that_is_no_url_is_refused(url: str) -> None:
    with pytest.raises(ConfigError, match=r"is not a URL of a service: .*http://127\.0\.0\.1:8731"):
        Client(url, None)


@pytest.mark.parametrize("key", ["schlüssel", "two\nlines"])
def test_a_key_that_cannot_be_sent_is_refused_without_showing_it(key: str) -> None:
    with pytest.raises(ConfigError, match="The API key holds a character that no key has") as refused:
        Client(URL, key)
    assert "URL" not in str(refused.value)


def test_every_error_of_the_client_is_a_service_error() -> None:
    for kind in (UnreachableError, ForeignAnswerError, RefusedError, ConflictError):
        assert issubclass(kind, ServiceError)
