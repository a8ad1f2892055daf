"""Every refusal is a problem that says what to do."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

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
from tests.unit.api.conftest import KEY, ServedBench

OPENAPI = Path(__file__).resolve().parents[3] / "config" / "openapi.json"


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
    document = json.loads(OPENAPI.read_text(encoding="utf-8"))
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            for status, found in operation["responses"].items():
                if int(status) >= 400:
                    assert list(found["content"]) == ["application/problem+json"], (path, method, status)
            if path not in {"/livez", "/readyz"}:
                assert "401" in operation["responses"], (path, method)


@pytest.mark.parametrize(
    ("request_body", "fields"),
    [
        ({"exposure_s": -1}, ["exposure_s"]),
        ({"exposure_s": 1e9}, ["exposure_s"]),
        ({"exposure_s": "0.1"}, ["exposure_s"]),
        ({"patterns": {"line_shift_period_px": 3}}, ["patterns.line_shift_period_px"]),
        ({"patterns": {"line_shift_period_px": 8.5}}, ["patterns.line_shift_period_px"]),
        ({"patterns": {"rows": 1}}, ["patterns.rows"]),
        ({"patterns": {"gray_cells": 4}}, ["patterns.gray_cells"]),
        ({"reconstruction": {"max_code_gap": 0}}, ["reconstruction.max_code_gap"]),
        ({"reconstruction": {"keep_holes": "yes"}}, ["reconstruction.keep_holes"]),
        ({"reconstruction": {"flip_rule": "dyer"}}, ["reconstruction.flip_rule"]),
        ({"reconstruction": {"smooth_boundary": 1}}, ["reconstruction.smooth_boundary"]),
        ({"if_busy": "wait"}, ["if_busy"]),
        ({"label": ""}, ["label"]),
        ({"label": "x" * 201}, ["label"]),
        ({"label": "a\x1b[2J"}, ["label"]),
        ({"exposure_s": 0, "if_busy": 1, "paint": "red"}, ["exposure_s", "if_busy", "paint"]),
        ({"colour": "red"}, ["colour"]),
        ([], ["body"]),
    ],
)
def test_absurd_request_is_refused_with_every_fault_named(
    client: TestClient, request_body: Any, fields: list[str]
) -> None:
    response = client.post("/scan", json=request_body)
    assert response.status_code == 422
    assert response.headers["content-type"] == "application/problem+json"
    problem = response.json()
    assert problem["type"] == "/problems/invalid-request"
    assert [fault["field"] for fault in problem["errors"]] == fields
    assert all(fault["message"] for fault in problem["errors"])
    assert client.get("/scan").json()["scans"] == []


def test_numbers_beyond_json_are_refused(client: TestClient) -> None:
    headers = {"Content-Type": "application/json"}
    for number in ("NaN", "Infinity", "1e999"):
        response = client.post("/scan", content=f'{{"exposure_s": {number}}}', headers=headers)
        assert response.status_code == 422, number
        assert response.json()["errors"][0]["field"] == "exposure_s"


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""])
@pytest.mark.parametrize("content", ['{"label": "a"}', "", iter([b"{}"])])
def test_body_that_is_not_called_json_is_refused(client: TestClient, content: Any, kind: str) -> None:
    if not kind and content == "":
        pytest.skip("nothing is sent: no page can send that, either, without its Origin")
    response = client.post("/scan", content=content, headers={"Content-Type": kind} if kind else {})
    assert (response.status_code, response.headers["content-type"]) == (415, "application/problem+json")
    assert "expected application/json, found" in response.json()["detail"]


def test_broken_json_is_told_where_it_breaks(client: TestClient) -> None:
    response = client.post("/scan", content='{"label": }', headers={"Content-Type": "application/json"})
    assert response.json()["errors"] == [{"field": "body", "message": "is no JSON: Expecting value at character 10"}]
    assert "1 fault: body" in response.json()["detail"]


@pytest.mark.parametrize(
    ("content", "field", "found"),
    [(r'{"label": "\ud800"}', "label", r"\ud800"), (r'{"\udfff": "a"}', "body", r"\udfff")],
)
def test_half_a_surrogate_pair_is_refused_in_print(client: TestClient, content: str, field: str, found: str) -> None:
    response = client.post("/scan", content=content, headers={"Content-Type": "application/json"})
    assert (response.status_code, response.headers["content-type"]) == (422, "application/problem+json")
    (fault,) = response.json()["errors"]
    assert (fault["field"], fault["found"]) == (field, found)


def test_pattern_that_the_projector_cannot_show_is_refused(client: TestClient) -> None:
    client.get(f"{client.post('/scan').json()['links']['events']}")
    response = client.post("/scan", json={"patterns": {"gray_cell_px": 64}})
    assert (response.status_code, response.json()["type"]) == (422, "/problems/pattern")


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
    assert client.get("/scan").status_code == 200


def test_no_foreign_page_may_read_the_answers(client: TestClient) -> None:
    response = client.get("/scan", headers={"Origin": "https://evil.example"})
    assert "access-control-allow-origin" not in response.headers


def test_every_kind_of_problem_is_explained(client: TestClient) -> None:
    for name in errors_by_code():
        found = client.get(f"/problems/{name}").json()
        assert found["description"], name
    assert {"invalid-request", "unauthorized", "not-found", "content-too-large"} <= set(explanations())


def test_unexpected_error_tells_no_secrets(
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
