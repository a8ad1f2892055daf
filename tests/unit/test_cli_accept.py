"""`slrig accept`: what it asks, refuses, prints, and returns."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from slrig.accept.plan import AcceptancePlan, Limits
from slrig.accept.running import run_acceptance
from slrig.accept.scene import scripted_config
from slrig.accept.verdicts import AcceptanceResult
from slrig.calibration.artefacts import Decision
from slrig.cli import accept as accepting
from slrig.cli.accept import moving, placed_by_hand, plan_for
from slrig.cli.commands import accept
from slrig.cli.options import AcceptanceOptions
from slrig.config import read_rig
from slrig.devices import Rig
from slrig.discovery import open_rig
from slrig.errors import InvalidInputError, ScanCancelledError, UnsupportedByDeviceError

RIGS = Path(__file__).parents[2] / "config" / "rigs"
BALL_BAR = RIGS / "ball_bar.toml"

app = typer.Typer()
app.command()(accept)


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    with open_rig(read_rig(BALL_BAR)) as rig:
        yield rig


@pytest.fixture(scope="module")
def plan(rig: Rig) -> AcceptancePlan:
    return plan_for(AcceptanceOptions(), rig)


@pytest.mark.slow
def test_rendered_rig_needs_no_artefacts_and_states_exact_ones(rig: Rig, plan: AcceptancePlan) -> None:
    assert plan.rendered
    assert plan.artefacts.diameter.uncertainty_mm == 0
    assert plan.limits.spacing_mm == pytest.approx(plan.diagonal_mm / 5000)
    assert len(plan.steps) == 23
    given = plan_for(AcceptanceOptions(volume_mm=(-50, -40, -25, 50, 40, 25)), rig)
    assert given.volume_mm.tolist() == [[-50, -40, -25], [50, 40, 25]]


def test_metal_needs_the_certificates(rig: Rig) -> None:
    metal = replace(rig, head=None)
    with pytest.raises(InvalidInputError, match="needs --sphere DIAMETER U"):
        plan_for(AcceptanceOptions(), metal)
    given = AcceptanceOptions(sphere_mm=(17.5, 0.001), bar_mm=(64.0, 0.002), plane_mm=(95.0, 67.0))
    with pytest.raises(InvalidInputError, match="the sphere's form, the plane's form is not told"):
        plan_for(given, metal)
    certain = replace(given, sphere_form_mm=0.001, plane_form_mm=0.002, spacing_limit_mm=0.05)
    wanted = plan_for(replace(certain, wanted_mm=0.03), metal).limits
    assert wanted == Limits(form_mm=0.06, size_mm=0.03, spacing_mm=0.05, flatness_mm=0.06)
    assert not plan_for(certain, metal).rendered


@pytest.mark.slow
def test_limits_follow_the_rig_file_unless_given(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    planned: list[Limits] = []

    def left(_rig: Rig, plan: AcceptancePlan, _output: Path, **_: object) -> AcceptanceResult:
        planned.append(plan.limits)
        message = "left"
        raise ScanCancelledError(message)

    monkeypatch.setattr(accepting, "_tested", left)
    rig_file = tmp_path / "rig.toml"
    told = BALL_BAR.read_text(encoding="utf-8").replace('"../', f'"{RIGS.parent}/')
    rig_file.write_text(f"{told}\n[accuracy]\nwanted_mm = 0.04\n", encoding="utf-8")
    for asked in ([], ["--wanted-mm", "0.01"]):
        CliRunner().invoke(app, [str(rig_file), "--output", str(tmp_path / "out"), *asked])
    assert [limits.spacing_mm for limits in planned] == [0.04, 0.01]


@pytest.mark.slow
def test_a_rig_whose_script_has_the_positions_moves_its_own_artefacts(tmp_path: Path) -> None:
    config = read_rig(RIGS / "rendered-acceptance.toml")
    assert moving(config, AcceptanceOptions(), tmp_path) is config
    other = moving(read_rig(BALL_BAR), AcceptanceOptions(), tmp_path)
    with open_rig(other) as rig:
        assert rig.positioner is not None
        assert len(rig.positioner.poses) == 23


def test_a_rig_that_is_not_rendered_cannot_be_scripted(tmp_path: Path, plan: AcceptancePlan) -> None:
    config = read_rig(BALL_BAR)
    with pytest.raises(UnsupportedByDeviceError, match=r"leave scripted \(--scripted\) out"):
        scripted_config(replace(config, head=None), plan, tmp_path)


def test_person_reads_each_position_and_may_leave(plan: AcceptancePlan) -> None:
    shown = io.StringIO()
    answers = iter(["", "q"])

    def ask(_: str) -> str:
        if (answer := next(answers, None)) is None:
            raise EOFError
        return answer

    place = placed_by_hand(plan, Console(file=shown, width=120), ask=ask)
    rig = Rig("tame", {}, None, {})  # type: ignore[arg-type]
    place(rig, plan.steps[0])
    assert "1 of 23" in shown.getvalue()
    assert "Put the sphere in the middle of the volume." in shown.getvalue()
    for _ in ("q", "end of input"):
        with pytest.raises(ScanCancelledError, match="left before sphere-2"):
            place(rig, plan.steps[1])


@pytest.mark.slow
@pytest.mark.parametrize("as_json", [False, True])
def test_the_command_does_the_test_and_returns_the_decision(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *, as_json: bool
) -> None:
    whole = run_acceptance

    def shortened(rig: Rig, plan: AcceptancePlan, folder: Path, **options: object) -> AcceptanceResult:
        steps = tuple(step for step in plan.steps if step.name == "bar-5")
        return whole(rig, replace(plan, steps=steps, repeats=1), folder, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(accepting, "run_acceptance", shortened)
    output = tmp_path / "out"
    # Sphere spacing is right to a few µm: a limit of one tenth of a µm fails, the usual one passes.
    tight = ["--spacing-limit-mm", "0.0000001"] if as_json else []
    given = [str(BALL_BAR), "--scripted", "--output", str(output), *tight, *(["--json"] if as_json else [])]
    ran = CliRunner().invoke(app, given)
    report = json.loads((output / "report.json").read_text())
    assert report["quantities"][0]["quantity"] == "SD"
    if as_json:
        assert json.loads(ran.stdout) == report
        assert report["decision"] == Decision.FAILS
        assert ran.exit_code == 1
    else:
        assert "SD sphere spacing error" in ran.stdout
        assert report["decision"] == Decision.PASSES
        assert ran.exit_code == 0
