"""`slrig conform`: its exit codes, and what it says to people and to programs."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import pytest
from typer.testing import CliRunner

from slrig.cli import examine
from slrig.cli.commands import app
from slrig.conformance import CHECKS, run
from slrig.jobs.examinations import last_examination

PLATE = """
name = "plate"

[[object]]
name = "plate"
shape = "plane"
size_mm = [400.0, 400.0]
rotation_deg = [6.0, -10.0, 0.0]
albedo = 0.8
"""


def small_rig(folder: Path, *, faults: str = "") -> Path:
    """A rig file of a small rendered rig before a plate."""
    (folder / "plate.toml").write_text(PLATE)
    rig = folder / "rig.toml"
    rig.write_text(
        f"""
        name = "small"
        [head]
        driver = "simulated"
        scene = "plate.toml"
        {faults}
        [head.projector]
        size_px = [96, 72]
        focal_px = [440.0, 440.0]
        position_mm = [90.0, 0.0, -500.0]
        target_mm = [0.0, 0.0, 0.0]
        blur_px = 0.4
        [[head.camera]]
        name = "left"
        size_px = [160, 120]
        focal_px = [800.0, 800.0]
        position_mm = [-60.0, 0.0, -500.0]
        target_mm = [0.0, 0.0, 0.0]
        saturation_s = 0.03
        blur_px = 0.5
        """
    )
    return rig


LATE = "a_frame_lies_wholly_in_its_pattern"


@pytest.fixture
def few_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two checks of all: what comes of them is tested by `test_broken_drivers`."""
    few = [check for check in CHECKS if check.name in {LATE, "show_needs_a_loaded_sequence"}]
    monkeypatch.setattr(examine, "run", partial(run, checks=few))


@pytest.mark.usefixtures("few_checks")
# Light that comes three exposures after the projector says so.
@pytest.mark.parametrize(("faults", "passed"), [("", 2), ("faults = {light_delay_s = 0.05}", 1)])
def test_conform_says_what_is_wrong_and_what_to_do(tmp_path: Path, faults: str, passed: int) -> None:
    rig, data = small_rig(tmp_path, faults=faults), tmp_path / "data"
    (data / "scans").mkdir(parents=True)
    shown = CliRunner().invoke(app, ["conform", str(rig), "--data", str(data)])
    assert shown.exit_code == (0 if passed == 2 else 1), shown.output
    assert f"{50 * passed} %: " in shown.stdout
    kept = last_examination(data, "conform", "small")
    assert kept is not None
    assert f"{kept.found['passed']} of {kept.found['applicable']} checks" in shown.stdout
    told = " ".join(shown.stdout.split())
    assert (f"({LATE})" in told) == (passed == 1)
    assert ("do read returns frames whose whole exposure, all rows, lies after after_ns" in told) == (passed == 1)
    # As JSON, and into a folder that is none of the service's.
    shown = CliRunner().invoke(app, ["conform", str(rig), "--json", "--data", str(tmp_path)])
    document = json.loads(shown.stdout)
    assert (document["rig"], document["conforms"], document["score"]) == ("small", passed == 2, passed / 2)
    assert (document["passed"], document["applicable"]) == (passed, 2)
    assert "is no data folder of slrig serve" in shown.stderr


def test_conform_on_a_rig_that_cannot_be_opened_is_exit_code_2(tmp_path: Path) -> None:
    rig = small_rig(tmp_path)
    rig.write_text(rig.read_text().replace('"simulated"', '"absent"'))
    shown = CliRunner().invoke(app, ["conform", str(rig)])
    assert shown.exit_code == 2
    assert "no installed package provides the head driver 'absent'" in shown.stderr
