"""A solved calibration as one page of HTML: the verdict first, then the error in mm, the devices and the poses.

The page holds everything that it shows: style, drawings (SVG) and pictures (JPEG). It runs no script and asks nobody
for anything, so that it can be mailed, printed and kept beside the calibration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import cv2

from slrig.calibration.board import Board
from slrig.calibration.judging.verdict import board_words
from slrig.calibration.poses.pictures import Picture, pose_picture
from slrig.calibration.solution import PROJECTOR
from slrig.model import Calibration, Pinhole, Pixels
from slrig.sessions.calibration.charts import legend
from slrig.sessions.calibration.device_section import device_section, device_title, shown_digits
from slrig.sessions.calibration.figures import (
    Baseline,
    DeviceFigures,
    PoseFigures,
    baselines,
    device_figures,
    pose_figures,
    volume_diagonal_mm,
)
from slrig.sessions.calibration.scene import error_range_mm, error_slices, rig_view
from slrig.sessions.calibration.solving import CalibrationResult, ReadPose
from slrig.sessions.calibration.words import MEANINGS, rounded
from slrig.sessions.markup import Markup, joined, picture_uri, tag
from slrig.sessions.report_style import report_page

_PICTURE_PX = 480
_MOST_REASONS = 5
"""So many reasons are told in full size; the others stand below them, smaller."""


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
    remarks, refused, pictures = remarks or {}, refused or {}, pictures or {}
    devices = device_figures(result)
    pinholes = _pinholes(result.calibration)
    shown = pose_figures(result, board, [pose.observation.name for pose in poses])
    sections = [
        _head(result, board, title, machine),
        _verdict(result),
        _tiles(result, devices),
        _volume(result),
        _rig(result, board),
        tag("h2", "Devices"),
        tag("p", MEANINGS["±"], class_="lead"),
        *(device_section(each, pinholes[each.name], result, poses, board) for each in devices),
        _poses(shown, devices, remarks, refused),
        _pictures(shown, poses, pictures, board),
        tag("footer", f"Written by slrig. {_identity(result)}"),
    ]
    return report_page(title, sections)


def _identity(result: CalibrationResult) -> str:
    solved = result.calibration.solved
    return "" if solved is None else f"Calibration {solved.id}, solved at {solved.solved_at}."


def _head(result: CalibrationResult, board: Board, title: str, machine: str) -> Markup:
    solved = result.calibration.solved
    facts = [board.title, f"{len(result.solution.poses)} poses used"]
    if solved is not None:
        facts += [f"solved {solved.solved_at.replace('T', ' ')}", f"calibration {solved.id}"]
    if machine:
        facts.append(machine)
    return tag("header", tag("h1", title), tag("p", " · ".join(facts), class_="facts"))


def _verdict(result: CalibrationResult) -> Markup:
    verdict = result.verdict
    words = verdict.grade.words
    summary = verdict.summary.removeprefix(words).lstrip(":; ")
    first, others = verdict.reasons[:_MOST_REASONS], verdict.reasons[_MOST_REASONS:]
    return tag(
        "section",
        tag("div", words.capitalize(), class_="word", data_figure="grade"),
        tag("p", f"{_begun(summary)}."),
        tag("ul", *(tag("li", tag("b", _begun(words))) for words in result.scale)) if result.scale else None,
        tag("ul", *(tag("li", _begun(reason)) for reason in first)) if first else None,
        tag("ul", *(tag("li", _begun(reason)) for reason in others), class_="more") if others else None,
        class_=f"card verdict {verdict.grade}",
    )


def _begun(words: str) -> str:
    """Words as the beginning of a sentence."""
    return words[:1].upper() + words[1:]


def _tiles(result: CalibrationResult, devices: Sequence[DeviceFigures]) -> Markup:
    expected = result.expected
    diagonal = volume_diagonal_mm(result)
    per_metre = 1000 * expected.length_share
    length_words = f"{MEANINGS['error of a length']} The volume's diagonal is {diagonal:.0f} mm."
    tiles = [
        _tile("Expected error of a point", expected.point_mm, "mm", MEANINGS["expected error of a point"], "point_mm"),
        _tile("Noise of a point", expected.noise_mm, "mm", MEANINGS["noise of a point"], "noise_mm"),
        _tile("Both together", expected.total_mm, "mm", MEANINGS["both together"], "total_mm"),
        _tile("Expected error of a length", per_metre, "mm per metre", length_words, "length_mm_per_m"),
    ]
    if expected.across:
        name = "error across the line of sight"
        tiles = [_tile(f"Expected {name}", expected.point_mm, "mm", MEANINGS[name], "point_mm")]
    tiles += [
        _tile(
            f"{device_title(each.name)}: rms",
            each.residuals.rms_px,
            "px",
            _fit_words(each),
            f"{each.name}.rms_px.tile",
        )
        for each in devices
    ]
    return tag("div", *tiles, class_="tiles")


def _fit_words(device: DeviceFigures) -> str:
    residuals = device.residuals
    held_out = (
        "too few poses to hold some out"
        if math.isnan(residuals.held_out_rms_px)
        else f"{rounded(residuals.held_out_rms_px)} px ({device.held_out_ratio:.2f} times) at poses it had not seen"
    )
    return f"{_begun(held_out)}; noise alone would leave {rounded(residuals.stated_rms_px)} px."


def _tile(name: str, value: float, unit: str, note: str, key: str) -> Markup:
    shown = ["not known"] if math.isnan(value) else [rounded(value), tag("small", f" {unit}")]
    return tag(
        "div",
        tag("div", name, class_="name"),
        tag("div", *shown, class_="value", data_figure=key),
        tag("div", note, class_="note"),
        class_="tile",
    )


def _volume(result: CalibrationResult) -> Markup:
    expected = result.expected
    least, most = error_range_mm(expected)
    low, high = expected.volume_mm
    sides = " × ".join(f"{side:.0f}" for side in high - low)
    slices = [
        tag("figure", each.picture, tag("figcaption", f"{each.z_mm:.0f} mm from the camera"))
        for each in error_slices(expected)
    ]
    return joined(
        tag("h2", "Expected error over the working volume"),
        tag(
            "p",
            f"The board was held in a volume of {sides} mm. The colour says by how much {expected.point_words} may lie "
            f"wrong{expected.way_words} there, one standard deviation, because of the calibration alone: slices across "
            f"the volume, as the first camera sees them. From {rounded(least)} mm where it is best to {rounded(most)} "
            "mm where it is worst. "
            "Outside the volume the error grows, and nothing is promised.",
            class_="lead",
        ),
        tag(
            "section",
            tag("div", *slices, class_="row three"),
            legend(1000 * least, 1000 * most, "µm, one standard deviation"),
            class_="card",
        ),
    )


def _rig(result: CalibrationResult, board: Board) -> Markup:
    stood = list(result.solution.poses.values())
    views = [
        tag(
            "figure",
            rig_view(result.calibration, stood, board, result.expected.volume_mm, aside=aside),
            tag("figcaption", words),
        )
        for aside, words in ((False, "From above: the camera's right is down."), (True, "From the side."))
    ]
    pairs = [
        tag(
            "li",
            f"{device_title(pair.first)} and {device_title(pair.second).lower()}: ",
            tag("b", f"{pair.length_mm.value:.{shown_digits(pair.length_mm)}f} mm", data_figure=_key(pair, "mm")),
            f" ± {pair.length_mm.sigma:.{shown_digits(pair.length_mm)}f} apart, at ",
            tag("b", f"{pair.angle_deg.value:.{shown_digits(pair.angle_deg)}f}°", data_figure=_key(pair, "deg")),
            f" ± {pair.angle_deg.sigma:.{shown_digits(pair.angle_deg)}f} to each other.",
        )
        for pair in baselines(result)
    ]
    return joined(
        tag("h2", "The rig, to scale"),
        tag("p", f"{_begun(board_words(result.solution))}.", class_="lead", data_figure="board"),
        tag("p", f"{MEANINGS['baseline']} {MEANINGS['angle']}", class_="lead") if pairs else None,
        tag("ul", *pairs) if pairs else None,
        tag(
            "section",
            tag("div", *views, class_="row"),
            tag(
                "p",
                "Lines: the board in every pose. Shaded: what each device sees. Dashed: the working volume.",
                class_="dim",
            ),
            class_="card",
        ),
    )


def _key(pair: Baseline, unit: str) -> str:
    return f"{pair.first}-{pair.second}.{unit}"


def _poses(
    shown: Sequence[PoseFigures],
    devices: Sequence[DeviceFigures],
    remarks: Mapping[str, Sequence[str]],
    refused: Mapping[str, str],
) -> Markup:
    names = [each.name for each in devices]
    most = {name: max((pose.rms_px.get(name, 0.0) for pose in shown), default=0.0) or 1.0 for name in names}
    rows = [_pose_row(pose, names, most, remarks.get(pose.name, ())) for pose in shown]
    rows += [
        tag(
            "tr",
            tag("td", name),
            *(tag("td", "–") for _ in range(len(names) + 2)),
            tag("td", tag("span", f"Not used: {reason}", class_="reason"), class_="words"),
            class_="outlier",
        )
        for name, reason in refused.items()
    ]
    head = tag(
        "tr",
        tag("th", "pose"),
        *(tag("th", f"{name}: rms, px") for name in names),
        tag("th", "tilt"),
        tag("th", "distance"),
        tag("th", "remarks", class_="words"),
    )
    table = tag("table", tag("thead", head), tag("tbody", *rows))
    return joined(
        tag("h2", "Poses"),
        tag("p", f"{MEANINGS['tilt']} {MEANINGS['distance']}", class_="lead"),
        tag("section", tag("div", table, class_="table"), class_="card"),
    )


def _pose_row(pose: PoseFigures, names: Sequence[str], most: Mapping[str, float], remarks: Sequence[str]) -> Markup:
    cells = []
    for name in names:
        rms = pose.rms_px.get(name, math.nan)
        key = f"{pose.name}.{name}.rms_px"
        if math.isnan(rms):
            cells.append(tag("td", "–", data_figure=key))
            continue
        bar = tag("span", tag("i", style=f"width:{100 * min(rms / most[name], 1):.0f}%"), class_="bar")
        cells.append(tag("td", tag("span", f"{rms:.3f}", data_figure=key), bar))
    words = [tag("span", f"Left out: {pose.left_out}", class_="reason")] if pose.left_out else []
    words += [tag("div", remark, class_="remark") for remark in remarks]
    return tag(
        "tr",
        tag("td", pose.name),
        *cells,
        tag("td", "–" if math.isnan(pose.tilt_deg) else f"{pose.tilt_deg:.0f}°", data_figure=f"{pose.name}.tilt_deg"),
        tag(
            "td",
            "–" if math.isnan(pose.distance_mm) else f"{pose.distance_mm:.0f} mm",
            data_figure=f"{pose.name}.distance_mm",
        ),
        tag("td", *words, class_="words"),
        class_="outlier" if pose.left_out else None,
    )


def _pictures(
    shown: Sequence[PoseFigures],
    poses: Sequence[ReadPose],
    pictures: Mapping[str, Mapping[str, Pixels]],
    board: Board,
) -> Markup | None:
    views = {pose.observation.name: pose.observation.views for pose in poses}
    figures = []
    for pose in shown:
        for camera, picture in pictures.get(pose.name, {}).items():
            words = f"{pose.name}, {device_title(camera).lower()}" + (" — left out" if pose.left_out else "")
            view = views.get(pose.name, {}).get(camera)
            drawn = pose_picture(picture, view, board, width_px=_PICTURE_PX)
            image = tag("img", src=picture_uri(_jpeg(drawn)), alt=words, loading="lazy")
            figures.append(tag("figure", image, tag("figcaption", words)))
    if not figures:
        return None
    return joined(
        tag("h2", "Pictures"),
        tag(
            "p",
            "What each camera saw, with the corners that were found: a colour per row, corner 0 in a ring.",
            class_="lead",
        ),
        tag("section", *figures, class_="card row narrow"),
    )


def _jpeg(picture: Picture) -> bytes:
    """A picture, red, green, blue, as a JPEG file: a twentieth of a PNG file's size, and a page holds dozens."""
    written, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    if not written:
        message = f"a picture of {picture.shape} could not be written as JPEG"
        raise ValueError(message)
    return data.tobytes()


def _pinholes(calibration: Calibration) -> Mapping[str, Pinhole]:
    named = dict(calibration.cameras)
    if calibration.projector is not None:
        named[PROJECTOR] = calibration.projector
    return named
