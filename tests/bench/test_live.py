"""How many depth images a second live depth gives of 1.3 megapixels, what they cost, and how late they are.

    pytest tests/bench/test_live.py -s

A rendered rig without pauses, all rays decoded, one viewer of each third. Processor time is that of service (which
renders the frames), worker and live process together; the delay is from a frame's arrival to its depth image. In a
browser without a GPU it goes on to the screen: to the picture after the one in which the canvases were drawn.
"""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import psutil

from slrig.client import Client
from slrig.client.live import split_messages
from tests.e2e.conftest import KEY, Start, browser
from tests.e2e.page.conftest import Visit, visit

__all__ = ["browser", "visit"]

LATEST_S = 0.15
SECONDS, SHORT_S, VIEWERS = 60.0, 10.0, 20
RIG = """
name = "large"
[head]
driver = "simulated"
scene = "scene.toml"
ambient = 0.01
[head.projector]
size_px = [1280, 800]
focal_px = [5500.0, 5500.0]
distortion = [0.03, -0.02, 0.0003, 0.0, 0.0]
position_mm = [105.0, -10.0, -590.0]
target_mm = [0.0, 0.0, 0.0]
blur_px = 0.6
gamma = 1.8
[[head.camera]]
name = "left"
size_px = [1280, 1024]
saturation_s = 0.02
focal_px = [5000.0, 5000.0]
distortion = [-0.11, 0.15, -0.0003, 0.0005, 0.0]
position_mm = [-150.0, -12.0, -560.0]
target_mm = [0.0, 0.0, 0.0]
blur_px = 0.6
"""
SCENE = """
[[object]]
name = "relief"
shape = "relief"
size_mm = [130.0, 100.0]
step_mm = 0.5
albedo = 0.85
texture = { kind = "noise", contrast = 0.25, scale_mm = 6.0 }
bump = [{ centre_mm = [-25.0, -10.0], height_mm = 16.0, sigma_mm = 14.0 }]
"""


def spent(service: psutil.Process) -> tuple[float, float]:
    """Processor seconds and resident MB of a service and its processes."""
    each = [service, *service.children(recursive=True)]
    times = [process.cpu_times() for process in each]
    return sum(used.user + used.system for used in times), sum(process.memory_info().rss for process in each) / 1e6


def read_raw(url: str) -> float:
    """Messages a second that one viewer reads."""
    with Client(url, KEY) as client, client.connection.streamed("/live/depth", params={"step": 3}) as pieces:
        begun, count = time.monotonic(), 0
        for head, _ in split_messages(pieces):
            count += head["kind"] == "depth"
            if time.monotonic() - begun > SHORT_S:
                break
        return count / (time.monotonic() - begun)


def test_depth_images_a_second_their_cost_and_their_delay(start: Start, tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "rig.toml").write_text(RIG)
    service = start(tmp_path / "rig.toml")
    process = psutil.Process(service.process.pid)
    with service.client() as client, ThreadPoolExecutor(VIEWERS) as pool:
        while client.system.readiness()["pending"]:
            time.sleep(0.5)
        client.live.start()
        delays_s, count = [], -20
        for frame in client.live.watch(step=3):
            count += 1
            if count == 0:
                (begun_s, before_mb), begun = spent(process), time.monotonic()
            elif count > 0:
                delays_s.append(frame.facts["age_s"])
                if time.monotonic() - begun > SECONDS:
                    break
        (ended_s, after_mb), took_s = spent(process), time.monotonic() - begun
        before = client.live.status()["facts"]["number"]
        begun, read = time.monotonic(), [pool.submit(read_raw, service.url) for _ in range(VIEWERS)]
        messages = [each.result() for each in read]
        beside = (client.live.status()["facts"]["number"] - before) / (time.monotonic() - begun)
        service.process.kill()
        killed = time.monotonic()
        while any(each.status() != psutil.STATUS_ZOMBIE for each in process.children(recursive=True)):
            time.sleep(0.01)
    print(f"\n{VIEWERS} more viewers: {beside:.1f} a second, of which each read {np.mean(messages):.1f}")  # noqa: T201
    print(  # noqa: T201
        f"\n{count / took_s:.1f} depth images a second, {(ended_s - begun_s) / took_s:.2f} cores, delay "
        f"{np.median(delays_s) * 1e3:.0f} ms (95 %: {np.quantile(delays_s, 0.95) * 1e3:.0f}), {before_mb:.0f} MB, "
        f"{after_mb - before_mb:+.0f} MB at the end; processes gone {time.monotonic() - killed:.2f} s after a kill"
    )
    assert count / took_s > 10


WATCHED = """async ([ahead_ms, lasts_ms]) => {
  const canvas = document.querySelector("canvas[data-came]");
  const delays = [];
  for (let begun = performance.now(), last = null; performance.now() - begun < lasts_ms;) {
    await new Promise(requestAnimationFrame);
    const {came} = canvas.dataset;
    if (came !== last) {
      await new Promise(requestAnimationFrame);
      delays.push((performance.timeOrigin + performance.now() - ahead_ms) / 1000 - came);
    }
    last = came;
  }
  return delays;
}"""


def test_how_soon_the_page_shows_what_came(start: Start, tmp_path: Path, visit: Visit) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "rig.toml").write_text(RIG)
    service = start(tmp_path / "rig.toml")
    process = psutil.Process(service.process.pid)
    page = visit(service, "scan")
    page.get_by_role("button", name="Depth", exact=True).click()
    page.locator("canvas[data-came]").wait_for()
    with service.client() as client:
        while client.live.status()["facts"]["number"] < 40:
            page.wait_for_timeout(500)
        (begun_s, _), begun, first = spent(process), time.monotonic(), client.live.status()["facts"]["number"]
        ahead_ms = 1e3 * (time.time() - time.monotonic())  # noqa: TID251 - the browser has the clock of the day
        delays_s = page.evaluate(WATCHED, [ahead_ms, 1e3 * SECONDS])
        (ended_s, _), took_s, last = spent(process), time.monotonic() - begun, client.live.status()["facts"]["number"]
    least, middle, most = np.quantile(delays_s, [0.05, 0.5, 0.95]) * 1e3
    print(  # noqa: T201
        f"\nnext to an open page: {(last - first) / took_s:.1f} images/s, {(ended_s - begun_s) / took_s:.2f} cores"
        f"; the page shows {len(delays_s) / took_s:.1f} a second, {middle:.0f} ms after the newest frame of each came "
        f"(5 and 95 %: {least:.0f} and {most:.0f})"
    )
    assert np.median(delays_s) < LATEST_S
