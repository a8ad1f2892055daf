"""Every path names all its methods, and answers HEAD as GET, without a body; streams are not opened by it."""

from __future__ import annotations

import json
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient

from tests.unit.api.conftest import ServedBench, ended
from tests.unit.api.test_problems import OPENAPI

DOCUMENT = json.loads(OPENAPI.read_text(encoding="utf-8"))["paths"]
STREAMS = ("/events", "/preview/{camera}")


def filled(path: str) -> str:
    """A path of the document with something in its braces."""
    return "/".join(str(uuid4()) if part.startswith("{") else part for part in path.split("/")).replace("{camera}", "a")


@pytest.mark.parametrize("path", DOCUMENT)
def test_path_names_all_its_methods_where_another_is_refused(client: TestClient, path: str) -> None:
    methods = {method.upper() for method in DOCUMENT[path]}
    if "GET" in methods and not path.endswith(STREAMS):
        methods.add("HEAD")
    for method in ("PATCH", "OPTIONS", "PUT", "GET", "HEAD", "DELETE", "POST"):
        if method in methods:
            continue
        refused = client.request(method, filled(path))
        assert refused.status_code == 405, method
        assert refused.headers["Allow"] == ", ".join(sorted(methods))
        if method != "HEAD":
            assert refused.headers["content-type"] == "application/problem+json"
            assert refused.headers["Allow"] in refused.json()["detail"]


def test_nothing_is_allowed_where_nothing_is(client: TestClient) -> None:
    for method in ("GET", "HEAD", "PATCH"):
        answer = client.request(method, "/nothing")
        assert (answer.status_code, answer.headers.get("Allow")) == (404, None)


def test_head_is_what_get_would_say_without_the_body(client: TestClient, served: ServedBench) -> None:
    scan = client.post("/scan").json()["id"]
    done = ended(client, scan)
    paths = [*done["links"]["files"].values(), "/livez", "/readyz", "/rig", "/scan", f"/scan/{scan}", "/openapi.json"]
    paths += [f"/scan/{uuid4()}", "/scan/none", "/scan?limit=0", "/problems/storage", "/calibration", "/schedule"]
    for path in paths:
        whole, head = client.get(path), client.head(path)
        assert head.content == b""
        assert head.status_code == whole.status_code, path
        assert dict(head.headers) == dict(whole.headers), path
    tag = client.head(f"/scan/{scan}/mesh.ply").headers["ETag"]
    assert client.head(f"/scan/{scan}/mesh.ply", headers={"If-None-Match": tag}).status_code == 304
    assert client.head("/scan", headers={"Authorization": "Bearer none"}).status_code == 401
    assert served.app.state.streams.count == 0
