"""The report of a calibration: its numbers are the result's, and it stands on its own."""

from __future__ import annotations

import io
import json
import math
import re
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser

import numpy as np
import pytest
from rich.console import Console

from slrig.bundle.calibration import require_two_rays
from slrig.calibrate.report import (
    baselines,
    device_figures,
    error_slices,
    judgement,
    pose_figures,
    report_html,
    summary,
)
from slrig.calibrate.store import CalibrationResult, ReadPose, Setting, solve_poses
from slrig.calibration.accuracy import compare_calibrations
from slrig.calibration.board import BoardShape, ViewQuality
from slrig.calibration.health.verification import verify_by_board
from slrig.calibration.judgement import Grade
from slrig.calibration.solution import PROJECTOR
from slrig.cli.calibrate_walk import print_result
from slrig.errors import CalibrationError
from slrig.model import Calibration, Size
from tests.unit.calibrate.solved import (
    BOARD,
    BUMP,
    BUMPED,
    CALIBRATION_ID,
    POSES,
    SOLVED_AT,
    board_poses,
    devices,
    read_poses,
    solved_result,
)
from tests.unit.calibration.synthetic import CHESSBOARD, Recipe, made

VOID = {"br", "img", "meta", "hr"}


class Page(HTMLParser):
    """A page, read strictly: every element closes where it should. figures : the text of each `data-figure`."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[tuple[str, str | None]] = []
        self.figures: dict[str, str] = {}
        self.addresses: list[str] = []
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        assert len(given) == len(attrs), tag
        self.tags.append(tag)
        self.addresses += [
            value or "" for name, value in attrs if name in {"src", "href", "xlink:href", "data", "action"}
        ]
        self.ids += [value or "" for name, value in attrs if name == "id"]
        if tag not in VOID:
            figure = given.get("data-figure")
            self.open.append((tag, figure))
            if figure is not None:
                assert figure not in self.figures, figure
                self.figures[figure] = ""

    def handle_endtag(self, tag: str) -> None:
        assert self.open, tag
        assert self.open[-1][0] == tag
        self.open.pop()

    def handle_data(self, data: str) -> None:
        self.words.append(data)
        for _, figure in self.open:
            if figure is not None:
                self.figures[figure] += data

    def number(self, figure: str) -> float:
        """The first number of a figure, and how it is rounded does not matter here."""
        found = re.match(r"[−-]?[\d,]*\.?\d+", self.figures[figure])
        assert found is not None, (figure, self.figures[figure])
        return float(found.group().replace("−", "-").replace(",", ""))


@cache
def result() -> CalibrationResult:
    return solved_result()


@cache
def report(*, pictured: bool = False) -> str:
    white = np.full((1024, 1280), 90, dtype=np.uint8)
    pictures = {name: {"left": white} for name in (POSES[0], BUMPED)} if pictured else {}
    return report_html(
        result(),
        list(read_poses().values()),
        pictures,
        board=BOARD,
        title="Calibration of <bench> & co",
        remarks={POSES[3]: ["a third of the board is < 1 m away"]},
        refused={"pose_20": "camera 'left': no board is in view"},
        machine="on a bench",
    )


@cache
def page() -> Page:
    return Page(report())


def test_page_is_sound_and_names_what_it_is_about() -> None:
    words = " ".join(page().words)
    named = ("Calibration of <bench> & co", CALIBRATION_ID, SOLVED_AT.replace("T", " "), BOARD.title, "on a bench")
    assert all(each in words for each in named)
    assert "<bench>" not in report()
    assert report().startswith("<!DOCTYPE html>")


def test_page_needs_nothing_but_itself() -> None:
    found = Page(report(pictured=True))
    assert found.addresses
    assert all(address.startswith("data:image/jpeg;base64,") for address in found.addresses)
    assert not {"script", "link", "iframe", "object", "embed", "form"} & set(found.tags)
    style = re.search(r"<style>(.*?)</style>", report(), re.DOTALL)
    assert style is not None
    assert "url(" not in style.group(1)
    assert "@import" not in style.group(1)
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", report())
    # Of a pose that was used, and of one that was left out.
    assert found.tags.count("img") == 2
    assert f"{BUMPED}, camera 'left' — left out" in found.words
    assert "img" not in page().tags


def test_names_and_titles_are_shown_as_text() -> None:
    label = '"><script>alert(1)</script>'
    whole, solution = result(), result().solution
    cameras = {label: whole.calibration.cameras["left"]}
    residuals = {label: solution.residuals["left"], PROJECTOR: solution.residuals[PROJECTOR]}
    named = replace(
        whole,
        solution=replace(solution, residuals=residuals, outliers={BUMPED: label}),
        calibration=replace(whole.calibration, cameras=cameras),
        verdict=replace(whole.verdict, summary=label, reasons=(label,)),
    )
    white = {BUMPED: {label: np.full((1024, 1280), 90, dtype=np.uint8)}}
    found = report_html(
        named, [], white, board=BOARD, title=label, remarks={POSES[3]: [label]}, refused={label: label}, machine=label
    )
    assert "<script" not in found
    assert "script" not in Page(found).tags
    assert Page(found).words.count(label) > 5


def test_verdict_comes_first_and_in_words() -> None:
    verdict = result().verdict
    assert page().figures["grade"] == verdict.grade.label.capitalize()
    words = "".join(page().words)
    assert words.index(verdict.grade.label.capitalize()) < words.index("Expected error of a point")
    for reason in verdict.reasons:
        assert reason[1:] in words
    worse = replace(
        result(), verdict=replace(verdict, grade=Grade.DO_NOT_USE, summary="do not use: it is bad", reasons=("a", "b"))
    )
    found = Page(report_html(worse, [], board=BOARD, title="bad"))
    assert found.figures["grade"] == "Do not use"
    assert "It is bad." in found.words


def test_every_number_is_that_of_the_result_and_its_covariance() -> None:
    expected = result().expected
    for name, value in (
        ("point_mm", expected.point_mm),
        ("odd_even_mm", 0.0171),
        ("noise_mm", expected.noise_mm),
        ("total_mm", expected.total_mm),
        ("length_mm_per_m", 1000 * expected.length_share),
    ):
        assert page().number(name) == pytest.approx(value, rel=5e-3)
    assert "0.89 times what is stated for two halves" in " ".join(" ".join(page().words).split())
    flat = "The board is flat as far as the poses determine: 0.031 ± 0.012 mm from its lowest to its highest corner."
    assert flat in page().words
    seen = 0
    for device in device_figures(result()):
        left = device.residuals
        assert page().number(f"{device.name}.rms_px") == pytest.approx(left.rms_px, rel=5e-3)
        assert page().number(f"{device.name}.rms_px.tile") == pytest.approx(left.rms_px, rel=5e-3)
        assert page().number(f"{device.name}.held_out_rms_px") == pytest.approx(left.held_out_rms_px, rel=5e-3)
        assert page().number(f"{device.name}.stated_rms_px") == pytest.approx(left.stated_rms_px, rel=5e-3)
        assert page().number(f"{device.name}.count") == left.count
        assert page().number(f"{device.name}.outlying") == left.outlying
        for name, figure in device.values.items():
            # The deviation shows two digits, and the number as many decimals.
            assert page().number(f"{device.name}.{name}.sigma") == pytest.approx(figure.sigma, rel=0.05)
            assert page().number(f"{device.name}.{name}") == pytest.approx(figure.value, abs=0.06 * figure.sigma)
            seen += 1
    assert seen == 4 + 2 + 4 + 1
    assert f"{PROJECTOR}.k2" not in page().figures
    camera, projector = device_figures(result())
    assert (camera.values["cx"].value, projector.values["cy"].value) == (641.2, 842.4)
    assert (camera.values["k2"].sigma, projector.values["cy"].sigma) == pytest.approx((2e-3, 0.61))
    assert [axis.sigma for axis in camera.centre_mm] == [0, 0, 0]
    np.testing.assert_allclose([axis.value for axis in projector.centre_mm], devices()[PROJECTOR].centre_mm)


def test_baseline_and_its_deviation_are_those_of_drawn_calibrations() -> None:
    """The deviation that is propagated, against the spread of projectors drawn from the covariance."""
    (pair,) = baselines(result())
    projector, covariance = devices()[PROJECTOR], result().solution.covariance[15:, 15:]
    drawn = np.random.default_rng(5).multivariate_normal(np.zeros(15), covariance, 4000)
    # The turn does not move |t|, which is the distance from a camera at the origin.
    lengths = np.linalg.norm(projector.translation_mm + drawn[:, 12:], axis=1)
    assert pair.length_mm.value == pytest.approx(float(np.linalg.norm(projector.centre_mm)))
    assert pair.length_mm.sigma == pytest.approx(float(lengths.std()), rel=0.05)
    assert page().number(f"left-{PROJECTOR}.mm") == pytest.approx(pair.length_mm.value, abs=5.001e-4)
    middle = result().expected.volume_mm.mean(axis=0)
    own, its = middle, middle - projector.centre_mm
    cosine = own @ its / np.linalg.norm(own) / np.linalg.norm(its)
    assert pair.angle_deg.value == pytest.approx(math.degrees(math.acos(cosine)))


def test_every_pose_is_listed_with_its_figures_and_reasons() -> None:
    poses = {pose.name: pose for pose in pose_figures(result(), BOARD, POSES)}
    assert list(poses) == list(POSES)
    for name, pose in poses.items():
        if name == BUMPED:
            continue
        for device, rms in pose.rms_px.items():
            assert page().number(f"{name}.{device}.rms_px") == pytest.approx(rms, abs=5.001e-4)
        board_pose = board_poses()[name]
        middle = board_pose.rotation @ BOARD.points_mm.mean(axis=0) + board_pose.translation_mm
        steep = math.degrees(math.acos(abs(board_pose.rotation[:, 2] @ middle) / np.linalg.norm(middle)))
        assert page().number(f"{name}.tilt_deg") == pytest.approx(steep, abs=0.5001)
        assert page().number(f"{name}.distance_mm") == pytest.approx(middle[2], abs=0.5001)
    words = "".join(page().words)
    assert f"Left out: {BUMP}" in words
    assert page().figures[f"{BUMPED}.tilt_deg"] == "–"
    assert "Not used: camera 'left': no board is in view" in words
    assert "a third of the board is < 1 m away" in words


def test_slices_show_the_error_of_the_places_in_them() -> None:
    slices = error_slices(result().expected)
    assert [z_mm for z_mm, _ in slices] == sorted({z_mm for z_mm, _ in slices})
    assert len(slices) == 3
    grid, errors = result().expected.grid_mm, result().expected.grid_point_mm
    for z_mm, picture in slices:
        told = {
            (float(x), float(y)): float(error)
            for x, y, error in re.findall(r"<title>x (-?\d+), y (-?\d+), z -?\d+ mm: ([\d.]+) mm</title>", picture)
        }
        here = np.abs(grid[:, 2] - z_mm) < 1e-6
        assert len(told) == here.sum() == 63
        for place, error in zip(grid[here], errors[here], strict=True):
            assert told[round(place[0]), round(place[1])] == pytest.approx(error, rel=5e-3)


def test_maps_show_every_cell_of_what_is_left_over() -> None:
    left = result().solution.residuals["left"]
    for rms, count in zip(left.map_rms_px.ravel(), left.map_count.ravel(), strict=True):
        if not math.isnan(rms):
            assert f"<title>rms {rms:.3f} px of {count:,};" in report()
    assert report().count("<title>nothing was seen here</title>") == 2


def test_figures_that_could_not_be_measured_are_named_so() -> None:
    solution = result().solution
    left = replace(solution.residuals["left"], held_out_rms_px=math.nan)
    few = replace(
        result(),
        solution=replace(solution, residuals={**solution.residuals, "left": left}),
        expected=replace(result().expected, length_share=math.nan),
    )
    found = Page(report_html(few, [], board=BOARD, title="few"))
    assert found.figures["left.held_out_rms_px"] == "too few poses"
    assert found.figures["length_mm_per_m"] == "not known"
    assert "nan" not in " ".join(found.words).lower().split()


def test_report_of_cameras_alone_needs_no_projector_and_keeps_their_capitals() -> None:
    whole, solution = result(), result().solution
    names = ("Nikon D5", "Canon")
    cameras = dict.fromkeys(names, whole.calibration.cameras["left"])
    residuals = dict.fromkeys(names, solution.residuals["left"])
    pinholes = replace(solution.calibration, cameras=cameras, projector=None)
    solution = replace(solution, calibration=pinholes, residuals=residuals)
    alone = replace(whole, solution=solution, calibration=replace(pinholes, solved=None))
    white = {POSES[0]: {"Canon": np.full((1024, 1280), 90, dtype=np.uint8)}}
    found = Page(report_html(alone, [], white, board=BOARD, title="two cameras"))
    assert "Camera 'Nikon D5' and camera 'Canon':" in "".join(found.words)
    assert f"{POSES[0]}, camera 'Canon'" in found.words
    assert "Canon.fx" in found.figures
    assert not any(name.startswith(PROJECTOR) for name in found.figures)


# ---- One camera calibrated alone: solved from made-up poses, shown on screen and page, and of no use to scans


SIZE = Size(1280, 1024)
FIGURES = ViewQuality(moved_px=0.01, saturated=0.0, contrast=0.6, sharpness_px=1.1, decoded=float("nan"))


@cache
def poses_of_one() -> tuple[tuple[ReadPose, ...], Calibration]:
    """Poses of a board that one camera saw in white light, and that camera."""
    observations, truth = made(Recipe(poses=8, projector=False, seed=4))
    return tuple(ReadPose(pose, {"left": FIGURES}) for pose in observations.poses), truth


@cache
def of_one() -> CalibrationResult:
    return solve_poses(CHESSBOARD, {"left": SIZE}, None, poses_of_one()[0], board_shape=BoardShape.FLAT)


def test_the_error_is_said_to_be_across_the_line_of_sight() -> None:
    verdict = of_one().verdict
    assert "the expected error of a point of known distance is" in verdict.summary
    assert "mm across the line of sight (1 in" in verdict.summary
    assert verdict.summary.endswith("that takes a projector or a second camera, calibrated with it")
    (error,) = (each for each in verdict.figures if each.figure == "error")
    assert "off across the line of sight by the calibration; twice that" in error.message
    assert "noise of the light" not in error.message


def test_what_is_not_known_is_null_in_json_and_no_number_on_screen_and_page() -> None:
    document = summary(of_one())
    json.dumps(document, allow_nan=False)
    expected = document["expected"]
    assert expected["across"] is True
    assert [expected[name] for name in ("noise_mm", "total_mm", "length_share")] == [None] * 3
    assert document["baselines"] == []
    assert 0 < document["odd_even"]["ratio"] < 3
    stream = io.StringIO()
    print_result(document, Console(file=stream, width=200))
    shown = [line.rstrip() for line in stream.getvalue().splitlines()]
    assert any(line.endswith("(1 σ) across the line of sight by the calibration") for line in shown)
    page = Page(report_html(of_one(), poses_of_one()[0], board=CHESSBOARD, title="one camera"))
    assert page.number("point_mm") == pytest.approx(of_one().expected.point_mm, rel=5e-3)
    assert not {"noise_mm", "total_mm", "length_mm_per_m"} & set(page.figures)
    words = " ".join(" ".join(page.words).split())
    assert "Expected error across the line of sight" in words
    assert "by how much a point of known distance may lie wrong across the line of sight there" in words
    for text in (stream.getvalue(), words):
        assert not {"nan", "inf", "none"} & set(text.lower().split())


def test_each_pose_is_judged_without_a_word_of_light() -> None:
    setting = Setting(CHESSBOARD, {"left": SIZE}, None)
    found = judgement(poses_of_one()[0][5], poses_of_one()[0][:5], setting)
    assert found.refusals == ()
    assert found.guidance is not None
    words = json.dumps([found.answer, found.guidance.coverage, found.guidance.next_move], allow_nan=False)
    assert "projector" not in words
    # Where the board was shot last, for an arrow from there.
    (view,) = poses_of_one()[0][5].observation.views.values()
    assert found.guidance.next_move["from_px"] == pytest.approx(view.points_px.mean(axis=0).tolist())
    first = judgement(poses_of_one()[0][0], (), setting)
    assert first.guidance is not None
    assert "projector" not in json.dumps(first.guidance.next_move)


def test_it_is_no_calibration_for_scans_and_is_compared_by_its_lens() -> None:
    with pytest.raises(CalibrationError) as refusal:
        require_two_rays(of_one().calibration, ["left", "right"], "calibration 3f2a")
    assert str(refusal.value) == (
        "calibration 3f2a: expected a calibration with two rays for each point, found that of camera 'left' alone, "
        "without a projector: it has no depth, and cannot scan; calibrate the camera together with the projector or "
        "with a second camera"
    )
    with pytest.raises(CalibrationError, match="one of camera 'left' alone: calibrate it again"):
        verify_by_board([poses_of_one()[0][0].observation], CHESSBOARD, of_one().calibration)
    found = compare_calibrations(of_one().calibration, of_one().calibration)
    assert found.words[0].endswith("the calibrations have only one device in common.")
    assert found.devices["left"].focal_percent.value == 0
