"""How long the page takes to show a large mesh in a browser without a GPU, and how much memory it holds.

    pytest tests/bench/test_page.py -s

A small scan of the rendered rig, whose mesh.ply is exchanged for one of 1.68 million triangles before anybody looks.
Times are from the address to a picture that is drawn; the first visit has both files made, the second finds them.
The heap is the engine's own and the buffers that its arrays stand in.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from slrig.jobs.data_folder import write_entries
from slrig.scan.artefacts import encode_mesh_ply
from tests.e2e.conftest import Start, browser, scanned, write_rig
from tests.e2e.page.conftest import Visit, visit
from tests.unit.scan.test_mesh_formats import sheet

if TYPE_CHECKING:
    from playwright.sync_api import Page

__all__ = ["browser", "visit"]

ROWS, COLUMNS = 917, 918
FIRST_S, FULL_S, HEAP_MB, PICK_S = 3.0, 8.0, 150.0, 0.3
LIMIT_MS = 120_000


def heap_mb(page: Page) -> float:
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    used = session.send("Runtime.getHeapUsage")
    return float(used["usedSize"] + used["backingStorageSize"]) / 1e6


def test_a_large_mesh_shows_at_once_and_whole_soon(start: Start, tmp_path: Path, visit: Visit) -> None:
    service = start(write_rig(tmp_path / "rig"))
    with service.client() as client:
        scan = scanned(client)["links"]["self"]
    mesh = sheet(ROWS, COLUMNS)
    results = service.data / "scans" / scan.rpartition("/")[2]
    (results / "mesh.ply").write_bytes(encode_mesh_ply(mesh))
    write_entries(results)
    seconds = []
    for _ in range(2):
        begun = time.monotonic()
        page = visit(service, scan[1:])
        page.locator("canvas[data-level]").wait_for(timeout=LIMIT_MS)
        first_s = time.monotonic() - begun
        page.locator("canvas[data-level=full]").wait_for(timeout=LIMIT_MS)
        full_s = time.monotonic() - begun
        page.wait_for_timeout(3000)
        held_mb = heap_mb(page)
        frame_ms = page.locator("canvas").get_attribute("data-ms")
        page.get_by_role("button", name="Measure").click()
        picked_s = page.evaluate(
            """async () => {
              const canvas = document.querySelector("canvas");
              canvas.focus();
              const begun = performance.now();
              canvas.dispatchEvent(new KeyboardEvent("keydown", {key: "Enter", bubbles: true}));
              return (performance.now() - begun) / 1000;
            }"""
        )
        page.get_by_text("Now the second point.").wait_for(timeout=LIMIT_MS)
        print(  # noqa: T201
            f"{len(mesh.faces)} triangles: first picture {first_s:.1f} s, full {full_s:.1f} s, a frame {frame_ms} ms, "
            f"a point {picked_s:.2f} s, heap {held_mb:.0f} MB"
        )
        page.goto("about:blank")
        seconds.append((first_s, full_s, held_mb, picked_s))
    goals = (FIRST_S, FULL_S, HEAP_MB, PICK_S)
    assert all(least <= goal for each in seconds for least, goal in zip(each, goals, strict=True)), seconds
