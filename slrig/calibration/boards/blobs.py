"""Dark round spots, and the lattice that they may form."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from slrig.calibration.boards.board_map import BoardMap
from slrig.calibration.boards.grey import Grey
from slrig.calibration.boards.lattice import Lattice, levels_at
from slrig.model import FloatArray, IntArray

_LEAST_AREA_PX = 25.0
_FEWEST_IN_LATTICE = 9
_MOST = 5000
_SEEDS = 12
_CLEAR, _HALF = 0.85, 0.6
"""Least share of the places that must be as they are between circles; a corner of a square may be light by its blur."""
_STRAY = 0.3
"""How far a spot may lie from where its neighbours say, in steps of the lattice."""


@dataclass(frozen=True, slots=True)
class Blobs:
    """Spots: points_px (n, 2) float64, radius_px (n,) float64."""

    points_px: FloatArray
    radius_px: FloatArray


def dark_blobs(image: NDArray[np.uint8], *, most: int) -> Blobs:
    """Dark spots that a circle may look like, tilted up to some 70 degrees, each at most 1 / `most` of the image."""
    settings = cv2.SimpleBlobDetector.Params()
    settings.minThreshold, settings.maxThreshold, settings.thresholdStep = 30, 230, 20
    settings.minRepeatability = 2
    settings.minDistBetweenBlobs = 4
    settings.filterByColor, settings.blobColor = True, 0
    settings.filterByArea, settings.minArea = True, _LEAST_AREA_PX
    settings.maxArea = image.size / max(most, 1)
    settings.filterByCircularity, settings.minCircularity = True, 0.4
    settings.filterByConvexity, settings.minConvexity = True, 0.85
    settings.filterByInertia, settings.minInertiaRatio = True, 0.08
    spots = cv2.SimpleBlobDetector.create(settings).detect(cv2.GaussianBlur(image, (0, 0), 0.8))
    spots = sorted(spots, key=lambda spot: -spot.size)[:_MOST]
    points = np.array([spot.pt for spot in spots], dtype=np.float64).reshape(-1, 2)
    return Blobs(points, np.array([spot.size / 2 for spot in spots], dtype=np.float64))


def circle_lattice(grey: Grey) -> Lattice | None:
    """The largest lattice of asymmetric circles in view, whatever its size. None where there is none."""
    lattice = lattice_of(dark_blobs(grey.eight, most=_FEWEST_IN_LATTICE).points_px)
    return lattice if lattice is not None and of_circles(grey.level, lattice) else None


def of_circles(level: FloatArray, lattice: Lattice) -> bool:
    """Whether the spots of a lattice are circles between which it is light. Dark squares of a chessboard stand in the
    same lattice and are dark in their corners, too; spots of noise are not light between.
    """
    board_map = lattice.board_map()
    if board_map is None:
        return False
    centres = _about(level, board_map, lattice, np.zeros((1, 2)))
    gaps = _about(level, board_map, lattice, np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]))
    tips = _about(level, board_map, lattice, np.array([(0.45, 0.45), (0.45, -0.45), (-0.45, 0.45), (-0.45, -0.45)]))
    halfway = (np.median(centres) + np.median(gaps)) / 2
    return bool(
        np.mean(centres < halfway) > _CLEAR and np.mean(gaps > halfway) > _CLEAR and np.mean(tips > halfway) > _HALF
    )


def _about(level: FloatArray, board_map: BoardMap, lattice: Lattice, offsets: FloatArray) -> FloatArray:
    """(n,) float64: grey levels at these offsets from every spot, those outside the image left out."""
    found = levels_at(level, board_map(lattice.places[:, None] + offsets).reshape(-1, 2))
    return found[np.isfinite(found)]


def lattice_of(points_px: FloatArray) -> Lattice | None:
    """The largest lattice of asymmetric circles that points form. None where there is none.

    The steps between neighbours are taken as (1, -1) and (1, 1), right-handed, as circles in rows that are shifted by
    half a distance stand; which of the two directions are rows is not known.
    """
    index, steps = neighbours_in_steps(points_px)
    if len(index) < _FEWEST_IN_LATTICE:
        return None
    places = np.column_stack([steps.sum(axis=1), steps[:, 1] - steps[:, 0]])
    places -= places.min(axis=0)
    columns, rows = (int(extent) + 1 for extent in places.max(axis=0))
    if min(columns, rows) < 3:
        return None
    return Lattice(columns, rows, points_px[index], places.astype(np.int32))


def neighbours_in_steps(points_px: FloatArray) -> tuple[NDArray[np.int64], IntArray]:
    """The largest set of points of which each is a neighbour of another in one of two directions.

    Returns their indices, (m,) int64, and how many steps along the two directions, right-handed, each lies from the
    first, (m, 2) int32. Both are empty where there is none.
    """
    best: dict[int, tuple[int, int]] = {}
    if len(points_px) >= _FEWEST_IN_LATTICE:
        tree = KDTree(points_px)
        near = np.asarray(tree.query(points_px, k=5)[1], dtype=np.int64)
        middle = np.median(points_px, axis=0)
        for seed in np.argsort(np.linalg.norm(points_px - middle, axis=1))[:_SEEDS]:
            if int(seed) in best:
                continue
            places = _grown(points_px, tree, int(seed), near[seed, 1:])
            if len(places) > len(best):
                best = places
    steps = np.array(list(best.values()), dtype=np.int32).reshape(-1, 2)
    return np.array(list(best), dtype=np.int64), steps


def _grown(points: FloatArray, tree: KDTree, seed: int, near: NDArray[np.int64]) -> dict[int, tuple[int, int]]:
    """From a seed outwards: each point's steps along the two directions. Steps follow those of the point come from."""
    first = points[near[0]] - points[seed]
    length = float(np.hypot(*first))
    second = None
    for other in near[1:]:
        step = points[other] - points[seed]
        sine = (first[0] * step[1] - first[1] * step[0]) / max(length * float(np.hypot(*step)), 1e-9)
        if abs(sine) > 0.5:
            first, second = (first, step) if sine > 0 else (step, first)
            break
    if second is None:
        return {}
    places = {seed: (0, 0)}
    queue = [(seed, first, second)]
    taken = {(0, 0)}
    while queue:
        index, one, two = queue.pop(0)
        a, b = places[index]
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            step = sign * (one, two)[axis]
            where = (a + sign, b) if axis == 0 else (a, b + sign)
            distance, found = tree.query(points[index] + step)
            if where in taken or int(found) in places or distance > _STRAY * float(np.hypot(*step)):
                continue
            places[int(found)] = where
            taken.add(where)
            now = sign * (points[found] - points[index])
            queue.append((int(found), now, two) if axis == 0 else (int(found), one, now))
    return places
