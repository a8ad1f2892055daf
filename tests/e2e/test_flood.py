"""What strangers cannot do to a scan: half-sent requests, slow bodies and event streams by the thousand, and no key.

Beside them a scan runs to its end, probes are answered, the log stays short, and descriptors are left for the rig.
"""

from __future__ import annotations

import resource
import socket
import statistics
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from slrig.api.connections import KEPT_DESCRIPTORS, WANTED_DESCRIPTORS
from tests.e2e.conftest import KEY, ServiceProcess, Start, write_rig
from tests.e2e.test_survival import SLOW, ended, followed_to

pytestmark = pytest.mark.slow

HALF_OPEN, SLOW_BODIES, STREAMS = 2000, 500, 1000
MOST_LOG_BYTES = 2**20
MOST_ANSWER_S = 2.0


@contextmanager
def many_descriptors() -> Iterator[None]:
    """This process, the stranger, may have enough sockets open for the while."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard < HALF_OPEN + SLOW_BODIES + STREAMS + 256:
        pytest.skip(f"this machine allows {hard} open files, too few to be the stranger")
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def request(service: ServiceProcess, path: str, key: str | None) -> HTTPConnection:
    """A connection with the answer to a GET on its way."""
    parts = urlsplit(service.url)
    connection = HTTPConnection(str(parts.hostname), parts.port, timeout=30)
    connection.request("GET", path, headers={} if key is None else {"Authorization": f"Bearer {key}"})
    return connection


def answer_s(service: ServiceProcess) -> float:
    """How long /livez takes, from connecting on."""
    began = time.monotonic()
    with closing(request(service, "/livez", KEY)) as connection:
        assert connection.getresponse().status == 200
    return time.monotonic() - began


def test_a_scan_succeeds_beside_a_flood_of_connections(start: Start, tmp_path: Path) -> None:
    with many_descriptors(), ExitStack() as held:
        # The service starts with the limit that systems give.
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (1024, hard))
        service = start(write_rig(tmp_path / "rig", head=SLOW), fresh=True)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        address = (urlsplit(service.url).hostname, urlsplit(service.url).port)
        with service.client() as client:
            scan = client.scans.start()
            followed_to(client, scan, "capture")
            waits_s = []
            head = f"POST /scan HTTP/1.1\r\nHost: {address[0]}\r\nAuthorization: Bearer {KEY}\r\n"
            for number in range(HALF_OPEN + SLOW_BODIES):
                stranger = held.enter_context(socket.create_connection(address, timeout=10))
                slow_body = number >= HALF_OPEN
                stranger.sendall(f"{head}Content-Length: 9\r\n\r\n{{".encode() if slow_body else head.encode())
                if number % 250 == 0:
                    waits_s.append(answer_s(service))
            streams = []
            for _ in range(STREAMS):
                streams.append(request(service, scan["links"]["events"], KEY))
                held.callback(streams[-1].close)
            waits_s.append(answer_s(service))
            statuses = []
            for stream in streams:
                try:
                    statuses.append(stream.getresponse().status)
                except (HTTPException, OSError):
                    statuses.append(0)  # it made room for another
            waits_s.append(answer_s(service))
            descriptors = len(list(Path(f"/proc/{service.process.pid}/fd").iterdir()))
            # 503 is what a connection is told that makes room, if it still hears it.
            assert set(statuses) <= {0, 200, 429, 503}
            final = ended(client, scan)
        assert final["state"] == "succeeded", final
        assert max(waits_s) < MOST_ANSWER_S
        assert service.log.stat().st_size < MOST_LOG_BYTES
        assert descriptors < min(WANTED_DESCRIPTORS, hard) - KEPT_DESCRIPTORS
        print(  # noqa: T201 - figures of the bench
            f"\n/livez {statistics.median(waits_s) * 1000:.1f} ms median, {max(waits_s) * 1000:.0f} ms at most; "
            f"log {service.log.stat().st_size} bytes; {descriptors} descriptors; streams "
            f"{ {status: statuses.count(status) for status in sorted(set(statuses))} }"
        )


def test_requests_on_one_connection_do_not_wait(start: Start, tmp_path: Path) -> None:
    service = start(write_rig(tmp_path / "rig"))
    parts = urlsplit(service.url)
    connection = HTTPConnection(str(parts.hostname), parts.port, timeout=30)
    times_s = []
    for _ in range(300):
        began = time.perf_counter()
        connection.request("GET", "/livez", headers={"Authorization": f"Bearer {KEY}"})
        connection.getresponse().read()
        times_s.append(time.perf_counter() - began)
    connection.close()
    print(f"\nGET /livez {1000 * statistics.median(times_s):.2f} ms")  # noqa: T201 - a figure of the bench
    # With Nagle's delay each takes 40 ms and more, however fast the machine.
    assert statistics.median(times_s) < 0.02
