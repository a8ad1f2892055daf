"""Half-sent requests, slow bodies and event streams by the thousand.

Meanwhile a scan runs to its end, probes are answered, the log stays short, and descriptors are left for the rig.
"""

from __future__ import annotations

import resource
import socket
from contextlib import ExitStack, closing
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from slrig.api.server import KEPT_DESCRIPTORS, WANTED_DESCRIPTORS
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
