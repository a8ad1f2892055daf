"""GET /preview/{camera} on the running service: pictures that a browser would show, and a scan that goes first."""

from __future__ import annotations

import json
import urllib.request
from http.client import HTTPResponse
from pathlib import Path
from urllib.error import HTTPError

import cv2
import numpy as np
import pytest

from slrig.model import Pixels
from tests.e2e.conftest import KEY, Start, write_rig

HEADERS = {"Authorization": f"Bearer {KEY}", "Content-Type": "application/json"}


def opened(url: str, *, data: bytes | None = None) -> HTTPResponse:
    request = urllib.request.Request(url, data=data, headers=HEADERS)  # noqa: S310 - loopback
    answer = urllib.request.urlopen(request, timeout=60)  # noqa: S310 - loopback
    assert isinstance(answer, HTTPResponse)
    return answer


def next_picture(stream: HTTPResponse) -> Pixels:
    """The next part of the stream, decoded."""
    length = 0
    while True:
        line = stream.readline()
        assert line, "the stream has ended"
        if line.lower().startswith(b"content-length:"):
            length = int(line.split(b":")[1])
        elif length and line == b"\r\n":
            break
    image = cv2.imdecode(np.frombuffer(stream.read(length), np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image, dtype=np.uint8)


def scanned(url: str) -> None:
    """Scan, and wait until it is over and well."""
    scan = json.load(opened(f"{url}/scan", data=b"{}"))
    with opened(f"{url}/scan/{scan['id']}/events") as events:
        for _ in events:
            pass
    assert json.load(opened(f"{url}/scan/{scan['id']}"))["state"] == "succeeded"


@pytest.mark.slow
def test_pictures_come_until_a_scan_does_and_again_after_it(start: Start, tmp_path: Path) -> None:
    service = start(write_rig(tmp_path / "rig"))
    # A scan that is over says that the rig is open.
    scanned(service.url)
    with opened(f"{service.url}/preview/left?light=white") as stream:
        assert stream.headers["Content-Type"] == "multipart/x-mixed-replace; boundary=picture"
        lit = next_picture(stream)
        assert lit.shape == (192, 240)
        with opened(f"{service.url}/preview/left") as second:
            assert next_picture(second).shape == (192, 240)
        scanned(service.url)
        again = next_picture(stream)
        assert again.shape == lit.shape
        assert abs(float(again.mean()) - float(lit.mean())) < 0.1 * float(lit.mean())
    with pytest.raises(HTTPError, match="404") as refused:
        opened(f"{service.url}/preview/middle")
    assert "left" in json.load(refused.value)["detail"]
    with pytest.raises(HTTPError, match="422"):
        opened(f"{service.url}/preview/left?light=green")
    assert service.stop() == 0
