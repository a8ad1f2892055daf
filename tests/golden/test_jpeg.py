"""Scans whose frames were kept as JPEG: the error that is stated is the one that is found, and it is told.

`pytest tests/golden/test_jpeg.py -s -m slow` prints the table.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import cv2
import pytest

from slrig.bundle.description import DESCRIPTION
from slrig.scan.plan import PatternPlan
from tests.golden.test_bundles import reconstructed
from tests.golden.test_light_axis import BALL, LEFT, PROJECTOR, rig_file, scanned

PLANS = {"lines": PatternPlan(), "Gray only": PatternPlan(line_shift=False, gray_cell_px=2)}


def compress(bundle: Path, quality: int) -> None:
    """Keep the frames as JPEG, and nothing else of them."""
    for path in (bundle / "frames").rglob("*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert cv2.imwrite(str(path.with_suffix(".jpg")), image, [cv2.IMWRITE_JPEG_QUALITY, quality])
        path.unlink()
    description = bundle / DESCRIPTION
    description.write_text(description.read_text().replace(".png", ".jpg"))


@pytest.mark.slow
@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_jpeg_errs_by_what_is_stated(tmp_path: Path, plan: PatternPlan) -> None:
    rig = rig_file(tmp_path / "rig", BALL, {**PROJECTOR, "position_mm": (105.0, 0.0, -590.0)}, LEFT)
    lossless = scanned(rig, plan=plan)
    for quality in (95, 80):
        bundle = tmp_path / f"bundle-{quality}"
        shutil.copytree(rig.parent / "bundle", bundle)
        compress(bundle, quality)
        report = reconstructed(bundle, tmp_path / f"out-{quality}")
        truth = report["truth"]
        sys.stdout.write(
            f"quality {quality}: rms {1000 * truth['rms_mm']:.1f} µm ({1000 * lossless['truth']['rms_mm']:.1f} without "
            f"loss), error/σ {truth['error_over_sigma_p68']:.2f} ({lossless['truth']['error_over_sigma_p68']:.2f}), "
            f"covered {truth['complete_0.3mm']:.2%} ({lossless['truth']['complete_0.3mm']:.2%})\n"
        )
        assert 0.6 < truth["error_over_sigma_p68"] < 1.4
        assert truth["complete_0.3mm"] > lossless["truth"]["complete_0.3mm"] - 0.02
        assert any("JPEG" in note for note in report["notes"])
