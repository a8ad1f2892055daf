"""What happens to a page that is open: its key ends, the service goes and comes back, a camera is unplugged."""

from __future__ import annotations

import json
from datetime import timedelta
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from slrig.api.keys import KeyRing
from slrig.api.scopes import Scope
from slrig.config import ServiceSettings
from slrig.jobs.records import utc_now
from tests.e2e.conftest import KEY, Start, write_rig
from tests.e2e.page.conftest import PHONE, Visit, disabled, fits, looking, violations
from tests.e2e.page.golden import looks_as_kept

pytestmark = pytest.mark.slow

COMPLAINT = "Failed to load resource"
"""What Chromium itself says of a request that is refused, or not answered."""


def test_a_camera_is_unplugged_and_a_key_expires(start: Start, tmp_path: Path, visit: Visit) -> None:
    service = start(write_rig(tmp_path / "rig", faults="[head.faults]\nunplug_camera_at_frame = 5"))
    page = visit(service, "scan")
    page.get_by_text("None yet.").wait_for()
    page.get_by_role("button", name="Scan", exact=True).click()
    failed = page.get_by_role("alert").filter(has_text="The last scan failed")
    failed.get_by_text("camera 'left' is gone (unplugged or powered off); plug it in").wait_for()
    page.get_by_role("listitem").get_by_text("failed").wait_for()
    assert violations(page) == []

    # The form, and back to the screen.
    keys = ServiceSettings(data_dir=service.data).key_path
    secret = KeyRing(keys).add("Ann", [Scope.SCAN], life=timedelta(hours=1))
    page = visit(service, "devices", key=secret, ignored=COMPLAINT)
    page.get_by_text("Logged in as Ann").wait_for()
    kept = json.loads(keys.read_text())
    kept["keys"][-1]["expires_at"] = (utc_now() - timedelta(seconds=1)).isoformat()
    keys.write_text(json.dumps(kept))
    page.get_by_role("alert").get_by_text("Your session is over").wait_for()
    assert violations(page) == []
    page.get_by_label("Key").fill(secret)
    page.get_by_role("button", name="Enter").click()
    page.get_by_role("alert").get_by_text("one that expired on").wait_for()
    page.get_by_label("Key").fill(KEY)
    page.get_by_role("button", name="Enter").click()
    page.get_by_text("Logged in as environment").wait_for()
    assert page.url.endswith("#/devices")


def test_health_without_a_calibration_while_the_service_goes_and_comes_back(
    start: Start, tmp_path: Path, visit: Visit
) -> None:
    rig = write_rig(tmp_path / "rig", head="carries_calibration = false")
    service = start(rig)
    secret = looking(service)
    page = visit(service, "health", key=secret, size=PHONE, dark=True, ignored=COMPLAINT)
    page.get_by_text("The rig has no calibration that could be verified.").wait_for()
    page.get_by_text("Your key is not for calibrations.").wait_for()
    page.get_by_text("Changing the schedule takes a key that may administer.").wait_for()
    disabled(page.get_by_role("button", name="Verify now"))
    fits(page)
    page.get_by_role("banner").get_by_text("not calibrated").wait_for()
    looks_as_kept(page, "health-phone-dark")
    service.stop()
    banner = page.get_by_role("alert").get_by_text("The service does not answer.")
    banner.wait_for()
    # What was known is still there to be read.
    assert page.get_by_text("The rig has no calibration that could be verified.").is_visible()
    assert violations(page) == []
    start(rig, port=urlsplit(service.url).port)
    # Sessions live as long as the service.
    page.get_by_role("alert").get_by_text("Your session is over").wait_for()
    banner.wait_for(state="detached")
    page.get_by_label("Key").fill(KEY)
    page.keyboard.press("Enter")
    page.get_by_text("The rig has no calibration that could be verified.").wait_for()
