"""A solved calibration as one page of HTML: the verdict first, then the error in mm, the devices and the poses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import numpy as np
from markupsafe import Markup

from slrig.calibrate.charts import (
    coverage_map,
    error_range_mm,
    error_slices,
    longest_arrow_px,
    residual_map,
    rig_view,
)
from slrig.calibrate.figures import (
    DeviceFigures,
    PoseFigures,
    baselines,
    device_figures,
    device_title,
    named_devices,
    pose_figures,
    volume_diagonal_mm,
)
from slrig.calibrate.solving import CalibrationResult, ReadPose
from slrig.calibrate.words import PARAMETERS, rounded
from slrig.calibration.board import Board
from slrig.calibration.judging.verdict import board_words
from slrig.calibration.poses.light_view import lit_board
from slrig.calibration.poses.pictures import pose_picture
from slrig.model import Pixels
from slrig.reports.drawing import legend
from slrig.reports.page import filled, jpeg_uri

_PICTURE_PX = 480
_QUALITY = 85
_MOST_DOTS = 1200


def report_html(
    result: CalibrationResult,
    poses: Sequence[ReadPose],
    pictures: Mapping[str, Mapping[str, Pixels]] | None = None,
    /,
    *,
    board: Board,
    title: str,
    remarks: Mapping[str, Sequence[str]] | None = None,
    refused: Mapping[str, str] | None = None,
    machine: str = "",
) -> str:
    """The report of a solved calibration.

    Parameters
    ----------
    poses : the poses that the solve was given, in their order.
    pictures : by pose and camera, its white frame, (H, W) or (H, W, 3) uint8, blue, green, red.
    remarks : by pose, what could be better about it. refused : by pose, why it could not be read at all.
    machine : where it was solved, in words.
    """
    expected, board_pose = result.expected, list(result.solution.poses.values())
    devices = device_figures(result)
    shown = pose_figures(result, board, [pose.observation.name for pose in poses])
    least_mm, most_mm = error_range_mm(expected)

    return filled(
        "calibration.html",
        result=result,
        board=board,
        title=title,
        remarks=remarks or {},
        refused=refused or {},
        machine=machine,
        devices=devices,
        shown=shown,
        # The longest bar of each device's column.
        most_px={
            device.name: max((pose.rms_px.get(device.name, 0.0) for pose in shown), default=0.0) or 1.0
            for device in devices
        },
        pairs=baselines(result),
        least_mm=least_mm,
        most_mm=most_mm,
        sides_mm=tuple(expected.volume_mm[1] - expected.volume_mm[0]),
        diagonal_mm=volume_diagonal_mm(result),
        slices=error_slices(expected),
        pictures=list(_pictures(shown, poses, pictures or {}, board)),
        parameters=PARAMETERS,
        board_words=board_words,
        coverage=partial(_coverage, result, poses, board),
        device_title=device_title,
        legend=legend,
        longest_arrow_px=longest_arrow_px,
        residual_map=residual_map,
        rig_view=partial(rig_view, result.calibration, board_pose, board, expected.volume_mm),
        rounded=rounded,
    )


def _pictures(
    shown: Sequence[PoseFigures],
    poses: Sequence[ReadPose],
    pictures: Mapping[str, Mapping[str, Pixels]],
    board: Board,
) -> Iterable[tuple[str, str]]:
    """The address of each picture with corners drawn in, and what it is of."""
    views = {pose.observation.name: pose.observation.views for pose in poses}
    for pose in shown:
        for camera, picture in pictures.get(pose.name, {}).items():
            words = f"{pose.name}, {device_title(camera).lower()}" + (" — left out" if pose.left_out else "")
            drawn = pose_picture(picture, views.get(pose.name, {}).get(camera), board, width_px=_PICTURE_PX)
            yield jpeg_uri(drawn[..., ::-1], _QUALITY), words


def _coverage(result: CalibrationResult, poses: Sequence[ReadPose], board: Board, figures: DeviceFigures) -> Markup:
    board_pose, left_out = result.solution.poses, result.solution.outliers
    used = [pose.observation for pose in poses if pose.observation.name not in left_out]
    if figures.is_projector:
        parts = [lit_board(pose, figures.size).positions_px for pose in used]
    else:
        parts = [pose.views[figures.name].points_px for pose in used if figures.name in pose.views]
    points = np.concatenate([np.zeros((0, 2)), *parts])
    chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), _MOST_DOTS)).astype(int))
    device = named_devices(result.calibration)[figures.name]
    return coverage_map(device, board, list(board_pose.values()), points[chosen], name=figures.name)
