"""A camera that sharpens is named, by whatever amount and behind whatever blur; one that does not is not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from simulated_rig.device import SimulatedHead, open_head
from slrig.devices import Camera, CameraInfo, CameraSettings, Rig, Trigger
from slrig.devices.camera import AppliedSettings
from slrig.doctor.doctor import doctor_sequence
from slrig.doctor.findings import Finding, Severity
from slrig.doctor.geometry import picture
from slrig.doctor.light import look
from slrig.doctor.measures.pictures import depth_mm_per_px
from slrig.doctor.sharpening import sharpening
from slrig.doctor.viewing import Viewer
from slrig.model import FloatArray, Frame, Pinhole, Pixels, Size
from tests.unit.simulated_rig.building import head_options

PRINTED = """
[[object]]
shape = "plane"
size_mm = [400.0, 400.0]
rotation_deg = [6.0, -10.0, 0.0]
albedo = 0.8
texture = { kind = "checker", contrast = 0.6, scale_mm = 35.0 }
"""
LAMP = {"size_px": [256, 192], "focal_px": [520.0, 520.0], "blur_px": 0.5}
EYE = {"size_px": [240, 192], "focal_px": [600.0, 600.0], "blur_px": 0.5, "saturation_s": 0.022}
Process = Callable[[Pixels], Pixels]

pytestmark = pytest.mark.slow


class ProcessingCamera:
    """A rendered camera that works on its pictures before it gives them."""

    def __init__(self, camera: Camera, process: Process) -> None:
        self._camera = camera
        self._process = process

    @property
    def info(self) -> CameraInfo:
        return self._camera.info

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        return self._camera.configure(settings)

    def arm(self, count: int, trigger: Trigger) -> None:
        self._camera.arm(count, trigger)

    def trigger(self) -> None:
        self._camera.trigger()

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        frame = self._camera.read(after_ns, timeout_s)
        return replace(frame, image=self._process(frame.image))

    def disarm(self) -> None:
        self._camera.disarm()

    def close(self) -> None:
        self._camera.close()


def grey(values: FloatArray) -> Pixels:
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


def unsharp(amount: float, sigma_px: float = 1.5) -> Process:
    def process(image: Pixels) -> Pixels:
        bare = image.astype(np.float64)
        return grey(bare + amount * (bare - cv2.GaussianBlur(bare, (0, 0), sigma_px)))

    return process


def gamma(image: Pixels) -> Pixels:
    return grey(255 * (image / 255) ** (1 / 2.2))


def blurred(image: Pixels) -> Pixels:
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


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    folder: Path = tmp_path_factory.mktemp("printed")
    (folder / "scene.toml").write_text(PRINTED)
    head = open_head(head_options(camera=EYE, projector=LAMP, ambient=0.03), folder)
    assert isinstance(head, SimulatedHead)
    settings = {"eye": CameraSettings(0.0166666667)}
    with Rig("bench", dict(head.cameras), head.projector, settings, head.calibration, head, clock=head.clock) as opened:
        yield opened


def judged(rig: Rig, process: Process, *, calibrated: bool = True) -> Finding:
    """What is said of the rig with a camera that works so on its pictures."""
    cameras: Mapping[str, Camera] = {"eye": ProcessingCamera(rig.cameras["eye"], process)}
    viewer = Viewer(replace(rig, cameras=cameras), "eye", wait_s=0.1)
    sequence = doctor_sequence(rig.projector.info.size)
    seen, _ = look(viewer, sequence, others="")
    assert seen is not None
    shown, _ = picture(viewer, sequence, seen, rig.calibration)
    [found] = sharpening("eye", seen, shown, rig.calibration if calibrated else None)
    return found


def test_an_unsharp_mask_is_named_with_its_cost(rig: Rig) -> None:
    found = judged(rig, unsharp(1.5))
    assert (found.name, found.severity) == ("sharpening.halo", Severity.FAULT)
    assert "the camera sharpens: beside edges its pictures exceed white and black by" in found.found
    assert "mm of depth where the optical axes meet" in found.found
    assert "control sharpness" in found.remedy
    assert "mm of depth" not in judged(rig, unsharp(1.5), calibrated=False).found


@pytest.mark.parametrize("process", [unsharp(0.5), after(gamma, unsharp(1.0), jpeg(80)), unsharp(1.5, 1.0)])
def test_less_of_it_is_named_too(rig: Rig, process: Process) -> None:
    found = judged(rig, process)
    assert found.name == "sharpening.halo"
    assert found.severity in (Severity.NOTE, Severity.FAULT)


@pytest.mark.parametrize(
    "process",
    [after(), blurred, gamma, noisy, jpeg(90), jpeg(50), after(gamma, jpeg(75)), after(blurred, noisy)],
    ids=["plain", "blur", "gamma", "noise", "jpeg 90", "jpeg 50", "gamma, jpeg", "blur, noise"],
)
def test_nothing_else_is_taken_for_it(rig: Rig, process: Process) -> None:
    found = judged(rig, process)
    assert (found.name, found.severity) == ("sharpening.none", Severity.OK)


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
