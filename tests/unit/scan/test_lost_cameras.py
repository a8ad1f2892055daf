"""A scan of several cameras goes on without one that fails or sees nothing, and says so; without others it ends."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from slrig.bundle import read_bundle
from slrig.bundle.sidecars import read_notes, read_refused
from slrig.capture.exposure import check_exposures
from slrig.devices import Trigger
from slrig.errors import DeviceGoneError, ScanEvidenceError, SlrigError, UnsupportedByDeviceError
from slrig.jobs.job import FrameFeed
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import PatternPlan, ScanPlan
from tests.unit.capture.fake_rig import CameraFaults, FakeRig, fake_rig

SHORT = PatternPlan(line_shift=False, gray_cell_px=32)
DEAD, SILENT = CameraFaults(unplug_at=4), CameraFaults(drop=frozenset(range(200)))
NAMES = ("left", "right", "third")


def rig_of(
    faults: dict[str, CameraFaults], *, names: tuple[str, ...] = NAMES, trigger: Trigger = Trigger.SOFTWARE
) -> FakeRig:
    return fake_rig(
        cameras=names,
        faults=faults,
        projector={"plays": trigger is Trigger.HARDWARE},
        triggers=dict.fromkeys(names, frozenset({trigger})),
    )


def captured(fake: FakeRig, folder: Path, *, plan: ScanPlan | None = None, may_lose: bool = True) -> FrameFeed:
    feed = FrameFeed(lambda _message: True)
    try:
        capture_frames(fake.rig, plan or ScanPlan(patterns=SHORT), folder, frames=feed, may_lose=may_lose).finish()
    finally:
        assert not fake.projector.lit
    return feed


def dark(fake: FakeRig, *names: str) -> FakeRig:
    """The rig with caps on the lenses of these cameras."""
    for name in names:
        fake.cameras[name].scene.white = fake.cameras[name].scene.ambient = 0.0
    return fake


@pytest.mark.parametrize("trigger", Trigger)
@pytest.mark.parametrize(
    ("lost", "words"),
    [(DEAD, "is gone"), (SILENT, "frame"), (None, "is the lamp off, the lens cap on")],
    ids=["dies", "silent", "capped"],
)
def test_a_scan_goes_on_without_a_camera_that_is_lost_and_says_so(
    tmp_path: Path, trigger: Trigger, lost: CameraFaults | None, words: str
) -> None:
    fake = rig_of({} if lost is None else {"right": lost}, trigger=trigger)
    feed = captured(fake if lost is not None else dark(fake, "right"), tmp_path / "bundle")
    capture = read_bundle(tmp_path / "bundle").capture
    assert set(capture.cameras) == {"left", "third"}
    assert len(capture.shots) == 2 * len(capture.patterns)
    summary = check_exposures(capture, read_refused(tmp_path / "bundle"))
    assert (summary.verified, summary.faults) == (len(capture.patterns), ())
    assert feed.evidence is not None
    assert (feed.evidence.verified, feed.evidence.faults) == (len(capture.patterns), ())
    note = read_notes(tmp_path / "bundle")[0]
    assert note.startswith("camera 'right' was lost, and the scan went on without it: ")
    assert words in note


def test_a_camera_that_could_not_be_opened_is_told_of(tmp_path: Path) -> None:
    fake = rig_of({}, names=("left",))
    captured(replace(fake, rig=replace(fake.rig, lost={"right": "no such camera"})), tmp_path / "bundle")
    notes = read_notes(tmp_path / "bundle")
    assert notes[0] == "camera 'right' was lost, and the scan went on without it: no such camera"


@pytest.mark.parametrize("unplugged_at", [3, 22], ids=["first exposure", "second exposure"])
def test_a_camera_that_dies_in_a_bracket_leaves_none_of_its_frames(tmp_path: Path, unplugged_at: int) -> None:
    fake = fake_rig(cameras={"left": 0.6, "right": 0.6}, faults={"right": CameraFaults(unplug_at=unplugged_at)})
    captured(fake, tmp_path / "bundle", plan=ScanPlan(exposures_s=(0.005, 0.01)))
    capture = read_bundle(tmp_path / "bundle").capture
    assert set(capture.cameras) == {"left"}
    assert len(capture.shots) == 2 * len(capture.patterns)
    summary = check_exposures(capture, read_refused(tmp_path / "bundle"))
    assert (summary.verified, summary.faults) == (len(capture.patterns), ())


@pytest.mark.parametrize(
    ("faults", "names", "kind", "words"),
    [
        (
            {"left": DEAD, "right": DEAD},
            ("left", "right"),
            DeviceGoneError,
            "'right' is gone.*Before that, camera 'left'",
        ),
        ({"right": CameraFaults(garbled=frozenset(range(200)))}, NAMES, ScanEvidenceError, "camera 'right'"),
        ({"right": CameraFaults(readback=1.5)}, NAMES, UnsupportedByDeviceError, "camera 'right'"),
    ],
    ids=["none is left", "wrong frames", "other settings"],
)
def test_a_scan_ends_without_cameras_and_by_faults_that_are_no_loss(
    tmp_path: Path, faults: dict[str, CameraFaults], names: tuple[str, ...], kind: type[SlrigError], words: str
) -> None:
    with pytest.raises(kind, match=words):
        captured(rig_of(faults, names=names), tmp_path / "bundle")
