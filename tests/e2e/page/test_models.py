"""Models as a person makes them on the page: scans on record joined, and an object that is turned by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.e2e.conftest import Start, write_rig
from tests.e2e.page.conftest import PHONE, Visit, count, fits, violations
from tests.e2e.page.golden import looks_as_kept
from tests.e2e.test_model_walk import ANGLES, STAGE, on_a_stage

pytestmark = pytest.mark.slow

# As of a stage that was measured with a ruler.
COVARIANCE = np.diag([0.25, 0.0, 0.25, 1e-4, 0.0, 1e-4]).tolist()


def test_scans_are_joined_and_an_object_is_turned_by_hand(start: Start, tmp_path: Path, visit: Visit) -> None:
    data = tmp_path / "data"
    on_a_stage(data)
    service = start(write_rig(tmp_path / "rig"), data)
    page = visit(service, "models", size=(1280, 1100), ignored="4")
    page.get_by_text("None yet.").wait_for()
    page.get_by_text("This rig has no turntable.").wait_for()
    boxes = page.get_by_role("region", name="Join scans").get_by_role("checkbox")
    count(boxes, len(ANGLES))
    # Listed from new to old; the first that is chosen gives the frame.
    for number in reversed(range(len(ANGLES))):
        boxes.nth(number).check()
    page.get_by_role("button", name="Make one model of 3").click()
    page.get_by_role("alert").get_by_text("axis: expected that of the stage").wait_for()
    assert violations(page) == []

    with service.client() as client:
        axis = {**STAGE, "covariance": COVARIANCE}
        client.stage.put({"format": "slrig-stage", "version": 1, "axis": axis})
    page.get_by_role("button", name="Make one model of 3").click()
    page.get_by_text("succeeded").wait_for()
    page.get_by_role("img", name="The model from six sides").wait_for()
    page.locator("canvas[data-level=full]").wait_for()
    count(page.get_by_role("region", name="Figures").get_by_text("model.ply"), 1)
    page.get_by_role("columnheader", name="Over σ").wait_for()
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
    page.get_by_role("button", name="I have turned it: next view").click()
    page.get_by_text("turn the object by 120° for view 3 of 3").wait_for()
    page.get_by_role("button", name="Stop it").click()
    page.get_by_role("alert").get_by_text("cancelled while its views were shot").wait_for()
    page.get_by_role("button", name="Delete").click()
    page.get_by_role("button", name="Delete it").click()
    page.get_by_text("3 views,").wait_for()
