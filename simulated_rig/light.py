"""Light of the simulated projector: from grey values to light tables, camera pixels and the lamp's history.

A pattern that varies along one axis, blurred by a round Gaussian, is a product of one profile along the columns and one
along the rows. The light of a pattern at any projector position is therefore two table look-ups.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from simulated_rig.optics import ALWAYS_SHARP, LEVELS_PX, Focus
from simulated_rig.transport import LightPaths
from slrig.kernels import kernel, kernel_part
from slrig.model import FloatArray, Pixels, Size

Float32Array = NDArray[np.float32]

NODES_PER_PX = 32
"""Table nodes per projector pixel, with linear interpolation between them (error below 0.0003 of white at blur 0.5 px).
"""

_WIDEST_SIGMAS = 4.5  # of a Gaussian; 7 parts per million of its light are beyond


NS_PER_S = 1_000_000_000
_MAX_CHANGES = 256


@dataclass(frozen=True, slots=True)
class Response:
    """Light of a projector by grey value: leak + (1 - leak) * (value / 255) ^ gamma, and its blur.

    `blur_px` is the standard deviation of the lens's Gaussian blur of the square pixels. `signal_blur_px` blurs the
    grey values before gamma, as a scaler or an analogue cable does; without it gamma has no effect on black-and-white
    patterns. `focus` is the focus of the lens.
    """

    gamma: float
    leak: float
    blur_px: float
    signal_blur_px: float = 0.0
    focus: Focus = ALWAYS_SHARP

    def signal(self, values: Pixels) -> FloatArray:
        """Blur the grey values of a pattern (H, W) on their way to the pixels: (H, W) float64, 0..255; the border is
        extended.
        """
        spread = [self.signal_blur_px if length > 1 else 0.0 for length in values.shape]
        return np.asarray(gaussian_filter(values.astype(np.float64), spread, mode="nearest"), np.float64)

    def light(self, values: Pixels | FloatArray) -> FloatArray:
        """Light of grey values 0..255 at the pixels, same shape, as a fraction of full white."""
        return np.asarray(self.leak + (1 - self.leak) * (values / 255.0) ** self.gamma, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class LightTable:
    """Light of one pattern: along(columns) * along(rows), NODES_PER_PX samples per projector pixel.

    columns, rows : (n,) float32; node i is at the projector coordinate i / NODES_PER_PX - margin_px. glow : uniform
    light from elsewhere. softer : out-of-focus tables for each of `optics.LEVELS_PX` except the first; empty if the
    projector is sharp at every distance. channel, power : channel of a single colour (0 blue, 1 green, 2 red; None for
    white) and its brightness.
    """

    columns: Float32Array
    rows: Float32Array
    margin_px: int
    glow: float = 0.0
    softer: tuple[LightTable, ...] = ()
    channel: int | None = None
    power: float = 1.0

    @property
    def peak(self) -> float:
        """Brightest light of the pattern; full white is 1."""
        return float(self.columns.max() * self.rows.max())


def light_table(profile: Pixels, projector: Size, response: Response) -> LightTable:
    """Compute the light of one pattern; `profile` is (1, Wp), (Hp, 1) or (1, 1) uint8."""
    light = response.light(response.signal(profile))
    if light.shape[0] > 1 and light.shape[1] > 1:
        message = f"a pattern may vary along one axis only, found an image of shape {profile.shape}"
        raise ValueError(message)
    across = np.broadcast_to(light[0], projector.width_px) if light.shape[0] == 1 else np.ones(projector.width_px)
    down = np.broadcast_to(light[:, 0], projector.height_px) if light.shape[0] > 1 else np.ones(projector.height_px)
    beyond = LEVELS_PX[1:] if response.focus.far_px else ()
    sharp, *softer = (
        LightTable(_spread_profile(across, blur_px), _spread_profile(down, blur_px), _margin_px(blur_px))
        for blur_px in (response.blur_px, *(math.hypot(response.blur_px, level) for level in beyond))
    )
    return replace(sharp, softer=tuple(softer))


def dark_table(projector: Size) -> LightTable:
    """Return the table of a lamp that is off."""
    return LightTable(
        np.zeros(projector.width_px * NODES_PER_PX, np.float32),
        np.zeros(projector.height_px * NODES_PER_PX, np.float32),
        0,
    )


def desktop_table(projector: Size, response: Response) -> LightTable:
    """Return the light of a computer desktop: a bright ground, two windows and a dark bar at the bottom."""
    across, down = np.full((1, projector.width_px), 180, np.uint8), np.full((projector.height_px, 1), 255, np.uint8)
    across[:, projector.width_px // 8 : projector.width_px // 2] = 255
    across[:, projector.width_px // 2 : projector.width_px * 5 // 8] = 90
    down[-max(projector.height_px // 12, 1) :] = 60
    windows, bar = light_table(across, projector, response), light_table(down, projector, response)
    return LightTable(windows.columns, bar.rows, windows.margin_px)


def radiance(paths: LightPaths, table: LightTable, *, blur_px: float) -> Float32Array:
    """Projector light on each camera pixel, (H, W) float32; a white diffuser gives 1.

    The lens blurs the light of the samples by a Gaussian of standard deviation blur_px, then the pixel's square
    integrates it; both together are one separable filter, evaluated only at the pixels. The light is mirrored at the
    image border. Jittered samples are treated as if in the middle of their cells.
    """
    height, width, count = paths.weight.shape
    shares = _pixel_weights(blur_px, math.isqrt(count))
    across: Float32Array = _filter_rows(
        paths.column_px,
        paths.row_px,
        paths.weight,
        table.columns,
        table.rows,
        np.float32(table.margin_px),
        shares,
        _mirror_indices(width, shares.shape),
    )
    light: Float32Array = _filter_columns(across, shares, _mirror_indices(height, shares.shape))
    return light


def blur_image(image: Float32Array, blur_px: float) -> Float32Array:
    """Blur an image by the camera lens, a Gaussian of standard deviation blur_px: for light without detail."""
    if blur_px == 0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px, borderType=cv2.BORDER_REFLECT_101), np.float32)


def _margin_px(blur_px: float) -> int:
    return int(np.ceil(_WIDEST_SIGMAS * blur_px)) + 1


@lru_cache(maxsize=32)
def _pixel_spread(blur_px: float) -> FloatArray:
    """A unit square pixel blurred by a Gaussian, sampled at the nodes from -margin to +margin."""
    margin = _margin_px(blur_px)
    x = np.arange(-margin * NODES_PER_PX, margin * NODES_PER_PX + 1) / NODES_PER_PX
    if blur_px == 0:
        return np.where(np.abs(x) < 0.5, 1.0, np.where(np.abs(x) == 0.5, 0.5, 0.0))
    return np.asarray(ndtr((x + 0.5) / blur_px) - ndtr((x - 0.5) / blur_px), dtype=np.float64)


def _spread_profile(light: FloatArray, blur_px: float) -> Float32Array:
    """Blurred light of a row of pixels at all nodes. scipy.signal could do it, but takes half a second to import."""
    one = _pixel_spread(blur_px)
    taps = -(-len(one) // NODES_PER_PX)
    by_node = np.pad(one, (0, taps * NODES_PER_PX - len(one))).reshape(taps, NODES_PER_PX)
    neighbours = np.lib.stride_tricks.sliding_window_view(np.pad(light, taps - 1), taps)
    return np.asarray((neighbours @ by_node[::-1]).ravel()[: (len(light) - 1) * NODES_PER_PX + len(one)], np.float32)


@kernel_part
def _look_up(table: Float32Array, position: np.float32, margin: np.float32) -> np.float32:
    at = (position + margin) * np.float32(NODES_PER_PX)
    if not (at >= 0) or at >= len(table) - 1:
        return np.float32(0)
    node = int(at)
    part = at - np.float32(node)
    return np.float32(table[node] + part * (table[node + 1] - table[node]))


def _pixel_weights(blur_px: float, per_axis: int) -> Float32Array:
    """(2 m + 1, S): weight in a pixel of sample s of its neighbour at distance i - m along one axis; the sum is 1.

    A Gaussian convolved with a square of 1 px, at the samples' distances d: Φ((d + ½)/σ) - Φ((d - ½)/σ).
    """
    reach = math.ceil(_WIDEST_SIGMAS * blur_px)
    offset, sample = np.arange(-reach, reach + 1)[:, None], np.arange(per_axis)
    distance = offset + (sample + 0.5) / per_axis - 0.5
    if blur_px == 0:
        return np.full(distance.shape, 1 / per_axis, np.float32)
    share = ndtr((distance + 0.5) / blur_px) - ndtr((distance - 0.5) / blur_px)
    return np.asarray(share / share.sum(), np.float32)


def _mirror_indices(length_px: int, shape: tuple[int, ...]) -> NDArray[np.intp]:
    """(m + length + m, S) indices of samples along an axis, mirrored at both ends. shape : of the weights."""
    taps, per_axis = shape
    around = np.pad(np.arange(length_px * per_axis), taps // 2 * per_axis, mode="symmetric")
    return around.reshape(-1, per_axis)


@kernel(in_every_scan=False)
def _filter_rows(
    column: Float32Array,
    row: Float32Array,
    weight: Float32Array,
    columns: Float32Array,
    rows: Float32Array,
    margin: np.float32,
    shares: Float32Array,
    source: NDArray[np.intp],
) -> Float32Array:
    """(H S, W): light of each row of samples, filtered along the row at the pixels."""
    height, width, _ = weight.shape
    taps, per_axis = shares.shape
    out = np.zeros((height * per_axis, width), np.float32)
    reach = taps // 2
    # One line per sample of a pixel, so that the sums below run over neighbours in memory.
    lines = np.zeros((per_axis, len(source)), np.float32)
    for fine in range(height * per_axis):
        r, first = fine // per_axis, fine % per_axis * per_axis
        for c in range(width):
            for s in range(per_axis):
                light = np.float32(0)
                share = weight[r, c, first + s]
                if share > 0:
                    light = _look_up(columns, column[r, c, first + s], margin)
                    if light > 0:
                        light *= share * _look_up(rows, row[r, c, first + s], margin)
                lines[s, reach + c] = light
        for i in range(reach):
            for beyond in (i, reach + width + i):
                for s in range(per_axis):
                    lines[s, beyond] = lines[source[beyond, s] % per_axis, reach + source[beyond, s] // per_axis]
        total = out[fine]
        for i in range(taps):
            for s in range(per_axis):
                line = lines[s, i : i + width]
                share = shares[i, s]
                for c in range(width):
                    total[c] += share * line[c]
    return out


@kernel(in_every_scan=False)
def _filter_columns(across: Float32Array, shares: Float32Array, source: NDArray[np.intp]) -> Float32Array:
    """(H, W): rows of samples, filtered down the columns at the pixels."""
    taps, per_axis = shares.shape
    width = across.shape[1]
    out = np.zeros((len(across) // per_axis, width), np.float32)
    for r in range(len(out)):
        total = out[r]
        for i in range(taps):
            for s in range(per_axis):
                share, line = shares[i, s], across[source[r + i, s]]
                for c in range(width):
                    total[c] += share * line[c]
    return out


def nanoseconds(seconds: float) -> int:
    """Round a time in seconds to whole nanoseconds."""
    return round(seconds * NS_PER_S)


class VirtualClock:
    """Clock that advances only while a device waits: as fast as possible, and the same in every run."""

    def __init__(self, start_ns: int = NS_PER_S) -> None:
        self._now_ns = start_ns
        self._lock = threading.Lock()

    def now_ns(self) -> int:
        """See `slrig.devices.Clock`."""
        return self._now_ns

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        """See `slrig.devices.Clock`. Returns at once; no time passes for a stopped device."""
        if stop.is_set():
            return
        with self._lock:
            self._now_ns = max(self._now_ns, t_ns)


@dataclass(frozen=True, slots=True)
class LampFlicker:
    """Light that oscillates about its mean, 1 + depth · sin(2π f t): mains lamps or a colour wheel."""

    frequency_hz: float
    depth: float

    def mean(self, t_start_ns: int, t_end_ns: int) -> float:
        """Mean over an interval: 1 over whole periods."""
        middle_s, half_s = (t_start_ns + t_end_ns) / 2 / NS_PER_S, (t_end_ns - t_start_ns) / 2 / NS_PER_S
        turn = 2 * math.pi * self.frequency_hz
        left = math.sin(turn * half_s) / (turn * half_s) if half_s > 0 else 1.0
        return 1 + self.depth * left * math.sin(turn * middle_s)


class Lamp:
    """Light of the projector over time, as a list of changes. Dark at first. Thread-safe."""

    def __init__(self, dark: LightTable, flicker: LampFlicker | None = None) -> None:
        self._dark = dark
        self.flicker = flicker
        self._changes: deque[tuple[int, LightTable]] = deque([(0, dark)], maxlen=_MAX_CHANGES)
        self._lock = threading.Lock()

    def show(self, table: LightTable, *, at_ns: int) -> int:
        """Change the light at `at_ns`, or right after the previous change; return the time of the change."""
        with self._lock:
            at_ns = max(at_ns, self._changes[-1][0])
            self._changes.append((at_ns, table))
        return at_ns

    def darken(self, *, at_ns: int) -> None:
        """Go dark at `at_ns` and drop every later change."""
        with self._lock:
            while len(self._changes) > 1 and self._changes[-1][0] >= at_ns:
                self._changes.pop()
            self._changes.append((at_ns, self._dark))

    def light_at(self, t_ns: int) -> LightTable:
        """Light at one instant."""
        return self.light_between(t_ns, t_ns)[0][1]

    def light_between(self, t_start_ns: int, t_end_ns: int) -> list[tuple[float, LightTable]]:
        """Return each light within an interval with the fraction of the interval for which it was on.

        The fractions sum to 1 unless the lamp flickers.
        """
        with self._lock:
            changes = list(self._changes)
        first = max((i for i, (at_ns, _) in enumerate(changes) if at_ns <= t_start_ns), default=0)
        span = t_end_ns - t_start_ns
        if span <= 0:
            return [(1.0, changes[first][1])]
        intervals: list[tuple[float, LightTable]] = []
        begin = t_start_ns
        for i in range(first, len(changes)):
            end = min(changes[i + 1][0], t_end_ns) if i + 1 < len(changes) else t_end_ns
            if end > begin:
                swing = 1.0 if self.flicker is None else self.flicker.mean(begin, end)
                intervals.append(((end - begin) / span * swing, changes[i][1]))
                begin = end
        return intervals
