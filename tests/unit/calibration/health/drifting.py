"""A made-up rig whose calibration has a known error and covariance, changed since, and a board seen by it.

Projection is OpenCV's, and points are found by the secant method (`perturbed`): nothing is shared with what is tested.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from slrig.calibration.board import COLUMN, ROW, Board, BoardKind, BoardView, Correspondences, PoseObservation
from slrig.calibration.solution import PROJECTOR
from slrig.model import Calibration, FloatArray, Pinhole, SolveRecord
from tests.unit.calibration.perturbed import (
    aligned,
    changed,
    covariance_by_known_points,
    draws,
    left_camera,
    light_source,
    met_with_projector,
    pixels,
    right_camera,
)

BOARD = Board(BoardKind.CHESSBOARD, 11, 8, 12.0)
VOLUME_MM = np.array([[-60.0, -50.0, 550.0], [60.0, 50.0, 660.0]])
CORNER_PX, LIGHT_PX, ALIKE_PX = 0.04, 0.04, 0.02
_SIDE = 40
_FIELD = 48


@dataclass(frozen=True)
class Bench:
    """The devices as they were when they were calibrated, and what the calibration says of them."""

    devices: Mapping[str, Pinhole]
    calibration: Calibration


@cache
def bench(seed: int = 0, *, cameras: int = 1, known_px: float = 0.02) -> Bench:
    """A rig, and a calibration that is off by one draw of its own covariance."""
    names = {"left": left_camera()} if cameras == 1 else {"left": left_camera(), "right": right_camera()}
    devices = {**names, PROJECTOR: light_source()}
    covariance = covariance_by_known_points(list(devices.values()), 1, known_px, 5)
    error = draws(covariance, 1, seed + 100)[0].reshape(-1, 15)
    stated = {name: changed(device, error[index]) for index, (name, device) in enumerate(devices.items())}
    solved = SolveRecord("0123456789ab", "2026-11-20T08:00:00+00:00", covariance, VOLUME_MM, 0.01)
    light = stated.pop(PROJECTOR)
    return Bench(devices, Calibration(stated, light, solved))


def turned(device: Pinhole, degrees: tuple[float, float, float]) -> Pinhole:
    """The device turned about its own centre and axes."""
    turn = np.asarray(cv2.Rodrigues(np.radians(degrees))[0])
    return replace(device, rotation=turn @ device.rotation, translation_mm=turn @ device.translation_mm)


def zoomed(device: Pinhole, share: float) -> Pinhole:
    """The device with a longer focal length."""
    matrix = device.matrix.copy()
    matrix[[0, 1], [0, 1]] *= 1 + share
    return replace(device, matrix=matrix)


def moved(device: Pinhole, by_mm: FloatArray) -> Pinhole:
    """The device moved in the world."""
    return replace(device, translation_mm=device.translation_mm - device.rotation @ by_mm)


def further_apart(devices: Mapping[str, Pinhole], by_mm: float) -> Mapping[str, Pinhole]:
    """The rig with its projector further from the first camera."""
    way = devices[PROJECTOR].centre_mm - devices["left"].centre_mm
    return {**devices, PROJECTOR: moved(devices[PROJECTOR], by_mm * way / np.linalg.norm(way))}


def look_of(devices: Mapping[str, Pinhole], seed: int, *, noise: float = 1.0, grown: float = 0.0) -> PoseObservation:
    """The board as the devices see it. noise : times the usual one; grown : share by which the print is too large."""
    rng = np.random.default_rng(seed)
    turn = np.asarray(cv2.Rodrigues(np.radians([18.0, 12.0, 2.0]))[0])
    corners = BOARD.points_mm * (1 + grown)
    shift = np.array([0.0, 0.0, 600.0]) - turn @ corners.mean(axis=0)
    views, light = {}, {}
    for name, camera in devices.items():
        if name == PROJECTOR:
            continue
        at = pixels(camera, corners @ turn.T + shift)
        at += rng.normal(0, noise * CORNER_PX, at.shape)
        number = np.arange(len(at), dtype=np.int32)
        views[name] = BoardView(number, at, np.full(len(at), CORNER_PX))
        light[name] = _light(camera, devices[PROJECTOR], turn, shift, rng, noise)
    return PoseObservation("look", views, light)


def true_error_mm(now: Mapping[str, Pinhole], calibration: Calibration) -> float:
    """Rms along the first camera's rays of what a scan is wrong by, after the best rigid motion, over the volume.

    Points of several cameras are averaged, weighted by how far each sees them move along the projector's ray.
    """
    steps = [low + (high - low) * (np.arange(8) + 0.5) / 8 for low, high in zip(*VOLUME_MM, strict=True)]
    places = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    lamp = now[PROJECTOR]
    if calibration.projector is None:
        raise ValueError(calibration)
    lit = pixels(lamp, places)[:, 0]
    farther = places + 0.01 * (places - lamp.centre_mm) / np.linalg.norm(places - lamp.centre_mm, axis=1, keepdims=True)
    total, found = np.zeros(len(places)), np.zeros_like(places)
    for name, stated in calibration.cameras.items():
        at = pixels(now[name], places)
        weight = ((pixels(now[name], farther) - at) ** 2).sum(axis=1)
        found += weight[:, None] * met_with_projector(stated, calibration.projector, at, lit, places, 0)
        total += weight
    off = aligned(found / total[:, None], places) - places
    ray = places - now["left"].centre_mm
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return float(np.sqrt(((off * ray).sum(axis=1) ** 2).mean()))


def _light(
    camera: Pinhole, lamp: Pinhole, turn: FloatArray, shift: FloatArray, rng: np.random.Generator, noise: float
) -> Correspondences:
    (left, top), (right, bottom) = BOARD.print_mm
    x, y = np.meshgrid(np.linspace(left, right, _SIDE), np.linspace(top, bottom, _SIDE))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) @ turn.T + shift
    at, lit = pixels(camera, points), pixels(lamp, points)
    cloud = gaussian_filter(rng.normal(size=(2, _FIELD, _FIELD)), (0, 2, 2), mode="wrap")[:, :_SIDE, :_SIDE]
    cloud *= noise * ALIKE_PX / cloud.std()
    lit += noise * LIGHT_PX * rng.normal(size=lit.shape) + cloud.reshape(2, -1).T
    wrong = rng.random(len(lit)) < 0.01
    lit[wrong] += rng.uniform(-40, 40, (int(wrong.sum()), 2))
    return Correspondences(
        np.concatenate([at, at]),
        np.repeat(np.array([COLUMN, ROW], dtype=np.uint8), len(at)),
        np.concatenate([lit[:, 0], lit[:, 1]]),
        np.full(2 * len(at), LIGHT_PX),
    )
