"""Calibrations whose numbers no rig has, and those of rigs that exist, which pass."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slrig.bundle import check_calibration, read_calibration, write_calibration
from slrig.errors import CalibrationError
from slrig.model import Calibration, Pinhole, Size, calibration_faults, rig_layout
from slrig.model.plausibility import _grid, _is_weak_lens, imaged_pixels, imaged_share

CAMERA, PROJECTOR = Size(640, 512), Size(640, 400)


def device(
    size: Size = CAMERA,
    *,
    focal: tuple[float, float] = (1375.0, 1376.0),
    principal: tuple[float, float] = (322.0, 251.0),
    lens: tuple[float, ...] = (-0.08, 0.11, 4e-4, -3e-4, 0.0),
    turn: float = 0.0,
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Pinhole:
    matrix = np.array([[focal[0], 0, principal[0]], [0, focal[1], principal[1]], [0, 0, 1.0]])
    rotation = cv2.Rodrigues(np.array([0.0, turn, 0.0]))[0]
    return Pinhole(size, matrix, np.array(lens), rotation, np.array(shift_mm))


def rig(
    scale: float = 1.0, *, camera: dict[str, Any] | None = None, projector: dict[str, Any] | None = None
) -> Calibration:
    """A bench: 244 mm between the devices, and 600 mm to the object."""
    shift = (-236.0 * scale, 12.0 * scale, 55.0 * scale)
    usual: dict[str, Any] = {"focal": (1450.0, 1451.0), "principal": (322.0, 195.0), "lens": (0.02, -0.03, 0, 0, 0)}
    there = device(PROJECTOR, turn=0.38, shift_mm=shift, **(usual | (projector or {})))
    return Calibration({"cam0": device(**(camera or {}))}, there)


@pytest.mark.parametrize(
    "calibration",
    [
        rig(),
        rig(0.04),
        rig(12.0),
        rig(camera={"focal": (450.0, 450.0), "lens": (0.1, -0.2, 0.001, 0, 0)}),
        rig(camera={"focal": (290.0, 290.0), "lens": (-0.3, 0.1, 0, 0, 0)}),
        rig(camera={"focal": (20_000.0, 20_000.0)}),
        rig(camera={"focal": (9000.0, 9000.0), "principal": (2000.0, 1500.0)}),
        rig(camera={"focal": (700.0, 1376.0)}),
        rig(projector={"focal": (1450.0, 2900.0)}),
        rig(projector={"focal": (1450.0, 1209.0)}),
        rig(projector={"principal": (320.0, 480.0)}),
        rig(projector={"focal": (160.0, 160.0), "principal": (320.0, 520.0), "lens": (0, 0, 0, 0, 0)}),
    ],
    ids=["a bench", "a microscope", "a room", "a webcam", "96 degrees", "a long lens", "a crop of a large sensor",
         "pixels binned in rows", "a diamond array", "a picture scaled to the panel", "a shifted projector",
         "a short throw"],
)  # fmt: skip
def test_a_rig_that_exists_passes(calibration: Calibration) -> None:
    assert calibration_faults(calibration) == []


@pytest.mark.parametrize(
    ("calibration", "words"),
    [
        (rig(camera={"lens": (-22.0, 0, 0, 0, 0)}), "cameras.cam0.distortion: .* folds within it"),
        (rig(camera={"lens": (-4.0, 0, 0, 0, 0)}), "cameras.cam0.distortion: .* folds within it"),
        (rig(projector={"lens": (27.6, -2344.6, 7.97, 10.36, 0)}), "projector.distortion: .* folds within it"),
        (rig(projector={"lens": (15.0, 0, 0, 0, 0)}), "projector.distortion: .* bends rays more than any lens"),
        (rig(camera={"lens": (-2.5, 0, 0, 0, 0)}), "cameras.cam0.distortion: .* bends rays more than any lens"),
        (rig(camera={"focal": (870.0, 1376.0)}), "cameras.cam0.matrix: .* found 0.632"),
        (rig(projector={"focal": (400.0, 1451.0)}), "projector.matrix: expected fx / fy"),
        (rig(camera={"focal": (8.0, 8.0)}), "cameras.cam0.matrix: expected focal lengths .* in millimetres?"),
        (rig(projector={"focal": (1e6, 1e6)}), "projector.matrix: expected focal lengths"),
        (rig(camera={"principal": (3220.0, 251.0)}), "cameras.cam0.matrix: expected the principal point in or near"),
        (rig(projector={"principal": (322.0, -1950.0)}), "projector.matrix: expected the principal point in or near"),
        (rig(1e-3), "translation_mm: .* 0.243 mm apart .* 0.6.* mm away. Metres\\? Then .* 243 mm apart"),
        (rig(1e3), "translation_mm: expected devices 2 to 15000 mm apart"),
    ],
)
def test_numbers_that_no_rig_has_are_named_with_their_device(calibration: Calibration, words: str) -> None:
    faults = calibration_faults(calibration)
    assert len(faults) == 1
    assert re.search(words, faults[0])


def test_every_fault_is_in_the_message_of_a_file(tmp_path: Path) -> None:
    wrong = rig(1e-3, camera={"lens": (-22.0, 0, 0, 0, 0)}, projector={"focal": (8.0, 8.0)})
    write_calibration(tmp_path / "rig.json", wrong)
    with pytest.raises(CalibrationError, match=r"no rig has these numbers(.|\n)*folds(.|\n)*focal(.|\n)*Metres\?"):
        read_calibration(tmp_path / "rig.json")


@pytest.mark.parametrize("lens", [(-4.0, 0.0), (-22.0, 0.0), (27.6, -2344.6)])
def test_a_lens_images_what_lies_within_its_fold(lens: tuple[float, float]) -> None:
    """Without tangential terms the fold is a circle: r' = r (1 + k1 r² + k2 r⁴) where dr'/dr = 0."""
    k1, k2 = lens
    folded = device(lens=(k1, k2, 0, 0, 0))
    radius = np.linspace(0, 1, 1_000_001)
    first = np.flatnonzero(1 + 3 * k1 * radius**2 + 5 * k2 * radius**4 <= 0)[0]
    limit_px = 1375 * radius[first] * (1 + k1 * radius[first] ** 2 + k2 * radius[first] ** 4)
    column_px = 322 + np.array([0.3, 1.02]) * limit_px
    points = np.stack([column_px, np.full(2, 251.0)], axis=1)
    assert imaged_pixels(folded, points).tolist() == [True, False]


def test_the_bound_of_weak_lenses_agrees_with_the_path() -> None:
    rng = np.random.default_rng(20261129)
    sizes = np.array([0.4, 0.8, 0.03, 0.03, 2.0])
    weak = 0
    for _ in range(200):
        lens = device(lens=tuple(sizes * rng.uniform(-1, 1, 5)))
        points = rng.uniform((0, 0), (639, 511), (200, 2))
        if _is_weak_lens(lens, _grid(CAMERA)):
            weak += 1
            assert imaged_pixels(lens, points).all()
    assert 20 < weak < 180


def test_corners_that_no_board_reached_may_fold() -> None:
    lens = device(lens=(-2.0, 0, 0, 0, 0))
    assert 0.85 < imaged_share(lens) < 1
    assert calibration_faults(Calibration({"cam0": lens}, None)) == []


def test_devices_in_one_place_and_a_single_one_have_no_layout() -> None:
    assert rig_layout(Calibration({"cam0": device()}, None)) is None
    assert rig_layout(Calibration({"cam0": device()}, device())) is None


def test_the_place_that_both_look_at_is_where_their_middle_rays_meet() -> None:
    turned = cv2.Rodrigues(np.array([0.0, 0.3, 0.0]))[0]
    seat = np.array([200.0, 0.0, 0.0])
    middle: dict[str, Any] = {"principal": (319.5, 255.5)}
    there = replace(device(**middle), rotation=turned, translation_mm=-turned @ seat)
    layout = rig_layout(Calibration({"a": device(**middle), "b": there}, None))
    assert layout is not None
    assert layout.baseline_mm == pytest.approx(200.0)
    assert layout.distance_mm is not None
    expected = 200.0 / np.tan(0.3)
    assert layout.distance_mm == pytest.approx(
        expected if layout.first == "camera 'a'" else expected / np.cos(0.3), rel=0.1
    )


@pytest.mark.parametrize(
    ("size", "words"), [(Size(1280, 1024), "the same shape 2 times as large"), (Size(640, 480), "")]
)
def test_a_calibration_of_larger_images_says_how_to_scale_it(size: Size, words: str) -> None:
    calibration = Calibration({"cam0": device(size)}, device(PROJECTOR))
    with pytest.raises(CalibrationError) as caught:
        check_calibration(calibration, PROJECTOR, {"cam0": CAMERA}, "rig.json")
    assert words in str(caught.value)
    assert ("multiply fx and fy by 0.5" in str(caught.value)) == bool(words)
