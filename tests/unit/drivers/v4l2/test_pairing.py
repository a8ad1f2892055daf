"""No frame is ever paired with a pattern that it does not show, whatever a camera does to its frames."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from slrig.devices import CameraSettings, Trigger
from tests.contract.pairing import FRAMES
from tests.contract.stage import StagedProjector
from tests.contract.v4l2_bench import Faked, FakeDevice, sequence, staged
from tests.contract.v4l2_sensor import GAIN_UNITS

pytestmark = pytest.mark.slow

EXPOSURE_S, GAIN = 0.0008, 8.0


def wrongly_paired(plugged: Callable[..., FakeDevice], stamp: str, frames: int) -> tuple[int, int]:
    """Show patterns at random times and read a frame of each, from a rolling shutter that loses, damages and delays.

    Returns the frames that show another pattern than theirs, or a mixture, and the frames that the sensor made.
    """
    faked = Faked(
        stamp=stamp, readout_s=0.0015, bands=4, jitter_s=0.001, lost=0.1, corrupt=0.05, noise_when_corrupt=False
    )
    stage = staged(noise_dn=1.0)
    device = plugged(faked, stage)
    camera = device.open_camera(frame_rate_hz=400, gain_unity=GAIN_UNITS)
    camera.configure(CameraSettings(EXPOSURE_S, GAIN))
    patterns = sequence()
    truth = np.array([stage.expected(profile, exposure_s=EXPOSURE_S * GAIN) for profile in patterns.profiles], float)
    projector = StagedProjector(stage)
    projector.load(patterns)
    camera.arm(frames, Trigger.FREE)
    rng, idle = np.random.default_rng(5), threading.Event()
    wrong, number = 0, -1
    for _ in range(frames):
        if rng.random() < 0.1:
            idle.wait(rng.random() * 0.03)
        index = int(rng.integers(len(patterns)))
        shown = projector.show(index)
        after_ns = shown.t_visible_ns + shown.t_err_ns
        frame = camera.read(after_ns, 2.0)
        assert after_ns <= frame.t_start_ns - frame.t_err_ns < time.monotonic_ns()
        assert frame.sequence_number > number
        number = frame.sequence_number
        away = np.square(frame.image - truth).mean(axis=(1, 2))
        # White and black are in the sequence twice. Noise alone is 1 grey value.
        wrong += bool(np.any(truth[int(np.argmin(away))] != truth[index])) or float(away[index]) > 2.0
    camera.close()
    return wrong, number


@pytest.mark.parametrize(
    ("stamp", "frames"),
    [("start", FRAMES), ("first packet", FRAMES), ("end", FRAMES), ("none", FRAMES // 2), ("other clock", FRAMES // 2)],
)
def test_no_frame_is_paired_wrongly(plugged: Callable[..., FakeDevice], stamp: str, frames: int) -> None:
    """Without a stamp of the kernel's clock the driver goes by when a frame came, the same way for both of these."""
    wrong, made = wrongly_paired(plugged, stamp, frames)
    assert wrong == 0
    assert made > 2 * frames
