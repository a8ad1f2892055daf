"""Captures by the timing rules of the drivers: no frame is paired wrongly, and none is waited for long."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest

from slrig.capture.latency import measure_latency
from slrig.capture.sequencer import capture
from slrig.devices import Rig, Synchronisation
from slrig.errors import FrameTimeoutError
from slrig.model import Pixels, Size
from slrig.patterns.sequence import encode
from tests.contract.live_devices import Webcam, live_rig
from tests.contract.pairing import FRAMES, wrong_pairings
from tests.contract.stage import REFERENCE_EXPOSURE_S, Stage
from tests.unit.capture.fake_rig import Scene, patterns_for

SIZE = Size(2048, 96)
SEQUENCE = encode(patterns_for(SIZE), SIZE)
"""30 patterns, as a projector of full size has."""

SMALL = Size(128, 96)
DISTURBED = {"lost": 0.1, "damaged": 0.05, "jitter_s": 0.002}
HOLDS_S = 0.03


def stage(exposure_s: float, size: Size = SIZE) -> Stage:
    """A display whose light is late, now and then by 1 ms more; as bright at any exposure."""
    scene = Scene(noise_dn=1.0, white=0.6 * REFERENCE_EXPOSURE_S / exposure_s, projector=size)
    scene.column_px += (size.width_px - SMALL.width_px) / 2
    return Stage(scene, latency_s=0.03, jitter_s=0.001)


@dataclass(frozen=True)
class Live:
    """A live rig, and the stage before it."""

    rig: Rig
    stage: Stage


def live(webcam: Webcam, *, refresh_hz: float = 60.0, size: Size = SIZE) -> Live:
    where = stage(1 / refresh_hz, size)
    return Live(live_rig(where, webcam, refresh_hz=refresh_hz), where)


def measured(rig: Rig) -> Synchronisation:
    return measure_latency(rig, trials=20, search_s=0.15).synchronisation


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("fps", "disturbed", "proven"), [(240.0, DISTURBED, True), (120.0, {"lost": 0.1, "jitter_s": 0.002}, False)]
)
def test_no_frame_is_paired_wrongly(fps: float, disturbed: dict[str, float], proven: bool) -> None:
    """At 240 refreshes a second, so that many fit into a test; 5000 with all disturbances were counted when this was
    written. Without damage, which no time stamp tells, nothing but the stamps is needed.
    """
    sequence = encode(patterns_for(SMALL), SMALL)
    one = live(Webcam(fps=fps, **disturbed), refresh_hz=240.0, size=SMALL)
    rig = replace(one.rig, synchronisation=measured(one.rig))

    def expected(_camera: str, index: int) -> Pixels:
        return one.stage.expected(sequence.profiles[index], exposure_s=1 / 240)

    result = wrong_pairings(
        lambda: rig, sequence, expected, frames=FRAMES, seed=2, longest_idle_s=HOLDS_S, proven=proven
    )
    assert result.frames >= FRAMES
    assert (result.wrong, result.examples) == (0, ())
    assert result.shot_again > 0.03 * FRAMES
    assert result.refused_scans < result.scans / 2


def test_a_camera_that_gives_no_frame_ends_a_capture() -> None:
    rig = replace(live(Webcam(lost=1.0)).rig, synchronisation=Synchronisation(0.0, 0.0, earliest_s=0.0))
    with pytest.raises(FrameTimeoutError, match="no frame came within"):
        list(capture(rig, SEQUENCE, timeout_s=0.1))
