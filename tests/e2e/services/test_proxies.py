"""TLS before a real service, by the recipes of config/deploy: nothing is held back, cut, or let in."""

from __future__ import annotations

import json
import os
import shutil
import socket
import ssl
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx2
import pytest

from slrig.api.calibration import MOST_IMPORT_BYTES
from slrig.client import Client
from slrig.client.connection import Progress
from tests.e2e.conftest import KEY, SLOW, ServiceProcess, ended, serving, write_rig
from tests.listening import free_port
from tests.npm import lacking

pytestmark = pytest.mark.slow

DEPLOY = Path(__file__).resolve().parents[3] / "config" / "deploy"
NAME = "scanner.example"
START_LIMIT_S = 20.0
WITH_KEY = {"X-API-Key": KEY}


class ToThisMachine(httpx2.HTTPTransport):
    """Finds the proxy on this machine, as its name would on a network."""

    def handle_request(self, request: httpx2.Request) -> httpx2.Response:
        """See `httpx2.HTTPTransport`."""
        request.extensions["sni_hostname"] = request.url.host
        request.url = request.url.copy_with(host="127.0.0.1")
        return super().handle_request(request)


@dataclass(frozen=True)
class Proxied:
    """A service, and where the proxy before it listens. authority : the certificate that its clients trust."""

    service: ServiceProcess
    port: int
    authority: Path

    @property
    def url(self) -> str:
        return f"https://{NAME}:{self.port}"

    def transport(self) -> ToThisMachine:
        return ToThisMachine(verify=ssl.create_default_context(cafile=str(self.authority)))

    def http(self) -> httpx2.Client:
        return httpx2.Client(base_url=self.url, transport=self.transport(), timeout=30)

    def client(self) -> Client:
        return Client(self.url, KEY, transport=self.transport())


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("openssl") is None:
        lacking("needs openssl: apt install openssl")
    folder = tmp_path_factory.mktemp("tls")
    made = subprocess.run(  # noqa: S603
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2",  # noqa: S607
         "-subj", f"/CN={NAME}", "-addext", f"subjectAltName=DNS:{NAME}",
         "-keyout", folder / "key.pem", "-out", folder / "certificate.pem"],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    return folder / "certificate.pem"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    folder = tmp_path_factory.mktemp("proxied")
    rig = write_rig(folder / "rig", head=SLOW)
    with serving(rig, folder / "data", SLRIG_ALLOWED_HOSTS=NAME) as service:
        yield service


def recipe(name: str, service: ServiceProcess, authority: Path, port: int, *changes: tuple[str, str]) -> str:
    """A recipe as it is, but for addresses and files of this test; each change has a place in it."""
    text = (DEPLOY / name).read_text(encoding="utf-8")
    for old, new in (
        ("127.0.0.1:8731", service.url.removeprefix("http://")),
        ("/etc/slrig/tls", str(authority.parent)),
        *((old, new.format(port=port)) for old, new in changes),
    ):
        assert old in text, old
        text = text.replace(old, new)
    return text


def nginx(folder: Path, service: ServiceProcess, authority: Path, port: int) -> list[str]:
    changes = (("listen 443", "listen 127.0.0.1:{port}"), ("listen [::]:443", "listen [::1]:{port}"))
    (folder / "slrig.conf").write_text(recipe("nginx.conf", service, authority, port, *changes))
    kinds = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    temporary = "".join(f"{kind}_temp_path {folder}/{kind};\n" for kind in kinds)
    # As Debian's own main file does: what is in conf.d belongs to http.
    (folder / "nginx.conf").write_text(
        f"{'user root;' if os.geteuid() == 0 else ''} daemon off; pid {folder}/pid; error_log stderr;\n"
        f"events {{}} http {{ access_log off; {temporary} include {folder}/slrig.conf; }}"
    )
    return ["nginx", "-p", str(folder), "-e", "stderr", "-c", str(folder / "nginx.conf")]


def caddy(folder: Path, service: ServiceProcess, authority: Path, port: int) -> list[str]:
    # No port for its administration, and none for redirections from port 80.
    own = "{{\n\tadmin off\n\tauto_https disable_redirects\n\tservers {{"
    changes = (("{\n\tservers {", own), (f"{NAME} {{", f"{NAME}:{{port}} {{{{"))
    (folder / "Caddyfile").write_text(recipe("Caddyfile", service, authority, port, *changes))
    return ["caddy", "run", "--adapter", "caddyfile", "--config", str(folder / "Caddyfile")]


@pytest.fixture(scope="module", params=[nginx, caddy], ids=lambda proxy: proxy.__name__)
def proxied(
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
    service: ServiceProcess,
    authority: Path,
) -> Iterator[Proxied]:
    proxy: Callable[..., list[str]] = request.param
    if shutil.which(proxy.__name__) is None:
        lacking(f"needs {proxy.__name__}: apt install {proxy.__name__}")
    folder, port = tmp_path_factory.mktemp(proxy.__name__), free_port()
    command = proxy(folder, service, authority, port)
    environment = {**os.environ, "HOME": str(folder), "XDG_DATA_HOME": str(folder), "XDG_CONFIG_HOME": str(folder)}
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)  # noqa: S603
    try:
        give_up = time.monotonic() + START_LIMIT_S
        while True:
            with socket.socket() as tried:
                if tried.connect_ex(("127.0.0.1", port)) == 0:
                    break
            assert process.poll() is None, (folder / "log").read_text()
            assert time.monotonic() < give_up, (folder / "log").read_text()
            time.sleep(0.05)
        yield Proxied(service, port, authority)
    finally:
        process.terminate()
        process.wait(START_LIMIT_S)


def test_scan_is_followed_as_it_happens_and_its_files_come_whole(proxied: Proxied, tmp_path: Path) -> None:
    with proxied.client() as client, proxied.service.client() as direct:
        scan = client.scans.start()
        for event in client.follow(scan["links"]["events"]):
            if isinstance(event, Progress) and event.stage == "capture":
                # A proxy that holds events back would give this one when the scan is over.
                assert direct.get(scan["links"]["self"])["state"] == "capturing"
                break
        else:
            pytest.fail("the scan reported no capture")
        record = ended(direct, scan)
        assert record["state"] == "succeeded"
        for name in ("mesh.ply", "bundle.zip"):
            path = record["links"]["files"][name]
            client.fetch(path, tmp_path / "through")
            direct.fetch(path, tmp_path / "direct")
            assert (tmp_path / "through").read_bytes() == (tmp_path / "direct").read_bytes()
            assert (tmp_path / "direct").stat().st_size > 100_000


def test_pictures_of_a_preview_come_one_by_one(proxied: Proxied) -> None:
    with proxied.http() as http, http.stream("GET", "/preview/left", headers=WITH_KEY) as answer:
        assert answer.status_code == 200
        came = 0
        for part in answer.iter_raw():
            came += part.count(b"Content-Type: image/jpeg") + part.count(b"content-type: image/jpeg")
            if came >= 2:
                break
    assert came >= 2


def test_forged_headers_open_nothing(proxied: Proxied) -> None:
    forged = {
        "Forwarded": "for=127.0.0.1;host=localhost;proto=http",
        "X-Forwarded-For": "127.0.0.1",
        "X-Forwarded-Host": "localhost",
        "X-Real-IP": "127.0.0.1",
        "X-Forwarded-Proto": "http",
    }
    with proxied.http() as http:
        assert http.get("/livez").status_code == 200
        for headers in ({}, forged, {"X-API-Key": "another key of 16"}):
            refused = http.get("/scan", headers=headers)
            assert refused.status_code == 401
            assert refused.headers["content-type"] == "application/problem+json"
        assert http.get("/scan", headers=WITH_KEY | forged).status_code == 200
        # By another name neither the proxy nor the service answers.
        other = http.get("/livez", headers={"Host": "elsewhere.example"})
        assert other.status_code >= 400 or "ok" not in other.text
    without_tls = b"GET /livez HTTP/1.1\r\nHost: %b\r\n\r\n" % NAME.encode()
    with socket.create_connection(("127.0.0.1", proxied.port), timeout=10) as plain:
        plain.sendall(without_tls)
        assert b" 400 " in plain.recv(4096)


def test_a_body_is_refused_by_the_service_which_says_why(proxied: Proxied) -> None:
    with proxied.http() as http:
        for length, status in ((MOST_IMPORT_BYTES - 64, {400, 422}), (MOST_IMPORT_BYTES + 1, {413})):
            body = b" " * length
            headers = WITH_KEY | {"Content-Type": "application/json"}
            answer = http.post("/calibration/import", content=body, headers=headers)
            assert answer.status_code in status, answer.text
            assert json.loads(answer.text)["type"].startswith("/problems/")


@pytest.mark.parametrize("proxied", [nginx], indirect=True)
def test_strangers_have_a_rate_at_nginx_and_keys_have_their_own(proxied: Proxied) -> None:
    with proxied.http() as http:
        assert any(http.get("/livez").status_code == 429 for _ in range(2000))
        assert {http.get("/scan", headers=WITH_KEY).status_code for _ in range(20)} == {200}
