"""The bench of public captures measures right, on captures that are made up here, and its table is of its recipes."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import cv2
import numpy as np
import pytest

from slrig.importers.orders import ProjectorCode, slstudio_micro_sequence
from slrig.model import Size
from slrig.patterns import encode
from tests.bench.field.__main__ import BEGIN, END, METHODS, README, agree
from tests.bench.field.measures import Floats, Reference, among, figures
from tests.bench.field.methods import AXES, gray_positions, phase_positions, triangulate
from tests.bench.field.recipes import CAPTURES, DIGEST

EXTENT = Size(400, 300)
CAMERA: dict[str, Any] = {"matrix": [[500.0, 0, 60], [0, 500.0, 50], [0, 0, 1]], "distortion": [-0.1, 0.05, 0, 0, 0]}
PIXELS = np.stack(np.meshgrid(np.arange(120.0), np.arange(100.0)), axis=-1).reshape(-1, 2)


def frames_of(words: str, axis: str) -> tuple[Any, list[dict[str, Any]]]:
    """One pixel before each place of the projector along the axis, and the patterns as a bundle describes them."""
    code = ProjectorCode(EXTENT)
    patterns = slstudio_micro_sequence(code, 12) if words == "micro" else code.parse_sequence(words)
    shown = encode(patterns, EXTENT)
    images = np.array([shown.image(index) for index in range(len(shown))])
    return (images[:, :, 0] if axis == "row" else images[:, 0]) // 2 + 20, [asdict(each) for each in patterns]


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("words", ["columns rows", "white black columns-plain rows-plain"])
def test_each_pixel_reads_its_gray_code(axis: str, words: str) -> None:
    frames, patterns = frames_of(words, axis)
    frames[:, 7] = 60
    position = gray_positions(frames, patterns, axis)
    assert np.isnan(position[7])
    assert np.delete(position, 7).tolist() == [each for each in range(frames.shape[1]) if each != 7]


@pytest.mark.parametrize("words", ["columns-sine:25/3 columns-sine:400/3", "micro"])
def test_each_pixel_reads_its_phase(words: str) -> None:
    frames, patterns = frames_of(words, "column")
    position = phase_positions(frames, patterns, "column", EXTENT.width_px)
    assert np.abs(position - np.arange(400))[3:-3].max() < 0.5  # grey levels are whole numbers


@pytest.mark.parametrize("axis", AXES)
def test_rays_meet_bent_sheets_of_light(axis: str) -> None:
    turn, shift = cv2.Rodrigues(np.array([0.1, -0.2, 0.05]))[0], np.array([-80.0, 60.0, 20.0])
    lens = np.array([[300.0, 0, 270], [0, 310.0, 90], [0, 0, 1]]), np.array([-0.2, 0.1, 0.002, 0.001, 0])
    true = surface(300 + 20 * np.sin(PIXELS[:, 0] / 9))
    light = cv2.projectPoints(true, turn, shift, *lens)[0][:, 0, AXES.index(axis)]
    projector = {"matrix": lens[0], "distortion": lens[1], "rotation": turn, "translation_mm": shift}
    projector["size_px"] = np.array([EXTENT.width_px, EXTENT.height_px])
    assert np.abs(triangulate(PIXELS, light, axis, CAMERA, projector) - true).max() < 1e-3


def surface(depth_mm: Floats) -> Floats:
    """(pixels, 3) mm: one point before each pixel."""
    flat = cv2.undistortPoints(PIXELS[:, None], np.array(CAMERA["matrix"]), np.array(CAMERA["distortion"]))[:, 0]
    return np.asarray(np.c_[flat, np.ones(len(flat))] * depth_mm[:, None])


@pytest.mark.parametrize("published", [False, True], ids=["plane", "cloud"])
def test_errors_are_those_that_were_planted(published: bool) -> None:
    rng = np.random.default_rng(0)
    error = rng.normal(0, 0.1, len(PIXELS))
    gross = rng.random(len(PIXELS)) < 0.03
    lit = np.ones((100, 120), dtype=np.bool_)
    truth = np.full(len(PIXELS), 300.0)
    reference = among(surface(truth)[::2], lit, CAMERA) if published else Reference(lit, lit)
    seen = PIXELS[:, 0] < 84
    found = figures(surface(truth + error + 40 * gross)[seen], np.full(seen.sum(), 0.1), reference, CAMERA)

    assert found.points == pytest.approx(seen.sum(), rel=0.02)  # gross errors leave their pixel's place, not its ray
    assert found.covered == pytest.approx(88 / 120, abs=0.01)  # 83 is the last column, 4 px more are near
    assert found.rms_mm == pytest.approx(0.1, rel=0.05)
    assert found.p95_mm == pytest.approx(np.percentile(np.abs(error + 40 * gross), 95), rel=0.1)
    assert found.gross == pytest.approx(gross.mean(), rel=0.15)
    assert found.within_sigma == pytest.approx(0.683 * 0.97, abs=0.02)


def test_the_table_is_of_the_recipes() -> None:
    table = README.read_text(encoding="utf-8").partition(BEGIN)[2].partition(END)[0]
    assert f"of recipes {DIGEST} " in table
    rows = [line.split(" | ")[:2] for line in table.splitlines() if line.startswith("| ")][1:]
    assert rows == [[f"| {name}", METHODS[each]] for name, recipe in CAPTURES.items() for each in recipe["methods"]]


@pytest.mark.parametrize(("other", "same"), [("0.104", True), ("0.106", False), ("not installed", False)])
def test_two_runs_agree_to_five_per_cent_but_for_cpu(other: str, same: bool) -> None:
    assert agree(f"| board | slrig | {other} | none | 3.0 |", "| board | slrig | 0.100 | none | 9.0 |") is same
