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
from tests.unit.conformance.broken_drivers import LightsLate
from tests.unit.conformance.model_rig import Maker, ModelProjector

LATE = "a_frame_lies_wholly_in_its_pattern"


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text('name = "small"\n[head]\ndriver = "absent"\n')
    return path


@pytest.mark.parametrize(("projector", "passed"), [(ModelProjector, 2), (LightsLate, 1)])
def test_conform_says_what_is_wrong_and_what_to_do(
    rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, projector: type[ModelProjector], passed: int
) -> None:
    # Two checks of all: what comes of them is tested by `test_broken_drivers`.
    few = [check for check in CHECKS if check.name in {LATE, "show_needs_a_loaded_sequence"}]
    monkeypatch.setattr(examine, "run", partial(run, checks=few))
    monkeypatch.setattr(examine, "open_rig", lambda _config: Maker(projector=projector)())
    data = tmp_path / "data"
    (data / "scans").mkdir(parents=True)
    shown = CliRunner().invoke(app, ["conform", str(rig), "--data", str(data)])
    assert shown.exit_code == (0 if passed == 2 else 1), shown.output
    assert f"{50 * passed} %: " in shown.stdout
    kept = last_examination(data, "conform", "model")
    assert kept is not None
    assert f"{kept.found['passed']} of {kept.found['applicable']} checks" in shown.stdout
    told = " ".join(shown.stdout.split())
    assert (f"({LATE})" in told) == (passed == 1)
    assert ("do read returns frames whose whole exposure, all rows, lies after after_ns" in told) == (passed == 1)
    # As JSON, and into a folder that is none of the service's.
    shown = CliRunner().invoke(app, ["conform", str(rig), "--json", "--data", str(tmp_path)])
    document = json.loads(shown.stdout)
    assert (document["rig"], document["conforms"], document["score"]) == ("model", passed == 2, passed / 2)
    assert (document["passed"], document["applicable"]) == (passed, 2)
    assert "is no data folder of slrig serve" in shown.stderr


def test_conform_on_a_rig_that_cannot_be_opened_is_exit_code_2(rig: Path) -> None:
    shown = CliRunner().invoke(app, ["conform", str(rig)])
    assert shown.exit_code == 2
    assert "no installed package provides the head driver 'absent'" in shown.stderr
