"""Keys, and who may send what with them, from which page, how often; every path and its methods; and every refusal."""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import AsyncIterator, Iterator
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from fastapi.responses import StreamingResponse
from fastapi.sse import EventSourceResponse
from fastapi.testclient import TestClient
from starlette.types import Receive, Send
from starlette.types import Scope as ASGIScope

from slrig import KEY_VARIABLE, local_key_path
from slrig.api import auth as access
from slrig.api.app import bare_app, create_app
from slrig.api.auth import (
    ALL_SCOPES,
    FIRST_NAME,
    GIVEN_NAME,
    LINK_PATH,
    Access,
    Key,
    KeyRing,
    Rates,
    Refused,
    Sessions,
    digest,
    first_key,
    local_key,
)
from slrig.api.problems import _CODES, explanations, text
from slrig.api.scopes import READING, KeyScope, needed_scope
from slrig.api.server import _keys, take_secrets
from slrig.client.connection import Connection
from slrig.config import ServiceSettings
from slrig.errors import ConfigError, StorageError
from slrig.failure import errors_by_code
from tests.unit.api.conftest import HERE, KEY, ServedBench, client_of, ended, refusal
from tests.unit.looped import on_loop
from tests.unit.scan.fakes import WAIT_S

OPENAPI = Path(__file__).resolve().parents[3] / "config" / "openapi.json"
PATHS = json.loads(OPENAPI.read_text(encoding="utf-8"))["paths"]
STREAMS = ("/events", "/preview/{camera}")


def filled(path: str) -> str:
    return "/".join(str(uuid4()) if part.startswith("{") else part for part in path.split("/")).replace("{camera}", "a")


def test_table_of_statuses_is_the_whole_error_tree() -> None:
    tree = {code for code, error in errors_by_code().items() if error.__module__.startswith("slrig.")}
    assert sorted(code for codes in _CODES.values() for code in codes.split()) == sorted(tree)


def test_given_key_that_protects_nothing_is_refused(tmp_path: Path) -> None:
    for given, words in (
        ("x" * 15, "found 15"),
        ("schlüssel" * 4, "found 36, and others"),
        ("x" * 20 + "\n", "found 21, and others"),
    ):
        with pytest.raises(ConfigError, match=f"SLRIG_API_KEY: expected a key of 16 or more .* {words}"):
            KeyRing(tmp_path / "keys.json", given=given)
    with pytest.raises(ConfigError, match="--new-key requests a new key, and SLRIG_API_KEY holds the one to use"):
        _keys(ServiceSettings(data_dir=tmp_path), "x" * 16, fresh=True)
    assert list(tmp_path.iterdir()) == []


def test_processes_that_the_service_starts_are_given_no_secret(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SLRIG_API_KEY", "SLRIG_WEBHOOK_SECRET", "SLRIG_MQTT_LOGIN", "SLRIG_CATALOGUE_LOGIN"):
        monkeypatch.setenv(name, "a secret of theirs")
    assert take_secrets() == "a secret of theirs"
    assert "a secret of theirs" not in os.environ.values()


def test_openapi_document_in_config_is_up_to_date() -> None:
    assert OPENAPI.read_text(encoding="utf-8") == text(bare_app()), "run: python -m slrig.api > config/openapi.json"


def test_parameters_are_left_out_and_never_null() -> None:
    for operation in (each for operations in PATHS.values() for each in operations.values()):
        assert "null" not in str([each["schema"] for each in operation.get("parameters", ())])


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
    visitor = stranger(served)
    for path in ("/scan", "/rig", "/device", "/openapi.json", "/nothing", "/problems/rig-busy"):
        response = visitor.get(path)
        assert (response.status_code, response.headers["content-type"]) == (401, "application/problem+json"), path
        assert response.headers["WWW-Authenticate"] == "Bearer"
    assert visitor.post("/scan").status_code == 401
    for path in ("/livez", "/readyz"):
        assert visitor.get(path).status_code in {200, 503}
    for headers in (
        {"Authorization": "Bearer wrong"},
        {"Authorization": f"Basic {KEY}"},
        {"Authorization": "Bearer "},
        {"X-API-Key": ""},
        {"X-API-Key": f"{KEY} "[:-2]},
    ):
        assert visitor.get("/scan", headers=headers).status_code == 401, headers
    assert visitor.get("/scan", headers={"X-API-Key": KEY}).status_code == 200
    # No page of another site may read an answer.
    assert "access-control-allow-origin" not in client.get("/scan", headers={"Origin": "https://evil.example"}).headers


def test_path_names_all_its_methods_where_another_is_refused(client: TestClient) -> None:
    for path, operations in PATHS.items():
        methods = {method.upper() for method in operations}
        if "GET" in methods and not path.endswith(STREAMS):
            methods.add("HEAD")
        for method in sorted({"PATCH", "PUT", "GET", "HEAD", "DELETE", "POST"} - methods)[:1]:
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
    files = [done["links"]["files"][name] for name in ("mesh.ply", "mesh.obj", "bundle.zip")]
    paths = [*files, "/livez", "/readyz", "/rig", "/scan", f"/scan/{scan}", "/openapi.json"]
    paths += [f"/scan/{uuid4()}", "/scan/none", "/scan?limit=0", "/problems/storage", "/calibration", "/schedule"]
    for path in paths:
        whole, head = client.get(path), client.head(path)
        assert head.content == b""
        assert head.status_code == whole.status_code, path
        assert dict(head.headers) == dict(whole.headers), path
    tag = client.head(f"/scan/{scan}/mesh.ply").headers["ETag"]
    assert client.head(f"/scan/{scan}/mesh.ply", headers={"If-None-Match": tag}).status_code == 304
    assert client.head("/scan", headers={"Authorization": "Bearer none"}).status_code == 401
    assert not served.service.streams.taken


def test_every_kind_of_problem_is_explained(client: TestClient) -> None:
    for name in errors_by_code():
        found = client.get(f"/problems/{name}").json()
        assert found["description"], name
    assert {"invalid-request", "unauthorized", "not-found", "content-too-large"} <= set(explanations())


def test_unexpected_error_shows_no_secrets(
    client: TestClient, served: ServedBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("secret")

    monkeypatch.setattr(type(served.service.store), "page", broken)
    response = client.get("/scan")
    monkeypatch.undo()
    assert (response.status_code, response.headers["content-type"]) == (500, "application/problem+json")
    assert response.json()["type"] == "/problems/unexpected"
    assert "secret" not in response.text
    # This request is about no scan, so there is no scan's id to look for.
    assert "scan" not in response.json()["detail"]
    assert "RuntimeError" in response.json()["detail"]


NOW = datetime(2026, 11, 24, 12, tzinfo=UTC)


def ring_in(folder: Path, *, given: str | None = None, now: datetime = NOW) -> KeyRing:
    return KeyRing(folder / "keys.json", given=given, clock=lambda: now)


def known(keys: KeyRing, key: str | None) -> Key:
    found = keys.find(str(key))
    assert found is not None
    return found


def test_key_is_shown_once_and_kept_as_its_digest(tmp_path: Path) -> None:
    key = ring_in(tmp_path).add("Ann", [KeyScope.SCAN])
    path = tmp_path / "keys.json"
    assert key not in path.read_text()
    assert path.stat().st_mode & 0o777 == 0o600
    found = known(ring_in(tmp_path), key)
    assert (found.name, found.scopes, found.fault(NOW)) == ("Ann", (KeyScope.LOOK, KeyScope.SCAN), None)
    assert ring_in(tmp_path).find(key[:-1]) is None


def test_what_another_process_changes_holds_at_once(tmp_path: Path) -> None:
    serving, elsewhere = ring_in(tmp_path), ring_in(tmp_path)
    key = elsewhere.add("Ann", [])
    assert serving.find(key) is not None
    elsewhere.revoke("Ann")
    assert known(serving, key).fault(NOW) == "was revoked on 2026-11-24"
    assert serving.find(elsewhere.add("Ann", [])) is not None


def test_a_key_ends_when_it_was_said_to(tmp_path: Path) -> None:
    key = ring_in(tmp_path).add("guest", [], life=timedelta(days=2))
    found = known(ring_in(tmp_path), key)
    assert found.fault(NOW + timedelta(days=1.9)) is None
    assert found.fault(NOW + timedelta(days=2)) == "expired on 2026-11-26"


def test_names_of_keys_are_unique_and_printable(tmp_path: Path) -> None:
    keys = ring_in(tmp_path, given="x" * 16)
    keys.add("Ann", [])
    for taken in ("Ann", GIVEN_NAME):
        with pytest.raises(ConfigError, match="There is a key of the name"):
            keys.add(taken, [])
    for none in ("", "a\nb", "\x1b[31m", "x" * 65, "-rf"):
        with pytest.raises(ConfigError, match="cannot name a key"):
            keys.add(none, [])
    with pytest.raises(ConfigError, match=r"no key 'Bob' to revoke.*Ann"):
        keys.revoke("Bob")


def test_the_first_start_makes_a_key_and_a_lost_one_is_replaced(tmp_path: Path) -> None:
    keys = ring_in(tmp_path)
    first = first_key(keys, fresh=False)
    assert first_key(keys, fresh=False) is None
    fresh = first_key(keys, fresh=True)
    old, new = known(keys, first), known(keys, fresh)
    assert old.fault(NOW) is not None
    assert (new.name, new.scopes, new.fault(NOW)) == (FIRST_NAME, ALL_SCOPES, None)


def test_the_key_of_the_environment_is_kept_nowhere(tmp_path: Path) -> None:
    keys = ring_in(tmp_path, given="the key of tests")
    found = known(keys, "the key of tests")
    assert (found.name, found.scopes) == (GIVEN_NAME, ALL_SCOPES)
    assert first_key(keys, fresh=False) is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["", "{}", '{"format": "slrig-keys", "version": 1, "keys": [{"name": "Ann"}]}'])
def test_a_damaged_file_opens_nothing(tmp_path: Path, text: str) -> None:
    keys = ring_in(tmp_path)
    key = keys.add("Ann", [])
    (tmp_path / "keys.json").write_text(text)
    with pytest.raises(StorageError, match=r"cannot be read: .*Restore the file from a backup"):
        keys.find(key)


OWN_PAGE = {"Sec-Fetch-Site": "same-origin", "Origin": HERE, "Referer": f"{HERE}/docs"}


@pytest.fixture
def ring(served: ServedBench) -> Iterator[KeyRing]:
    path = served.service.settings.key_path
    yield KeyRing(path)
    path.unlink(missing_ok=True)


def stranger(served: ServedBench, key: str | None = None) -> TestClient:
    return client_of(served, key=key)


def sessions(served: ServedBench) -> Sessions:
    found: Sessions = served.app.state.sessions
    return found


def logged_in(served: ServedBench) -> TestClient:
    browser = stranger(served)
    assert browser.post("/session", headers={"Authorization": f"Bearer {KEY}"}).status_code == 201
    return browser


@pytest.mark.usefixtures("client")
@pytest.mark.parametrize("scope", list(KeyScope))
def test_each_key_does_what_it_is_for_and_nothing_else(served: ServedBench, ring: KeyRing, scope: KeyScope) -> None:
    mine = stranger(served, ring.add("Ann", [scope]))
    asked = {
        KeyScope.LOOK: ("GET", "/scan"),
        KeyScope.SCAN: ("POST", "/scan/00000000-0000-4000-8000-000000000000/cancel"),
        KeyScope.CALIBRATE: ("POST", "/calibration/00000000-0000-4000-8000-000000000000/solve"),
        KeyScope.ADMINISTER: ("GET", "/audit"),
    }
    for needed, (method, path) in asked.items():
        response = mine.request(method, path)
        if needed in {KeyScope.LOOK, scope}:
            assert response.status_code in {200, 404}, (method, path)
        else:
            assert response.status_code == 403, (method, path)
            assert response.json()["type"] == "/problems/scope"
            assert f"--scope {needed}" in response.json()["detail"]
    assert mine.get("/session").json() == {
        "name": "Ann",
        "scopes": sorted({KeyScope.LOOK, scope}, key=list(KeyScope).index),
        "expires_at": None,
    }


def test_every_operation_has_the_scope_of_its_path() -> None:
    for path, operations in PATHS.items():
        for method, operation in operations.items():
            scope = needed_scope(method.upper(), path)
            assert operation.get("x-scope", scope) == scope
            if path in {"/audit", "/rig/file", "/rig/settings"}:
                assert scope is KeyScope.ADMINISTER
            elif method.upper() in READING:
                assert scope is (KeyScope.SCAN if path.startswith(("/preview/", "/live/")) else KeyScope.LOOK)
            elif not path.startswith(("/session", "/schedule", "/preset", "/notices")):
                assert scope in {KeyScope.SCAN, KeyScope.CALIBRATE}, (method, path)


@pytest.mark.usefixtures("client")
def test_a_key_that_is_over_opens_nothing(served: ServedBench, ring: KeyRing) -> None:
    mine = stranger(served, ring.add("Ann", [], life=timedelta(seconds=-1)))
    assert "This API key expired on" in mine.get("/scan").json()["detail"]
    mine = stranger(served, ring.add("Bob", []))
    assert mine.get("/scan").status_code == 200
    ring.revoke("Bob")
    assert mine.get("/scan").status_code == 401


@pytest.mark.usefixtures("client")
@pytest.mark.parametrize("answer", [EventSourceResponse, StreamingResponse])
def test_a_stream_ends_with_the_key_that_began_it_and_needs_nothing_to_send(
    served: ServedBench, ring: KeyRing, monkeypatch: pytest.MonkeyPatch, answer: type[StreamingResponse]
) -> None:
    monkeypatch.setattr(access, "_CHECK_AGAIN_S", 0.0)
    mine, ended = ring.add("Ann", []), []

    async def silent() -> AsyncIterator[str]:
        yield "part 1"
        ring.revoke("Ann")
        # Who has it now may not go on with it.
        ring.add("Ann", [])
        try:
            async with asyncio.timeout(WAIT_S):
                await asyncio.Event().wait()
        except asyncio.CancelledError:
            ended.append(True)
            raise

    async def app(scope: ASGIScope, receive: Receive, send: Send) -> None:
        await answer(silent())(scope, receive, send)

    guarded = Access(app, ring=ring, sessions=sessions(served), audit=served.service.audit, per_second=1e6)
    body = TestClient(guarded, base_url=HERE).get("/events", headers={"Authorization": f"Bearer {mine}"}).text
    assert ("part 1" in body, ended) == (True, [True])
    ring.revoke("Ann")
    # A defect of what makes the stream is none of the key's.
    defective = Access(broken, ring=ring, sessions=sessions(served), audit=served.service.audit, per_second=1e6)
    with pytest.raises(ZeroDivisionError):
        TestClient(defective, base_url=HERE, headers={"X-API-Key": ring.add("Bob", [])}).get("/events")


async def broken(_scope: ASGIScope, _receive: Receive, send: Send) -> None:
    """An application that fails in the middle of a stream."""
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"part 0", "more_body": True})
    raise ZeroDivisionError


@pytest.mark.usefixtures("client")
def test_a_browser_logs_in_and_out(served: ServedBench) -> None:
    browser = stranger(served)
    response = browser.post("/session", headers={"Authorization": f"Bearer {KEY}"})
    cookie = response.headers["set-cookie"]
    for part in ("HttpOnly", "SameSite=strict", "Path=/", "Max-Age=43200"):
        assert part in cookie
    assert "Secure" not in cookie
    assert KEY not in cookie
    assert browser.get("/scan").status_code == 200
    assert browser.get("/session").json()["name"] == "environment"
    left = browser.delete("/session", headers=OWN_PAGE)
    assert (left.status_code, "Max-Age=0" in left.headers["set-cookie"]) == (204, True)
    # The service ends the session, and not the browser alone.
    for one in (browser, stranger(served)):
        assert one.get("/scan", headers={"Cookie": cookie.partition(";")[0]}).status_code == 401
    told = stranger(served).post("/session", headers={"Authorization": f"Bearer {KEY}", "Origin": "https://127.0.0.1"})
    assert "Secure" in told.headers["set-cookie"]


@pytest.mark.usefixtures("client")
def test_the_link_works_once_and_not_for_long(served: ServedBench, monkeypatch: pytest.MonkeyPatch) -> None:
    token = sessions(served).link("environment", digest(KEY))
    browser = stranger(served)
    response = browser.get(f"{LINK_PATH}?token={token}", follow_redirects=False)
    assert (response.status_code, response.headers["location"]) == (303, "/")
    assert browser.get("/docs").status_code == 200
    for used in (token, "none-such", ""):
        refused = stranger(served).get(f"{LINK_PATH}?token={used}", follow_redirects=False)
        assert (refused.status_code, refused.headers["content-type"]) == (401, "application/problem+json")
    late = sessions(served).link("environment", digest(KEY))
    now = sessions(served)._clock()
    monkeypatch.setattr(sessions(served), "_clock", lambda: now + timedelta(minutes=16))
    assert stranger(served).get(f"{LINK_PATH}?token={late}", follow_redirects=False).status_code == 401


def test_a_program_makes_a_link_for_the_person_before_it(
    client: TestClient, served: ServedBench, ring: KeyRing
) -> None:
    paths = [client.post("/session/links").json()["path"] for _ in range(9)]
    other = client.post("/session/links", headers={"Authorization": f"Bearer {ring.add('Ann', [])}"}).json()["path"]
    browser = stranger(served)
    assert browser.get(paths[-1], follow_redirects=False).status_code == 303
    assert browser.get("/session").json()["name"] == "environment"
    # The newest eight links of a key work; those of other keys do not count.
    answers = [stranger(served).get(path, follow_redirects=False).status_code for path in (*paths[:2], other)]
    assert answers == [401, 303, 303]
    assert stranger(served).post("/session/links").status_code == 401


@pytest.mark.usefixtures("client")
def test_sessions_of_one_key_log_nobody_out(
    served: ServedBench, ring: KeyRing, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access, "MOST_SESSIONS", 8)
    app = create_app(served.service, ring=KeyRing(ring._path, given=KEY))

    def cookie(key: str) -> dict[str, str]:
        answer = TestClient(app, base_url=HERE, headers={"X-API-Key": key}).post("/session")
        return {"Cookie": answer.headers["set-cookie"].partition(";")[0]}

    def status(cookie: dict[str, str]) -> int:
        return TestClient(app, base_url=HERE, headers=cookie).get("/scan").status_code

    ann, bob = ring.add("Ann", []), ring.add("Bob", [])
    mine = cookie(KEY)
    hers = [cookie(ann) for _ in range(6)]
    # Eight, of which she has as many as she leaves; her own oldest have ended.
    assert [status(each) for each in (mine, *hers)] == [200, 401, 401, 200, 200, 200, 200]
    his = [cookie(bob) for _ in range(5)]
    assert [status(each) for each in (mine, *hers[2:], *his)] == [200] * 5 + [401] * 3 + [200] * 2
    # Those of a key that has ended have room for others.
    ring.revoke("Ann")
    assert [status(each) for each in [cookie(bob) for _ in range(2)] + his[3:]] == [200] * 4
    ring.revoke("Bob")


@pytest.mark.slow
def test_idempotency_keys_belong_to_a_key(served: ServedBench, ring: KeyRing, client: TestClient) -> None:
    # Two programs that count 1, 2, 3 do not take each other's scans.
    ann = stranger(served, ring.add("Ann", [KeyScope.SCAN]))
    mine = client.post("/scan", headers={"Idempotency-Key": "1"}).json()
    ended(client, mine["id"])
    hers = ann.post("/scan", headers={"Idempotency-Key": "1"}).json()
    assert hers["id"] != mine["id"]
    assert ann.post("/scan", headers={"Idempotency-Key": "1"}).json()["id"] == hers["id"]
    ended(client, hers["id"])
    ring.revoke("Ann")


@pytest.mark.usefixtures("client")
def test_a_session_ends_with_its_time_and_with_its_key(
    served: ServedBench, ring: KeyRing, monkeypatch: pytest.MonkeyPatch
) -> None:
    browser = stranger(served)
    ann = ring.add("Ann", [])
    browser.post("/session", headers={"Authorization": f"Bearer {ann}"})
    assert browser.get("/scan").status_code == 200
    link = sessions(served).link("Ann", digest(ann))
    ring.revoke("Ann")
    assert browser.get("/scan").status_code == 401
    # Nor do session and link live again with the next key of that name, which may do more.
    ring.add("Ann", list(KeyScope))
    assert browser.get("/scan").status_code == 401
    assert stranger(served).get(f"{LINK_PATH}?token={link}", follow_redirects=True).status_code == 401
    ring.revoke("Ann")
    other = logged_in(served)
    now = sessions(served)._clock()
    monkeypatch.setattr(sessions(served), "_clock", lambda: now + timedelta(hours=12))
    assert "The session is over." in other.get("/scan").json()["detail"]


FOREIGN_PAGES = (
    {"Sec-Fetch-Site": "cross-site"},
    {"Sec-Fetch-Site": "same-site", "Origin": "http://127.0.0.1:3000"},
    {"Origin": "https://evil.example"},
    {"Origin": "null"},
    {"Origin": "http://127.0.0.1:3000"},
    {"Origin": "http://127.0.0.1.evil.example"},
    {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"},
)


@pytest.mark.parametrize("keyed", [True, False])
def test_requests_of_a_foreign_page_move_nothing(client: TestClient, served: ServedBench, keyed: bool) -> None:
    browser = logged_in(served) if keyed else TestClient(create_app(served.service, ring=None), base_url=HERE)
    before = client.get("/scan").json()
    for headers in FOREIGN_PAGES:
        for method, path in (("POST", "/scan"), ("POST", "/session"), ("GET", "/preview/cam0?light=white")):
            assert refusal(browser, method, path, headers=headers) == (403, "/problems/foreign-page"), (path, headers)
        # A link on another page may lead here; nothing else of it may read.
        assert browser.get("/scan", headers=headers).status_code == (200 if "Sec-Fetch-Mode" in headers else 403)
    assert client.get("/scan").json() == before


def test_picture_that_moves_light_says_which_page_it_is_on(client: TestClient, served: ServedBench) -> None:
    # Browsers send neither Sec-Fetch-Site nor Origin with a picture of an address that is neither local nor encrypted.
    browser = logged_in(served)
    path = "/preview/none?light=white"
    for headers, status in (({}, 403), ({"Referer": f"{HERE}:3000/"}, 403), ({"Referer": f"{HERE}/docs"}, 404)):
        assert browser.get(path, headers=headers).status_code == status
    assert client.get(path).status_code == 404


def test_programs_of_the_same_user_here_need_no_key_as_long_as_the_service_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.delenv(KEY_VARIABLE, raising=False)
    ring = KeyRing(tmp_path / "keys.json")

    def sent(url: str) -> str | None:
        with Connection(url).http as mine:
            return mine.headers.get("authorization")

    with local_key(8731) as key:
        assert key is not None
        ring.admit(key)
        found = ring.find(key)
        assert found is not None
        assert (found.name, set(found.scopes)) == ("local", set(KeyScope))
        assert ring.everybody == ()
        path = local_key_path(8731)
        assert (path.stat().st_mode & 0o777, path.parent.stat().st_mode & 0o777) == (0o600, 0o700)
        assert sent("http://127.0.0.1:8731") == sent("http://localhost:8731") == f"Bearer {key}"
        # The key is sent neither to another service nor to another machine.
        assert sent("http://127.0.0.1:8732") is sent("http://192.0.2.1:8731") is None
        with pytest.raises(ConfigError, match="of the name 'local' already"):
            ring.add("local", [])
    assert sent("http://127.0.0.1:8731") is None
    monkeypatch.setenv("XDG_STATE_HOME", "/proc")
    with local_key(8731) as key:
        assert key is None


def test_own_pages_and_programs_are_served(client: TestClient, served: ServedBench) -> None:
    browser = logged_in(served)
    for headers in (OWN_PAGE, {"Origin": HERE}, {"Sec-Fetch-Site": "none"}):
        assert browser.get("/scan", headers=headers).status_code == 200
        scan = browser.post("/scan", headers=headers)
        assert scan.status_code == 202
        ended(client, scan.json()["id"])


def test_name_of_the_key_is_on_record(client: TestClient, served: ServedBench, ring: KeyRing) -> None:
    scan = stranger(served, ring.add("Ann", [KeyScope.SCAN])).post("/scan").json()
    assert scan["requested_by"] == "Ann"
    assert ended(client, scan["id"])["requested_by"] == "Ann"
    assert stranger(served, ring.add("Bob", [])).post("/scan").status_code == 403
    entries: list[dict[str, Any]] = client.get("/audit?limit=2").json()["entries"]
    assert [(each["who"], each["method"], each["path"], each["status"], each["made"]) for each in entries] == [
        ("Bob", "POST", "/scan", 403, ""),
        ("Ann", "POST", "/scan", 202, f"/scan/{scan['id']}"),
    ]
    older = client.get(client.get("/audit?limit=1").json()["next"]).json()["entries"]
    assert older[0]["who"] == "Ann"
    # Strangers and readers are not on it.
    before = client.get("/audit").json()
    stranger(served).post("/scan")
    client.get("/scan")
    assert client.get("/audit").json() == before


@pytest.mark.usefixtures("client")
def test_too_many_requests_of_one_name_wait(
    served: ServedBench, ring: KeyRing, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = served.service.settings.model_copy(update={"requests_per_s": 1.0})
    monkeypatch.setattr(served.service, "settings", slow)
    monkeypatch.setattr(access, "Rates", partial(access.Rates, clock=lambda: 0.0))
    app = create_app(served.service, ring=ring)
    ann = TestClient(app, base_url=HERE, headers={"X-API-Key": ring.add("Ann", [])})
    bob = TestClient(app, base_url=HERE, headers={"X-API-Key": ring.add("Bob", [])})
    statuses = [ann.get("/session").status_code for _ in range(12)]
    assert (statuses[0], statuses[-2:]) == (200, [429, 429])
    # It is put on record, and does not fill that.
    assert [each.status for each in served.service.audit.page(before=None, limit=3) if each.who == "Ann"] == [429]
    assert ann.get("/session").headers["Retry-After"] == "1"
    assert bob.get("/session").status_code == 200
    unknown = [TestClient(app, base_url=HERE).get("/scan").status_code for _ in range(8)]
    assert (unknown[0], unknown[-1]) == (401, 429)
    # Behind a proxy a monitor has the address of all strangers.
    probes = [TestClient(app, base_url=HERE).get(path).status_code for path in ("/livez", "/readyz", "/")]
    assert probes == [200, 200, 429]


@on_loop
async def test_request_too_many_waits_for_its_refusal_where_few_do(
    served: ServedBench, ring: KeyRing, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access, "_HELD_S", 3600.0)
    monkeypatch.setattr(access, "_MOST_HELD", 2)
    guarded = Access(broken, ring=ring, sessions=sessions(served), audit=served.service.audit, per_second=1e-9)
    headers = [(b"x-api-key", ring.add("Ann", []).encode())]
    scope = {"type": "http", "method": "GET", "path": "/scan", "headers": headers, "client": ("127.0.0.1", 1)}
    sent = list[Any]()

    async def send(message: Any) -> None:
        sent.append(message)

    async def nothing() -> Any:
        return {"type": "http.disconnect"}

    with pytest.raises(ZeroDivisionError):
        await guarded(scope, nothing, send)
    sent.clear()
    waiting = asyncio.ensure_future(guarded(scope, nothing, send))
    while not guarded._held.taken:
        await asyncio.to_thread(int)
    await guarded(scope, nothing, send)
    assert (sent[0]["status"], waiting.done()) == (429, False)
    waiting.cancel()
    await asyncio.wait([waiting])
    assert not guarded._held.taken


def test_rates_come_back_with_time_and_forget_the_oldest(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    rates = Rates(2, clock=lambda: now)
    for _ in range(8):
        rates.count("ann", "ann")
    with pytest.raises(Refused):
        rates.count("ann", "ann")
    now = 1.0
    rates.count("ann", "ann")
    rates.count("ann", "ann")
    with pytest.raises(Refused):
        rates.count("ann", "ann")
    monkeypatch.setattr(access, "_MOST_COUNTED", 10)
    for number in range(100):
        rates.count(f"name {number}", f"name {number}")
    assert len(rates._left) <= 10


def test_every_answer_has_headers_that_protect_browsers(client: TestClient, served: ServedBench) -> None:
    for response in (client.get("/scan"), client.get("/docs"), stranger(served).get("/scan"), client.get("/nothing")):
        assert response.headers["X-Content-Type-Options"] == "nosniff"
        assert "frame-ancestors 'none'" in response.headers["Content-Security-Policy"]
        assert response.headers["Cross-Origin-Resource-Policy"] == "same-origin"
        assert response.headers["Referrer-Policy"] == "same-origin"
        assert response.headers["Cache-Control"] == "no-store"


def test_the_description_is_a_page_of_our_own(client: TestClient, served: ServedBench) -> None:
    page = client.get("/docs").text
    assert "http" not in page.replace("<!doctype html>", "")
    for part in ("swagger-ui-bundle.js", "swagger-ui.css", "favicon.png", "start.js"):
        assert f"/docs/{part}" in page
        assert client.get(f"/docs/{part}").status_code == 200
        assert stranger(served).get(f"/docs/{part}").status_code == 401
    led = stranger(served).get("/docs", headers={"Accept": "text/html,*/*"}, follow_redirects=False)
    assert (led.status_code, led.headers["location"]) == (303, "/")


def test_the_description_says_what_its_page_lacks(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slrig.api.app.find_spec", lambda _: None)
    answer = client.get("/docs")
    assert (answer.status_code, "pip install 'slrig[docs]'" in answer.json()["detail"]) == (404, True)


def test_damaged_file_of_keys_is_a_storage_problem(client: TestClient, served: ServedBench) -> None:
    path = served.service.settings.key_path
    path.write_text("{}")
    try:
        assert refusal(client, "GET", "/scan") == (507, "/problems/storage")
    finally:
        path.unlink()
