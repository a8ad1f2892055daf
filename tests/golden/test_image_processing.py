"""Scans by cameras and in light as benches have them: the error stated is the one found, and what is wrong is told.

Cameras that interpolate, bend or compress their frames; a bright room, exposure that creeps, lamps on mains before a
rolling shutter, lenses that are sharp at one distance.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.bundle import read_bundle, write_bundle
from slrig.model import Gray
from slrig.scan.plan import PatternPlan
from tests.golden.test_bundles import reconstructed
from tests.golden.test_light_axis import BALL, LEFT, PROJECTOR, rig_file, scanned

pytestmark = pytest.mark.slow
PLANS = {"lines": PatternPlan(), "Gray only": PatternPlan(line_shift=False, gray_cell_px=2)}
BALANCE = (0.55, 1.0, 0.7)
"""What red, green and blue pixels see of white light."""


def processed(
    bundle: Path,
    *,
    mosaic: bool = False,
    rows: float = 0.0,
    spread_px: float = 0.0,
    gamma: float = 1.0,
    unsharp: float = 0.0,
    quality: int | None = None,
    kept: bool = False,
) -> None:
    """Make the frames those of a camera with a mosaic and noisy rows, that bends, sharpens and compresses, in turn.

    rows : standard deviation of a row, grey levels; spread_px : of light that spreads to the right, by e at this
    distance, about its centroid. quality : of JPEG, None for none. kept : the frames are the JPEG
    files, and not what these decode to.
    """
    random = np.random.default_rng(3)
    for path in sorted((bundle / "frames").rglob("*.png")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        if mosaic:
            image = through_mosaic(image)
        if spread_px:
            image = np.rint(spread_to_one_side(image, spread_px))
        image = image + rows * random.standard_normal((len(image), 1))
        light = 255 * (np.maximum(image, 0).astype(np.float32) / 255) ** (1 / gamma)
        light += unsharp * (light - cv2.GaussianBlur(light, (0, 0), 1.0))
        image = np.clip(np.rint(light), 0, 255).astype(np.uint8)
        if quality is not None:
            done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
            assert done
            if kept:
                path.with_suffix(".jpg").write_bytes(data.tobytes())
                path.unlink()
                continue
            image = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
        assert cv2.imwrite(str(path), image)
    if kept:
        description = bundle / "bundle.json"
        description.write_text(description.read_text().replace(".png", ".jpg"))


def spread_to_one_side(image: NDArray[np.uint8], spread_px: float) -> NDArray[np.float64]:
    """Light that a translucent surface lets out on one side. Its centroid, where all wide patterns see it, is kept."""
    frequency = 2 * np.pi * np.fft.rfftfreq(4 * image.shape[1])
    padded = np.concatenate([image, image[:, ::-1]] * 2, axis=1)
    spread = np.exp(1j * frequency * spread_px) / (1 + 1j * frequency * spread_px)
    return np.clip(np.fft.irfft(np.fft.rfft(padded) * spread, padded.shape[1])[:, : image.shape[1]], 0, 255)


def through_mosaic(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A grey scene by a camera with a colour mosaic: dimmer in red and blue, balanced, interpolated, made grey."""
    seen = np.ones(image.shape)
    seen[::2, ::2], seen[1::2, 1::2] = BALANCE[0], BALANCE[2]
    balanced = np.clip(np.rint(np.rint(image * seen) / seen), 0, 255).astype(np.uint8)
    colours = cv2.demosaicing(balanced, cv2.COLOR_BayerBG2BGR)
    return np.asarray(cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def scored(folder: Path, work: Path, **processing: Any) -> Any:
    """Reconstruct a bundle after what a camera may do to its frames; the report."""
    shutil.copytree(folder, work / "bundle")
    processed(work / "bundle", **processing)
    return reconstructed(work / "bundle", work / "out")


@pytest.mark.shared
@pytest.mark.parametrize(
    ("scene", "processing", "least_covered"),
    [
        pytest.param("vase", {"quality": 75}, 0.93, id="vase-75"),
        pytest.param("gauge", {"quality": 50, "kept": True}, 0.97, id="gauge-50-files"),
        pytest.param("terrace", {"gamma": 2.2, "quality": 75}, 0.96, id="terrace-gamma-75"),
        pytest.param("terrace", {"mosaic": True}, 0.96, id="terrace-mosaic"),
    ],
)
def test_an_error_is_what_is_stated(
    shared: Path, tmp_path: Path, scene: str, processing: dict[str, Any], least_covered: float
) -> None:
    report = scored(shared / "bundles" / scene, tmp_path, **processing)
    assert 0.8 < report["truth"]["error_over_sigma_p68"] < 1.25
    assert report["truth"]["complete_0.3mm"] > least_covered
    assert any("JPEG" in note for note in report["notes"]) == ("quality" in processing)
    for camera in report["cameras"].values():
        assert (camera["noise"]["compression_dn"] > 0) == ("quality" in processing)
        assert (camera["noise"]["shared_by_neighbours"] > 1.2) == ("mosaic" in processing or "quality" in processing)
        assert camera["gamma"] == pytest.approx(processing.get("gamma", 1.0), abs=0.1)


@dataclass(frozen=True)
class Light:
    """What differs from the ideal. rms, complete : how much worse than there a scan may be: times, and share lost;
    sigma : the error over what is stated for it, at most.
    """

    camera: Mapping[str, Any] = field(default_factory=dict)
    projector: Mapping[str, Any] = field(default_factory=dict)
    head: str = "ambient = 0.01"
    faults: str = ""
    rms: float = 1.2
    complete: float = 0.01
    sigma: float = 1.3


# Measured with lines, ideal 9.6 µm: 9.1, 12.8, 9.6 and 19.4. The webcam's values are made straight first; its deviation
# is a little larger, so that it smooths more.
LIGHTS = {
    "webcam": Light({"response": 0.45}, rms=1.05),
    "bright room": Light(head="ambient = 0.3", rms=1.4),
    "creeping exposure": Light({"exposure_drift": 0.0015}, rms=1.1),
    "rolling bands": Light({"line_time_s": 3e-5}, head="ambient = 0.1\nambient_flicker_depth = 0.3", rms=2.3),
    # Sharp at the ball; on the wall behind it the projector's spread is 1.5 px more, and the camera's 1.0 px. The rms,
    # 38.8 and 57.3 µm, is that of the shadow's border, where the projector's spread is wider than what is refused; the
    # median error is 10 µm. 1.10 and 1.39 times what is stated.
    # The projector's focus changes with the slope here, and lines would tell 0.56 px of blur for 0.67; but slopes are
    # so even that what is expected stands.
    "focus over depth": Light(
        {"focus_mm": 540.0, "defocus_px": 9.5}, {"focus_mm": 570.0, "defocus_px": 15.0}, rms=5.0, sigma=1.5
    ),
}


def rig_of(folder: Path, light: Light) -> Path:
    """A ball before a wall, in this light."""
    rig = rig_file(
        folder, BALL, {**PROJECTOR, "position_mm": (105.0, 0.0, -590.0), **light.projector}, {**LEFT, **light.camera}
    )
    text = rig.read_text()
    assert text.count("ambient = 0.01") == 1
    rig.write_text(text.replace("ambient = 0.01", light.head) + light.faults)
    return rig


@dataclass(frozen=True)
class Ideal:
    """A scan in the best light before anything is done to its frames: plan, bundle, and figures against truth."""

    plan: PatternPlan
    bundle: Path
    truth: Mapping[str, Any]


@pytest.fixture(scope="module", params=[*PLANS.values()], ids=[*PLANS])
def ideal(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Ideal:
    rig = rig_of(tmp_path_factory.mktemp("ideal") / "rig", Light())
    return Ideal(request.param, rig.parent / "bundle", scanned(rig, plan=request.param)["truth"])


# Eight draws of noisy rows cost 2.0 to 2.4 times the error.
@pytest.mark.parametrize(("processing", "worse"), [({"gamma": 2.2}, 1.05), ({"rows": 1.5}, 2.5)], ids=["bent", "rows"])
def test_bent_values_cost_next_to_nothing_and_noisy_rows_are_stated(
    tmp_path: Path, ideal: Ideal, processing: dict[str, Any], worse: float
) -> None:
    report = scored(ideal.bundle, tmp_path, **processing)
    assert report["truth"]["rms_mm"] < worse * ideal.truth["rms_mm"]
    # Of Gray code alone it is 1.31 without all that.
    assert 0.8 < report["truth"]["error_over_sigma_p68"] < (1.25 if ideal.plan.line_shift else 1.4)
    assert report["truth"]["complete_0.3mm"] > ideal.truth["complete_0.3mm"] - 0.01
    assert any("gamma 2.2" in note for note in report["notes"]) == ("gamma" in processing)


def test_so_it_is_of_a_small_scene_and_of_code_edges(tmp_path: Path, ideal: Ideal) -> None:
    truth = scored(ideal.bundle, tmp_path, quality=80)["truth"]
    assert 0.7 < truth["error_over_sigma_p68"] < 1.4
    assert truth["complete_0.3mm"] > ideal.truth["complete_0.3mm"] - 0.02


@pytest.mark.parametrize("ideal", [PLANS["Gray only"]], ids=["Gray only"], indirect=True)
@pytest.mark.parametrize("spread_px", [0.7, 2.5])
def test_light_that_spreads_to_one_side_is_in_the_deviation_of_code_edges(
    tmp_path: Path, ideal: Ideal, spread_px: float
) -> None:
    """They lie beside the centroid of the light, by which sinusoids measure: 2.3 times what noise alone states."""
    truth = scored(ideal.bundle, tmp_path, spread_px=spread_px)["truth"]
    assert truth["rms_mm"] > 2 * ideal.truth["rms_mm"]
    assert 0.7 < truth["error_over_sigma_p68"] < 1.4


@pytest.mark.parametrize("ideal", [PLANS["Gray only"]], ids=["Gray only"], indirect=True)
def test_a_bit_that_moved_is_told_by_the_others(tmp_path: Path, ideal: Ideal) -> None:
    moved_px = 0.4
    bundle = read_bundle(ideal.bundle)
    finest = max(each.bit for each in bundle.capture.patterns if isinstance(each, Gray))
    shots = tuple(
        replace(shot, image=np.asarray(cv2.warpAffine(shot.image, np.array([[1, 0, moved_px], [0, 1.0, 0]]),
                                                      shot.image.shape[::-1]), shot.image.dtype))
        if getattr(bundle.capture.patterns[shot.pattern], "bit", -1) == finest else shot
        for shot in bundle.capture.shots
    )  # fmt: skip
    write_bundle(tmp_path / "bundle", replace(bundle.capture, shots=shots), bundle.calibration)
    shutil.copy(ideal.bundle / "truth.ply", tmp_path / "bundle")
    shutil.copy(ideal.bundle / "visible_points.npy", tmp_path / "bundle")
    report = reconstructed(tmp_path / "bundle", tmp_path / "out")
    (camera,) = report["cameras"].values()
    assert camera["bits_displaced_px"][-1] == pytest.approx(moved_px, abs=0.1)
    assert max(camera["bits_displaced_px"][:-1]) < 0.1
    assert any("finest bits" in note for note in report["notes"])
    assert 0.7 < report["truth"]["error_over_sigma_p68"] < 1.4


@pytest.mark.parametrize("name", LIGHTS)
def test_light_of_a_bench_is_not_shot_again_and_the_surface_is_as_good(tmp_path: Path, ideal: Ideal, name: str) -> None:
    light = LIGHTS[name]
    report = scanned(rig_of(tmp_path / "rig", light), plan=ideal.plan)
    truth, evidence = report["truth"], report["evidence"]
    sys.stdout.write(
        f"{name:20} {evidence['patterns_verified']:>7}, rms {1000 * truth['rms_mm']:5.1f} "
        f"({1000 * ideal.truth['rms_mm']:.1f}) µm, covered {truth['complete_0.3mm']:.2%} "
        f"({ideal.truth['complete_0.3mm']:.2%}), error/σ {truth['error_over_sigma_p68']:.2f}\n"
    )
    assert not evidence["shot_again"]
    assert not evidence["contradictions"]
    assert truth["rms_mm"] <= light.rms * ideal.truth["rms_mm"]
    assert truth["error_over_sigma_p68"] <= light.sigma
    assert truth["complete_0.3mm"] >= ideal.truth["complete_0.3mm"] - light.complete


def test_automatic_exposure_is_measured_and_noted(tmp_path: Path) -> None:
    stepped = Light(faults="[head.faults]\nexposure_step_frames = [9]\nexposure_step = 0.75\n")
    report = scanned(rig_of(tmp_path / "rig", stepped), plan=PatternPlan())
    assert any("the light is not the same in all frames" in note for note in report["notes"])
    # A step between line frames displaces points; what it does is in σ.
    assert report["truth"]["rms_mm"] < 0.05
    assert report["truth"]["error_over_sigma_p68"] <= 1.25
