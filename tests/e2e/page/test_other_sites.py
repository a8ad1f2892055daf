"""What pages of other sites may not do with the service, in a real browser."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import pytest

from tests.e2e.conftest import KEY, ServiceProcess, scanned, serving, write_rig

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext

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


class _Blank(BaseHTTPRequestHandler):
    """An empty page of another site."""

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


@pytest.mark.parametrize("keyed", [True, False], ids=["cookie", "no key"])
def test_pages_of_other_sites_move_neither_light_nor_rig(tmp_path: Path, browser: Browser, keyed: bool) -> None:
    settings = {} if keyed else {"SLRIG_REQUIRE_KEY": "false"}
    with serving(write_rig(tmp_path / "rig"), tmp_path / "data", **settings) as service:
        context = browser.new_context()
        context.set_default_timeout(_LIMIT_MS)
        attack(service, context, keyed=keyed)
        context.close()


def attack(service: ServiceProcess, context: BrowserContext, *, keyed: bool) -> None:
    with service.client() as client:
        scan = scanned(client)["links"]["self"]
    page = context.new_page()
    if keyed:
        # As the page of the service does.
        page.goto(f"{service.url}/livez")
        sent = (
            "key => fetch('/session', {method: 'POST', headers: {Authorization: `Bearer ${key}`}}).then(r => r.status)"
        )
        assert page.evaluate(sent, KEY) == 201
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
            # A link that a person follows.
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
