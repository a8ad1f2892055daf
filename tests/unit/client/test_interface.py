"""The client has an operation for each of config/openapi.json, with its parameters, and none besides."""

from __future__ import annotations

import inspect
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import pytest

from slrig.client import Client
from slrig.client.endpoints import ScanOptions
from slrig.client.operations import Operation, Remote, Spec
from tests.unit.client.service import URL

DOCUMENT = json.loads((Path(__file__).parents[3] / "config" / "openapi.json").read_text(encoding="utf-8"))
NEVER_ASKED = {"If-None-Match"}
"""Of files: a result keeps what it has fetched."""
SENT_BY_ITSELF = {"idempotency-key", "last-event-id"}
_KINDS = {
    "application/json": {"Json", "bytes"},
    "application/pdf": {"bytes"},
    "application/zip": {"bytes"},
    "image/png": {"Picture", "bytes"},
    "image/svg+xml": {"str"},
    "text/plain": {"str"},
}


@dataclass(frozen=True)
class Described:
    """An operation of the document."""

    name: str
    method: str
    path: str
    about: dict[str, Any]

    def parameters(self, place: str) -> set[str]:
        return {each["name"] for each in self.about.get("parameters", ()) if each["in"] == place}

    @property
    def body(self) -> dict[str, Any] | None:
        """The schema of its JSON body."""
        content = self.about.get("requestBody", {}).get("content", {}).get("application/json")
        if content is None:
            return None
        schema: dict[str, Any] = content["schema"]
        place = schema.get("$ref") or next(each["$ref"] for each in schema.get("anyOf", [{"$ref": ""}]))
        return DOCUMENT["components"]["schemas"].get(place.rpartition("/")[2], schema)  # type: ignore[no-any-return]


DESCRIBED = [
    Described(about["operationId"], method.upper(), path, about)
    for path, methods in DOCUMENT["paths"].items()
    for method, about in methods.items()
]
_client = Client(URL)
NAMESPACES: dict[str, Remote[Any]] = {name: found for name, found in vars(_client).items() if isinstance(found, Remote)}
OFFERED: dict[str, Spec] = {
    f"{space}.{name}": found.spec
    for space, remote in NAMESPACES.items()
    for name, found in vars(type(remote)).items()
    if isinstance(found, Operation) and found.spec is not None
}


def serves(spec: Spec, described: Described) -> bool:
    """Whether it is this operation, or one that fetches any file of a folder, and this is the file of one name."""
    if spec.line == f"{described.method} {described.path}":
        return True
    folder, is_any, _ = spec.line.partition("{name}")
    here = f"{described.method} {described.path}"
    return bool(is_any) and here.startswith(folder) and bool(re.fullmatch(r"[a-z{}-]+\.[a-z0-9]+", here[len(folder) :]))


def of(described: Described) -> str:
    """The client's name for an operation; one of its own rather than one that fetches any file."""
    found = sorted((spec.line.count("{name}"), name) for name, spec in OFFERED.items() if serves(spec, described))
    assert found, f"the client has no operation for {described.name}"
    return found[0][1]


def test_there_are_operations_to_look_at() -> None:
    assert len(DESCRIBED) > 70
    assert len(OFFERED) > 50


@pytest.mark.parametrize("described", DESCRIBED, ids=lambda each: each.name)
def test_each_operation_of_the_service_is_one_of_the_client_with_its_parameters(described: Described) -> None:
    spec = OFFERED[of(described)]
    names = set(inspect.signature(spec.declared).parameters) - {"self"}
    if "options" in names and of(described) == "scans.start":
        names = set(ScanOptions.__annotations__)
    if "{name}" in spec.line and "{name}" not in described.path:
        assert len(names) == 2
    else:
        in_path = described.parameters("path")
        takes = described.parameters("query")
        if described.body is not None and spec.content is None:
            takes |= set(described.body["properties"])
        # Some name what the path does by another word.
        assert len(names) == len(in_path) + len(takes) + (spec.content is not None)
        assert takes <= names, f"{of(described)} lacks {takes - names}"
    headers = described.parameters("header") - NEVER_ASKED
    assert headers <= SENT_BY_ITSELF
    assert spec.once == ("idempotency-key" in headers)
    assert ("last-event-id" in headers) == (
        "text/event-stream" in described.about["responses"].get("200", {}).get("content", {})
    )


@pytest.mark.parametrize("described", DESCRIBED, ids=lambda each: each.name)
def test_an_answer_is_read_as_what_it_is(described: Described) -> None:
    found = getattr(NAMESPACES[of(described).partition(".")[0]].__class__, of(described).partition(".")[2])
    content = {
        kind
        for status, about in described.about["responses"].items()
        if status < "400"
        for kind in about.get("content", ())
    }
    if found.spec.kind == "stream":
        assert content <= {"text/event-stream", "multipart/x-mixed-replace; boundary=picture"}
        return
    kind = OFFERED[of(described)].kind
    if "{name}" in OFFERED[of(described)].line and "{name}" not in described.path:
        assert kind == "bytes"
    else:
        assert (kind == "None") == (not content)
        assert all(kind in _KINDS[each] for each in content)


def test_the_client_has_no_operation_besides() -> None:
    assert {name for name, spec in OFFERED.items() if not any(serves(spec, each) for each in DESCRIBED)} == set()


@pytest.mark.parametrize("name", OFFERED)
def test_a_call_sends_what_it_was_given_to_its_place(name: str) -> None:
    spec = OFFERED[name]
    asked: list[httpx2.Request] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        asked.append(request)
        return httpx2.Response(204)

    space, _, own = name.partition(".")
    parameters = list(inspect.signature(spec.declared).parameters.values())[1:]
    placed = [
        f"<{each.name}>"
        for each in parameters
        if each.kind is not inspect.Parameter.KEYWORD_ONLY and each.name != "options"
    ]
    told = {each.name: f"the {each.name}" for each in parameters if each.kind is inspect.Parameter.KEYWORD_ONLY}
    with Client(URL, "key", transport=httpx2.MockTransport(handler)) as client:
        request = spec.request(getattr(client, space), placed, told)
        client.core.wire.drive(client.core.send(**request))
    method, _, path = spec.line.partition(" ")
    sent = asked[0]
    assert sent.method == method
    assert re.fullmatch(re.sub(r"\{\w+\}", r"%3C\\w+%3E", path), sent.url.raw_path.decode().partition("?")[0])
    body = json.loads(sent.content) if sent.content and spec.content is None else {}
    assert {**sent.url.params, **body}.items() >= told.items()
    assert ("Idempotency-Key" in sent.headers) == spec.once
    assert own in dir(getattr(_client, space))


def test_what_is_not_given_is_not_sent() -> None:
    asked: list[httpx2.Request] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        asked.append(request)
        return httpx2.Response(200, json={})

    with Client(URL, "key", transport=httpx2.MockTransport(handler)) as client:
        client.calibration.open(label=None)
        client.scans.list(limit=5)
        client.calibration.submit({"format": "slrig-calibration"}, label="from the vendor")
        client.calibration.submit("%YAML:1.0\n---\n")
        client.calibration.submit(b'<?xml version="1.0"?>')
        client.calibration.activate("a/b")
    assert [(request.url.raw_path.decode(), request.content) for request in asked] == [
        ("/calibration", b"{}"),
        ("/scan?limit=5", b""),
        ("/calibration/import?label=from+the+vendor", b'{"format":"slrig-calibration"}'),
        ("/calibration/import", b"%YAML:1.0\n---\n"),
        ("/calibration/import", b'<?xml version="1.0"?>'),
        ("/calibration/a%2Fb/activate", b""),
    ]
    kinds = [request.headers["Content-Type"] for request in asked[2:5]]
    assert kinds == ["application/json", "application/yaml", "application/xml"]


def test_help_shows_what_an_operation_takes_and_does() -> None:
    assert "exposure_s" in str(inspect.signature(_client.calibration.shoot))
    assert _client.calibration.activate.__doc__ == "Have scans use it from now on."
    assert "Mapping" in str(inspect.signature(_client.calibration.open))
