"""Random wrong calibrations of a recorded scan of columns and rows: are their errors said?

    python -m tests.bench.wrong_calibrations BUNDLE [COUNT]

BUNDLE holds both axes of one camera and its right calibration. Each wrong one displaces the points; that error, over
the standard deviation of 0.03 px of a column, is compared with what `check_calibration` says: refuted, significant, or
nothing.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from slrig.bundle import open_bundle
from slrig.model import CaptureHeader, FloatArray, Pinhole
from slrig.reconstruction import PixelPairs, check_calibration
from slrig.reconstruction.calibration_check import coded_depth_mm
from slrig.reconstruction.triangulation import pixel_rays
from slrig.scan.stream import ScanStream

NOISE_PX = 0.03
Case = tuple[Pinhole, Pinhole, PixelPairs]


def moved(projector: Pinhole, turn_deg: FloatArray, shift_mm: FloatArray) -> Pinhole:
    rotation = Rotation.from_rotvec(np.radians(turn_deg)).as_matrix() @ projector.rotation
    return replace(projector, rotation=rotation, translation_mm=-rotation @ (projector.centre_mm + shift_mm))


def with_lens(device: Pinhole, *, focal: float = 1.0, centre_px: float = 0.0, k1: float = 0.0) -> Pinhole:
    matrix, distortion = device.matrix.copy(), device.distortion.copy()
    matrix[:2, :2] *= focal
    matrix[0, 2] += centre_px
    distortion[0] += k1
    return replace(device, matrix=matrix, distortion=distortion)


def kinds(
    camera: Pinhole, projector: Pinhole, pairs: PixelPairs, random: np.random.Generator
) -> list[Callable[[], Case]]:
    """One function for each kind of mistake, which draws its size."""

    def size(low: float, high: float) -> float:
        return float(np.exp(random.uniform(np.log(low), np.log(high))) * random.choice([-1, 1]))

    def direction() -> FloatArray:
        each = random.normal(size=3)
        return np.asarray(each / np.linalg.norm(each))

    def on_camera(pixels: FloatArray) -> Case:
        return camera, projector, replace(pairs, camera_px=pixels)

    nothing, pixels = np.zeros(3), pairs.camera_px
    return [
        lambda: (camera, moved(projector, direction() * size(0.01, 5), nothing), pairs),
        lambda: (camera, moved(projector, nothing, direction() * size(0.05, 30)), pairs),
        lambda: (camera, moved(projector, direction() * size(0.02, 1), direction() * size(0.1, 5)), pairs),
        lambda: (with_lens(camera, focal=1 + size(0.001, 0.1)), projector, pairs),
        lambda: (camera, with_lens(projector, focal=1 + size(0.001, 0.1)), pairs),
        lambda: (with_lens(camera, centre_px=size(0.5, 60)), projector, pairs),
        lambda: (with_lens(camera, k1=size(0.01, 0.3)), projector, pairs),
        lambda: (camera, with_lens(projector, k1=size(0.01, 0.3)), pairs),
        lambda: on_camera(pixels - random.integers(-60, 60, 2)),
        lambda: on_camera((pixels + 0.5) * (1 + size(0.002, 0.5)) - 0.5),
        lambda: (
            camera,
            projector,
            replace(pairs, projector_px=pairs.projector_px + np.round([size(1, 200), size(1, 60)])),
        ),
    ]


def points_mm(camera: Pinhole, projector: Pinhole, pairs: PixelPairs) -> FloatArray:
    ray = pixel_rays(camera, pairs.camera_px)
    return np.asarray(camera.centre_mm + coded_depth_mm(camera, projector, pairs)[:, None] * ray)


def main(bundle: Path, count: int) -> None:
    files = open_bundle(bundle)
    calibration = files.calibration
    assert calibration is not None
    assert calibration.projector is not None
    stream = ScanStream(CaptureHeader.from_capture(files.outline), calibration, entered=lambda *_: None)
    for shot in files.shots(range(len(files.outline.shots))):
        stream.take(shot)
    (found,) = stream.finish()
    assert found.second is not None
    camera, projector, pairs = found.device, calibration.projector, found.second.pairs.thinned(30_000)
    random = np.random.default_rng(5)
    makers, right = kinds(camera, projector, pairs, random), points_mm(camera, projector, pairs)
    said = unsaid = 0
    for index in range(count):
        case = makers[index % len(makers)]()
        noisy = replace(case[2], projector_px=case[2].projector_px + np.array([NOISE_PX, 0.0]))
        wrong = points_mm(*case)
        sigma_mm = float(np.nanmedian(np.linalg.norm(points_mm(case[0], case[1], noisy) - wrong, axis=1)))
        over = float(np.nanmedian(np.linalg.norm(wrong - right, axis=1))) / sigma_mm
        check = check_calibration(*case, found.second.codes)
        is_said = check is None or check.is_refuted or check.is_significant
        said, unsaid = said + is_said, unsaid + (not is_said and over > 3)
        if not is_said and over > 3:
            sys.stdout.write(f"unsaid: case {index}, kind {index % len(makers)}, {over:.1f} times the noise\n")
    sys.stdout.write(f"{count} wrong calibrations, {said} said, {unsaid} beyond three times the noise unsaid\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 200)
