"""A calibration from the pixels that camera and projector share, against devices and lenses of OpenCV."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from slrig.errors import SolveRefusedError
from slrig.model import Axis, Calibration, FloatArray, Pinhole, Size
from slrig.reconstruction import DeviceGuess, PixelPairs, SelfCalibration, guessed_calibration, self_calibrate
from slrig.reconstruction.self_calibration import _Problem, _residuals, similarity_rms, triangulate

CAMERA, PROJECTOR = Size(1280, 1024), Size(1280, 800)
BASELINE_MM = 190.0
NOISE_PX = 0.05


@dataclass(frozen=True)
class Truth:
    """Devices as (matrix, distortion, rotation, centre), which OpenCV projects with."""

    camera: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    projector: tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def towards(centre: FloatArray, target: FloatArray) -> FloatArray:
    ahead = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead])


def rig(chance: np.random.Generator, *, lens_shift_px: float, baseline_mm: float = BASELINE_MM) -> Truth:
    """A camera beside a projector whose lens is shifted."""
    target = np.array([0.0, 0.0, 600.0])
    focal = np.array([1800.0, 1500.0]) * chance.uniform(0.9, 1.1, 2)
    turned = towards(np.zeros(3), target)
    # The picture of a level projector with a shifted lens is thrown up: it stands tilted to meet the scene.
    tilt = np.arctan(lens_shift_px / focal[1])
    turned = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]) @ turned
    centre = np.array([baseline_mm, chance.uniform(-30, 30), chance.uniform(-20, 20)])
    centre *= baseline_mm / np.linalg.norm(centre)

    def device(
        size: Size, focal_px: float, shift_px: float, spread_px: float, lens: FloatArray, rotation: FloatArray,
        at: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
        middle = np.array([size.width_px - 1, size.height_px - 1 + 2 * shift_px]) / 2 + chance.normal(0, spread_px, 2)
        return np.array([[focal_px, 0, middle[0]], [0, focal_px, middle[1]], [0, 0, 1.0]]), lens, rotation, at

    return Truth(
        device(
            CAMERA, focal[0], 0.0, 12.0, np.array([chance.normal(-0.05, 0.06), chance.normal(0, 0.05), 2e-4, -3e-4, 0]),
            towards(centre, target), centre,
        ),
        device(PROJECTOR, focal[1], lens_shift_px, 8.0, np.array([0.02, -0.01, -2e-4, 1e-4, 0]), turned, np.zeros(3)),
    )  # fmt: skip


def surface(kind: str, chance: np.random.Generator, count: int) -> FloatArray:
    """Points of a scene about (0, 0, 600), mm."""
    x, y = chance.uniform(-130, 130, count), chance.uniform(-100, 100, count)
    if kind == "relief":
        depth = 25 * np.sin(x / 30) * np.cos(y / 25) + 10 * np.sin(x / 11 + 1)
    elif kind == "steps":
        depth = 20 * np.floor((x + 130) / 65)
    elif kind == "corner":
        depth = 120 - np.maximum(np.abs(x), np.abs(y + 0.3 * x))
    elif kind == "two balls":
        ball = np.where(x < 0, 45.0, 40.0)
        left = (x - np.where(x < 0, -50.0, 50.0)) ** 2 + y**2
        inside = left < 0.9 * ball**2
        x, y, ball, left = x[inside], y[inside], ball[inside], left[inside]
        depth = np.sqrt(ball**2 - left) + np.where(x < 0, 0.0, 60.0)
    elif kind == "sculpture":
        depth = 70 * np.exp(-(x**2) / 6000 - y**2 / 9000) * (1 + 0.3 * np.sin(x / 9) * np.cos(y / 13)) + 0.1 * x
    else:
        depth = {"plane": 0.35 * x + 0.1 * y}[kind]
    return np.column_stack([x, y, 600 - depth])


def pixels(device: tuple[FloatArray, FloatArray, FloatArray, FloatArray], points_mm: FloatArray) -> FloatArray:
    matrix, lens, rotation, centre = device
    found, _ = cv2.projectPoints(points_mm, cv2.Rodrigues(rotation)[0], -rotation @ centre, matrix, lens)
    return np.asarray(found).reshape(-1, 2)


def shared(truth: Truth, points_mm: FloatArray, chance: np.random.Generator | None) -> tuple[PixelPairs, FloatArray]:
    """Pixels of both devices that see the points, and these; with noise of the projector's positions."""
    here, there = pixels(truth.camera, points_mm), pixels(truth.projector, points_mm)
    seen = np.ones(len(points_mm), dtype=bool)
    for each, size in ((here, CAMERA), (there, PROJECTOR)):
        seen &= (each >= 0).all(axis=1) & (each <= [size.width_px - 1, size.height_px - 1]).all(axis=1)
    here, there = here[seen], there[seen]
    if chance is not None:
        there = there + chance.normal(0, NOISE_PX, there.shape)
    return PixelPairs(here, there, np.full(len(here), NOISE_PX), Axis.COLUMN), points_mm[seen]


def pinhole(size: Size, device: tuple[FloatArray, FloatArray, FloatArray, FloatArray]) -> Pinhole:
    matrix, lens, rotation, centre = device
    return Pinhole(size, matrix, lens, rotation, -rotation @ centre)


def guessed(truth: Truth, wrong: float, chance: np.random.Generator) -> tuple[Calibration, FloatArray]:
    """Focal lengths that are wrong by a share, either way, and stated to be."""
    signs = chance.choice([-1, 1], 2)
    camera, projector = (
        DeviceGuess(size, float(device[0][0, 0]) * (1 + sign * wrong), wrong)
        for size, device, sign in ((CAMERA, truth.camera, signs[0]), (PROJECTOR, truth.projector, signs[1]))
    )
    return guessed_calibration({"left": camera}, projector)


def shape_error(found: SelfCalibration, truth: Truth, points_mm: FloatArray) -> float:
    """Error of the shape of the points over its size, after a similarity; noise aside."""
    pairs, seen = shared(truth, points_mm, None)
    projector = found.calibration.projector
    assert projector is not None
    return similarity_rms(seen, triangulate(found.calibration.cameras["left"], projector, pairs)) / found.size_mm


KINDS = ("relief", "steps", "corner", "two balls", "sculpture")


@pytest.mark.parametrize(("kind", "seed"), [(kind, seed) for seed, kind in enumerate(KINDS)])
def test_the_stated_error_of_shape_holds_what_the_error_is(kind: str, seed: int) -> None:
    chance = np.random.default_rng(seed)
    truth = rig(chance, lens_shift_px=400 * (-1) ** seed)
    points = surface(kind, chance, 8_000)
    pairs, _ = shared(truth, points, chance)
    found = self_calibrate(
        *guessed(truth, 0.1, chance), [{"left": pairs}], baseline_mm=BASELINE_MM, most_error=0.05
    )  # fmt: skip
    assert shape_error(found, truth, points) < 2 * found.shape_error
    assert found.residual_px == pytest.approx(NOISE_PX, rel=0.1)
    assert found.calibration.projector is not None
    assert np.linalg.norm(found.calibration.projector.centre_mm) == pytest.approx(BASELINE_MM, rel=1e-6)


def test_what_the_data_sheet_states_closely_gives_a_shape_that_is_let_through() -> None:
    chance = np.random.default_rng(5)
    truth = rig(chance, lens_shift_px=0)
    points = surface("steps", chance, 12_000)
    pairs, _ = shared(truth, points, chance)
    found = self_calibrate(*guessed(truth, 0.002, chance), [{"left": pairs}], baseline_mm=BASELINE_MM)
    assert shape_error(found, truth, points) < 0.003


@pytest.mark.parametrize(("wrong", "seed"), [(0.02, 0), (0.02, 1), (0.1, 2), (0.001, 3)])
def test_a_flat_scene_is_refused_however_well_the_lenses_are_known(wrong: float, seed: int) -> None:
    chance = np.random.default_rng(seed)
    truth = rig(chance, lens_shift_px=200)
    pairs, _ = shared(truth, surface("plane", chance, 6_000), chance)
    with pytest.raises(SolveRefusedError, match=r"flat|no pose|fit no two devices"):
        self_calibrate(*guessed(truth, wrong, chance), [{"left": pairs}], baseline_mm=BASELINE_MM, most_error=1.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda pairs: pairs.take(slice(None, None, 20)), "expected at least 500 pixels"),
        # A picture that is mirrored fits no two devices.
        (
            lambda each: PixelPairs(each.camera_px * [-1, 1] + [1279, 0], each.projector_px, each.sigma_px, each.axis),
            "mirrored|flat|only, and",
        ),
    ],
    ids=["few", "mirrored"],
)  # fmt: skip
def test_pairs_that_give_no_rig_are_refused_in_words(change: object, words: str) -> None:
    chance = np.random.default_rng(7)
    truth = rig(chance, lens_shift_px=0)
    pairs, _ = shared(truth, surface("relief", chance, 6_000), chance)
    assert callable(change)
    with pytest.raises(SolveRefusedError, match=words):
        self_calibrate(*guessed(truth, 0.05, chance), [{"left": change(pairs)}], baseline_mm=BASELINE_MM)


def test_devices_that_look_from_one_place_are_refused() -> None:
    chance = np.random.default_rng(8)
    truth = rig(chance, lens_shift_px=0, baseline_mm=0.5)
    pairs, _ = shared(truth, surface("relief", chance, 6_000), chance)
    with pytest.raises(SolveRefusedError, match=r"nearly the same place|no pose|fit no two devices|only, and"):
        self_calibrate(*guessed(truth, 0.02, chance), [{"left": pairs}], baseline_mm=BASELINE_MM)


def test_scans_improve_a_calibration_that_states_its_errors() -> None:
    sigma = np.array([4.0, 4.0, 3.0, 3.0, 3e-3, 3e-3, 2e-4, 2e-4, 0, 1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1])
    sigmas = np.concatenate([sigma * ([1] * 9 + [0] * 6), sigma])
    errors = []
    for seed in range(4):
        chance = np.random.default_rng(seed)
        truth = rig(chance, lens_shift_px=0)
        points = surface("steps", chance, 8_000)
        pairs, _ = shared(truth, points, chance)
        true = (pinhole(CAMERA, truth.camera), pinhole(PROJECTOR, truth.projector))
        camera, projector = (
            Pinhole(
                each.size,
                each.matrix + np.array([[off[0], 0, off[2]], [0, off[1], off[3]], [0, 0, 0]]),
                each.distortion + off[4:9],
                cv2.Rodrigues(off[9:12])[0] @ each.rotation,
                each.translation_mm + off[12:],
            )
            for each, off in zip(true, (chance.normal(size=30) * sigmas).reshape(2, 15), strict=True)
        )
        prior = Calibration({"left": camera}, projector)
        found = self_calibrate(prior, np.diag(sigmas**2), [{"left": pairs}], most_error=1.0)
        clean, seen = shared(truth, points, None)
        before = similarity_rms(seen, triangulate(camera, projector, clean)) / found.size_mm
        errors.append([before, shape_error(found, truth, points)])
        assert errors[-1][1] < 2 * found.shape_error
        assert found.contradiction < 2
    first, last = np.sqrt(np.mean(np.square(errors), axis=0))
    assert last < 0.8 * first


def test_a_rig_that_was_moved_since_is_told_by_its_scans() -> None:
    chance = np.random.default_rng(12)
    truth = rig(chance, lens_shift_px=0)
    pairs, _ = shared(truth, surface("relief", chance, 6_000), chance)
    projector = pinhole(PROJECTOR, truth.projector)
    turned = cv2.Rodrigues(np.deg2rad([0.3, 0.2, 0.1]))[0] @ projector.rotation
    before = Calibration(
        {"left": pinhole(CAMERA, truth.camera)},
        Pinhole(PROJECTOR, projector.matrix, projector.distortion, turned, projector.translation_mm),
    )
    sigma = np.array([0.5, 0.5, 0.5, 0.5, 1e-3, 1e-3, 1e-5, 1e-5, 0, 1e-4, 1e-4, 1e-4, 0.02, 0.02, 0.02])
    covariance = np.diag(np.concatenate([sigma[:9], np.zeros(6), sigma]) ** 2)
    found = self_calibrate(before, covariance, [{"left": pairs}], most_error=1.0)
    assert found.contradiction > 10


def test_derivatives_are_those_of_differences() -> None:
    chance = np.random.default_rng(3)
    truth = rig(chance, lens_shift_px=300)
    pairs, _ = shared(truth, surface("relief", chance, 600), chance)
    calibration = Calibration({"left": pinhole(CAMERA, truth.camera)}, pinhole(PROJECTOR, truth.projector))
    sigma = np.tile([3.0] * 4 + [0.01] * 5 + [0.05] * 3 + [1.0] * 3, 2)
    problem = _Problem.build(calibration, np.diag(sigma**2), [{"left": PixelPairs(
        np.tile(pairs.camera_px, (3, 1)), np.tile(pairs.projector_px, (3, 1)), np.tile(pairs.sigma_px, 3), pairs.axis
    )}])  # fmt: skip
    z = 3 * chance.normal(size=problem.free)
    index, used = problem.blocks[0]
    _, slopes = problem._slopes(z, index, used)
    for at, step in enumerate(1e-4 * np.eye(problem.free)):
        two = [_residuals(problem.devices(z + sign * step), index, used) for sign in (1, -1)]
        differences = (two[0] - two[1]) / 2e-4
        np.testing.assert_allclose(slopes[:, at], differences, atol=2e-3 * np.abs(differences).max() + 1e-9)
