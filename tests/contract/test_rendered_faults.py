"""The sequencer on the rendered rig with faults on demand: each is overcome or refused, and the rig ends dark."""

from __future__ import annotations

from pathlib import Path

import pytest

from simulated_rig.device import SimulatedHead
from slrig.bundle.refused import Refused
from slrig.capture.sequencer import capture
from slrig.errors import DeviceGoneError, FrameTimeoutError, ScanEvidenceError, SlrigError
from slrig.model import Shot
from tests.contract.benches import simulated
from tests.contract.pairing import Truths, seen_by
from tests.contract.suite import rig_of


def run(folder: Path, faults: dict[str, object], refused: list[Refused] | None = None) -> list[Shot]:
    bench = simulated(folder, faults=faults)
    told = [] if refused is None else refused
    with bench.head() as head:
        assert isinstance(head, SimulatedHead)
        try:
            return list(capture(rig_of(head), bench.sequence, refused=told.append))
        finally:
            assert not head.projector.lit


LATER = list(range(4, 200))


@pytest.mark.parametrize(
    ("faults", "kind", "words"),
    [
        (
            {"drop_frames": LATER[1:], "cameras": ["left"]},
            FrameTimeoutError,
            r"'left', pattern 5 .*failed 3 times.*no frame came within",
        ),
        (
            {"stale_frames": LATER, "cameras": ["right"]},
            ScanEvidenceError,
            r"'right', pattern 4 .*failed 3 times.*equals that of pattern 3",
        ),
        ({"corrupt_frames": LATER}, ScanEvidenceError, r"'left', pattern 4 .*failed 3 times"),
        ({"corrupt_probability": 1.0}, ScanEvidenceError, r"'left', pattern 0 .*failed 3 times"),
        ({"stale_probability": 1.0}, ScanEvidenceError, r"failed 3 times"),
        ({"unplug_camera_at_frame": 3}, DeviceGoneError, "gone"),
        ({"unplug_projector_at_show": 3}, DeviceGoneError, "gone"),
        ({"lamp_off": True}, ScanEvidenceError, "is the lamp off"),
        # Light that comes a whole exposure after the projector says so.
        ({"light_delay_s": 0.05}, ScanEvidenceError, "pattern"),
    ],
)
def test_a_fault_that_stays_is_refused(
    tmp_path: Path, faults: dict[str, object], kind: type[SlrigError], words: str
) -> None:
    with pytest.raises(kind, match=words):
        run(tmp_path, faults)


@pytest.mark.parametrize(
    "faults",
    [
        {"drop_frames": [5]},
        {"late_frames": [5]},
        {"drop_frames": [5, 7], "cameras": ["left"]},
        {"stale_frames": [4], "cameras": ["right"]},
        {"stale_frames": [14]},
        {"corrupt_frames": [0]},
        {"corrupt_frames": [1]},
        {"corrupt_frames": [7]},
        {"corrupt_frames": [15]},
        {"stale_frames": [21]},
        {"jitter_s": 0.02},
    ],
    ids=str,
)
def test_a_fault_that_passes_is_overcome(tmp_path: Path, faults: dict[str, object]) -> None:
    (tmp_path / "sound").mkdir()
    sound = simulated(tmp_path / "sound")
    sequence, expected = sound.sequence, seen_by(sound.open_rig, sound.sequence)
    refused: list[Refused] = []
    latest = {(shot.camera, shot.pattern): shot for shot in run(tmp_path, faults, refused)}
    assert len(latest) == 2 * len(sequence)
    assert (refused == []) == ("jitter_s" in faults or "late_frames" in faults)
    truths = {name: Truths.of(name, sequence, expected) for name in ("left", "right")}
    assert [words for shot in latest.values() if (words := truths[shot.camera].wrong(shot))] == []
