"""Unusual rigs: other triggers, projectors that hold their patterns, no calibration, cameras that sharpen."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest

from simulated_rig.device import SimulatedHead, open_head
from slrig.capture.latency import measure_latency
from slrig.devices import AppliedSettings, Camera, CameraSettings, Projector, Rig, Trigger
from slrig.doctor import timing
from slrig.doctor.doctor import Diagnosis, doctor_sequence, examine
from slrig.doctor.image import check_calibrated, check_exposures, check_sharpening, check_steady, measure_response
from slrig.doctor.light import CameraSession, Finding, Severity, locate_picture, measure_light
from slrig.doctor.measures import depth_mm_per_px
from slrig.errors import FrameTimeoutError, ScanEvidenceError, UnsupportedByDeviceError
from slrig.jobs.listener import Listener
from slrig.model import FloatArray, Frame, PatternSequence, Pinhole, Pixels, Size, White
from slrig.patterns.sequence import encode, scan_patterns
from tests.core import parametrize_core
from tests.unit.capture.fake_rig import CameraFaults, fake_rig
from tests.unit.simulated_rig.building import FACING_PLATE, head_options

LAMP = {"size_px": [96, 72], "focal_px": [400.0, 400.0], "blur_px": 0.4}
EYE = {"size_px": [96, 72], "focal_px": [520.0, 520.0], "blur_px": 0.4}


PRINTED = """
[[object]]
shape = "plane"
size_mm = [400.0, 400.0]
rotation_deg = [6.0, -10.0, 0.0]
albedo = 0.8
texture = { kind = "checker", contrast = 0.6, scale_mm = 35.0 }
"""
Process = Callable[[Pixels], Pixels]


class OtherCamera:
    """A rendered camera that is another in what a test names. lose : the reads, counted from 1, that time out.

    change : what it makes of its frames before it gives them. longest_s : an exposure that is longer cannot be armed.
    takes : the exposure that it takes for one that it says to take.
    """

    def __init__(
        self, camera: Camera, *, lose: Container[int] = (), change: Callable[[Frame], Frame] = lambda each: each,
        longest_s: float = math.inf, takes: Callable[[float], float] = lambda each: each, **info: Any,
    ) -> None:  # fmt: skip
        self._camera, self._lose, self._change, self._longest_s, self._takes = camera, lose, change, longest_s, takes
        self.info = replace(camera.info, **info)
        self._reads = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        self._camera.configure(replace(settings, exposure_s=self._takes(settings.exposure_s)))
        self._applied = AppliedSettings(settings.exposure_s, settings.gain)
        return self._applied

    def arm(self, count: int, trigger: Trigger) -> None:
        assert trigger in self.info.triggers
        if self._applied.exposure_s > self._longest_s:
            message = "its frames are shorter"
            raise UnsupportedByDeviceError(message)
        self._camera.arm(count, trigger)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        self._reads += 1
        frame = self._camera.read(after_ns, timeout_s)
        if self._reads in self._lose:
            message = "lost"
            raise FrameTimeoutError(message)
        return self._change(frame)


class HoldingProjector:
    """A rendered projector that takes a run of the patterns that it holds, and no others. greys : and any of greys."""

    def __init__(self, projector: Projector, held: PatternSequence, *, greys: bool = False) -> None:
        self._projector = projector
        self._held = held
        self._greys = greys

    def __getattr__(self, name: str) -> Any:
        return getattr(self._projector, name)

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


def with_camera(rig: Rig, **other: Any) -> Rig:
    """The rig with a camera that is another, see `OtherCamera`."""
    return replace(rig, cameras={"eye": cast("Camera", OtherCamera(rig.cameras["eye"], **other))})


@contextmanager
def small_rig(
    folder: Path,
    scene: str = FACING_PLATE,
    *,
    eye: Any = EYE,
    lamp: Any = LAMP,
    exposure_s: float = 0.014,
    ambient: float = 0.02,
    **more: Any,
) -> Iterator[Rig]:
    """An open rendered rig; its projector is dark in the end."""
    (folder / "scene.toml").write_text(scene)
    head = open_head(head_options(camera=eye, projector=lamp, ambient=ambient, **more), folder)
    assert isinstance(head, SimulatedHead)
    settings = {"eye": CameraSettings(exposure_s)}
    with Rig("small", dict(head.cameras), head.projector, settings, head.calibration, head, clock=head.clock) as opened:
        yield opened
        assert not head.projector.is_lit


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


def run_doctor(rig: Rig, **options: Any) -> Diagnosis:
    return examine(rig, own_sequence=own(rig), **options)


def names(diagnosis: Diagnosis, severity: Severity) -> set[str]:
    return {each.name for each in diagnosis.with_severity(severity)}


def holding(rig: Rig, held: PatternSequence, *, greys: bool = False) -> Rig:
    """The rig with a projector that holds its patterns."""
    return replace(rig, projector=cast("Projector", HoldingProjector(rig.projector, held, greys=greys)))


@pytest.mark.parametrize("trigger", [pytest.param(Trigger.FREE, marks=pytest.mark.slow), Trigger.SOFTWARE])
def test_sound_rig_is_sound_by_any_trigger_though_frames_are_lost(rig: Rig, trigger: Trigger) -> None:
    steps: list[str] = []
    diagnosis = run_doctor(
        with_camera(rig, triggers=frozenset({trigger}), lose=range(5, 400, 31)),
        listener=Listener(report=lambda step, _fraction, _detail: steps.append(step)),
    )
    assert diagnosis.with_severity(Severity.FAULT) == ()
    assert diagnosis.with_severity(Severity.NOTE) == ()
    assert {"patterns.verified", "picture.upright", "focus.sharp", "sharpening.none", "flicker.none"} <= names(
        diagnosis, Severity.OK
    )
    # A camera that waits for its trigger while the projector works sees no flash as it happens.
    timed = "timing.late" if trigger is Trigger.FREE else "timing.punctual"
    assert timed in names(diagnosis, Severity.OK)
    assert any(re.search(r"\b[1-9]\d% of full scale", each.found) for each in diagnosis.findings)
    order = list(dict.fromkeys(steps))
    assert order[:2] == ["patterns", "light"]
    assert "flashes before eye" in order
    assert order[-2:] == ["exposure", "live depth"]


def test_triggered_camera_that_sees_no_flash_happen_still_shows_late_light(tmp_path: Path) -> None:
    with small_rig(tmp_path, faults={"light_delay_s": 0.008}) as rig:
        session = CameraSession(rig, "eye", wait_s=0.5)
        light, _ = measure_light(session, doctor_sequence(rig.projector.info.size), displays="")
        assert light is not None
        found = timing.check_punctuality(rig, light, ScanEvidenceError("no flash was seen as it happened"))
    assert (found.name, found.severity) == ("timing.late", Severity.FAULT)
    assert "no flash was seen as it happened" in found.found


@pytest.mark.slow
@pytest.mark.parametrize(("is_stated", "name"), [(True, "timing.stamps"), (False, "timing.jitter")])
def test_vague_time_stamps_are_not_blamed_on_the_projector(rig: Rig, is_stated: bool, name: str) -> None:
    """Stamps are off by 10 ms either way, at random, and the camera states that or does not."""
    rng = np.random.default_rng(5)

    def vague(frame: Frame) -> Frame:
        off_ns = int(rng.integers(-10_000_000, 10_000_000))
        start_ns, end_ns = frame.t_start_ns + off_ns, frame.t_end_ns + off_ns
        return replace(frame, t_start_ns=start_ns, t_end_ns=end_ns, t_err_ns=10_000_000 if is_stated else 0)

    rig = with_camera(rig, triggers=frozenset({Trigger.FREE}), change=vague)
    light, _ = measure_light(
        CameraSession(rig, "eye", wait_s=0.1), doctor_sequence(rig.projector.info.size), displays=""
    )
    assert light is not None
    scans_s = {"eye": light.exposure_s}
    _, findings = timing.measure_light_latency(rig, {"eye": light}, scans_s, search_s=0.1)
    [found] = [each for each in findings if each.name in {"timing.stamps", "timing.jitter"}]
    assert found.name == name
    assert found.subject == ("camera 'eye'" if is_stated else "projector")
    assert ("they limit the measurement" in found.found) is is_stated


@pytest.mark.slow
def test_exposure_that_a_dim_camera_declares_and_refuses_ends_the_search_alone(rig: Rig) -> None:
    def dimmed(frame: Frame) -> Frame:
        return replace(frame, image=frame.image // 8)

    camera = with_camera(rig, change=dimmed, longest_s=0.03, exposure_range_s=(1e-4, 0.2))
    diagnosis = run_doctor(camera)
    assert names(diagnosis, Severity.FAULT) == set()
    assert {"exposure.range", "timing.late", "flicker.none"} <= names(diagnosis, Severity.OK)


@parametrize_core("halfway_s", [0.0, 1 / 60])
def test_pictures_that_nobody_sent_are_named(rig: Rig, monkeypatch: pytest.MonkeyPatch, halfway_s: float) -> None:
    found = measure_latency(rig, trials=8)
    eye = replace(found.cameras["eye"], halfway_s=halfway_s)
    monkeypatch.setattr(timing, "measure_latency", lambda *_, **__: replace(found, cameras={"eye": eye}))
    light, _ = measure_light(CameraSession(rig, "eye"), doctor_sequence(rig.projector.info.size), displays="")
    assert light is not None
    _, findings = timing.measure_light_latency(rig, {"eye": light}, {"eye": light.exposure_s}, search_s=0.1)
    said = [each.found for each in findings if each.name == "timing.interpolated"]
    assert len(said) == (halfway_s > 0)
    assert all("stands halfway for 16.7 ms" in each for each in said)


@pytest.mark.slow
def test_rig_without_calibration_has_its_picture_checked_and_its_drivers_notes_reported(rig: Rig) -> None:
    slow = with_camera(rig, triggers=frozenset({Trigger.FREE}), notes=("gives 5 frames per second",))
    diagnosis = run_doctor(replace(slow, calibration=None))
    assert names(diagnosis, Severity.NOTE) == {"device.uncalibrated", "device.note"}
    [note] = [each for each in diagnosis.findings if each.name == "device.note"]
    assert note.subject == "camera 'eye'"
    assert "gives 5 frames per second" in note.found
    assert "picture.upright" in names(diagnosis, Severity.OK)


def test_camera_triggered_by_wire_is_skipped_and_named(rig: Rig) -> None:
    diagnosis = run_doctor(with_camera(rig, triggers=frozenset({Trigger.HARDWARE})))
    [note] = diagnosis.with_severity(Severity.NOTE)
    assert note.name == "device.unexamined"
    assert "can be triggered by wire only (hardware)" in note.found
    assert diagnosis.healthy
    assert diagnosis.exposures == {}


@pytest.mark.slow
def test_projector_that_holds_its_patterns_is_examined_with_them(rig: Rig) -> None:
    diagnosis = run_doctor(holding(rig, own(rig)))
    assert diagnosis.with_severity(Severity.FAULT) == ()
    assert {"patterns.own", "response.binary", "picture.unmeasured", "focus.unmeasured"} <= names(
        diagnosis, Severity.OK
    )
    assert diagnosis.response is None
    assert diagnosis.synchronisation is None


@pytest.mark.slow
def test_projector_of_one_bit_has_no_response(rig: Rig) -> None:
    diagnosis = run_doctor(holding(rig, doctor_sequence(rig.projector.info.size), greys=True))
    assert diagnosis.healthy
    assert "response.binary" in names(diagnosis, Severity.OK)
    assert "patterns.own" not in names(diagnosis, Severity.OK)


@pytest.mark.parametrize(
    ("late", "name"),
    [
        ([9, 17], "patterns.verified"),
        pytest.param(range(9, 999), "patterns.contradicted", marks=pytest.mark.slow),
    ],
)
def test_frames_that_contradict_are_shot_once_more(rig: Rig, late: Container[int], name: str) -> None:
    """Frames of the pattern before, as of a display that missed its refresh; now and then, or from the tenth on."""
    frames: list[Frame] = []

    def behind(frame: Frame) -> Frame:
        frames.append(frame)
        return replace(frame, image=frames[-2].image) if len(frames) - 1 in late else frame

    session = CameraSession(rig, "eye", wait_s=0.05)
    sequence = doctor_sequence(rig.projector.info.size)
    light, _ = measure_light(session, sequence, displays="")
    assert light is not None
    picture, findings = locate_picture(session, sequence, light, rig.calibration)
    other, again = locate_picture(
        CameraSession(with_camera(rig, change=behind), "eye", wait_s=0.05), sequence, light, rig.calibration
    )
    assert (findings[0].name, again[0].name) == ("patterns.verified", name)
    if name == "patterns.verified":
        assert "shot again" in again[0].found
        assert "shot again" not in findings[0].found
        # What was measured is of the frames that were shot last.
        for axis, found_px in picture.position_px.items():
            assert np.array_equal(found_px[picture.known], other.position_px[axis][picture.known])


class ProcessingProjector:
    """A rendered projector that makes another picture of each."""

    def __init__(self, projector: Projector, process: Process) -> None:
        self._projector = projector
        self._process = process

    def __getattr__(self, name: str) -> Any:
        return getattr(self._projector, name)

    def load(self, sequence: PatternSequence) -> None:
        processed = tuple(map(self._process, sequence.profiles))
        self._projector.load(PatternSequence(sequence.projector, sequence.patterns, processed))


def processing(rig: Rig, process: Process) -> Rig:
    return replace(rig, projector=cast("Projector", ProcessingProjector(rig.projector, process)))


def limited(profile: Pixels) -> Pixels:
    """Full-range values taken for video levels, 16 to 235."""
    return grey((profile - 16.0) * 255 / 219)


def zoomed(profile: Pixels) -> Pixels:
    """Enlarged by a tenth about its middle, as by overscan."""
    place = [np.clip((np.arange(n) + 0.5 - n / 2) / 1.1 + n / 2 - 0.5, 0, n - 1) for n in profile.shape]
    rows, columns = np.meshgrid(*(each.astype(np.float32) for each in place), indexing="ij")
    return np.asarray(cv2.remap(profile, columns, rows, cv2.INTER_LINEAR), np.uint8).reshape(profile.shape)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("process", "severity", "words"),
    [
        pytest.param(lambda profile: profile, Severity.OK, "disagree by 0.", marks=pytest.mark.slow),
        (zoomed, Severity.FAULT, "overscan or digital zoom"),
    ],
)
def test_zoom_that_was_changed_since_the_calibration_is_named(
    printed: Rig, process: Process, severity: Severity, words: str
) -> None:
    rig = processing(printed, process)
    session = CameraSession(rig, "eye", wait_s=0.05)
    sequence = doctor_sequence(rig.projector.info.size)
    light, _ = measure_light(session, sequence, displays="")
    assert light is not None
    picture, findings = locate_picture(session, sequence, light, rig.calibration)
    assert [each for each in findings if each.severity is Severity.FAULT] == []
    [found] = check_calibrated("eye", light, picture, rig.calibration)
    assert found.severity is severity
    assert words in found.found
    assert check_calibrated("eye", light, picture, None) == []


@parametrize_core(
    ("response", "gamma", "is_limited", "names"),
    [
        (0.6, 2.2, False, {"response.gamma", "response.camera"}),
        (0.6, 1.0, False, {"response.straight", "response.camera"}),
        (0.6, 2.2, True, {"response.crushed", "response.clipped", "response.gamma", "response.camera"}),
        (1.0, 1.0, True, {"response.crushed", "response.clipped", "response.camera"}),
    ],
)
def test_what_the_camera_makes_of_light_is_not_blamed_on_the_projector(
    tmp_path: Path, response: float, gamma: float, is_limited: bool, names: set[str]
) -> None:
    with small_rig(tmp_path, eye=EYE | {"response": response}, lamp=LAMP | {"gamma": gamma}, ambient=0.1) as rig:
        session = CameraSession(processing(rig, limited) if is_limited else rig, "eye", wait_s=0.05)
        sequence = doctor_sequence(rig.projector.info.size)
        light, _ = measure_light(session, sequence, displays="")
        assert light is not None
        light, exponent, camera = check_exposures(session, sequence, light)
        curve, findings = measure_response(session, light, exponent)
    assert curve is not None
    assert {each.name for each in (*findings, *camera)} == names
    assert curve.gamma == pytest.approx(gamma, abs=0.06)
    assert (curve.black_knee, curve.white_knee) == pytest.approx((16, 235) if is_limited else (0, 255), abs=3)


@parametrize_core("response", [1.0, 0.5], core=[0, 1])
@pytest.mark.parametrize(
    ("takes", "name", "taken_s"),
    [
        (lambda asked_s: asked_s, "response.camera", math.inf),
        (lambda asked_s: min(asked_s, 0.009), "exposure.clamped", 0.009),
        (lambda asked_s: min(asked_s, 0.004), "exposure.clamped", 0.004),
        (lambda _: 0.01, "exposure.ignored", math.inf),
    ],
)
def test_exposures_that_a_camera_never_took_show_in_its_pictures(
    tmp_path: Path, takes: Callable[[float], float], name: str, taken_s: float, response: float
) -> None:
    with small_rig(tmp_path, eye=EYE | {"response": response}, ambient=0.1) as opened:
        rig = with_camera(opened, takes=takes)
        session, sequence = CameraSession(rig, "eye", wait_s=0.05), doctor_sequence(rig.projector.info.size)
        light, _ = measure_light(session, sequence, displays="")
        assert light is not None
        light, _, [found] = check_exposures(session, sequence, light)
    assert found.name == name
    assert light.taken_s == pytest.approx(taken_s, rel=0.06)
    assert light.exposure_s <= 1.06 * taken_s


def grey(values: FloatArray) -> Pixels:
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


def unsharp(amount: float, sigma_px: float = 1.5) -> Process:
    def process(image: Pixels) -> Pixels:
        bare = image.astype(np.float64)
        return grey(bare + amount * (bare - cv2.GaussianBlur(bare, (0, 0), sigma_px)))

    return process


def gamma(image: Pixels) -> Pixels:
    return grey(255 * (image / 255) ** (1 / 2.2))


def blur(image: Pixels) -> Pixels:
    return grey(cv2.GaussianBlur(image.astype(np.float64), (0, 0), 2.0))


def jpeg(quality: int) -> Process:
    def process(image: Pixels) -> Pixels:
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)

    return process


def noisy(image: Pixels) -> Pixels:
    return grey(image + np.random.default_rng(int(image.astype(np.int64).sum())).normal(0, 8, image.shape))


def after(*steps: Process) -> Process:
    def process(image: Pixels) -> Pixels:
        for step in steps:
            image = step(image)
        return image

    return process


@parametrize_core(
    ("process", "severity", "remedy"),
    [
        (lambda image: image, Severity.OK, ""),
        (blur, Severity.FAULT, "its focus moves by itself"),
        (lambda image: np.roll(image, 2, axis=1), Severity.FAULT, "see that camera, projector and object stand still"),
    ],
)
def test_a_lens_that_moves_after_its_focus_was_measured_is_named(
    rig: Rig, process: Process, severity: Severity, remedy: str
) -> None:
    session, sequence = CameraSession(rig, "eye", wait_s=0.05), doctor_sequence(rig.projector.info.size)
    light, _ = measure_light(session, sequence, displays="")
    assert light is not None
    picture, _ = locate_picture(session, sequence, light, None)
    moved = with_camera(rig, change=lambda frame: replace(frame, image=process(frame.image)))
    [found] = check_steady(CameraSession(moved, "eye", wait_s=0.05), sequence, light, picture)
    assert (found.name, found.severity) == ("picture.steady", severity)
    assert found.remedy.startswith(remedy)


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """A rig before a plate with a printed board, whose edges a camera may sharpen."""
    eye, lamp = (
        {"size_px": size, "focal_px": [focal] * 2, "blur_px": 0.5}
        for size, focal in (([240, 192], 600.0), ([256, 192], 520.0))
    )
    with small_rig(
        tmp_path_factory.mktemp("printed"), PRINTED, eye={**eye, "saturation_s": 0.022}, lamp=lamp, exposure_s=1 / 60
    ) as opened:
        yield opened


def check_processed(rig: Rig, process: Process, *, calibrated: bool = True) -> Finding:
    """The finding on a camera that processes its pictures so."""
    session = CameraSession(
        with_camera(rig, change=lambda frame: replace(frame, image=process(frame.image))), "eye", wait_s=0.1
    )
    sequence = doctor_sequence(rig.projector.info.size)
    light, _ = measure_light(session, sequence, displays="")
    assert light is not None
    picture, _ = locate_picture(session, sequence, light, rig.calibration)
    [found] = check_sharpening("eye", light, picture, rig.calibration if calibrated else None)
    return found


@pytest.mark.slow
def test_an_unsharp_mask_is_named_with_its_cost(printed: Rig) -> None:
    found = check_processed(printed, unsharp(1.5))
    assert (found.name, found.severity) == ("sharpening.halo", Severity.FAULT)
    assert "the camera sharpens: next to edges its pictures exceed white and black by" in found.found
    assert "mm of depth where the optical axes meet" in found.found
    assert "control sharpness" in found.remedy
    assert "mm of depth" not in check_processed(printed, unsharp(1.5), calibrated=False).found


LESS = [unsharp(0.5), after(gamma, unsharp(1.0), jpeg(80)), unsharp(1.5, 1.0)]
OTHERS = [after(), blur, gamma, noisy, jpeg(90), jpeg(50), after(gamma, jpeg(75)), after(blur, noisy)]


@pytest.mark.parametrize(
    ("process", "name"), [*product(LESS, ["sharpening.halo"]), *product(OTHERS, ["sharpening.none"])]
)
@pytest.mark.slow
def test_weak_sharpening_is_found_and_nothing_else_is_taken_for_it(printed: Rig, process: Process, name: str) -> None:
    found = check_processed(printed, process)
    assert found.name == name
    assert (found.severity is Severity.OK) is (name == "sharpening.none")


def test_depth_per_pixel_is_that_of_two_rays() -> None:
    # Axes that cross at right angles, 500 mm from each: a pixel to the side of one is as far along the other.
    camera = pinhole(np.eye(3), (0.0, 0.0, -500.0))
    across = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    projector = pinhole(across, (-500.0, 0.0, 0.0))
    assert depth_mm_per_px(camera, projector) == pytest.approx(500 / 600, rel=0.01)
    # Turned towards each other by 10° each: the sheet of light is cut at 20°.
    turn = np.deg2rad(10)
    left, right = (
        np.array([[np.cos(a), 0, -np.sin(a)], [0, 1.0, 0], [np.sin(a), 0, np.cos(a)]]) for a in (turn, -turn)
    )
    one, other = (pinhole(each, tuple(-500 * each[2])) for each in (left, right))
    assert depth_mm_per_px(one, other) == pytest.approx(500 / 600 / np.sin(2 * turn), rel=0.02)
    assert np.isnan(depth_mm_per_px(camera, pinhole(np.eye(3), (60.0, 0.0, -500.0))))


def pinhole(rotation: FloatArray, centre_mm: tuple[float, ...]) -> Pinhole:
    matrix = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]])
    return Pinhole(Size(640, 480), matrix, np.zeros(5), rotation, -rotation @ np.array(centre_mm))


# The fake engine is a thread: a busy machine may hold it for longer than `image_load_s`.
@pytest.mark.realtime
def test_the_direction_of_the_current_is_found_before_all_other_checks(tmp_path: Path) -> None:
    from drivers.dlpc350.flash import MIRRORS
    from tests.contract.dlpc350_bench import Table
    from tests.contract.suite import rig_of

    # Not as on the LightCrafter 4500.
    inverted = False
    picture = doctor_sequence(MIRRORS)
    table = Table(tmp_path, picture, led_inverted=inverted)
    head = table.connected(led_current_inverted=None, image_load_s=0.05)
    settings = dict.fromkeys(head.cameras, CameraSettings(0.03))
    with replace(rig_of(head), settings=settings) as rig:
        diagnosis = examine(rig, own_sequence=picture, search_s=0.1)
        assert table.engine.lit is None
    (found,) = (each for each in diagnosis.findings if each.name == "light.current")
    assert found.severity is Severity.NOTE
    assert f"led_current_inverted = {str(inverted).lower()}" in found.remedy
    assert diagnosis.synchronisation is None
    assert not diagnosis.exposures


@pytest.mark.slow
def test_the_least_period_of_the_trigger_is_measured_where_a_camera_states_a_shorter_one() -> None:
    readout = CameraFaults(min_period_s=0.0115, readout_s=0.0044)
    every = {"eye": frozenset(Trigger)}
    fake = fake_rig(cameras=["eye"], projector={"plays": True}, triggers=every, faults={"eye": readout})
    found = run_doctor(fake.rig, search_s=0.05)
    assert "timing.pulses" in names(found, Severity.NOTE)
    period_s = Diagnosis.from_document(found.document()).trigger_period_s
    assert period_s is not None
    exposure_s = found.exposures["eye"].exposure_s
    assert exposure_s + 0.0044 <= period_s < exposure_s + 0.0052
    assert fake.at_rest
