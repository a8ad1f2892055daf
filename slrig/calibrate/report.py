"""A solved calibration as one page of HTML: the verdict first, then the error in mm, the devices and the poses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import numpy as np
from markupsafe import Markup

from slrig.calibrate import charts
from slrig.calibrate.figures import PoseFigures, baselines, device_figures, named_devices, pose_figures
from slrig.calibrate.solving import CalibrationResult, ReadPose
from slrig.calibrate.words import rounded
from slrig.calibration import PROJECTOR, Board, device_title
from slrig.calibration.judgement import describe_board
from slrig.calibration.poses import draw_pose, projector_view
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
    expected = result.expected
    devices = device_figures(result)
    shown = pose_figures(result, board, [pose.observation.name for pose in poses])
    least_mm, most_mm = charts.error_range_mm(expected)
    sides_mm = expected.volume_mm[1] - expected.volume_mm[0]
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
        sides_mm=tuple(sides_mm),
        diagonal_mm=float(np.linalg.norm(sides_mm)),
        pictures=list(_pictures(shown, poses, pictures or {}, board)),
        describe_board=describe_board,
        coverage=partial(_coverage, result, poses, board),
        charts=charts,
        device_title=device_title,
        legend=legend,
        rig_view=partial(
            charts.rig_view, result.calibration, list(result.solution.poses.values()), board, expected.volume_mm
        ),
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
            words = f"{pose.name}, {device_title(camera)}" + (" — left out" if pose.left_out else "")
            drawn = draw_pose(picture, views.get(pose.name, {}).get(camera), board, width_px=_PICTURE_PX)
            yield jpeg_uri(drawn[..., ::-1], _QUALITY), words


def _coverage(result: CalibrationResult, poses: Sequence[ReadPose], board: Board, name: str) -> Markup:
    device = named_devices(result.calibration)[name]
    used = [pose.observation for pose in poses if pose.observation.name not in result.solution.outliers]
    if name == PROJECTOR:
        parts = [projector_view(pose, device.size).positions_px for pose in used]
    else:
        parts = [pose.views[name].points_px for pose in used if name in pose.views]
    points = np.concatenate([np.zeros((0, 2)), *parts])
    chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), _MOST_DOTS)).astype(int))
    return charts.coverage_map(device, board, list(result.solution.poses.values()), points[chosen], name=name)
