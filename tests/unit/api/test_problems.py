"""Every path of the description: its methods, HEAD, its key; and every refusal as a problem that says what to do."""

from __future__ import annotations

import json
from pathlib import Path
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient

from slrig import KEY_VARIABLE
from slrig.api.app import bare_app
from slrig.api.keys import KeyRing
from slrig.api.openapi import text
from slrig.api.problems import _CODES, explanations
from slrig.api.server import _keys
from slrig.config import ServiceSettings
from slrig.errors import ConfigError
from slrig.failure import errors_by_code
from tests.unit.api.conftest import KEY, ServedBench, ended

OPENAPI = Path(__file__).resolve().parents[3] / "config" / "openapi.json"
PATHS = json.loads(OPENAPI.read_text(encoding="utf-8"))["paths"]
STREAMS = ("/events", "/preview/{camera}")


def filled(path: str) -> str:
    return "/".join(str(uuid4()) if part.startswith("{") else part for part in path.split("/")).replace("{camera}", "a")


def test_table_of_statuses_is_the_whole_error_tree() -> None:
    tree = {code for code, error in errors_by_code().items() if error.__module__.startswith("slrig.")}
    assert sorted(code for codes in _CODES.values() for code in codes.split()) == sorted(tree)


def test_given_key_that_protects_nothing_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for given, words in (
        ("x" * 15, "found 15"),
        ("schlüssel" * 4, "found 36, and others"),
        ("x" * 20 + "\n", "found 21, and others"),
    ):
        with pytest.raises(ConfigError, match=f"SLRIG_API_KEY: expected a key of 16 or more .* {words}"):
            KeyRing(tmp_path / "keys.json", given=given)
    monkeypatch.setenv(KEY_VARIABLE, "x" * 16)
    with pytest.raises(ConfigError, match="--new-key asks for a new key, and SLRIG_API_KEY holds the one to use"):
        _keys(ServiceSettings(data_dir=tmp_path), fresh=True)
    assert list(tmp_path.iterdir()) == []


def test_openapi_document_in_config_is_up_to_date() -> None:
    assert OPENAPI.read_text(encoding="utf-8") == text(bare_app()), "run: python -m slrig.api > config/openapi.json"


def test_every_refusal_is_documented_as_a_problem() -> None:
    for path, operations in PATHS.items():
        for method, operation in operations.items():
            for status, found in operation["responses"].items():
                if int(status) >= 400:
                    assert list(found["content"]) == ["application/problem+json"], (path, method, status)
            if path not in {"/livez", "/readyz"}:
                assert "401" in operation["responses"], (path, method)


@pytest.mark.parametrize(
    ("method", "path", "status", "kind"),
    [
        ("GET", "/nothing", 404, "not-found"),
        ("PUT", "/scan", 405, "method-not-allowed"),
        ("GET", "/scan/not-an-id", 422, "invalid-request"),
        ("GET", "/scan?cursor=x", 422, "invalid-request"),
        ("GET", "/scan?limit=0", 422, "invalid-request"),
        ("GET", "/problems/none-such", 404, "not-found"),
        ("GET", "/docs/none-such.js", 404, "not-found"),
    ],
)
def test_refusals_of_http_itself_are_problems(
    client: TestClient, method: str, path: str, status: int, kind: str
) -> None:
    response = client.request(method, path)
    assert (response.status_code, response.headers["content-type"]) == (status, "application/problem+json")
    assert response.json()["type"] == f"/problems/{kind}"
    assert response.json()["status"] == status
    assert response.json()["detail"]


def test_body_beyond_the_limit_is_refused_however_it_is_sent(client: TestClient) -> None:
    for content in (b" " * 5000, iter([b" " * 3000, b" " * 3000])):
        response = client.post("/schedule", content=content, headers={"Content-Type": "application/json"})
        assert (response.status_code, response.headers["content-type"]) == (413, "application/problem+json")
        assert response.json()["type"] == "/problems/content-too-large"


def test_foreign_host_name_is_refused(client: TestClient) -> None:
    for host in ("evil.example", "evil.example:80", "127.0.0.1.evil.example"):
        response = client.get("/livez", headers={"Host": host})
        assert (response.status_code, response.headers["content-type"]) == (400, "application/problem+json"), host
        assert "--allow-host" in response.json()["detail"]
    for host in ("localhost", "localhost:8731", "127.0.0.1:1", "[::1]:8731"):
        assert client.get("/livez", headers={"Host": host}).status_code == 200, host


def test_key_is_needed_for_all_but_the_probes(client: TestClient, served: ServedBench) -> None:
    stranger = TestClient(served.app, base_url="http://127.0.0.1")
    for path in ("/scan", "/rig", "/device", "/openapi.json", "/nothing", "/problems/rig-busy"):
        response = stranger.get(path)
        assert (response.status_code, response.headers["content-type"]) == (401, "application/problem+json"), path
        assert response.headers["WWW-Authenticate"] == "Bearer"
    assert stranger.post("/scan").status_code == 401
    for path in ("/livez", "/readyz"):
        assert stranger.get(path).status_code in {200, 503}
    for headers in (
        {"Authorization": "Bearer wrong"},
        {"Authorization": f"Basic {KEY}"},
        {"Authorization": "Bearer "},
        {"X-API-Key": ""},
        {"X-API-Key": f"{KEY} "[:-2]},
    ):
        assert stranger.get("/scan", headers=headers).status_code == 401, headers
    assert stranger.get("/scan", headers={"X-API-Key": KEY}).status_code == 200
    # No page of another site may read an answer.
    assert "access-control-allow-origin" not in client.get("/scan", headers={"Origin": "https://evil.example"}).headers


def test_path_names_all_its_methods_where_another_is_refused(client: TestClient) -> None:
    for path, operations in PATHS.items():
        methods = {method.upper() for method in operations}
        if "GET" in methods and not path.endswith(STREAMS):
            methods.add("HEAD")
        for method in ("PATCH", *sorted({"PUT", "GET", "HEAD", "DELETE", "POST"} - methods)[:2]):
            refused = client.request(method, filled(path))
            assert refused.status_code == 405, (method, path)
            assert refused.headers["Allow"] == ", ".join(sorted(methods))
            if method != "HEAD":
                assert refused.headers["content-type"] == "application/problem+json"
                assert refused.headers["Allow"] in refused.json()["detail"]
    for method in ("GET", "HEAD", "PATCH"):
        answer = client.request(method, "/nothing")
        assert (answer.status_code, answer.headers.get("Allow")) == (404, None)


def test_head_answers_as_get_without_the_body(client: TestClient, served: ServedBench) -> None:
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


def test_every_kind_of_problem_is_explained(client: TestClient) -> None:
    for name in errors_by_code():
        found = client.get(f"/problems/{name}").json()
        assert found["description"], name
    assert {"invalid-request", "unauthorized", "not-found", "content-too-large"} <= set(explanations())


def test_unexpected_error_shows_no_secrets(
    client: TestClient, served: ServedBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        message = "secret"
        raise RuntimeError(message)

    monkeypatch.setattr(type(served.service.store), "page", broken)
    response = client.get("/scan")
    monkeypatch.undo()
    assert (response.status_code, response.headers["content-type"]) == (500, "application/problem+json")
    assert response.json()["type"] == "/problems/unexpected"
    assert "secret" not in response.text
    # This request is about no scan, so there is no scan's id to look for.
    assert "scan" not in response.json()["detail"]
    assert "RuntimeError" in response.json()["detail"]
