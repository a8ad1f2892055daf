"""Devices, surfaces and light for the reconstruction's tests, built with OpenCV and plain numpy only.

Nothing here calls the code under test: projections are `cv2.projectPoints`, rays `cv2.undistortPoints`, light is an
analytic profile.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr

from slrig.model import Axis, CameraFormat, Capture, FloatArray, Gray, IntArray, LineShift, Pattern, Pinhole, Shot, Size
from slrig.patterns.sequence import encode
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.frames import AxisFrames
from slrig.reconstruction.identification import StripeEnsemble
from slrig.reconstruction.stripes import Stripes

_TO_THE_LAST_BIT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-15)


def looking(
    position_mm: tuple[float, float, float],
    target_mm: tuple[float, float, float],
    *,
    size: Size,
    focal_px: tuple[float, float],
    distortion: tuple[float, float, float, float, float],
    roll_rad: float = 0.0,
) -> Pinhole:
    """A device at one point that looks at another, its rows roughly along the world's x."""
    position = np.array(position_mm)
    forward = np.array(target_mm) - position
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    upright = np.stack([right, np.cross(forward, right), forward])
    cosine, sine = math.cos(roll_rad), math.sin(roll_rad)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ upright
    matrix = np.array(
        [[focal_px[0], 0.0, 0.49 * size.width_px], [0.0, focal_px[1], 0.52 * size.height_px], [0.0, 0.0, 1.0]]
    )
    return Pinhole(size, matrix, np.array(distortion), rotation, -rotation @ position)


CAMERA = looking(
    (-90.0, 10.0, -520.0), (0.0, 0.0, 0.0), size=Size(640, 480), focal_px=(1400.0, 1395.0),
    distortion=(-0.21, 0.12, 9e-4, -7e-4, 0.03), roll_rad=0.02,
)  # fmt: skip
OTHER_CAMERA = looking(
    (210.0, -5.0, -500.0), (0.0, 0.0, 0.0), size=Size(640, 480), focal_px=(1380.0, 1390.0),
    distortion=(-0.15, 0.05, -5e-4, 6e-4, 0.0), roll_rad=-0.03,
)  # fmt: skip
PROJECTOR = looking(
    (60.0, -20.0, -510.0), (0.0, 0.0, 0.0), size=Size(320, 240), focal_px=(680.0, 684.0),
    distortion=(-0.12, 0.06, -1.1e-3, 8e-4, 0.01), roll_rad=-0.015,
)  # fmt: skip


def opencv_pixels(device: Pinhole, points_mm: FloatArray) -> FloatArray:
    """(n, 2) float64: pixels of world points, by OpenCV."""
    turn, _ = cv2.Rodrigues(device.rotation)
    pixels, _ = cv2.projectPoints(
        points_mm.reshape(-1, 1, 3), turn, device.translation_mm, device.matrix, device.distortion
    )
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def opencv_rays(device: Pinhole, points_px: FloatArray) -> FloatArray:
    """(n, 3) float64: world directions through pixels, of depth 1 in the device, by OpenCV."""
    normalised = cv2.undistortPoints(
        points_px.reshape(-1, 1, 2), device.matrix, device.distortion, criteria=_TO_THE_LAST_BIT
    ).reshape(-1, 2)
    return np.asarray(np.column_stack([normalised, np.ones(len(normalised))]) @ device.rotation)


@dataclass(frozen=True)
class Sphere:
    """A ball in the world whose near side, towards -z, is the surface."""

    centre_mm: tuple[float, float, float] = (0.0, 0.0, 260.0)
    radius_mm: float = 260.0

    def seen_along(self, origin_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """(n, 3) float64: where rays first meet the ball."""
        from_centre = origin_mm - np.array(self.centre_mm)
        a = (directions**2).sum(axis=1)
        b = directions @ from_centre
        depth = (-b - np.sqrt(b * b - a * (from_centre @ from_centre - self.radius_mm**2))) / a
        return np.asarray(origin_mm + depth[:, None] * directions)

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """(n,) float64: signed distance from the surface, outwards."""
        return np.asarray(np.linalg.norm(points_mm - np.array(self.centre_mm), axis=1) - self.radius_mm)


def ensemble_of(
    points_px: list[FloatArray],
    position_px: list[float],
    *,
    normal: tuple[float, float] = (1.0, 0.0),
    sigma_px: float = 0.01,
    breaks: dict[int, tuple[int, ...]] | None = None,
) -> StripeEnsemble:
    """Linked curves from pixels. breaks : per curve, the points after which the next stripe begins."""
    counts = [len(points) for points in points_px]
    total = sum(counts)
    stripe, bridge = np.zeros(total, dtype=np.int32), np.zeros(total, dtype=np.bool_)
    number = 0
    first = 0
    for index, count in enumerate(counts):
        for point in range(count):
            stripe[first + point] = number
            if point in (breaks or {}).get(index, ()):
                bridge[first + point] = True
                number += 1
        number += 1
        first += count
    return StripeEnsemble(
        offsets=np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]).astype(np.int32),
        position_px=np.array(position_px, dtype=np.float64),
        points_px=np.concatenate([np.zeros((0, 2)), *points_px]),
        normals=np.tile(np.array(normal, dtype=np.float64), (total, 1)),
        sigma_px=np.full(total, sigma_px),
        stripe=stripe,
        bridge_after=bridge,
    )


def lit_rows(column_px: float, rows_px: FloatArray, surface: Sphere, *, projector: Pinhole = PROJECTOR) -> FloatArray:
    """(n, 3) float64: points of the surface lit by one projector column at the given rows."""
    pixels = np.column_stack([np.full(len(rows_px), column_px), rows_px])
    return surface.seen_along(projector.centre_mm, opencv_rays(projector, pixels))


BALL = Sphere()


def seen_on_ball(
    camera: Pinhole,
    columns: list[float],
    rows: FloatArray,
    *,
    sigma_px: float = 0.01,
    noise_px: float = 0.0,
    seed: int = 0,
) -> StripeEnsemble:
    """Stripes of projector columns on the ball, with true normals; steps of more than ten rows are bridges."""
    pixels = [opencv_pixels(camera, lit_rows(column, rows, BALL)) for column in columns]
    ahead = [opencv_pixels(camera, lit_rows(column, rows + 0.01, BALL)) for column in columns]
    cuts = tuple(np.flatnonzero(np.abs(np.diff(rows)) > 10).tolist())
    ensemble = ensemble_of(pixels, columns, sigma_px=sigma_px, breaks=dict.fromkeys(range(len(columns)), cuts))
    along = np.concatenate([np.zeros((0, 2)), *ahead]) - ensemble.points_px
    normals = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.linalg.norm(along, axis=1)[:, None]
    noise = noise_px * np.random.default_rng(seed).normal(0, 1, len(normals))
    return ensemble._replace(points_px=ensemble.points_px + noise[:, None] * normals, normals=normals)


def stripes_of(
    chains: list[FloatArray], *, frame: list[int] | None = None, normals: list[FloatArray] | None = None
) -> Stripes:
    """Chains of pixels as detected stripes."""
    points = np.concatenate([np.zeros((0, 2)), *chains])
    across = np.concatenate([np.zeros((0, 2)), *normals]) if normals else np.tile([1.0, 0.0], (len(points), 1))
    offsets: IntArray = np.concatenate([[0], np.cumsum([len(each) for each in chains])]).astype(np.int32)
    return Stripes(
        offsets=offsets,
        frame=np.array(frame or [0] * len(chains), dtype=np.int32),
        points_px=points,
        normals=across,
        sigma_px=np.linspace(0.01, 0.02, len(points)),
    )


def gaussian_stripe(distance_px: FloatArray, sigma_px: float) -> NDArray[np.float32]:
    """A bright bar of unit height with a Gaussian section, from the distance to its centre line."""
    return np.exp(-(distance_px**2) / (2 * sigma_px**2)).astype(np.float32)


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def code_frames(
    *,
    bits: NDArray[np.float32],
    white: NDArray[np.float32],
    black: NDArray[np.float32],
    inverses: NDArray[np.float32] | None = None,
    lines: NDArray[np.float32] | None = None,
    line_patterns: tuple[LineShift, ...] = (),
    cell_px: int = 4,
    full_scale: float = 255.0,
) -> AxisFrames:
    """Frames of the column axis, from images."""
    return AxisFrames(
        axis=Axis.COLUMN,
        white=white,
        black=black,
        bits=bits,
        inverses=inverses,
        gray=Gray(Axis.COLUMN, 0, len(bits), cell_px=cell_px),
        lines=np.zeros((0, *white.shape), dtype=np.float32) if lines is None else lines,
        line_patterns=line_patterns,
        full_scale=full_scale,
    )


def grid(shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """(x, y) of every pixel, (H, W) float64 each."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    return x, y


def bars(position_px: FloatArray, pattern: LineShift, blur_px: float) -> FloatArray:
    """Light of a line pattern at projector positions, 1 in the middle of a wide line; blur_px in projector pixels."""
    apart = position_px - pattern.centre_px
    apart = apart - pattern.period_px * np.rint(apart / pattern.period_px)
    half = pattern.line_width_px / 2
    near = (apart + turn * pattern.period_px for turn in (-1, 0, 1))
    return np.asarray(sum(ndtr((each + half) / blur_px) - ndtr((each - half) / blur_px) for each in near))


def cells_of(position_px: FloatArray, cell_px: int) -> CodeMap:
    """The code cell that each pixel shows; NaN is refused."""
    lit = np.isfinite(position_px)
    cell = np.where(lit, np.floor((np.nan_to_num(position_px) + 0.5) / cell_px), -1).astype(np.int32)
    return CodeMap(cell, cell.copy(), np.where(lit, 0, 1).astype(np.uint8))


def nearest_lines(lines: tuple[LineShift, ...], cell_px: int, cells: int) -> tuple[FloatArray, FloatArray]:
    """The middle of each code cell, (cells,), and the line of each frame nearest to it, (frames, cells)."""
    middle: FloatArray = cell_px * np.arange(cells, dtype=np.float64) + (cell_px - 1) / 2
    number = [np.rint((middle - line.centre_px) / line.period_px) for line in lines]
    return middle, np.stack([n * line.period_px + line.centre_px for n, line in zip(number, lines, strict=True)])


def seen_by_camera(
    position_px: FloatArray,
    patterns: tuple[Pattern, ...],
    projector: Size,
    *,
    axis: Axis = Axis.COLUMN,
    blur_px: float = 0.6,
    smear_px: float = 0.0,
    noise: float = 0.8,
    seed: int = 7,
    white: float = 150.0,
    bit_depth: int = 8,
) -> Capture:
    """Every pattern on a surface of known projector positions, whichever way the stripes run; NaN is not lit.

    blur_px : standard deviation of the light's blur, projector pixels; smear_px : of the camera's, over borders of what
    is lit as well. Albedo swings by a third over the image.
    """
    fine = 32
    lit = np.isfinite(position_px)
    x, y = grid((position_px.shape[0], position_px.shape[1]))
    albedo = white * (1 + np.cos(x / 23 + y / 31) / 3)
    rng = np.random.default_rng(seed)
    sequence = encode(patterns, projector)
    shots = []
    for index in range(len(sequence)):
        image = sequence.image(index)
        profile = np.repeat((image[0] if axis is Axis.COLUMN else image[:, 0]) / 255.0, fine)
        blurred = gaussian_filter1d(np.pad(profile, 4 * fine), blur_px * fine, mode="constant")
        at = (np.arange(len(blurred)) + 0.5) / fine - 4.5
        light = np.where(lit, np.interp(np.nan_to_num(position_px, nan=-9.0), at, blurred, left=0.0, right=0.0), 0.0)
        if smear_px:
            light = cv2.GaussianBlur(light, (0, 0), smear_px)
        counts = 12 + albedo * light + rng.normal(0, noise, light.shape)
        kind = np.uint8 if bit_depth <= 8 else np.uint16
        shots.append(Shot(index, "eye", np.clip(np.rint(counts), 0, 2**bit_depth - 1).astype(kind)))
    size = Size(position_px.shape[1], position_px.shape[0])
    return Capture(projector, patterns, {"eye": CameraFormat(size, bit_depth)}, tuple(shots))
