"""Devices: the rig as it is set, what examinations found, who is logged in, and what was done."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from slrig.conformance import Outcome, Report
from slrig.conformance.expectation import Failure
from slrig.conformance.running import Result
from slrig.doctor.doctor import Diagnosis
from slrig.doctor.findings import fault, ok
from slrig.jobs.examinations import keep
from tests.e2e.conftest import Start, write_rig
from tests.e2e.page.conftest import PHONE, Visit, count, fits, looking, violations
from tests.e2e.page.golden import looks_as_kept

if TYPE_CHECKING:
    from playwright.sync_api import Page, Route

pytestmark = pytest.mark.slow

PLUGGED_IN = {
    "drivers": [], "missing": [], "elsewhere": [], "faults": [],
    "devices": [{"driver": "v4l2", "device": "/dev/video0", "label": "a camera of no rig"}],
}  # fmt: skip


def looks_as_elsewhere(page: Page, name: str) -> None:
    """`looks_as_kept` with one device, whatever is plugged in here, and without a path of this machine."""

    def without_path(route: Route) -> None:
        found = route.fetch()
        commands = {name: f"slrig {name} RIG.toml --data DATA" for name in ("doctor", "conform")}
        route.fulfill(response=found, json={**found.json(), "commands": commands})

    page.route("**/device", lambda route: route.fulfill(json=PLUGGED_IN))
    page.route("**/rig/examinations", without_path)
    page.reload()
    page.get_by_role("cell", name="a camera of no rig").wait_for()
    page.get_by_text("slrig doctor RIG.toml --data DATA").wait_for()
    page.get_by_role("banner").get_by_text("ready").wait_for()
    looks_as_kept(page, name)
    page.unroute_all(behavior="ignoreErrors")


def test_devices_are_shown_as_set_and_as_examined(start: Start, tmp_path: Path, visit: Visit) -> None:
    rig = write_rig(tmp_path / "rig")
    service = start(rig)
    page = visit(service, "devices")
    camera = page.get_by_role("listitem").filter(has=page.get_by_role("heading", name="Camera left"))
    camera.get_by_text("not set yet").first.wait_for()
    page.get_by_text("Not examined yet.").first.wait_for()
    page.get_by_role("region", name="Plugged in").get_by_text("Installed drivers").wait_for()
    assert violations(page) == []
    with service.client() as client:
        client.scans.start(exposure_s=0.012)
    camera.get_by_text("12 ms", exact=True).wait_for()
    page.get_by_role("row").filter(has_text="POST /scan").get_by_text("202").wait_for()
    page.get_by_text("Logged in as environment").wait_for()

    findings = (
        fault("light.dark", "camera 'left'", "it is too dark", "open the iris"),
        ok("focus.sharp", "camera 'left'", "it is sharp"),
    )
    keep(service.data, "doctor", Diagnosis("small", findings, {}, None, None, None, ()).document())
    page.get_by_text("it is too dark").wait_for()
    page.get_by_text("open the iris").wait_for()
    page.get_by_text("What is well: 1").click()
    page.get_by_text("it is sharp").wait_for()
    assert violations(page) == []
    looks_as_elsewhere(page, "devices")

    # On a phone, by a key for looking.
    failure = Failure("every frame shows its own pattern", "light of another one", "wait for it", "camera 'left'")
    results = (
        Result("frames", "Every frame shows its pattern", Outcome.FAILED, 1.0, failure),
        Result("wires", "Wires trigger", Outcome.NOT_APPLICABLE, 0.0, None, "it needs a wire"),
        *(Result(f"check {number}", "All is well", Outcome.PASSED, 0.1) for number in range(2)),
    )
    keep(service.data, "conform", Report("small", results, 1.2).document())
    secret = looking(service)
    page = visit(service, "devices", key=secret, size=PHONE, dark=True)
    page.get_by_text("66 %").wait_for()
    page.get_by_text("2 of 3 checks that apply passed.").wait_for()
    page.get_by_text("Every frame shows its pattern").wait_for()
    page.get_by_text("Logged in as Ann").wait_for()
    page.get_by_text("You may look.").wait_for()
    count(page.get_by_role("table", name="Who did what last"), 0)
    fits(page)
    looks_as_elsewhere(page, "devices-phone-dark")
