"""The service in a real browser: what its own pages may do, and what the pages of others may not."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import pytest

from tests.e2e.conftest import KEY, ServiceProcess, Start, write_rig
from tests.e2e.test_survival import ended

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, Page

pytestmark = pytest.mark.slow

_LIMIT_MS = 20_000

# Each way in which a page can have a browser send something; what the browser or the service refuses is no error here.
_ATTACK = """async ([service, scan]) => {
  const tried = [];
  const attempt = async (name, action) => {
    try { tried.push([name, String(await action())]); } catch (error) { tried.push([name, String(error)]); }
  };
  const settled = (element, begin) => new Promise((resolve) => {
    element.onload = () => resolve("loaded"); element.onerror = () => resolve("refused");
    begin(element); document.body.append(element); setTimeout(() => resolve("nothing"), 1500);
  });
  const form = (path, method, type) => settled(document.createElement("iframe"), (frame) => {
    frame.name = `frame-${tried.length}`;
    const sent = document.createElement("form");
    Object.assign(sent, {action: service + path, method, enctype: type, target: frame.name});
    document.body.append(sent); setTimeout(() => sent.submit(), 50);
  });
  const send = (path, options) => fetch(service + path, {credentials: "include", ...options});
  for (const type of ["application/x-www-form-urlencoded", "text/plain", "multipart/form-data"])
    await attempt(`form ${type}`, () => form("/scan", "post", type));
  await attempt("form GET preview", () => form("/preview/left", "get", "text/plain"));
  await attempt("fetch no-cors", () => send("/scan", {method: "POST", mode: "no-cors"}));
  await attempt("fetch text", () => send("/scan", {method: "POST", mode: "no-cors", body: "{}"}));
  await attempt("fetch JSON", () => send("/scan", {
    method: "POST", headers: {"Content-Type": "application/json"}, body: "{}"}));
  await attempt("fetch DELETE", () => send(scan, {method: "DELETE"}));
  await attempt("fetch reading", async () => (await send("/scan", {})).text());
  await attempt("beacon", () => navigator.sendBeacon(service + "/scan", "{}"));
  await attempt("img preview", () => settled(new Image(), (image) => {
    image.src = service + "/preview/left?light=white";}));
  await attempt("img picture", () => settled(new Image(), (image) => {
    image.src = service + scan + "/preview.png";}));
  await attempt("frame", () => settled(document.createElement("iframe"), (frame) => {
    frame.src = service + "/preview/left?light=white";}));
  await attempt("script", () => settled(document.createElement("script"), (script) => {
    script.src = service + "/preview/left?light=white";}));
  await attempt("EventSource", () => new Promise((resolve) => {
    const source = new EventSource(service + scan + "/events", {withCredentials: true});
    source.onmessage = source.onopen = () => resolve("opened"); source.onerror = () => {
      source.close(); resolve("refused");};
  }));
  await attempt("WebSocket", () => new Promise((resolve) => {
    const socket = new WebSocket(service.replace("http", "ws") + "/preview/left?light=white");
    socket.onopen = () => resolve("opened"); socket.onerror = () => resolve("refused");
  }));
  return tried;
}"""

_OWN_PAGE = """async (scan) => {
  const image = new Image();
  const shown = await new Promise((resolve) => {
    image.onload = () => resolve(image.naturalWidth); image.onerror = () => resolve(0);
    image.src = scan + "/preview.png";
  });
  const preview = await new Promise((resolve) => {
    const moving = new Image();
    moving.onload = () => { const width = moving.naturalWidth; moving.src = ""; resolve(width); };
    moving.onerror = () => resolve(0);
    moving.src = "/preview/left?light=white";
  });
  const events = await new Promise((resolve) => {
    const source = new EventSource(scan + "/events"), seen = [];
    source.addEventListener("state", (event) => {
      seen.push(JSON.parse(event.data).state);
      if (seen.at(-1) === "succeeded") { source.close(); resolve(seen); }
    });
    source.onerror = () => { source.close(); resolve(seen); };
  });
  return {shown, preview, events, cookie: document.cookie};
}"""


class _Blank(BaseHTTPRequestHandler):
    """An empty page of somebody else's."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><title>elsewhere</title><body></body>")

    def log_message(self, *_: object) -> None:
        """Say nothing for each request."""


@contextmanager
def elsewhere() -> Iterator[int]:
    """The port of another web server of this machine."""
    with ThreadingHTTPServer(("127.0.0.1", 0), _Blank) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.server_address[1]
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    """A browser with an empty profile."""
    made = browser.new_context()
    made.set_default_timeout(_LIMIT_MS)
    yield made
    made.close()


def log_in(page: Page, service: ServiceProcess) -> None:
    """Exchange the key for a cookie, as the page of the service does."""
    page.goto(f"{service.url}/livez")
    sent = "key => fetch('/session', {method: 'POST', headers: {Authorization: `Bearer ${key}`}}).then(r => r.status)"
    assert page.evaluate(sent, KEY) == 201


def scanned(service: ServiceProcess) -> str:
    """The path of a scan that succeeded."""
    with service.client() as client:
        scan = ended(client, client.scans.start())
    assert scan["state"] == "succeeded"
    path: str = scan["links"]["self"]
    return path


def test_a_page_of_the_service_sees_pictures_events_and_files(
    start: Start, tmp_path: Path, context: BrowserContext
) -> None:
    service = start(write_rig(tmp_path / "rig"))
    scan = scanned(service)
    page = context.new_page()
    log_in(page, service)
    complaints: list[str] = []
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    page.goto(f"{service.url}/docs")
    page.get_by_text("/scan/{scan_id}/events").wait_for()
    assert complaints == []
    page.screenshot(path=str(tmp_path / "docs.png"))
    found = page.evaluate(_OWN_PAGE, scan)
    assert found["shown"] > 0
    assert found["preview"] > 0
    assert found["events"][-1] == "succeeded"
    assert found["cookie"] == ""
    with page.expect_download() as download:
        page.evaluate(
            "path => { const a = document.createElement('a'); a.href = path; a.click(); }", f"{scan}/bundle.zip"
        )
    download.value.save_as(tmp_path / "bundle.zip")
    assert (tmp_path / "bundle.zip").read_bytes().startswith(b"PK")
    assert page.evaluate("() => fetch('/session', {method: 'DELETE'}).then(r => r.status)") == 204
    assert page.evaluate("() => fetch('/scan').then(r => r.status)") == 401


@pytest.mark.parametrize("keyed", [True, False], ids=["cookie", "no key"])
def test_pages_of_others_move_neither_light_nor_rig(
    start: Start, tmp_path: Path, context: BrowserContext, monkeypatch: pytest.MonkeyPatch, keyed: bool
) -> None:
    if not keyed:
        monkeypatch.setenv("SLRIG_REQUIRE_KEY", "false")
    service = start(write_rig(tmp_path / "rig"))
    scan = scanned(service)
    page = context.new_page()
    if keyed:
        log_in(page, service)
    answers: list[tuple[str, str, int]] = []
    context.on("response", lambda got: answers.append((got.request.method, urlsplit(got.url).path, got.status)))
    with elsewhere() as port:
        # The first is another site, the second another service of the same one.
        for foreign in (f"http://localhost:{port}/", f"http://127.0.0.1:{port}/"):
            answers.clear()
            page.goto(foreign)
            tried: dict[str, str] = dict(page.evaluate(_ATTACK, [service.url, scan]))
            assert len(tried) == 16
            for refused in ("fetch reading", "fetch JSON", "fetch DELETE"):
                assert "TypeError" in tried[refused], tried
            for refused in ("img preview", "img picture", "script", "EventSource", "WebSocket"):
                assert tried[refused] == "refused", tried
            moved = [each for each in answers if each[0] not in {"GET", "OPTIONS"} or each[1].startswith("/preview/")]
            assert {each[1] for each in moved} >= {"/scan", "/preview/left"}, answers
            assert {status for _, _, status in moved} <= {401, 403, 415}, moved
            # A link that somebody follows.
            page.goto(foreign)
            page.set_content(f"<a href='{service.url}/preview/left?light=white'>a picture</a>")
            with page.expect_response(f"{service.url}/preview/**") as linked:
                page.get_by_text("a picture").click()
            assert linked.value.status in {401, 403}
    with service.client() as client:
        assert [each["links"]["self"] for each in client.get("/scan")["scans"]] == [scan]
        done: list[dict[str, Any]] = client.get("/audit?limit=200")["entries"]
        assert {each["status"] for each in done if each["path"] == "/scan" and each["status"] != 202} <= {403, 415}
        assert sum(each["status"] == 202 for each in done) == 1
