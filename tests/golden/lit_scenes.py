"""A relief before the rig of `config/rigs/relief.toml`, under light that is worse in one property than the best.

The exposure is set as an operator or an automatic exposure sets it: white comes near full scale and nowhere clips.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from simulated_rig.light import Float32Array
from simulated_rig.options import HeadOptions
from simulated_rig.rendering import CameraView, SceneState
from simulated_rig.scene import Scene, SceneSurface, build_surface, read_scene
from slrig.bundle import write_bundle, write_truth
from slrig.model import Calibration, CameraFormat, Capture, Pattern, Pixels, Shot, Surface, Truth
from slrig.patterns.sequence import profile
from slrig.scan.artefacts import decode_mesh_ply
from slrig.scan.plan import PatternPlan, pattern_sequence
from tests.golden.test_bundles import reconstructed
from tests.light_bound import ExposedView

CONFIG = Path(__file__).parents[2] / "config"
SCENES = CONFIG / "scenes"
ALBEDO = 0.85
WHITE_LEVEL = 0.85
BRIGHTEST_PERCENT = 99.9
SCATTERED_PX = 4.0
RETURNED_PX = 12.0


@dataclass(frozen=True, slots=True)
class Light:
    """What the scene and its light are like.

    gamma : of the projector; signal_blur_px : see `simulated_rig.light.Response`. ambient : light of the room over the
    projector's white. texture_ratio : brightest over darkest albedo; texture : its kind, in grains of 5 mm.
    lobe : strength of a mirror lobe beside the diffuse albedo; lobe_exponent : how narrow it is.
    camera_blur_px, projector_blur_px : of a device out of focus. brightness : of white, over that of a good exposure.
    scattered : share of the light that leaves a translucent object elsewhere, spread over 4 px of the camera.
    returned : share of the light of the other half of the image that comes back to a point of a concave object.
    jpeg_quality : of frames that the camera compresses; None without.
    """

    gamma: float = 1.0
    signal_blur_px: float = 0.0
    ambient: float = 0.01
    texture_ratio: float = 1.0
    texture: str = "checker"
    lobe: float = 0.0
    lobe_exponent: float = 20.0
    camera_blur_px: float | None = None
    projector_blur_px: float | None = None
    brightness: float = 1.0
    scattered: float = 0.0
    returned: float = 0.0
    jpeg_quality: int | None = None

    def beyond_the_renderer(self, electrons: Float32Array) -> Float32Array:
        """(H, W): expected electrons of an image with the light that takes a way which the renderer does not know."""
        if self.scattered:
            spread = cv2.GaussianBlur(electrons, (0, 0), SCATTERED_PX)
            electrons = np.float32(1 - self.scattered) * electrons + np.float32(self.scattered) * spread
        if self.returned:
            other = cv2.GaussianBlur(electrons[:, ::-1], (0, 0), RETURNED_PX)
            electrons = electrons + np.float32(self.returned) * other
        return electrons


@dataclass(frozen=True, slots=True)
class Figures:
    """What one scan under one light gave.

    rms_mm, complete_03, error_over_sigma : see `slrig.meshing.quality.TruthScore`.
    sigma_rms_mm : of the standard deviations that the mesh states. frames : how many were played.
    """

    rms_mm: float
    complete_03: float
    error_over_sigma: float
    sigma_rms_mm: float
    frames: int


class LitScene:
    """A scene under one light, exposed well, whose frames of any pattern can be had.

    share : the middle of the camera's image that is kept. scene : what stands there, of the light's material; None for
    the relief of `config/scenes`.
    """

    def __init__(self, light: Light, *, share: float = 1.0, scene: Scene | None = None) -> None:
        table = tomllib.loads((CONFIG / "rigs" / "relief.toml").read_text(encoding="utf-8"))["head"]
        del table["driver"]
        table["projector"] |= {"gamma": light.gamma, "signal_blur_px": light.signal_blur_px}
        table["camera"] = [_cut(table["camera"][0], share)]
        if light.camera_blur_px is not None:
            table["camera"][0]["blur_px"] = light.camera_blur_px
        if light.projector_blur_px is not None:
            table["projector"]["blur_px"] = light.projector_blur_px
        options = HeadOptions.model_validate(table | {"ambient": light.ambient})
        self.eye, lamp = options.camera[0], options.projector
        self.light, self.projector = light, lamp.size
        self.surface = _surface(light, scene or read_scene(SCENES / "relief.toml"))
        stage = SceneState(
            self.surface, lamp.pinhole(), working_distance_mm=float(np.linalg.norm(lamp.pinhole().centre_mm))
        )
        self.view = CameraView(
            self.eye.pinhole(), stage, blur_px=self.eye.blur_px, ambient=options.ambient, jitter=False,
            seed=options.seed, samples_per_axis=options.samples_per_axis, workers=options.workers,
        )  # fmt: skip
        self.calibration = Calibration({self.eye.name: self.eye.pinhole()}, lamp.pinhole())
        sensor = self.eye.sensor()
        # The brightest part in a thousand of the expected white comes to WHITE_LEVEL of what the well holds.
        full = ExposedView(self.view, lamp.size, lamp.response(), sensor, sensor.saturation_s)
        brightest_e = np.percentile(light.beyond_the_renderer(full.ends[0].astype(np.float32)), BRIGHTEST_PERCENT)
        exposure_s = float(sensor.saturation_s * light.brightness * WHITE_LEVEL * sensor.full_well_e / brightest_e)
        self.exposed = ExposedView(self.view, lamp.size, lamp.response(), sensor, exposure_s)
        self._electrons: dict[Pattern, Float32Array] = {}

    @property
    def format(self) -> CameraFormat:
        """That of its frames."""
        return CameraFormat(self.eye.size, self.eye.sensor().bit_depth)

    def frame(self, pattern: Pattern, rng: np.random.Generator) -> Pixels:
        """(H, W): one noisy frame of a pattern."""
        image = self.exposed.sensor.read_out(self.electrons(pattern), gain=self.exposed.gain, rng=rng)
        if self.light.jpeg_quality is None:
            return image
        return compressed(image, self.light.jpeg_quality)

    def electrons(self, pattern: Pattern) -> Float32Array:
        """(H, W): what is expected of a pattern. Rendered once."""
        expected = self._electrons.get(pattern)
        if expected is None:
            expected = self.light.beyond_the_renderer(self.exposed.electrons(profile(pattern, self.projector)))
            self._electrons[pattern] = expected
        return expected

    def expected_dn(self, pattern: Pattern) -> Float32Array:
        """(H, W): the value that is expected of each pixel, without noise, rounding and clipping."""
        sensor = self.exposed.sensor
        return np.asarray(
            self.electrons(pattern) * np.float32(sensor.dn_per_electron(self.exposed.gain))
            + np.float32(sensor.pedestal_dn)
        )

    def capture(self, patterns: Sequence[Pattern], seed: int = 1) -> Capture:
        """One scan's frames."""
        rng = np.random.default_rng(seed)
        shots = tuple(
            Shot(index, self.eye.name, self.frame(pattern, rng), exposure_s=self.exposed.exposure_s)
            for index, pattern in enumerate(patterns)
        )
        return Capture(self.projector, tuple(patterns), {self.eye.name: self.format}, shots)

    def scan(self, work: Path, patterns: Sequence[Pattern], seed: int = 1) -> Figures:
        """Capture and reconstruct in the folder `work`."""
        capture = self.capture(patterns, seed)
        write_bundle(work / "bundle", capture, self.calibration)
        truth = Truth(Surface(self.surface.vertices_mm, self.surface.faces), {self.eye.name: self.view.truth()})
        write_truth(work / "bundle", truth)
        score = reconstructed(work / "bundle", work / "out")["truth"]
        sigma_mm = decode_mesh_ply((work / "out" / "mesh.ply").read_bytes()).sigma_mm.astype(np.float64)
        return Figures(
            rms_mm=score["rms_mm"],
            complete_03=score["complete_0.3mm"],
            error_over_sigma=score["error_over_sigma_p68"],
            sigma_rms_mm=float(np.sqrt(np.nanmean(sigma_mm**2))),
            frames=len(capture.shots),
        )


def scanned(light: Light, work: Path, *, share: float = 1.0) -> Figures:
    """Capture and reconstruct the relief by the usual patterns, in the folder `work`."""
    scene = LitScene(light, share=share)
    return scene.scan(work, pattern_sequence(PatternPlan(), scene.projector).patterns)


def compressed(image: Pixels, quality: int) -> Pixels:
    """An 8-bit image after JPEG."""
    done, data = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, quality))
    assert done
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)


def _surface(light: Light, scene: Scene) -> SceneSurface:
    contrast = 1.0 - 1.0 / light.texture_ratio
    material = {
        "albedo": ALBEDO,
        "texture": {"kind": light.texture, "contrast": contrast, "scale_mm": 5.0},
        "specular": {"strength": light.lobe, "exponent": light.lobe_exponent},
    }
    things = tuple(type(thing).model_validate(thing.model_dump() | material) for thing in scene.object)
    return build_surface(scene.model_copy(update={"object": things}), SCENES)


def _cut(device: Mapping[str, Any], share: float) -> dict[str, Any]:
    """The device with the middle of its image alone: the same pixels, fewer of them."""
    lengths = device["size_px"]
    kept = [round(length * share) for length in lengths]
    centre = [at - (length - less) / 2 for at, length, less in zip(device["principal_px"], lengths, kept, strict=True)]
    return {**device, "size_px": kept, "principal_px": centre}
