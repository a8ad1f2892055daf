"""Health and schedule: the calibration verified by a person and by the clock, and its results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.e2e.conftest import SLOW, Start
from tests.e2e.page.conftest import Visit, count, disabled, violations
from tests.e2e.page.golden import looks_as_kept
from tests.e2e.test_calibration_walk import write_rig as write_board_rig

if TYPE_CHECKING:
    from playwright.sync_api import Locator

pytestmark = pytest.mark.slow

BUMP = 'faults = {bump = [{device = "projector", pose = 3, turn_deg = [0.0, 0.06, 0.0]}]}'
"""From pose 3 on the projector is turned."""


def describe_board(part: Locator, pose: str = "pose 1") -> None:
    """Say what is printed on the board of the rendered rig, and where it is to stand."""
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
    picture = page.get_by_role("img", name="Expected error of a scan")
    assert picture.evaluate("(image) => image.decode().then(() => image.naturalWidth)") > 0
    assert violations(page) == []
    looks_as_kept(page, "health")

    form = page.get_by_role("form", name="Add to the schedule")
    form.get_by_label("Minute, hour").fill("0 26 * * *")
    form.get_by_label("Name").fill("nights")
    describe_board(form)
    form.get_by_role("button", name="Add").click()
    form.get_by_role("alert").get_by_text("cron: Bad hour").wait_for()
    form.get_by_label("Minute, hour").fill("30 2 * * *")
    form.get_by_label("Time zone").fill("Europe/Berlin")
    form.get_by_role("button", name="Add").click()
    added = form.get_by_text("Added. Next:").inner_text()
    assert added.count("02:30") == 5
    nights = page.get_by_role("region", name="nights", exact=True)
    nights.get_by_text("Verification, next").wait_for()
    nights.get_by_role("button", name="Pause").click()
    nights.get_by_text("paused: nothing becomes due").wait_for()
    nights.get_by_role("button", name="Run now").click()
    nights.get_by_text("under way").first.wait_for()
    disabled(nights.get_by_role("button", name="Run now"))
    nights.get_by_text("The calibration is good").wait_for()
    nights.get_by_text("asked for by a person, not by the clock").wait_for()
    assert violations(page) == []
    looks_as_kept(page, "schedule", part=nights)
    nights.get_by_role("button", name="Remove").click()
    page.get_by_role("alertdialog").get_by_role("button", name="Remove it").click()
    page.get_by_text("Nothing is done by the clock yet.").wait_for()

    describe_board(verify, pose="pose 5")
    verify.get_by_role("button", name="Verify now").click()
    verify.get_by_text("Likely cause: the projector turned by 0.06").wait_for()
    verify.get_by_text("What to do: check the projector's mount, and calibrate again.").wait_for()
    page.get_by_role("table", name="Last verifications").get_by_role("cell", name="Watch").wait_for()
    assert violations(page) == []
