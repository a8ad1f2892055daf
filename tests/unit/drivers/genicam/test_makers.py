"""What makers of GenICam cameras name otherwise: what starts a frame, and the rate that settings result in."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.genicam import GenicamCamera, open_camera
from slrig.devices import CameraSettings, Trigger
from tests.contract.genicam_bench import FakeGigE, require_aravis, scene, table
from tests.contract.stage import Stage

LONG_S = 5.0
Opened = Callable[..., GenicamCamera]


@pytest.fixture
def other(request: pytest.FixtureRequest) -> Iterator[FakeGigE]:
    """A camera of another kind."""
    require_aravis()
    peer = FakeGigE(Stage(scene()), kind=request.param)
    peer.start()
    yield peer
    peer.stop()


@pytest.mark.parametrize("other", ["exposure start"], indirect=True)
def test_a_camera_that_names_its_trigger_exposure_start_works_by_each(other: FakeGigE) -> None:
    camera = open_camera("left", table(), Path())
    assert camera.info.triggers == set(Trigger)
    camera.configure(CameraSettings(0.002, 1.0))
    for trigger in Trigger:
        camera.arm(1, trigger)
        if trigger is Trigger.SOFTWARE:
            camera.trigger()
        elif trigger is Trigger.HARDWARE:
            other.pulse()
        assert np.asarray(camera.read(0, LONG_S).image).size
        camera.disarm()
    camera.close()


def test_the_least_period_is_what_the_camera_says(opened: Opened) -> None:
    camera = opened()
    for exposure_s in (0.004, 0.013):
        applied = camera.configure(CameraSettings(exposure_s, 1.0))
        assert applied.least_period_s == pytest.approx(exposure_s + 0.002)


@pytest.mark.parametrize("other", ["stock"], indirect=True)
@pytest.mark.usefixtures("other")
def test_a_camera_that_does_not_say_has_no_least_period() -> None:
    camera = open_camera("left", table(), Path())
    assert camera.configure(CameraSettings(0.004, 1.0)).least_period_s is None
    camera.close()
