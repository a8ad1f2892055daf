"""Live depth through the real service: what viewers get, a scan in between, and its end."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from slrig.client import Client, LiveFrame, read_recording
from slrig.errors import ServiceError
from slrig.live.room import UNWATCHED_S
from tests.e2e.conftest import KEY, serving, write_rig
from tests.unit.command import done

VIEWERS = 20
LIMITED = """
[scan.region.polygons_px]
left = [[0, 0], [178, 0], [178, 192], [0, 192]]
"""


def _first(client: Client, count: int = 1) -> list[LiveFrame]:
    return [frame for frame, _ in zip(client.live.watch(step=1), range(count), strict=False)]


@pytest.mark.slow
def test_live_depth_is_seen_by_many_gives_way_to_a_scan_and_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = write_rig(tmp_path / "rig", faults=LIMITED)
    with serving(rig, tmp_path / "data") as service, service.client() as client:
        with pytest.raises(ServiceError, match="There is no live depth"):
            client.live.status()
        while not client.get("/rig")["open"]:
            threading.Event().wait(0.1)
        client.live.start(region={})
        assert client.live.start(region={})["viewers"] == 0
        watching = client.live.watch(step=2)
        next(watching)
        with pytest.raises(ServiceError, match="with other options"):
            client.live.start(step=2)
        del watching
        (frame,) = _first(client)
        assert np.mean(frame.state == 0) > 0.5
        # The plate turns by 8 and 12 degrees about the axes of a camera 15 degrees aside.
        assert 0 < frame.facts["tilt_deg"] < 40

        _watch_together(client, service.url)

        # A scan takes the rig, and live depth goes on after it.
        before = client.live.status()["facts"]["number"]
        watching = client.live.watch(step=2)
        next(watching)
        scan = client.scan(label="between")
        after = next(frame for frame in watching if frame.facts["number"] > before)
        cloud = scan.cloud("left")
        assert _apart_mm(after, cloud.points_mm) < 0.2

        monkeypatch.setenv("SLRIG_API_KEY", KEY)
        client.live.end()
        with pytest.raises(ServiceError, match="There is no live depth"):
            client.live.status()
        said = done("live", "--url", service.url, "--record", tmp_path / "aim.live", "--seconds", "0.5", "--step", "4")
        assert "depth images" in said
        # Others may watch it.
        client.live.status()
        recorded = list(read_recording(tmp_path / "aim.live"))
        assert recorded[0].depth_mm.shape == (48, 60)
        # The rig file's region is the default.
        assert (recorded[0].state[:, 45:] == 6).all()
        assert (recorded[0].state[:, :44] != 6).all()
        done("live", tmp_path / "aim.live", "--export", tmp_path / "clouds")
        clouds = sorted((tmp_path / "clouds").iterdir())
        assert len(clouds) == len(recorded)
        assert b"WIDTH 60\nHEIGHT 48\n" in clouds[0].read_bytes()

        client.live.start()
        began_s = time.monotonic()
        while True:
            try:
                client.live.status()
            except ServiceError:
                break
            assert time.monotonic() - began_s < 4 * UNWATCHED_S
            threading.Event().wait(0.5)
        assert time.monotonic() - began_s > UNWATCHED_S / 2


def _watch_together(client: Client, url: str) -> None:
    """Have many watch at once, of whom one reads nothing, and compare what two got of one image."""
    got: list[dict[int, LiveFrame]] = [{} for _ in range(VIEWERS)]

    def watch(number: int) -> None:
        with Client(url, KEY) as viewer:
            for frame in viewer.live.watch(step=2):
                got[number][frame.facts["number"]] = frame
                if len(got[number]) == 6:
                    return

    threads = [threading.Thread(target=watch, args=(number,)) for number in range(VIEWERS)]
    with client.connection.streamed("/live/depth", params={"step": 2}):
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
    assert all(len(each) == 6 for each in got)
    shared = set(got[0]).intersection(*got[1:])
    assert shared
    number = min(shared)
    assert all(np.array_equal(each[number].depth_mm, got[0][number].depth_mm, equal_nan=True) for each in got)


def _apart_mm(frame: LiveFrame, points_mm: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> float:
    """Median difference of the distances between points of the same pixels, in two frames of coordinates."""
    live, scanned = frame.points_mm, points_mm[::2, ::2]
    both = np.isfinite(live).all(axis=2) & np.isfinite(scanned).all(axis=2)
    assert both.mean() > 0.3
    lengths = [np.linalg.norm(each[both] - each[both][0], axis=1) for each in (live, scanned)]
    return float(np.median(np.abs(lengths[0] - lengths[1])))
