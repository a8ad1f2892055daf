"""Rigs that a doctor does not meet every day: other triggers, projectors that hold their patterns, no calibration."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from simulated_rig.device import SimulatedHead, open_head
from slrig.devices import Camera, CameraInfo, CameraSettings, Projector, ProjectorInfo, Rig, Shown, Trigger
from slrig.devices.camera import AppliedSettings
from slrig.doctor import timing
from slrig.doctor.doctor import Diagnosis, doctor_sequence, examine
from slrig.doctor.findings import Severity
from slrig.doctor.light import look
from slrig.doctor.viewing import Viewer
from slrig.errors import FrameTimeoutError, ScanEvidenceError, UnsupportedByDeviceError
from slrig.model import Frame, PatternSequence, White
from slrig.patterns.sequence import encode, scan_patterns
from tests.unit.simulated_rig.building import FACING_PLATE, head_options

LAMP = {"size_px": [96, 72], "focal_px": [400.0, 400.0], "blur_px": 0.4}
EYE = {"size_px": [96, 72], "focal_px": [520.0, 520.0], "blur_px": 0.4}


class OtherCamera:
    """A rendered camera with other triggers, that loses frames now and then."""

    def __init__(
        self,
        camera: Camera,
        triggers: frozenset[Trigger],
        *,
        lose: frozenset[int] = frozenset(),
        notes: tuple[str, ...] = (),
    ) -> None:
        self._camera = camera
        self._notes = notes
        self._triggers = triggers
        self._lose = lose
        self._reads = 0

    @property
    def info(self) -> CameraInfo:
        return replace(self._camera.info, triggers=self._triggers, notes=self._notes)

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        return self._camera.configure(settings)

    def arm(self, count: int, trigger: Trigger) -> None:
        assert trigger in self._triggers
        self._camera.arm(count, trigger)

    def trigger(self) -> None:
        self._camera.trigger()

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        self._reads += 1
        frame = self._camera.read(after_ns, timeout_s)
        if self._reads in self._lose:
            message = "lost"
            raise FrameTimeoutError(message)
        return frame

    def disarm(self) -> None:
        self._camera.disarm()

    def close(self) -> None:
        self._camera.close()


class VagueCamera(OtherCamera):
    """A rendered camera whose time stamps are off by 10 ms either way, at random, and that says so or does not."""

    def __init__(self, camera: Camera, *, says_so: bool) -> None:
        super().__init__(camera, frozenset({Trigger.FREE}))
        self._rng = np.random.default_rng(5)
        self._error_ns = 10_000_000 if says_so else 0

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        frame = super().read(after_ns, timeout_s)
        off_ns = int(self._rng.integers(-10_000_000, 10_000_000))
        start_ns, end_ns = frame.t_start_ns + off_ns, frame.t_end_ns + off_ns
        return replace(frame, t_start_ns=start_ns, t_end_ns=end_ns, t_err_ns=self._error_ns)


class HoldingProjector:
    """A rendered projector that takes a run of the patterns that it holds, and no others."""

    def __init__(self, projector: Projector, held: PatternSequence, *, greys: bool = False) -> None:
        self._projector = projector
        self._held = held
        self._greys = greys

    @property
    def info(self) -> ProjectorInfo:
        return self._projector.info

    def load(self, sequence: PatternSequence) -> None:
        of_greys = all(isinstance(each, White) for each in sequence.patterns[1:])
        if len(sequence) > 2 and sequence.patterns != self._held.patterns and not (of_greys and self._greys):
            message = "it holds other patterns"
            raise UnsupportedByDeviceError(message)
        if of_greys and self._greys:
            # One bit deep: whatever is not black is white.
            lit = tuple((profile > 0).astype(profile.dtype) * 255 for profile in sequence.profiles)
            sequence = PatternSequence(sequence.projector, sequence.patterns, lit)
        self._projector.load(sequence)

    def show(self, index: int) -> Shown:
        return self._projector.show(index)

    def play(self, exposure_s: float, period_s: float) -> None:
        self._projector.play(exposure_s, period_s)

    def stop(self) -> None:
        self._projector.stop()

    def blank(self) -> None:
        self._projector.blank()

    def close(self) -> None:
        self._projector.close()


@contextmanager
def small_rig(folder: Path, **options: object) -> Iterator[Rig]:
    """An open rendered rig; its projector is dark in the end."""
    (folder / "scene.toml").write_text(FACING_PLATE)
    head = open_head(head_options(camera=EYE, projector=LAMP, ambient=0.02, **options), folder)
    assert isinstance(head, SimulatedHead)
    settings = {"eye": CameraSettings(0.014)}
    with Rig("small", dict(head.cameras), head.projector, settings, head.calibration, head, clock=head.clock) as opened:
        yield opened
        assert not head.projector.lit


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with small_rig(tmp_path) as opened:
        yield opened


def own(rig: Rig) -> PatternSequence:
    size = rig.projector.info.size
    patterns = scan_patterns(
        size, line_shift=True, period_px=8, line_width_px=1, gray_cell_px=None, gray_offset_px=0, rows=False
    )
    return encode(patterns, size)


def examined(rig: Rig) -> Diagnosis:
    return examine(rig, own_sequence=own(rig))


def names(diagnosis: Diagnosis, severity: Severity) -> set[str]:
    return {each.name for each in diagnosis.of(severity)}


@pytest.mark.parametrize("trigger", [Trigger.FREE, Trigger.SOFTWARE])
def test_a_sound_rig_is_sound_by_any_trigger_though_frames_are_lost(rig: Rig, trigger: Trigger) -> None:
    camera = OtherCamera(rig.cameras["eye"], frozenset({trigger}), lose=frozenset(range(5, 400, 31)))
    diagnosis = examined(replace(rig, cameras={"eye": camera}))
    assert diagnosis.of(Severity.FAULT) == ()
    assert diagnosis.of(Severity.NOTE) == ()
    assert {"patterns.verified", "picture.upright", "focus.sharp", "sharpening.none", "flicker.none"} <= names(
        diagnosis, Severity.OK
    )
    # A camera that waits for its trigger while the projector works sees no flash as it happens.
    told = "timing.late" if trigger is Trigger.FREE else "timing.punctual"
    assert told in names(diagnosis, Severity.OK)


def test_a_triggered_camera_that_sees_no_flash_happen_still_tells_late_light(tmp_path: Path) -> None:
    with small_rig(tmp_path, faults={"light_delay_s": 0.008}) as rig:
        viewer = Viewer(rig, "eye", wait_s=0.5)
        seen, _ = look(viewer, doctor_sequence(rig.projector.info.size), others="")
        assert seen is not None
        told = timing.punctual(rig, seen, ScanEvidenceError("no flash was seen as it happened"))
    assert (told.name, told.severity) == ("timing.late", Severity.FAULT)
    assert "no flash was seen as it happened" in told.found


@pytest.mark.parametrize(("says_so", "name"), [(True, "timing.stamps"), (False, "timing.jitter")])
def test_vague_time_stamps_are_not_put_down_to_the_projector(rig: Rig, says_so: bool, name: str) -> None:
    vague = replace(rig, cameras={"eye": VagueCamera(rig.cameras["eye"], says_so=says_so)})
    seen, _ = look(Viewer(vague, "eye", wait_s=0.1), doctor_sequence(rig.projector.info.size), others="")
    assert seen is not None
    _, findings = timing.latency(vague, {"eye": seen}, search_s=0.1, told=lambda *_: None)
    [told] = [each for each in findings if each.name in {"timing.stamps", "timing.jitter"}]
    assert told.name == name
    assert told.subject == ("camera 'eye'" if says_so else "projector")
    assert ("they are the limit of what can be measured" in told.found) is says_so


def test_what_a_driver_tells_of_its_camera_is_passed_on(rig: Rig) -> None:
    slow = OtherCamera(rig.cameras["eye"], frozenset({Trigger.FREE}), notes=("gives 5 frames per second",))
    [told] = examined(replace(rig, cameras={"eye": slow})).of(Severity.NOTE)
    assert (told.name, told.subject) == ("device.told", "camera 'eye'")
    assert "gives 5 frames per second" in told.found


def test_a_camera_on_a_wire_is_left_alone_and_named(rig: Rig) -> None:
    wired = OtherCamera(rig.cameras["eye"], frozenset({Trigger.HARDWARE}))
    diagnosis = examined(replace(rig, cameras={"eye": wired}))
    [told] = diagnosis.of(Severity.NOTE)
    assert told.name == "device.unexamined"
    assert "can be triggered by wire only (hardware)" in told.found
    assert diagnosis.healthy
    assert diagnosis.exposures == {}


def test_a_projector_that_holds_its_patterns_is_examined_with_them(rig: Rig) -> None:
    diagnosis = examined(replace(rig, projector=HoldingProjector(rig.projector, own(rig))))
    assert diagnosis.of(Severity.FAULT) == ()
    assert {"patterns.own", "response.binary", "picture.untold", "focus.untold"} <= names(diagnosis, Severity.OK)
    assert diagnosis.response is None
    assert diagnosis.synchronisation is None


def test_a_projector_of_one_bit_has_no_response(rig: Rig) -> None:
    held = doctor_sequence(rig.projector.info.size)
    diagnosis = examined(replace(rig, projector=HoldingProjector(rig.projector, held, greys=True)))
    assert diagnosis.healthy
    assert "response.binary" in names(diagnosis, Severity.OK)
    assert "patterns.own" not in names(diagnosis, Severity.OK)


def test_a_rig_without_calibration_is_told_so_and_its_picture_is_still_judged(rig: Rig) -> None:
    diagnosis = examined(replace(rig, calibration=None))
    assert names(diagnosis, Severity.NOTE) == {"device.uncalibrated"}
    assert "picture.upright" in names(diagnosis, Severity.OK)


def test_progress_is_told(rig: Rig) -> None:
    stages: list[str] = []
    examine(rig, own_sequence=own(rig), told=lambda stage, _fraction, _detail: stages.append(stage))
    order = list(dict.fromkeys(stages))
    assert order[:2] == ["patterns", "light"]
    assert "flashes before eye" in order
    assert order[-1] == "exposure"
