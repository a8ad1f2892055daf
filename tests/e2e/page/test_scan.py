"""From the key to a scan: what a new user sees."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e.conftest import KEY, SLOW, Start, write_rig
from tests.e2e.page.conftest import PHONE, Visit, count, disabled, fits, looking, violations
from tests.e2e.page.golden import looks_as_kept

pytestmark = pytest.mark.slow


def test_a_new_user_logs_in_looks_and_scans(start: Start, tmp_path: Path, visit: Visit) -> None:
    # In real time, so that there is something to see of the progress.
    service = start(write_rig(tmp_path / "rig", head=SLOW))
    page = visit(service, key=None, ignored="401")
    page.get_by_label("Key", exact=True).fill("not the key")
    page.get_by_role("button", name="Enter").click()
    page.get_by_role("alert").get_by_text("Unknown API key.").wait_for()
    assert violations(page) == []
    page.get_by_label("Key", exact=True).fill(KEY)
    page.keyboard.press("Enter")
    page.get_by_text("No scans yet.").wait_for()
    page.get_by_text("ready").wait_for()
    # A rig alone has no fleet.
    count(page.get_by_role("link", name="Fleet"), 0)

    # The picture is there at once, and what it says of the light.
    page.get_by_role("img", name="Live picture of camera left").wait_for()
    # The picture itself has this figure, so it is there.
    page.get_by_text("% saturated").wait_for()
    page.get_by_role("img", name="Brightness of the picture").wait_for()
    page.get_by_role("button", name="Look and propose").click()
    page.get_by_text("of what is lit can be read").wait_for()
    assert violations(page) == []
    # The rig is free again, and its picture comes back.
    page.get_by_text("% saturated").wait_for()
    page.get_by_role("button", name="Scan", exact=True).and_(page.locator(":enabled")).wait_for()
    looks_as_kept(page, "scan")
    # The shape while somebody aims.
    page.get_by_role("button", name="Depth", exact=True).click()
    page.get_by_text("% measured").wait_for()
    assert violations(page) == []
    data = "canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data"
    drawn = f"canvas => {data}.filter((each) => each > 180).length"
    assert page.get_by_role("img", name="Depth in colours").evaluate(drawn) > 10_000
    # What the next scan is limited to limits it, too.
    page.get_by_text("Limit the scan").click()
    farthest = page.get_by_label("Farthest depth, mm")
    farthest.fill("580")
    page.get_by_text("outside the limits;").wait_for()
    farthest.fill("")
    page.get_by_role("button", name="Picture", exact=True).click()
    page.get_by_role("button", name="As the rig is set").click()
    page.get_by_role("button", name="Off").click()

    page.get_by_label("Name").fill("plate-007")
    page.get_by_role("button", name="Scan", exact=True).click()
    progress = page.get_by_role("progressbar")
    progress.wait_for()
    assert violations(page) == []
    # After a reload the page shows what is under way; the scan is still its own, so it goes on to the mesh.
    page.reload()
    progress.wait_for()
    page.wait_for_url("**/#/scan/*-*")
    # Saved by its name, which can be changed.
    page.get_by_role("button", name="Download").click()
    assert violations(page) == []
    with page.expect_download() as download:
        page.get_by_role("link", name="mesh.stl").click()
    assert download.value.suggested_filename == "small-plate-007-mesh.stl"
    page.keyboard.press("Escape")
    page.get_by_role("button", name="Rename").click()
    page.get_by_label("New name").fill("plate-007, turned")
    page.keyboard.press("Enter")
    page.get_by_role("heading", name="plate-007, turned").wait_for()
    page.goto(f"{service.url}/#/scan")
    page.reload()
    page.get_by_text("succeeded").wait_for()
    page.get_by_text("triangles, σ").wait_for()
    count(page.get_by_role("list").get_by_role("link"), 1)
    assert page.get_by_label("Name").input_value() == "plate-008"
    assert violations(page) == []

    # All scans: found, chosen by keyboard, fetched together, deleted.
    with service.client() as client:
        client.scans.cancel(client.scans.start(label="gone")["id"])
    page.get_by_role("link", name="All scans").click()
    cards = page.get_by_role("region", name="Today").get_by_role("link")
    count(cards, 2)
    page.get_by_role("link", name="gone").get_by_text("Cancelled", exact=True).wait_for()
    page.locator("img").evaluate_all("(all) => Promise.all(all.map((each) => each.decode()))")
    looks_as_kept(page, "scans")
    cards.first.focus()
    for key in ("Space", "ArrowRight", "Space"):
        page.keyboard.press(key)
    chosen = page.get_by_role("region", name="Selected scans")
    chosen.get_by_text("1 without a mesh").wait_for()
    assert violations(page) == []
    with page.expect_download() as download:
        chosen.get_by_role("button", name="Download 1 as zip").click()
    assert download.value.suggested_filename == "small-1-scans-mesh.stl.zip"
    page.get_by_role("searchbox").fill("GONE")
    count(cards, 1)
    chosen.get_by_role("button", name="Delete …").click()
    chosen.get_by_role("alertdialog").get_by_role("button", name="Delete it").click()
    page.get_by_text("No scan matches.").wait_for()
    page.get_by_role("combobox", name="Day").select_option("last")
    page.get_by_role("button", name="Show all").click()
    count(cards, 1)

    # A phone, a dark room, and a key for looking.
    secret = looking(service)
    page = visit(service, key=secret, size=PHONE, dark=True, ignored="401")
    page.get_by_text("Your key is for looking only.").wait_for()
    disabled(page.get_by_role("button", name="Scan", exact=True))
    fits(page)
    page.get_by_role("banner").get_by_text("ready").wait_for()
    page.get_by_text("triangles, σ").wait_for()
    looks_as_kept(page, "scan-phone-dark")
    page.get_by_role("button", name="Log out").click()
    page.get_by_label("Key", exact=True).wait_for()
    assert page.evaluate("fetch('/scan').then((answer) => answer.status)") == 401
