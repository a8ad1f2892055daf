"""Poses of a calibration board, shot by a small rendered rig: frames in memory, and the truth."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from simulated_rig.options import HeadOptions
from simulated_rig.rendering import CameraView, SceneState
from simulated_rig.scene import Scene, build_surface
from slrig.calibration.board import Board, BoardKind
from slrig.examples import EXAMPLES
from slrig.model import CameraFormat, CameraTruth, Capture, FloatArray, Pattern, Shot, Size
from slrig.patterns.sequence import encode, scan_patterns
from tests.light_bound import ExposedView

BOARD = Board(BoardKind.CHESSBOARD, 8, 5, 18.0)
ROTATION_DEG = (16.0, -12.0, 6.0)
POSITION_MM = (6.0, 2.0, 20.0)

_RIG = EXAMPLES / "rigs" / "rendered-calibration.toml"
_SCALE = 0.3
_PERIOD_PX = 8
_WHITE = 0.85


@dataclass(frozen=True)
class Standing:
    """Where a board stands before the rig, and how it is seen.

    away : nothing but the wall is in view.
    """

    rotation_deg: tuple[float, float, float] = ROTATION_DEG
    position_mm: tuple[float, float, float] = POSITION_MM
    away: bool = False

    def shifted(self, shift_mm: tuple[float, float, float]) -> Standing:
        x, y, z = (here + by for here, by in zip(self.position_mm, shift_mm, strict=True))
        return replace(self, position_mm=(x, y, z))


def patterns_for(size: Size, *, line_shift: bool = True) -> tuple[Pattern, ...]:
    """Both axes, as a pose is shot."""
    return scan_patterns(
        size, line_shift=line_shift, period_px=_PERIOD_PX, line_width_px=1, gray_cell_px=None, gray_offset_px=0,
        rows=True,
    )  # fmt: skip


@cache
def exposed(standing: Standing) -> tuple[ExposedView, CameraView]:
    """The rig's camera before a board, exposed so that its brightest paper comes to `_WHITE` of full scale."""
    table = tomllib.loads(_RIG.read_text(encoding="utf-8"))["head"]
    head = {key: table[key] for key in ("scene", "seed", "samples_per_axis", "ambient")}
    head["projector"] = _scaled(table["projector"], _SCALE)
    head["camera"] = [_scaled(table["camera"][0], _SCALE) | {"blur_px": 0.6}]
    options = HeadOptions.model_validate(head)
    eye, lamp = options.camera[0], options.projector
    stage = SceneState(
        build_surface(_scene(standing), _RIG.parent),
        lamp.pinhole(),
        working_distance_mm=float(np.linalg.norm(lamp.pinhole().centre_mm)),
    )
    view = CameraView(
        eye.pinhole(), stage, blur_px=eye.blur_px, ambient=options.ambient, jitter=False, seed=options.seed,
        samples_per_axis=options.samples_per_axis, workers=1,
    )  # fmt: skip
    sensor = eye.sensor()
    full = ExposedView(view, lamp.size, lamp.response(), sensor, sensor.saturation_s)
    brightest = float(np.percentile(full.ends[0], 99.9)) / sensor.full_well_e
    return replace(full, exposure_s=sensor.saturation_s * _WHITE / brightest), view


def shot(
    standing: Standing = Standing(),
    *,
    then: Standing | None = None,
    line_shift: bool = True,
    patterns: Sequence[Pattern] | None = None,
    seed: int = 1,
    camera: str = "left",
) -> Capture:
    """One pose; from the middle of the sequence on the board stands as `then` says."""
    before, _ = exposed(standing)
    after = before if then is None else replace(exposed(then)[0], exposure_s=before.exposure_s)
    size = before.projector
    shown = tuple(patterns) if patterns is not None else patterns_for(size, line_shift=line_shift)
    rng = np.random.default_rng(seed)
    shots = []
    for index, light in enumerate(encode(shown, size).profiles):
        seen = before if 2 * index < len(shown) else after
        shots.append(Shot(index, camera, seen.frame(light, rng), before.exposure_s, 0.1 * index))
    form = CameraFormat(Size(shots[0].image.shape[1], shots[0].image.shape[0]), before.sensor.bit_depth)
    return Capture(size, shown, {camera: form}, tuple(shots))


def both(first: Capture, second: Capture) -> Capture:
    """One capture of two cameras."""
    return replace(first, cameras={**first.cameras, **second.cameras}, shots=(*first.shots, *second.shots))


def truth_of(standing: Standing = Standing()) -> CameraTruth:
    """What the camera truly sees."""
    return exposed(standing)[1].truth()


def position_at(truth: CameraTruth, pixels_px: FloatArray, axis: int) -> FloatArray:
    """(n,) float64: the true projector coordinate at pixels, between the four that surround each."""
    known = truth.projector_px[..., axis].astype(np.float64)
    rows, columns = known.shape
    left, top = np.clip(np.floor(pixels_px).astype(int), 0, (columns - 2, rows - 2)).T
    right, down = pixels_px[:, 0] - left, pixels_px[:, 1] - top
    upper = known[top, left] * (1 - right) + known[top, left + 1] * right
    lower = known[top + 1, left] * (1 - right) + known[top + 1, left + 1] * right
    return np.asarray(upper * (1 - down) + lower * down)


def _scene(standing: Standing) -> Scene:
    wall = {"shape": "plane", "size_mm": [900.0, 800.0], "position_mm": [0.0, 0.0, 260.0], "albedo": 0.35}
    board = {
        "shape": "board", "kind": BOARD.kind.value, "columns": BOARD.columns,
        "rows": BOARD.rows, "square_mm": BOARD.square_mm, "position_mm": standing.position_mm,
        "rotation_deg": standing.rotation_deg, "albedo_dark": 0.05,
    }  # fmt: skip
    return Scene.model_validate({"object": [wall] if standing.away else [board, wall]})


def _scaled(device: Mapping[str, Any], scale: float) -> dict[str, Any]:
    """The device with fewer, larger pixels."""
    size = [round(length * scale) for length in device["size_px"]]
    return {
        **device, "size_px": size, "focal_px": [f * scale for f in device["focal_px"]],
        "principal_px": [(c + 0.5) * scale - 0.5 for c in device["principal_px"]],
    }  # fmt: skip
