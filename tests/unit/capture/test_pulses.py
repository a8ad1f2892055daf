"""The least time between trigger pulses that cameras follow."""

from __future__ import annotations

import pytest

from slrig.capture.pulses import measure_trigger_period
from slrig.devices import Trigger
from slrig.errors import FrameTimeoutError
from slrig.patterns.sequence import encode
from tests.unit.capture.fake_rig import PROJECTOR, CameraFaults, FakeRig, fake_rig, patterns_for

SEQUENCE = encode(patterns_for(line_shift=False), PROJECTOR)
TOLD_S = 0.0115
NEVER_S = 10.0


def wired(readout_s: float | None) -> FakeRig:
    """Two cameras that state a period of 11.5 ms, one of which takes no pulse while it reads out."""
    hardware = frozenset({Trigger.HARDWARE})
    return fake_rig(
        projector={"plays": True},
        triggers={"left": hardware, "right": hardware},
        faults={
            "left": CameraFaults(min_period_s=TOLD_S),
            "right": CameraFaults(min_period_s=TOLD_S, readout_s=readout_s),
        },
    )


@pytest.mark.parametrize(("readout_s", "least_s"), [(None, TOLD_S), (0.0115, 0.0215)])
def test_the_least_period_is_found_by_a_few_plays(readout_s: float | None, least_s: float) -> None:
    fake = wired(readout_s)
    asked_s, found_s = measure_trigger_period(fake.rig, SEQUENCE)
    assert asked_s == pytest.approx(TOLD_S)
    assert least_s <= found_s + 1e-9 < least_s + TOLD_S / 16 + 1e-9
    assert len(fake.world.periods_s) <= 8
    assert fake.at_rest


def test_a_camera_that_misses_pulses_however_slowly_they_come_says_so() -> None:
    fake = wired(NEVER_S)
    with pytest.raises(FrameTimeoutError, match=r"even when these come every 0\.046 s; check the trigger cable"):
        measure_trigger_period(fake.rig, SEQUENCE)
    assert fake.at_rest
