"""Devices, health and schedule, models, the fleet; and what happens to a page that is open."""

from __future__ import annotations

import json
import tomllib
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from sqlalchemy import update

from slrig.api.auth import KeyRing
from slrig.api.scopes import KeyScope
from slrig.catalogue.store import Catalogue, RigRow, open_catalogue
from slrig.config import ServiceSettings, read_rig
from slrig.conformance import CheckOutcome, ConformanceReport
from slrig.conformance.bench import Failure
from slrig.conformance.running import CheckResult
from slrig.doctor import keep
from slrig.doctor.doctor import Diagnosis
from slrig.doctor.light import fault, ok
from slrig.jobs.records import utc_now
from tests.e2e.conftest import KEY, SLOW, Start, write_rig
from tests.e2e.page.conftest import PHONE, Visit, count, disabled, fits, looking, violations
from tests.e2e.page.golden import looks_as_kept
from tests.e2e.test_calibration_walk import write_rig as write_board_rig
from tests.e2e.test_model_walk import ANGLES, TURNTABLE, on_a_turntable
from tests.unit.catalogue.test_store import job, row
from tests.unit.schedule.receivers import Hook

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

pytestmark = pytest.mark.slow

PLUGGED_IN = {
    "drivers": [], "missing": [], "elsewhere": [], "faults": [],
    "devices": [{"driver": "v4l2", "device": "/dev/video0", "label": "a camera of no rig"}],
}  # fmt: skip


def looks_as_elsewhere(page: Page, name: str) -> None:
    """`looks_as_kept` with one device, not those of this machine."""
    page.route("**/device", lambda route: route.fulfill(json=PLUGGED_IN))
    page.reload()
    page.get_by_role("cell", name="a camera of no rig").wait_for()
    page.get_by_role("button", name="Examine now").first.wait_for()
    page.get_by_role("banner").get_by_text("ready").wait_for()
    looks_as_kept(page, name)
    page.unroute_all(behavior="ignoreErrors")


def test_devices_are_shown_as_set_and_as_examined(start: Start, tmp_path: Path, visit: Visit) -> None:
    rig = write_rig(tmp_path / "rig")
    service = start(rig)
    page = visit(service, "devices")
    camera = page.get_by_role("listitem").filter(has=page.get_by_role("heading", name="Camera left"))
    camera.get_by_text("not set yet").first.wait_for()
    doctor = page.get_by_role("region", name="Doctor")
    doctor.get_by_text("Not examined yet.").wait_for()
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
    keep(service.data, "doctor", Diagnosis("small", findings, {}, None, None, None, None, ()).document())
    page.get_by_text("It is too dark.").wait_for()
    page.get_by_text("Open the iris.").wait_for()
    page.get_by_text("What is well: 1").click()
    page.get_by_text("It is sharp.").wait_for()
    assert violations(page) == []
    looks_as_elsewhere(page, "devices")
    # Examined from the page, which shows what was found in place of the last.
    doctor.get_by_role("button", name="Examine now").click()
    doctor.get_by_role("button", name="Cancel").wait_for()
    doctor.get_by_role("button", name="Apply to the rig file").click(timeout=120_000)
    doctor.get_by_text("Applied. The rig was opened again").wait_for()
    count(page.get_by_text("It is too dark"), 0)
    measured, known = rig.read_text(), read_rig(rig).head
    assert known is not None
    assert known.exposure_s is not None
    assert violations(page) == []
    # Settings of the file are changed beside their comments, and what cannot be is told at its field.
    here = page.get_by_role("region", name="This rig")
    here.get_by_text("Change settings").click()
    here.get_by_label("Exposure, ms").fill("16000")
    here.get_by_role("alert").get_by_text("Expected 0.01 to 10000").wait_for()
    disabled(here.get_by_role("button", name="Save and open the rig again").first)
    here.get_by_label("Exposure, ms").fill("16,5")
    here.get_by_role("button", name="Save and open the rig again").first.click()
    disabled(here.get_by_role("button", name="Save and open the rig again").first)
    doctor.get_by_role("button", name="Apply to the rig file").wait_for()
    assert tomllib.loads(rig.read_text())["head"]["exposure_s"] == 0.0165
    assert rig.with_name("rig.toml.bak").read_text() == measured
    # An editor takes it back, and the rig is opened by that.
    rig.write_text(measured)
    here.get_by_role("button", name="Open the rig again", exact=True).click()
    doctor.get_by_text("Applied. The rig was opened again").wait_for()
    keep(service.data, "doctor", Diagnosis("small", findings, {}, None, None, None, None, ()).document())

    # On a phone, by a key for looking.
    failure = Failure("every frame shows its own pattern", "light of another one", "wait for it", "camera 'left'")
    results = (
        CheckResult("frames", "Every frame shows its pattern", CheckOutcome.FAILED, 1.0, failure),
        CheckResult("wires", "Wires trigger", CheckOutcome.NOT_APPLICABLE, 0.0, None, "it needs a wire"),
        *(CheckResult(f"check {number}", "All is well", CheckOutcome.PASSED, 0.1) for number in range(2)),
    )
    keep(service.data, "conformance", ConformanceReport("small", results, 1.2).document())
    secret = looking(service)
    page = visit(service, "devices", key=secret, size=PHONE, dark=True)
    page.get_by_text("66 %").wait_for()
    page.get_by_text("2 of 3 checks that apply passed.").wait_for()
    page.get_by_text("Every frame shows its pattern").wait_for()
    page.get_by_text("Logged in as Ann").wait_for()
    page.get_by_text("You may look.").wait_for()
    page.get_by_text("A key with the scope “administer” sees what is proposed").first.wait_for()
    disabled(page.get_by_role("button", name="Open the rig again", exact=True))
    count(page.get_by_role("table", name="Who did what last"), 0)
    fits(page)
    looks_as_elsewhere(page, "devices-phone-dark")


BUMP = 'faults = {bump = [{device = "projector", pose = 3, turn_deg = [0.0, 0.06, 0.0]}]}'
"""From pose 3 on the projector is turned."""


def describe_board(part: Locator, pose: str = "pose 1") -> None:
    part.get_by_label("Kind").select_option(label="Chessboard")
    for label, value in (("Corners across", 8), ("Corners down", 5), ("Square, mm", 20)):
        part.get_by_label(label).fill(str(value))
    part.get_by_label("Position of the board").select_option(label=pose)


def test_a_person_verifies_and_has_it_done_each_night(start: Start, tmp_path: Path, visit: Visit) -> None:
    page = visit(
        start(write_board_rig(tmp_path / "rig", head=f"{SLOW}\n{BUMP}", carries="true")), "health", ignored="422"
    )
    verify = page.get_by_role("region", name="Verify")
    page.get_by_text("Nothing was verified yet.").wait_for()
    describe_board(verify)
    assert violations(page) == []
    verify.get_by_role("button", name="Verify now").click()
    verify.get_by_role("progressbar").wait_for()
    # After a reload in the middle of it, the page goes on with it.
    page.reload()
    verify.get_by_role("progressbar").wait_for()
    verify.get_by_text("Good", exact=True).wait_for()
    state = page.get_by_role("region", name="State")
    state.get_by_role("status").get_by_text("Good").wait_for()
    state.get_by_text("just now").wait_for()
    count(page.get_by_role("table", name="Last verifications").get_by_role("row"), 2)
    picture = page.get_by_role("img", name="Largest mean disagreement of two devices, px: 1 verifications")
    assert picture.locator("circle.good").count() == 1
    page.get_by_role("region", name="Alerts").get_by_text("Damaged jobs").wait_for()
    assert violations(page) == []
    looks_as_kept(page, "health")

    form = page.get_by_role("form", name="Add to the schedule")
    form.get_by_text("More", exact=True).click()
    form.get_by_label("Cron").fill("0 26 * * *")
    form.get_by_label("Name").fill("nights")
    describe_board(form)
    form.get_by_role("button", name="Add").click()
    form.get_by_role("alert").get_by_text("cron: Bad hour").wait_for()
    form.get_by_label("Cron").fill("")
    form.get_by_label("Time", exact=True).fill("02:30")
    form.get_by_label("Time zone").fill("Europe/Berlin")
    form.get_by_role("button", name="Add").click()
    added = form.get_by_text("Added. Next:").inner_text()
    assert added.count("02:30") == 5
    nights = page.get_by_role("region", name="nights", exact=True)
    nights.get_by_text("Verification. Every day at 02:30, Europe/Berlin. Next:").wait_for()
    nights.get_by_role("button", name="Pause").click()
    nights.get_by_text("Paused: nothing becomes due").wait_for()
    nights.get_by_role("button", name="Run now").click()
    nights.get_by_text("Under way").first.wait_for()
    disabled(nights.get_by_role("button", name="Run now"))
    nights.get_by_text("The calibration is good").wait_for()
    nights.get_by_text("Requested by a person, not by the clock").wait_for()
    nights.get_by_role("button", name=": Good").wait_for()
    nights.get_by_role("link", name="Show the verification").click()
    verify.get_by_role("heading", name="A verification on record").wait_for()
    verify.get_by_role("link", name="Close").click()

    # An alert: set, tried, and removed.
    receiver = Hook()
    alerts = page.get_by_role("region", name="Alerts")
    alerts.get_by_label("Address of a webhook").fill(receiver.url)
    alerts.get_by_role("button", name="Save and send a test notice").click()
    alerts.get_by_text("Delivered", exact=True).wait_for()
    alerts.get_by_text("status 204").wait_for()
    assert receiver.next()["kind"] == "test"
    receiver.status = 500
    alerts.get_by_role("button", name="Send a test notice").click()
    alerts.get_by_text("Not delivered", exact=True).wait_for()
    alerts.get_by_text("status 500").wait_for()
    assert violations(page) == []
    nights.get_by_role("button", name="Remove").click()
    page.get_by_role("alertdialog").get_by_role("button", name="Remove it").click()
    page.get_by_text("No scheduled tasks.").wait_for()
    alerts.get_by_role("button", name="Remove").click()
    alerts.get_by_label("Address of a webhook").wait_for()
    receiver.close()

    describe_board(verify, pose="pose 5")
    verify.get_by_role("button", name="Verify now").click()
    verify.get_by_text("Likely cause: The projector turned by 0.06").wait_for()
    verify.get_by_text("What to do: Check the projector's mount, and calibrate again.").wait_for()
    page.get_by_role("table", name="Last verifications").get_by_role("cell", name="Watch").wait_for()
    assert violations(page) == []


# As of a turntable that was measured with a ruler.
COVARIANCE = np.diag([0.25, 0.0, 0.25, 1e-4, 0.0, 1e-4]).tolist()


def test_scans_are_joined_and_an_object_is_turned_by_hand(start: Start, tmp_path: Path, visit: Visit) -> None:
    data = tmp_path / "data"
    on_a_turntable(data)
    service = start(write_rig(tmp_path / "rig"), data)
    page = visit(service, "models", size=(1280, 1100), ignored="4")
    page.get_by_text("None yet.").wait_for()
    page.get_by_text("This rig has no turntable.").wait_for()
    boxes = page.get_by_role("region", name="Join scans").get_by_role("checkbox")
    count(boxes, len(ANGLES))
    # Listed from new to old; the first that is chosen gives the frame.
    for number in reversed(range(len(ANGLES))):
        boxes.nth(number).check()
    join = page.get_by_role("region", name="Join scans")
    join.get_by_role("button", name="By the turntable's axis").click()
    join.get_by_role("button", name="Make one model of 3").click()
    page.get_by_role("alert").get_by_text("axis: expected that of the turntable").wait_for()
    assert violations(page) == []

    with service.client() as client:
        axis = {**TURNTABLE, "covariance": COVARIANCE}
        client.turntable.put({"format": "slrig-turntable", "version": 1, "axis": axis})
    page.get_by_role("button", name="Make one model of 3").click()
    page.get_by_text("succeeded").wait_for()
    page.get_by_role("img", name="The model from six sides").wait_for()
    page.locator("canvas[data-level=full]").wait_for()
    page.get_by_role("button", name="Download").click()
    page.get_by_role("link", name="model.ply").wait_for()
    page.keyboard.press("Escape")
    page.get_by_role("columnheader", name="Over σ").wait_for()
    views = page.get_by_role("link").filter(has_text="View ")
    count(views, 3)
    views.filter(has_text="View 2, 40°").get_by_text("turned 40").wait_for()
    count(page.get_by_text("pose known to"), 2)
    page.get_by_role("button", name="σ", exact=True).click()
    assert page.get_by_role("button", name="Stripe").count() == 0
    assert violations(page) == []
    looks_as_kept(page, "model")

    # By hand, on a phone: the page says when to turn and by how much.
    page = visit(service, "models", size=PHONE, dark=True, ignored="4")
    page.get_by_label("Views, evenly around").fill("3")
    page.get_by_role("button", name="Shoot the views").click()
    page.get_by_text("turn the object by 120° for view 2 of 3").wait_for()
    fits(page)
    turning = page.get_by_role("group", name="Turn the object")
    turning.get_by_text("To 120° in all").wait_for()
    turning.get_by_role("button", name="left").click()
    ghost = turning.get_by_role("img", name="The last view, half-transparent")
    assert ghost.evaluate("(image) => image.decode().then(() => image.naturalWidth)") > 0
    turning.get_by_role("button", name="Off").click()
    turning.get_by_role("button", name="I have turned it: next view").click()
    page.get_by_text("turn the object by 120° for view 3 of 3").wait_for()
    turning.get_by_role("button", name="Make the model of 2 views").wait_for()
    page.get_by_role("button", name="Stop it").click()
    page.get_by_role("alert").get_by_text("cancelled while its views were shot").wait_for()
    page.get_by_role("button", name="Delete").click()
    page.get_by_role("button", name="Delete it").click()
    page.get_by_text("3 views,").wait_for()


def others(catalogue: Catalogue) -> None:
    """Three more rigs: one works, one cannot, one has been silent for two days."""
    now = datetime.now(UTC)

    def scans(rig: str, number: int, hours: float, **other: Any) -> list[dict[str, Any]]:
        at = (now - timedelta(hours=hours)).isoformat()
        return [job(rig, finished_at=at, **other) for _ in range(number)]

    catalogue.see(row("hall-1", words="scan 5f1c", health="good", uncopied=0))
    why = "The camera 'left' does not answer. Plug it in again, then scan."
    catalogue.see(row("hall-2", state="fault", words=why, waiting=0, computing=0, health="stale", uncopied=12,
                      health_message="the projector has turned by 0.06°"))  # fmt: skip
    catalogue.see(row("hall-3"))
    too_dark = {"state": "failed", "fault_message": "The pictures are too dark: open the aperture."}
    catalogue.copy([
        *scans("hall-1", 41, 2, label="housing 17"), *scans("hall-2", 12, 5), *scans("hall-2", 1, 4, **too_dark),
        *scans("hall-3", 1, 49),
    ])  # fmt: skip
    with catalogue._writer.begin() as connection:
        gone = update(RigRow).where(RigRow.name == "hall-3")
        connection.execute(gone.values(seen_at=now - timedelta(days=2)))


def test_a_person_sees_many_rigs_at_once(start: Start, tmp_path: Path, visit: Visit) -> None:
    address = f"sqlite:///{tmp_path}/fleet.sqlite"
    catalogue = open_catalogue(address, None, None)
    catalogue.open()
    service = start(write_rig(tmp_path / "rig"), SLRIG_CATALOGUE=address)
    with service.client() as client:
        client.scan()
    # Last: a slow machine would take them for away.
    others(catalogue)
    page = visit(service)
    page.get_by_role("link", name="Fleet").click()
    page.get_by_text("4 rigs, 1 not ready, 1 not seen for a minute or longer").wait_for()
    rigs = page.get_by_role("region", name="Rigs").get_by_role("row")
    count(rigs, 5)
    for number, words in enumerate(["Busy", "does not answer", "Not seen", "This one"]):
        rigs.nth(1 + number).get_by_text(words, exact=number == 2).first.wait_for()
    assert rigs.nth(3).get_by_text("Not known").count() == 2
    assert violations(page) == []
    looks_as_kept(page, "fleet")
    phone = visit(service, "fleet", size=PHONE, dark=True)
    count(phone.get_by_role("region", name="Rigs").get_by_role("row"), 5)
    assert violations(phone) == []
    looks_as_kept(phone, "fleet-phone-dark")
    catalogue.close()


WRITTEN_IN = {
    "scan": None,
    "scan/all": None,
    "models": None,
    "calibrate": None,
    "health": None,
    "devices": "Change settings",
}
"""Screens with something to fill in, and what has to be opened before."""
OVER = {"type": "/problems/unauthorized", "title": "Log in first", "status": 401, "detail": "The session is over."}
COMPLAINT = "Failed to load resource"
"""What Chromium itself says of a request that is refused, or not answered."""


def test_a_camera_is_unplugged_and_a_key_expires(start: Start, tmp_path: Path, visit: Visit) -> None:
    service = start(write_rig(tmp_path / "rig", faults="[head.faults]\nunplug_camera_at_frame = 5"))
    # Without the live picture, whose frames would be counted, too.
    page = visit(service, "devices")
    page.evaluate("sessionStorage.setItem('live', '')")
    page.get_by_role("link", name="Scan").click()
    page.get_by_text("No scans yet.").wait_for()
    page.get_by_role("button", name="Scan", exact=True).click()
    failed = page.get_by_role("alert").filter(has_text="The last scan failed")
    failed.get_by_text("camera 'left' is gone (unplugged or powered off); plug it in").wait_for()
    page.get_by_role("listitem").get_by_text("failed").wait_for()
    assert violations(page) == []

    # The form, and back to the screen.
    keys = ServiceSettings(data_dir=service.data).key_path
    secret = KeyRing(keys).add("Ann", [KeyScope.SCAN], life=timedelta(hours=1))
    page = visit(service, "devices", key=secret, ignored=COMPLAINT)
    page.get_by_text("Logged in as Ann").wait_for()
    kept = json.loads(keys.read_text())
    kept["keys"][-1]["expires_at"] = (utc_now() - timedelta(seconds=1)).isoformat()
    keys.write_text(json.dumps(kept))
    page.get_by_role("alert").get_by_text("Your session is over").wait_for()
    assert violations(page) == []
    page.get_by_label("Key", exact=True).fill(secret)
    page.get_by_role("button", name="Enter").click()
    page.get_by_role("alert").get_by_text("This API key expired on").wait_for()
    page.get_by_label("Key", exact=True).fill(KEY)
    page.get_by_role("button", name="Enter").click()
    page.get_by_text("Logged in as environment").wait_for()
    assert page.url.endswith("#/devices")

    # On every screen the page says so, and keeps what is shown and was typed.
    field = page.locator("#content input:is(:not([type]), [type=number], [type=text], [type=search]):visible").first
    for screen, folded in WRITTEN_IN.items():
        page.goto(f"{service.url}/#/{screen}")
        if folded:
            page.get_by_text(folded).click()
        field.fill("7")
        page.route("**/*", lambda route: route.abort())
        page.get_by_role("alert").get_by_text("The service does not answer.").wait_for()
        assert field.input_value() == "7", screen
        page.unroute_all(behavior="ignoreErrors")
        page.get_by_role("alert").get_by_text("The service does not answer.").wait_for(state="detached")
        page.route("**/rig", lambda route: route.fulfill(status=401, json=OVER))
        page.get_by_role("alert").get_by_text("Your session is over").wait_for()
        page.unroute_all(behavior="ignoreErrors")
        page.get_by_label("Key", exact=True).fill(KEY)
        page.keyboard.press("Enter")
        field.wait_for()
        assert field.input_value() == "7", screen


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
    page.get_by_label("Key", exact=True).fill(KEY)
    page.keyboard.press("Enter")
    page.get_by_text("The rig has no calibration that could be verified.").wait_for()
