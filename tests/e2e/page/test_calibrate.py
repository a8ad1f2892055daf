"""From nothing to an activated calibration: a board to print, its poses, the solve, the verdict."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.e2e.conftest import SLOW, Start
from tests.e2e.page.conftest import PHONE, Visit, count, disabled, fits, looking, violations
from tests.e2e.page.golden import looks_as_kept
from tests.e2e.test_calibration_walk import Caller, write_rig

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.slow

_SOLVED_MS = 120_000


def choose_board(page: Page) -> None:
    page.get_by_role("button", name="Chessboard").click()
    page.get_by_label("Inner corners across").fill("8")
    page.get_by_label("Inner corners down").fill("5")
    page.get_by_label("Side of a square").fill("20")


def shows_the_live_picture(page: Page) -> None:
    picture = page.get_by_role("img", name="Live picture of camera left")
    page.wait_for_function("image => image.naturalWidth > 0", arg=picture.element_handle())


BALL = """
[[object]]
name = "ball"
shape = "sphere"
position_mm = [165.0, 125.0, 190.0]
radius_mm = 60.0
albedo = 0.7
"""
"""Behind every pose of the board, before the wall."""


def scan_without_a_calibration(page: Page) -> None:
    """From guesses over a refusal to a calibration that the rig uses, which is deleted again."""
    page.get_by_label("Camera left, px").fill("480")
    page.get_by_label("Right within, %").first.fill("2")
    page.get_by_label("Projector: distance over width").fill("1.22")
    page.get_by_label("Right within, %").nth(1).fill("2")
    page.get_by_label("Refuse errors of shape above, %").fill("0.01")
    page.get_by_role("button", name="Scan without a calibration").click()
    page.get_by_role("link", name="What to do now").click(timeout=_SOLVED_MS)
    page.wait_for_url("**/#/scan/*-*")
    page.get_by_role("alert").get_by_text("the scene has too little depth").wait_for()
    page.get_by_text("Say more of the devices").click()
    assert violations(page) == []
    page.get_by_role("button", name=re.compile(r"Allow 0\.\d+\s% and compute again")).click()
    page.get_by_text("hundredths of the distance from the first camera").wait_for(timeout=_SOLVED_MS)
    page.get_by_text(re.compile(r"0\.\d+\s% of its size: .* hundredths of the baseline")).wait_for()
    count(page.get_by_role("button", name="Use it as the rig's calibration"), 0)
    page.get_by_text(re.compile(r"^[\d\s]+ triangles\.$")).wait_for()
    page.get_by_role("button", name="Measure").click()
    for right in (0.4, 0.6):
        box = page.get_by_role("application").bounding_box()
        assert box is not None
        page.get_by_role("application").click(position={"x": right * box["width"], "y": box["height"] / 2})
    page.get_by_text("This length is known").click()
    page.get_by_label("True length, mm").fill("110")
    assert violations(page) == []
    page.get_by_role("button", name="Compute again with this length").click()
    page.get_by_text("It is being computed again; this is the result of before.").wait_for()
    page.get_by_text("mm: the baseline is").wait_for(timeout=_SOLVED_MS)
    page.get_by_text(re.compile(r"^[\d\s]+ triangles\.$")).wait_for()
    looks_as_kept(page, "result-uncalibrated")
    page.get_by_role("button", name="Use it as the rig's calibration").click()
    page.get_by_text("The rig uses this calibration.").wait_for()
    assert violations(page) == []
    page.get_by_role("link", name="look at it").click()
    page.get_by_role("heading", name="Found by scan").wait_for()
    page.get_by_role("button", name="Stop using it").click()
    page.get_by_role("button", name="Use it", exact=True).wait_for()
    page.get_by_role("button", name="Delete this calibration").click()
    page.get_by_role("alertdialog").get_by_role("button", name="Delete").click()
    page.wait_for_url("**/#/calibrate")
    page.get_by_role("link", name="Scan without a calibration").click()


def test_a_rig_is_calibrated_from_a_board_to_its_use(start: Start, tmp_path: Path, visit: Visit) -> None:
    rig = write_rig(tmp_path / "rig")
    with rig.with_name("scene.toml").open("a") as scene:
        scene.write(BALL)
    service = start(rig)
    # A scan that could not be reconstructed is not offered, and what helps is.
    # Nor does it matter that a page asked for a calibration that it had just had deleted.
    page = visit(service, "scan", ignored=r"422|404 .*/calibration/[0-9a-f-]+\)$")
    page.get_by_text("This rig is not calibrated. Calibrate it before you scan.").wait_for()
    disabled(page.get_by_role("button", name="Scan", exact=True))
    scan_without_a_calibration(page)
    page.get_by_role("region", name="Scan", exact=True).get_by_role("link", name="Calibrate").click()
    page.get_by_text("None is kept here yet.").wait_for()
    page.get_by_text("This rig is not calibrated.").wait_for()
    choose_board(page)
    page.get_by_label("Side of a square").fill("60")
    page.get_by_role("button", name="Board sheet").click()
    page.get_by_role("alert").get_by_text("the largest square that fits there is").wait_for()
    assert violations(page) == []
    page.get_by_label("Side of a square").fill("20")
    with page.expect_download() as download:
        page.get_by_role("button", name="Board sheet").click()
    download.value.save_as(tmp_path / "board.pdf")
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    page.get_by_label("Scale below").fill("180")
    page.get_by_label("Scale on the left").fill("120")
    page.get_by_label("Name").fill("walk")
    page.get_by_role("button", name="Start").click()

    page.wait_for_url("**/#/calibrate/*-*")
    page.get_by_text("Hold the board where every camera sees it").wait_for()
    assert violations(page) == []
    # The first of these is behind the wall, and refused; the others are enough.
    page.get_by_role("button", name="Capture all 11 positions").click()
    page.get_by_text("✗ Pose 1 refused: no camera sees the board").wait_for(timeout=_SOLVED_MS)
    assert "camera 'left': no chessboard 8x5, 20 mm found" in page.get_by_role("list").last.inner_text()
    page.reload()
    page.get_by_text("You may move the board.").wait_for()
    assert violations(page) == []
    page.get_by_text("✓ Pose 11 accepted").wait_for(timeout=_SOLVED_MS)
    page.get_by_text("10 poses accepted. Still wanted:").wait_for()
    page.get_by_text("40 of 40 corners").first.wait_for()
    page.get_by_role("img", name="left: 78 % of the image covered").wait_for()
    shows_the_live_picture(page)
    looks_as_kept(page, "calibrate-poses")

    page.get_by_role("button", name="Solve").click()
    page.get_by_text("Solving …").wait_for()
    page.reload()
    page.get_by_role("heading", name="What the solve says").wait_for(timeout=_SOLVED_MS)
    page.get_by_text(re.compile("✓ Good: the expected error of a scanned point is")).wait_for()
    count(page.get_by_role("row", name="left").get_by_text(re.compile(r"0\.0\d\d px")), 3)
    page.get_by_role("button", name="Use it").click()
    page.get_by_role("banner").get_by_text("ready").wait_for()
    assert violations(page) == []
    looks_as_kept(page, "calibrate-solved")
    with page.context.expect_page() as report:
        page.get_by_role("link", name="Report with pictures").click()
    report.value.get_by_role("heading", name="walk").first.wait_for()
    with page.expect_download() as download:
        page.get_by_role("link", name="calibration.json").click()
    download.value.save_as(tmp_path / "calibration.json")

    page.get_by_role("link", name="All calibrations").click()
    page.get_by_text("Scans use walk.").wait_for()
    (tmp_path / "notes.json").write_text('{"cameras": 1}')
    page.get_by_label("A calibration of slrig's").set_input_files(tmp_path / "notes.json")
    page.get_by_role("alert").get_by_text("the calibration sent").wait_for()
    page.get_by_label("A calibration of slrig's").set_input_files(tmp_path / "calibration.json")
    page.get_by_role("heading", name="What the file holds").wait_for()
    page.get_by_role("button", name="Compare with the one in use").click()
    page.get_by_text("Points in the working volume move by").wait_for()
    page.get_by_role("button", name="Delete this calibration").click()
    assert violations(page) == []
    page.get_by_role("alertdialog").get_by_role("button", name="Delete").click()
    page.get_by_text("Scans use walk.").wait_for()
    count(page.get_by_role("listitem"), 1)


def test_one_person_shoots_from_two_metres_away(start: Start, tmp_path: Path, visit: Visit) -> None:
    service = start(write_rig(tmp_path / "rig", head=SLOW))
    with Caller(service) as caller:
        calibration = caller.opened()
        caller.post(calibration["links"]["pose"], 202, position=1)
        page = visit(service, f"calibrate/{calibration['id']}", size=PHONE, dark=True, ignored="409")
        page.get_by_text("✓ Pose 1 accepted").wait_for()
        shows_the_live_picture(page)
        page.get_by_text("the board goes here").wait_for()
        looks_as_kept(page, "calibrate-phone-dark")

        # The space bar presses what has the focus, and shoots otherwise. The board did not move.
        page.get_by_role("heading", name="walk").click()
        page.keyboard.press("Space")
        # Nothing slow between these two: a pose is read in a second.
        page.get_by_text("Hold the board still.").wait_for()
        page.get_by_text("You may move the board.").wait_for()
        page.get_by_text("✗ Pose 2 refused").wait_for()
        assert violations(page) == []
        page.get_by_text("the same as pose 1").first.wait_for()
        fits(page)

        page.get_by_role("button", name="Delete pose 1").click()
        page.get_by_text("0 poses accepted.").wait_for()
        page.get_by_role("button", name="3 s", exact=True).click()
        page.get_by_role("button", name="Shoot every 3 s").click()
        page.get_by_role("timer").get_by_text("2").wait_for()
        page.get_by_text("✓ Pose 3 accepted").wait_for()
        page.get_by_role("timer").wait_for()
        assert violations(page) == []
        page.keyboard.press("x")
        page.get_by_role("timer").wait_for(state="detached")

        page.get_by_role("button", name="Shoot (space bar)").click()
        page.get_by_role("button", name="Stop", exact=True).click()
        page.get_by_text("Pose 4 stopped").wait_for()
        page.get_by_role("button", name="Solve").click()
        page.get_by_role("alert").get_by_text("Solve refused").wait_for()
        assert violations(page) == []
        assert [pose["number"] for pose in caller.settled(calibration)["shot"]] == [2, 3, 4]

    key = looking(service)
    page = visit(service, f"calibrate/{calibration['id']}", key=key)
    page.get_by_text("Your key is for looking").wait_for()
    page.get_by_text("Pose 4 stopped").wait_for()
    for name in ("Shoot (space bar)", "Solve", "Delete pose 3", "Delete this calibration"):
        disabled(page.get_by_role("button", name=name))
    assert violations(page) == []
