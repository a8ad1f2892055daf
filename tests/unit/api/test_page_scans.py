"""What the page makes of scans before it shows them: names that count on, days, addresses, groups of files."""

from __future__ import annotations

import json
import shutil
import subprocess
from typing import Any

import pytest

from slrig.api.system import FOLDER
from tests.npm import lacking

NOW = "new Date(2026, 10, 25, 14, 30)"  # a Wednesday
ASKED = '{name: "", state: "", span: "", from: "", to: ""}'


def told(module: str, expression: str) -> Any:
    """What an expression gives in Node, which runs it an hour east of Greenwich; `page` is the module."""
    node = shutil.which("node") or lacking("needs Node 18 or newer, to run the page's modules: apt install nodejs")
    program = f"import * as page from '{(FOLDER / module).as_uri()}'; console.log(JSON.stringify({expression}))"
    done = subprocess.run(  # noqa: S603 - our own program
        [node, "--input-type=module", "--eval", program],
        capture_output=True, text=True, check=True, env={"TZ": "Europe/Berlin"},
    )  # fmt: skip
    return json.loads(done.stdout)


def test_a_name_counts_on() -> None:
    names = ["plate-007", "plate-099", "plate", "7", "rev 2 ", "", "a9b", "x99999999999999999999"]
    following = ["plate-008", "plate-100", "plate-002", "8", "rev 3", "", "a9b-002", "x100000000000000000000"]
    assert told("names.js", f"{json.dumps(names)}.map(page.following)") == following


@pytest.mark.parametrize(
    ("asked", "query"),
    [
        ("", "limit=48"),
        ('name: " a&b ", state: "failed interrupted"', "limit=48&name=a%26b&state=failed&state=interrupted"),
        ('span: "today"', "limit=48&since=2026-11-24T23%3A00%3A00.000Z"),
        ('span: "last"', "limit=48&since=2026-11-15T23%3A00%3A00.000Z&until=2026-11-22T23%3A00%3A00.000Z"),
        # One day, the longer one on which clocks are set back.
        (
            'span: "days", from: "2026-10-25", to: "2026-10-25"',
            "limit=48&since=2026-10-24T22%3A00%3A00.000Z&until=2026-10-25T23%3A00%3A00.000Z",
        ),
    ],
)
def test_what_is_asked_for_becomes_an_address(asked: str, query: str) -> None:
    assert told("scans.js", f"page.address({{...{ASKED}, {asked}}}, {NOW})") == f"/scan?{query}"


def test_scans_are_grouped_by_the_days_of_who_looks() -> None:
    days = ["11-25T00:10", "11-24T23:30", "11-24T22:59", "11-01T12:00"]
    times = [*(f"2026-{each}Z" for each in days), "2025-12-31T22:00Z"]
    scans = json.dumps([{"created_at": each} for each in times])
    found = told("scans.js", f"page.days({scans}, {NOW}).map(([words, all]) => [words, all.length])")
    assert found == [["Today", 2], ["Yesterday", 1], ["Sunday 1 November", 1], ["Wednesday, 31 December 2025", 1]]


def test_files_stand_in_groups_by_what_they_are_for() -> None:
    names = "bundle.zip causes-left.png coarse.glb mesh.glb mesh.ply mesh.stl points-left.e57 report.json x.new"
    files = json.dumps({name: f"/scan/5f/{name}" for name in names.split()})
    named = "([group, all]) => [group, all.map(({name, later}) => [name, later])]"
    found = told("downloads.js", f"page.grouped({files}).map({named})")
    assert found == [
        ["CAD", [["mesh.stl", True], ["mesh.glb", False]]],
        ["Point clouds", [["points-left.e57", True]]],
        ["Programs", [["mesh.ply", False], ["report.json", False]]],
        ["Raw", [["bundle.zip", True]]],
        ["More", [["causes-left.png", False], ["coarse.glb", True], ["x.new", False]]],
    ]


def test_what_is_typed_of_devices_becomes_a_guess_and_back() -> None:
    typed = 'by: "lens", cameras: {left: {lens: "8", pixel: "4"}, right: {lens: "8"}}, throwRatio: "1.2", throwOff: "5"'
    guess = {"focal_px": {"left": 2000}, "throw_ratio": 1.2, "throw_sigma": 0.05}
    assert told("uncalibrated.js", f'page.guessed({{{typed}}}, ["left", "right"])') == guess
    assert told("uncalibrated.js", f'page.guessed(page.typedOf({json.dumps(guess)}), ["left"])') == guess


def test_an_error_of_shape_is_allowed_where_that_helps() -> None:
    stated = "the scan determines the shape to {}% of its size only, and 0.15% are allowed: {}, or allow a larger error"
    refusals = [stated.format("2.77", "too little depth"), stated.format("0.20", "…")[:60], "the scene is flat"]
    assert told("uncalibrated.js", f"{json.dumps(refusals)}.map(page.allowable)") == [0.0278, None, None]


def test_a_known_length_scales_the_baseline_by_what_it_is_known_to() -> None:
    found = "{valueMm: 40, sigmaMm: 0.3, clickedMm: [0.2, 0.2]}"
    scale = told("measure.js", f"page.scaleBy({found}, 100, 0.5)")
    assert scale == {"factor": 2.5, "sigma": pytest.approx(((0.3**2 + 2 * 0.2**2) / 40**2 + 0.005**2) ** 0.5)}
    guesses = "[{throw_ratio: 1.2, baseline_mm: null}, {baseline_mm: 200}]"
    rescaled = "(each) => page.rescaled(each, {factor: 2.5, sigma: 0.01})"
    first, second = told("uncalibrated.js", f"{guesses}.map({rescaled})")
    assert first == {"throw_ratio": 1.2, "baseline_mm": 250, "baseline_sigma": 0.01}
    assert second == {"baseline_mm": 500, "baseline_sigma": 0.01}
    unknown = "{valueMm: 40, sigmaMm: NaN, clickedMm: [0, 0]}"
    assert told("measure.js", f"page.scaleBy({unknown}, 100).sigma") == 1e-5
