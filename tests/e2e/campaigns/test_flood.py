"""Half-sent requests, slow bodies and event streams by the thousand; and all that a key that may only look can ask for.

Meanwhile scans run to their ends, probes are answered, the log stays short, and descriptors are left for the rig.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import resource
import socket
import threading
import time
from collections import Counter
from contextlib import ExitStack, closing, suppress
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from urllib.parse import urlsplit

import httpx2
import pytest

from slrig.api.auth import KeyRing
from slrig.api.scopes import KeyScope
from slrig.api.server import KEPT_DESCRIPTORS, WANTED_DESCRIPTORS
from slrig.scan.artefacts import ON_REQUEST
from tests.e2e.conftest import KEY, SLOW, ServiceProcess, Start, ended, followed_to, write_rig

pytestmark = pytest.mark.slow

HALF_OPEN, SLOW_BODIES, STREAMS = 2000, 500, 1000
MOST_LOG_BYTES = 2**20


def request(service: ServiceProcess, path: str) -> HTTPConnection:
    parts = urlsplit(service.url)
    connection = HTTPConnection(str(parts.hostname), parts.port, timeout=30)
    connection.request("GET", path, headers={"Authorization": f"Bearer {KEY}"})
    return connection


def answers(service: ServiceProcess) -> None:
    with closing(request(service, "/livez")) as connection:
        assert connection.getresponse().status == 200


def test_a_scan_succeeds_beside_a_flood_of_connections(start: Start, tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard < HALF_OPEN + SLOW_BODIES + STREAMS + 256:
        pytest.skip(f"this machine allows {hard} open files, too few to be the stranger")
    with ExitStack() as held:
        held.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        # The service starts with the limit that systems give.
        resource.setrlimit(resource.RLIMIT_NOFILE, (1024, hard))
        service = start(write_rig(tmp_path / "rig", head=SLOW))
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        address = (urlsplit(service.url).hostname, urlsplit(service.url).port)
        with service.client() as client:
            scan = client.scans.start()
            followed_to(client, scan, "capture")
            head = f"POST /scan HTTP/1.1\r\nHost: {address[0]}\r\nAuthorization: Bearer {KEY}\r\n"
            for number in range(HALF_OPEN + SLOW_BODIES):
                stranger = held.enter_context(socket.create_connection(address, timeout=10))
                slow_body = number >= HALF_OPEN
                stranger.sendall(f"{head}Content-Length: 9\r\n\r\n{{".encode() if slow_body else head.encode())
                if number % 250 == 0:
                    answers(service)
            streams = []
            for _ in range(STREAMS):
                streams.append(request(service, scan["links"]["events"]))
                held.callback(streams[-1].close)
            answers(service)
            statuses = []
            for stream in streams:
                try:
                    statuses.append(stream.getresponse().status)
                except (HTTPException, OSError):
                    statuses.append(0)  # it made room for another
            answers(service)
            descriptors = len(list(Path(f"/proc/{service.process.pid}/fd").iterdir()))
            # 503 is for a connection that makes room, if it still listens.
            assert set(statuses) <= {0, 200, 429, 503}
            final = ended(client, scan)
        assert final["state"] == "succeeded", final
        assert service.log.stat().st_size < MOST_LOG_BYTES
        assert descriptors < min(WANTED_DESCRIPTORS, hard) - KEPT_DESCRIPTORS


GREEDY_STREAMS = 200
SCANS = 8
GONE_S = 15.0
"""How long a key that was revoked may still be told something."""


def greedy(url: str, key: str, scans: list[str]) -> None:
    """Ask for all that a key may look at, as fast as it is answered or refused, until this process is ended."""
    # As from a machine of its own: what it takes of this one is not the service's.
    os.nice(10)
    headers = {"X-API-Key": key}

    def ask(method: str, *paths: str) -> None:
        with httpx2.Client(base_url=url, headers=headers, timeout=60) as client:
            for path in itertools.cycle(paths):
                with suppress(httpx2.HTTPError):
                    client.request(method, path)

    def follow() -> None:
        parts = urlsplit(url)
        with ExitStack() as opened:
            for _ in range(GREEDY_STREAMS):
                connection = HTTPConnection(str(parts.hostname), parts.port, timeout=60)
                opened.callback(connection.close)
                connection.request("GET", "/events", headers=headers)
            threading.Event().wait()

    files = [f"{scan}/{name}" for scan in scans for name in ON_REQUEST]
    boards = [f"/calibration/board.pdf?square_mm={size}" for size in range(5, 15)]
    work = [("POST", "/session"), ("GET", "/device"), ("GET", "/scan?limit=200", "/metrics"), ("GET", *boards)]
    threads = [threading.Thread(target=ask, args=each, daemon=True) for each in [*work, *[("GET", *files)] * 6]]
    for thread in threads:
        thread.start()
    follow()


class Person:
    """Somebody who scans and looks at it. answers : by status. slowest_s : of all."""

    def __init__(self, service: ServiceProcess, key: str) -> None:
        self.http = httpx2.Client(base_url=service.url, headers={"X-API-Key": key}, timeout=60)
        self.answers, self.slowest_s = Counter[int](), 0.0

    def ask(self, method: str, path: str, **body: str) -> httpx2.Response:
        begun_s = time.monotonic()
        answer = self.http.request(method, path, json=body or None)
        self.slowest_s = max(self.slowest_s, time.monotonic() - begun_s)
        self.answers[answer.status_code] += 1
        return answer

    def close(self) -> None:
        self.http.close()

    def scans(self, count: int) -> tuple[float, list[str]]:
        """Seconds that so many scans take, one after the other, and the state of each."""
        begun_s, states = time.monotonic(), []
        for _ in range(count):
            path = self.ask("POST", "/scan", if_busy="queue").json()["links"]["self"]
            while (state := self.ask("GET", path).json()["state"]) not in {"succeeded", "failed"}:
                self.ask("GET", "/readyz")
                time.sleep(0.05)
            self.ask("GET", f"{path}/mesh.stl")
            states.append(state)
        return time.monotonic() - begun_s, states


def test_a_key_that_may_only_look_takes_nothing_from_others(start: Start, tmp_path: Path) -> None:
    service = start(write_rig(tmp_path / "rig", head=SLOW), SLRIG_REQUESTS_PER_S="50")
    ring = KeyRing(service.data / "keys.json")
    ann, look = ring.add("Ann", [KeyScope.SCAN]), ring.add("Look", [])
    with ExitStack() as held:
        browser = held.enter_context(httpx2.Client(base_url=service.url))
        browser.post("/session", headers={"X-API-Key": ann})
        first, alone, beside = (held.enter_context(closing(Person(service, ann))) for _ in range(3))
        # Until the worker is ready probes say so.
        first.scans(2)
        finished = [scan["links"]["self"] for scan in alone.ask("GET", "/scan").json()["scans"]]
        alone_s, states = alone.scans(SCANS)
        stranger = multiprocessing.get_context("spawn").Process(target=greedy, args=(service.url, look, finished))
        stream = held.enter_context(httpx2.Client(base_url=service.url, headers={"X-API-Key": look}, timeout=60))
        silent = held.enter_context(stream.stream("GET", "/events"))
        assert silent.status_code == 200
        stranger.start()
        held.callback(stranger.kill)
        beside_s, more = beside.scans(SCANS)
        assert browser.get("/session").json()["name"] == "Ann"
        ring.revoke("Look")
        again, begun_s = ring.add("Look", []), time.monotonic()
        with suppress(httpx2.HTTPError):
            for _ in silent.iter_raw():
                assert time.monotonic() - begun_s < GONE_S
        assert time.monotonic() - begun_s < GONE_S
        assert httpx2.get(f"{service.url}/scan", headers={"X-API-Key": look}).status_code in {401, 429}
        assert httpx2.get(f"{service.url}/scan", headers={"X-API-Key": again}).status_code == 200
    print(  # noqa: T201
        f"\n{SCANS} scans: {alone_s:.1f} s alone, {beside_s:.1f} s beside ({beside_s / alone_s - 1:+.0%}); slowest "
        f"request {alone.slowest_s:.2f} s and {beside.slowest_s:.2f} s; {beside.answers.total()} answers, a stream of "
        f"the revoked key ended after {time.monotonic() - begun_s:.1f} s"
    )
    assert {*states, *more} == {"succeeded"}
    assert set(alone.answers + beside.answers) == {200, 202}, (alone.answers, beside.answers)
