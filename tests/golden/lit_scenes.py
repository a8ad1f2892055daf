"""A relief before the example rig `relief`, under light that is worse in one property than the best.

The exposure is set as an operator or an automatic exposure sets it: white comes near full scale and nowhere clips.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simulated_rig.options import HeadOptions
from simulated_rig.rendering import CameraView, SceneState
from simulated_rig.scene import SceneSurface, build_surface, read_scene
from slrig.bundle import write_bundle, write_truth
from slrig.examples import EXAMPLES
from slrig.model import Calibration, CameraFormat, Capture, Shot, Surface, Truth
from slrig.patterns.sequence import profile
from slrig.scan.artefacts import decode_mesh_ply
from slrig.scan.plan import PatternPlan, pattern_sequence
from tests.golden.test_bundles import reconstructed
from tests.light_bound import ExposedView

SCENES = EXAMPLES / "scenes"
ALBEDO = 0.85
WHITE_LEVEL = 0.85
BRIGHTEST_PERCENT = 99.9


@dataclass(frozen=True, slots=True)
class Light:
    """What the scene and its light are like.

    gamma : of the projector; signal_blur_px : see `simulated_rig.light.Response`. ambient : light of the room over the
    projector's white. texture_ratio : brightest over darkest albedo; texture : its kind, in grains of 5 mm.
    lobe : strength of a mirror lobe beside the diffuse albedo; lobe_exponent : how narrow it is.
    camera_blur_px : of a camera out of focus.
    """

    gamma: float = 1.0
    signal_blur_px: float = 0.0
    ambient: float = 0.01
    texture_ratio: float = 1.0
    texture: str = "checker"
    lobe: float = 0.0
    lobe_exponent: float = 20.0
    camera_blur_px: float | None = None


@dataclass(frozen=True, slots=True)
class Figures:
    """What one scan under one light gave.

    rms_mm, complete_03, error_over_sigma : see `slrig.meshing.quality.TruthScore`.
    sigma_rms_mm : of the standard deviations that the mesh states.
    """

    rms_mm: float
    complete_03: float
    error_over_sigma: float
    sigma_rms_mm: float


def scanned(light: Light, work: Path, *, share: float = 1.0) -> Figures:
    """Capture and reconstruct the relief by the usual patterns, in the folder `work`.

    share : the middle of the camera's image that is kept.
    """
    table = tomllib.loads((EXAMPLES / "rigs" / "relief.toml").read_text(encoding="utf-8"))["head"]
    del table["driver"]
    table["projector"] |= {"gamma": light.gamma, "signal_blur_px": light.signal_blur_px}
    table["camera"] = [_cut(table["camera"][0], share)]
    if light.camera_blur_px is not None:
        table["camera"][0]["blur_px"] = light.camera_blur_px
    options = HeadOptions.model_validate(table | {"ambient": light.ambient})
    eye, lamp = options.camera[0], options.projector
    surface = _surface(light)
    stage = SceneState(surface, lamp.pinhole(), working_distance_mm=float(np.linalg.norm(lamp.pinhole().centre_mm)))
    view = CameraView(
        eye.pinhole(), stage, blur_px=eye.blur_px, ambient=options.ambient, jitter=False, seed=options.seed,
        samples_per_axis=options.samples_per_axis, workers=options.workers,
    )  # fmt: skip
    sensor = eye.sensor()
    # The brightest part in a thousand of the expected white comes to WHITE_LEVEL of what the well holds.
    full = ExposedView(view, lamp.size, lamp.response(), sensor, sensor.saturation_s)
    brightest_e = np.percentile(full.ends[0].astype(np.float32), BRIGHTEST_PERCENT)
    exposure_s = float(sensor.saturation_s * WHITE_LEVEL * sensor.full_well_e / brightest_e)
    exposed = ExposedView(view, lamp.size, lamp.response(), sensor, exposure_s)
    rng = np.random.default_rng(1)
    patterns = pattern_sequence(PatternPlan(), lamp.size).patterns
    shots = tuple(
        Shot(index, eye.name, exposed.frame(profile(pattern, lamp.size), rng), exposure_s=exposure_s)
        for index, pattern in enumerate(patterns)
    )
    capture = Capture(lamp.size, patterns, {eye.name: CameraFormat(eye.size, sensor.bit_depth)}, shots)
    write_bundle(work / "bundle", capture, Calibration({eye.name: eye.pinhole()}, lamp.pinhole()))
    write_truth(work / "bundle", Truth(Surface(surface.vertices_mm, surface.faces), {eye.name: view.truth()}))
    score = reconstructed(work / "bundle", work / "out")["truth"]
    sigma_mm = decode_mesh_ply((work / "out" / "mesh.ply").read_bytes()).sigma_mm.astype(np.float64)
    return Figures(
        rms_mm=score["rms_mm"],
        complete_03=score["complete_0.3mm"],
        error_over_sigma=score["error_over_sigma_p68"],
        sigma_rms_mm=float(np.sqrt(np.nanmean(sigma_mm**2))),
    )


def _surface(light: Light) -> SceneSurface:
    scene = read_scene(SCENES / "relief.toml")
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
