"""The sequencer on the rendered rig with faults on demand: each is refused or overcome, and the rig ends dark."""

from __future__ import annotations

from pathlib import Path

import pytest

from simulated_rig.device import SimulatedHead
from slrig.capture.sequencer import capture
from slrig.errors import DeviceGoneError, FrameTimeoutError, ScanEvidenceError, SlrigError
from slrig.model import Shot
from tests.contract.benches import simulated
from tests.contract.suite import rig_of


def run(folder: Path, faults: dict[str, object]) -> list[Shot]:
    bench = simulated(folder, faults=faults)
    with bench.head() as head:
        assert isinstance(head, SimulatedHead)
        try:
            return list(capture(rig_of(head), bench.sequence))
        finally:
            assert not head.projector.lit


@pytest.mark.parametrize(
    ("faults", "kind", "words"),
    [
        ({"drop_frames": [5, 6], "cameras": ["left"]}, FrameTimeoutError, r"'left' gave no frame of pattern 5 "),
        (
            {"stale_frames": [4], "cameras": ["right"]},
            ScanEvidenceError,
            r"'right', pattern 4 .*equals that of pattern 3",
        ),
        ({"stale_frames": [14]}, ScanEvidenceError, r"'left', pattern 14 .*equals that of pattern 13"),
        ({"corrupt_frames": [7]}, ScanEvidenceError, r"'left', pattern 7 "),
        ({"corrupt_frames": [15]}, ScanEvidenceError, r"'left', pattern 15 "),
        ({"unplug_camera_at_frame": 3}, DeviceGoneError, "gone"),
        ({"unplug_projector_at_show": 3}, DeviceGoneError, "gone"),
        ({"lamp_off": True}, ScanEvidenceError, "is the lamp off"),
        # Light that comes a whole exposure after the projector says so.
        ({"light_delay_s": 0.05}, ScanEvidenceError, "pattern"),
    ],
)
def test_a_fault_is_refused(tmp_path: Path, faults: dict[str, object], kind: type[SlrigError], words: str) -> None:
    with pytest.raises(kind, match=words):
        run(tmp_path, faults)


@pytest.mark.parametrize("faults", [{"drop_frames": [5]}, {"late_frames": [5]}])
def test_a_frame_that_is_lost_or_late_is_overcome(tmp_path: Path, faults: dict[str, object]) -> None:
    bench = simulated(tmp_path)
    assert len(run(tmp_path, faults)) == 2 * len(bench.sequence)
