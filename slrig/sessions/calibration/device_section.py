"""What a calibration's report tells of one device: its numbers, what is left over, and where it saw the board."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from slrig.calibration.board import Board
from slrig.calibration.poses.light_view import lit_board
from slrig.calibration.solution import PROJECTOR
from slrig.model import FloatArray, Pinhole
from slrig.sessions.calibration.charts import coverage_map, legend, longest_arrow_px, residual_map
from slrig.sessions.calibration.figures import DeviceFigures, Figure
from slrig.sessions.calibration.scene import board_outline_mm
from slrig.sessions.calibration.solving import CalibrationResult, ReadPose
from slrig.sessions.calibration.words import MEANINGS, NAMES, rounded
from slrig.sessions.markup import Markup, tag

_MOST_DOTS = 1200
_POINTS_ALONG = 8


def device_title(name: str) -> str:
    """A device as a heading has it.

    >>> device_title("left"), device_title("projector")
    ("Camera 'left'", 'Projector')
    """
    return "Projector" if name == PROJECTOR else f"Camera '{name}'"


def device_section(
    figures: DeviceFigures, device: Pinhole, result: CalibrationResult, poses: Sequence[ReadPose], board: Board
) -> Markup:
    """One device's card: a table of its numbers, the map of what is left over, and where the board was held."""
    residuals = figures.residuals
    # Twice the rms is the brightest: an even image is of one quiet colour, and a bad corner stands out.
    most_px = 2 * max(residuals.rms_px, 1e-6)
    left_over = tag(
        "figure",
        residual_map(residuals, figures.size, name=figures.name, most_px=most_px),
        legend(0.0, most_px, "px"),
        tag(
            "figcaption",
            "What is left over, cell by cell: the number is the rms in px; the arrow is the mean, and the longest one "
            f"stands for {rounded(longest_arrow_px(residuals), 2)} px. Arrows that agree with their neighbours, or "
            "corners much brighter than the middle, speak of a lens that the model does not fit.",
        ),
    )
    where = tag(
        "figure",
        _coverage(figures, device, result, poses, board),
        tag(
            "figcaption",
            "Where the board was held: its outline in every pose that was used, and "
            + ("the light that was decoded on it. " if figures.is_projector else "its corners. ")
            + MEANINGS["coverage"],
        ),
    )
    heading = tag("h3", f"{device_title(figures.name)} ", tag("span", f"{figures.size} px", class_="dim"))
    maps = tag("div", left_over, where, class_="row")
    return tag("section", heading, tag("div", _table(figures), class_="table"), maps, class_="card")


def _table(figures: DeviceFigures) -> Markup:
    name, residuals = figures.name, figures.residuals
    rows = [
        _plain_row("rms", f"{rounded(residuals.rms_px)} px", f"{name}.rms_px", MEANINGS["rms"]),
        _plain_row("rms at held-out poses", _held_out(figures), f"{name}.held_out_rms_px", MEANINGS["held out"]),
        _plain_row(
            "noise alone", f"{rounded(residuals.stated_rms_px)} px", f"{name}.stated_rms_px", MEANINGS["noise alone"]
        ),
        _plain_row("observations", f"{residuals.count:,}", f"{name}.count", MEANINGS["observations"]),
        _plain_row("of them outlying", f"{residuals.outlying:,}", f"{name}.outlying", MEANINGS["outlying"]),
    ]
    rows += [_figure_row(each, value, f"{name}.{each}") for each, value in figures.values.items()]
    if any(axis.sigma > 0 for axis in figures.centre_mm):
        rows += [
            _figure_row(each, value, f"{name}.{each}")
            for each, value in zip(("x_mm", "y_mm", "z_mm"), figures.centre_mm, strict=True)
        ]
    head = tag("tr", tag("th", ""), tag("th", "value"), tag("th", "±"), tag("th", "what it means", class_="words"))
    return tag("table", tag("thead", head), tag("tbody", *rows))


def _held_out(figures: DeviceFigures) -> str:
    if math.isnan(figures.residuals.held_out_rms_px):
        return "too few poses"
    return f"{rounded(figures.residuals.held_out_rms_px)} px (× {figures.held_out_ratio:.2f})"


def _plain_row(name: str, value: str, key: str, meaning: str) -> Markup:
    return tag("tr", tag("td", name), tag("td", value, data_figure=key), tag("td", ""), _meaning(meaning))


def _figure_row(parameter: str, figure: Figure, key: str) -> Markup:
    digits = shown_digits(figure)
    unit = "mm" if parameter.endswith("_mm") else "px" if parameter[0] in "fc" else ""
    symbol = None if unit == "mm" else tag("span", f" {parameter}", class_="dim")
    return tag(
        "tr",
        tag("td", NAMES[parameter], symbol),
        tag("td", f"{signed(figure.value, digits)} {unit}".strip(), data_figure=key),
        tag(
            "td",
            f"{figure.sigma:.{digits}f}" if figure.sigma > 0 else "held",
            class_="sigma",
            data_figure=f"{key}.sigma",
        ),
        _meaning(MEANINGS[parameter]),
    )


def signed(value: float, digits: int) -> str:
    """A number with so many decimals and a true minus sign.

    >>> signed(-0.1214, 3)
    '−0.121'
    """
    return f"{value:.{digits}f}".replace("-", "−")


def shown_digits(figure: Figure) -> int:
    """Decimals at which a number's deviation still shows two digits; four where it has none.

    >>> shown_digits(Figure(1810.4, 0.213)), shown_digits(Figure(-0.12, 0.00031)), shown_digits(Figure(842.0, 15.0))
    (2, 5, 0)
    """
    if not figure.sigma > 0:
        return 4
    return min(max(1 - math.floor(math.log10(figure.sigma)), 0), 9)


def _meaning(words: str) -> Markup:
    return tag("td", words, class_="words dim")


def _coverage(
    figures: DeviceFigures, device: Pinhole, result: CalibrationResult, poses: Sequence[ReadPose], board: Board
) -> Markup:
    stood, left_out = result.solution.poses, result.solution.outliers
    outline_mm = board_outline_mm(board, along=_POINTS_ALONG)
    outlines = [_projected(device, outline_mm @ pose.rotation.T + pose.translation_mm) for pose in stood.values()]
    used = [pose.observation for pose in poses if pose.observation.name not in left_out]
    if figures.is_projector:
        parts = [lit_board(pose, figures.size).positions_px for pose in used]
    else:
        parts = [pose.views[figures.name].points_px for pose in used if figures.name in pose.views]
    points = np.concatenate([np.zeros((0, 2)), *parts])
    chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), _MOST_DOTS)).astype(int))
    return coverage_map(figures.size, outlines, points[chosen], name=figures.name)


def _projected(device: Pinhole, points_mm: FloatArray) -> FloatArray:
    """(n, 2) float64: where points of the world fall in the device's image, also beyond its edge."""
    turn, _ = cv2.Rodrigues(device.rotation)
    pixels, _ = cv2.projectPoints(points_mm, turn, device.translation_mm, device.matrix, device.distortion)
    return np.asarray(pixels[:, 0], dtype=np.float64)
