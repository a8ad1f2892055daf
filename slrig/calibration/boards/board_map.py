"""From a place on a board to a place in an image: a homography, and a smooth rest for what a lens bends."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from slrig.model import FloatArray

_CUBIC, _QUADRATIC = 30, 14
"""Fewest points for all terms of third degree, and for those of second with one of third."""
_SPAN = 3
"""Fewest different columns and rows for a rest at all."""
_TURNS = 4
_HORIZON = 1e-9


@dataclass(frozen=True, slots=True)
class BoardMap:
    """A smooth map of the plane of a board into an image: q = homography(place), then q + a polynomial of q.

    With k1, p1 and p2 of Brown's lens that polynomial is q |q|^2 and terms of second degree, wherever the lens has its
    centre; k2 adds q |q|^4 and terms of third and fourth degree.

    homography : (3, 3) float64; rest : (terms,) float64, px, over those of `_terms`; middle : (2,) float64 px, half :
    px, the box of q that it was fitted to; bound : (2,) float64, how far the rest goes on, over `half`: a step of the
    grid beyond the box. Farther out it stays what it is there, so that an extrapolation is no wilder than the
    homography's.
    """

    homography: FloatArray
    rest: FloatArray
    middle: FloatArray
    half: float
    bound: FloatArray
    degree: int

    def __call__(self, places: FloatArray) -> FloatArray:
        """(..., 2) float64, px: where places of the board, (..., 2), lie in the image."""
        flat = _flat(self.homography, places)
        if not self.degree:
            return flat
        within = np.clip((flat - self.middle) / self.half, -self.bound, self.bound)
        return np.asarray(flat + _terms(within, self.degree) @ self.rest)

    def jacobian(self, places: FloatArray, *, step: float) -> FloatArray:
        """(..., 2, 2) float64: derivative of (x, y) in the image, rows, by (x, y) on the board, columns."""
        columns = [(self(places + step * unit) - self(places - step * unit)) / (2 * step) for unit in np.eye(2)]
        return np.stack(columns, axis=-1)


def fitted_map(places: FloatArray, points_px: FloatArray) -> BoardMap | None:
    """The map that best takes places of the board (n, 2) to points of the image (n, 2); None if they determine none.

    The rest has 15 terms with 30 points or more, 7 with 14 or more, and none below: a few points bend a polynomial more
    than a lens bends a board.
    """
    if len(places) < 4:
        return None
    homography, _ = cv2.findHomography(places, points_px, 0)
    if homography is None or not np.isfinite(homography).all():
        return None
    homography = np.asarray(homography, dtype=np.float64)
    steps = np.array([len(np.unique(np.round(places[:, axis], 6))) for axis in (0, 1)])
    spans = int(steps.min())
    degree = 3 if len(places) >= _CUBIC else 2 if len(places) >= _QUADRATIC else 0
    degree = min(degree, spans - 1) if spans >= _SPAN else 0
    flat = _flat(homography, places)
    least, most = flat.min(axis=0), flat.max(axis=0)
    middle, half = (least + most) / 2, max(float((most - least).max()) / 2, 1e-9)
    bound = (most - least) / 2 / half + 2.5 / max(spans - 1, 1)
    rest = np.zeros(_terms(np.zeros((1, 2)), degree).shape[-1])
    for _ in range(_TURNS if degree else 0):
        # One step of Gauss and Newton in both: the homography that the bent points alone give is not the straight one.
        flat = _flat(homography, places)
        terms = _terms((flat - middle) / half, degree)
        off = points_px - flat - terms @ rest
        design = np.concatenate([_by_homography(homography, places), terms], axis=2).reshape(-1, 8 + len(rest))
        scale = np.maximum(np.linalg.norm(design, axis=0), 1e-12)
        step, *_ = np.linalg.lstsq(design / scale, off.ravel(), rcond=1e-9)
        step = step / scale
        homography = homography + np.append(step[:8], 0.0).reshape(3, 3)
        rest = rest + step[8:]
    return BoardMap(homography, rest, middle, half, bound, degree)


def _flat(homography: FloatArray, places: FloatArray) -> FloatArray:
    """(..., 2) float64: places through the homography alone."""
    homogeneous = places @ homography[:, :2].T + homography[:, 2]
    below = homogeneous[..., 2:]
    # A place on the horizon is nowhere in the image: very far away will do.
    return np.asarray(homogeneous[..., :2] / np.where(np.abs(below) < _HORIZON, _HORIZON, below))


def _by_homography(homography: FloatArray, places: FloatArray) -> FloatArray:
    """(n, 2, 8) float64: derivative of a place in the image by the first eight numbers of the homography."""
    full = np.column_stack([places, np.ones(len(places))])
    flat, below = _flat(homography, places), (full @ homography[2])[:, None]
    below = np.where(np.abs(below) < _HORIZON, _HORIZON, below)
    derivative = np.zeros((len(places), 2, 8))
    derivative[:, 0, :3] = derivative[:, 1, 3:6] = full / below
    derivative[:, :, 6:] = -flat[:, :, None] * full[:, None, :2] / below[:, :, None]
    return derivative


def _terms(within: FloatArray, degree: int) -> FloatArray:
    """(..., 2, terms) float64: what each term adds to x and to y; terms of first degree are the homography's."""
    x, y = within[..., 0], within[..., 1]
    square = x * x + y * y
    if degree < 3:
        products, radial = [x * x, x * y, y * y], square
    else:
        products, radial = [x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], square * square
    nothing = np.zeros_like(x)
    to_x = np.stack([*products, *[nothing] * len(products), radial * x], axis=-1)
    to_y = np.stack([*[nothing] * len(products), *products, radial * y], axis=-1)
    return np.stack([to_x, to_y], axis=-2)
