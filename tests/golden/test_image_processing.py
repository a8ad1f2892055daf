"""Scans whose camera interpolated, bent or compressed its frames: the error stated is the one found, and it is told.

`tests/bench/test_image_processing.py` has the whole table.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.scan.plan import PatternPlan
from tests.golden.test_bundles import reconstructed
from tests.golden.test_light_axis import BALL, LEFT, PROJECTOR, rig_file, scanned

PLANS = {"lines": PatternPlan(), "Gray only": PatternPlan(line_shift=False, gray_cell_px=2)}
BALANCE = (0.55, 1.0, 0.7)
"""What red, green and blue pixels see of white light."""


def processed(
    bundle: Path,
    *,
    mosaic: bool = False,
    rows: float = 0.0,
    gamma: float = 1.0,
    unsharp: float = 0.0,
    quality: int | None = None,
    kept: bool = False,
) -> None:
    """Make the frames those of a camera with a mosaic and noisy rows, that bends, sharpens and compresses, in turn.

    rows : standard deviation of a row, grey levels; quality : of JPEG, None for none. kept : the frames are the JPEG
    files, and not what these decode to.
    """
    random = np.random.default_rng(3)
    for path in sorted((bundle / "frames").rglob("*.png")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        if mosaic:
            image = through_mosaic(image)
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
        pytest.param("gauge", {"quality": 50, "kept": True}, 0.97, id="gauge-50-files", marks=pytest.mark.slow),
        pytest.param("terrace", {"gamma": 2.2, "quality": 75}, 0.96, id="terrace-gamma-75", marks=pytest.mark.slow),
        pytest.param("terrace", {"mosaic": True}, 0.96, id="terrace-mosaic", marks=pytest.mark.slow),
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
class Ideal:
    """A scan of a small scene before anything is done to its frames: its plan, bundle, and figures against truth."""

    plan: PatternPlan
    bundle: Path
    truth: Mapping[str, Any]


@pytest.fixture(scope="module", params=[*PLANS.values()], ids=[*PLANS])
def ideal(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Ideal:
    folder = tmp_path_factory.mktemp("ideal") / "rig"
    rig = rig_file(folder, BALL, {**PROJECTOR, "position_mm": (105.0, 0.0, -590.0)}, LEFT)
    truth = scanned(rig, plan=request.param)["truth"]
    return Ideal(request.param, folder / "bundle", truth)


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("quality", [95, 80])
def test_so_it_is_of_a_small_scene_and_of_code_edges(tmp_path: Path, ideal: Ideal, quality: int) -> None:
    truth = scored(ideal.bundle, tmp_path, quality=quality)["truth"]
    assert 0.7 < truth["error_over_sigma_p68"] < 1.4
    assert truth["complete_0.3mm"] > ideal.truth["complete_0.3mm"] - 0.02
