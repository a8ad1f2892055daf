"""`slrig model --shoot`: turned by hand and by a table, left and gone on with, and asked of a service."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import Result

from slrig.bundle.stage import StageAngle, write_stage
from slrig.cli import model_shoot
from slrig.client.events import Progress
from slrig.devices import Rig
from slrig.errors import DeviceGoneError, ServiceError
from slrig.scan.artefacts import encode_mesh_ply
from slrig.scan.plan import ScanPlan
from tests.turned_views import AXIS, AXIS_POINT_MM, bumpy, seen
from tests.unit.capture.fake_rig import FakeTurntable, fake_rig
from tests.unit.command import slrig

STAGE = ["--axis-point", *map(str, AXIS_POINT_MM), "--axis-direction", *map(str, AXIS)]
RIG = Path(__file__).parents[2] / "config" / "rigs" / "demo.toml"


class Bench:
    """Shoots meshes that were made before. shot : the angles; faults : what the next view at an angle raises."""

    def __init__(self) -> None:
        self.table: FakeTurntable | None = None
        self.shot: list[float | None] = []
        self.faults: dict[float, Exception] = {}
        angles = [0.0, 40.0, 80.0, 120.0]
        self.meshes = dict(zip(angles, seen(bumpy, angles, pitch_mm=1.5).noisy(0, length_mm=2.0), strict=True))

    def open_rig(self, _: object) -> Rig:
        return replace(fake_rig().rig, positioner=self.table)

    def shoot(self, _: Rig, plan: ScanPlan, output: Path, number: int) -> None:
        assert plan.turn_deg is not None
        self.shot.append(plan.turn_deg)
        if (error := self.faults.pop(plan.turn_deg, None)) is not None:
            raise error
        (output / f"view-{number}").mkdir(parents=True)
        (output / f"bundle-{number}").mkdir()
        write_stage(output / f"bundle-{number}", StageAngle(angle_deg=plan.turn_deg, turned_by=plan.turned_by))
        (output / f"view-{number}" / "mesh.ply").write_bytes(encode_mesh_ply(self.meshes[plan.turn_deg]))


@pytest.fixture(scope="module")
def made() -> Bench:
    return Bench()


@pytest.fixture
def bench(made: Bench, monkeypatch: pytest.MonkeyPatch) -> Bench:
    made.table, made.shot, made.faults = None, [], {}
    monkeypatch.setattr(model_shoot, "open_rig", made.open_rig)
    monkeypatch.setattr(model_shoot, "_shot", made.shoot)
    return made


def model(*words: object, typed: str = "") -> Result:
    return slrig("model", *words, typed=typed, COLUMNS="120")


@pytest.mark.slow
def test_a_person_turns_leaves_and_goes_on_in_the_same_folder(bench: Bench, tmp_path: Path) -> None:
    shoot = ["--shoot", 9, "--rig", RIG, "--by-hand", "--output", tmp_path, *STAGE]
    bench.faults = {40.0: DeviceGoneError("left was unplugged")}
    done = model(*shoot, typed="\n\nq\n")
    assert done.exit_code == 0, done.output
    assert "turn the object by about 40°, to 40° in all, then press Enter" in done.stdout
    assert "view-2: left was unplugged" in done.stderr
    assert bench.shot == [0.0, 40.0, 40.0]
    assert [line.split()[0] for line in done.stdout.splitlines() if line.startswith("view-")] == ["view-1", "view-2"]
    again = model(*shoot, typed="\nq\n")
    assert again.exit_code == 0, again.output
    assert bench.shot == [0.0, 40.0, 40.0, 80.0]
    report = json.loads((tmp_path / "model" / "report.json").read_bytes())
    assert [each["name"] for each in report["views"]] == ["view-1", "view-2", "view-3"]
    assert report["axis"]["stage_error_deg"] == pytest.approx([0, 0, 0], abs=0.05)
    # Another number of views changes nothing of where those stood that there are.
    fewer = model("--shoot", 3, "--rig", RIG, "--by-hand", "--output", tmp_path, *STAGE)
    assert fewer.exit_code == 0, fewer.output
    assert json.loads((tmp_path / "model" / "poses.json").read_bytes())["views"][2]["name"] == "view-3"
    assert json.loads((tmp_path / "model" / "report.json").read_bytes())["axis"]["stage_error_deg"] == pytest.approx(
        [0, 0, 0], abs=0.05
    )


@pytest.mark.slow
def test_table_turns_and_a_view_that_fails_is_named(bench: Bench, tmp_path: Path) -> None:
    bench.table = FakeTurntable()
    bench.faults = {
        angle: DeviceGoneError("left was unplugged") for angle in (120.0, 160.0, 200.0, 240.0, 280.0, 320.0)
    }
    done = model("--shoot", 9, "--rig", RIG, "--output", tmp_path, *STAGE)
    assert done.exit_code == 0, done.output
    assert "view-4, at 120°, is not in it: left was unplugged" in done.stdout
    assert len(json.loads((tmp_path / "model" / "report.json").read_bytes())["notes"]) == 6


def test_what_cannot_be_shot_is_said(bench: Bench, tmp_path: Path) -> None:
    rig = ["--shoot", 9, "--rig", RIG, "--output", tmp_path]
    for words, asked in (
        ("this rig has no turntable", [*rig, *STAGE]),
        ("expected the stage's axis", [*rig, "--by-hand"]),
        ("expected scans, or --shoot N", ["--output", tmp_path]),
        ("expected scans, or --shoot N", ["--output", tmp_path, "--by-hand", tmp_path]),
        ("leave --angle and --poses out", [*rig, "--angle", 40, *STAGE]),
    ):
        refused = model(*asked)
        assert refused.exit_code == 2
        assert words in refused.output
    bench.faults = {0.0: DeviceGoneError("left was unplugged")}
    failed = model(*rig, "--by-hand", *STAGE, typed="q\n")
    assert (failed.exit_code, "0 of 9 views succeeded" in failed.stderr) == (2, True), failed.output
    assert bench.shot == [0.0]


class Models:
    """The part of a client that has to do with models. asked : what was called, in order."""

    def __init__(self, state: str) -> None:
        self.asked: list[Any] = []
        self.state = state

    def shoot(self, **request: Any) -> dict[str, Any]:
        self.asked.append(request)
        return {"id": "m"}

    def follow(self, _: str) -> Iterator[Progress]:
        for number, stage in enumerate(("view", "turn", "view", "turn", "done"), 1):
            yield Progress(number=number, stage=stage, fraction=0.1, detail=f"turn for view {number}")

    def view(self, _: str, *, again: bool, if_busy: str) -> None:
        self.asked.append({"again": again, "if_busy": if_busy})

    def combine(self, _: str) -> None:
        self.asked.append("combine")

    def get(self, _: str) -> dict[str, Any]:
        error = {"detail": "too few views"}
        return {"state": self.state, "error": error, "links": {"files": {"model.ply": "/model/m/model.ply"}}}


class Asked:
    """A client. fetched : what it was to write."""

    def __init__(self, state: str = "succeeded") -> None:
        self.models = Models(state)
        self.fetched: list[tuple[str, Path]] = []
        self.fetch: Callable[[str, Path], None] = lambda link, path: self.fetched.append((link, path))


def test_service_shoots_what_the_person_answers(tmp_path: Path) -> None:
    client, answers = Asked(), iter(["a", "q"])
    model_shoot.views_there(client, {"views": 3}, tmp_path / "out", ask=lambda _: next(answers))  # type: ignore[arg-type]
    wait = {"if_busy": "queue"}
    assert client.models.asked == [{"views": 3, **wait}, {"again": True, **wait}, "combine"]
    assert client.fetched == [("/model/m/model.ply", tmp_path / "out" / "model.ply")]
    failed, answers = Asked("failed"), iter(["", ""])
    with pytest.raises(ServiceError, match="Model m failed: too few views"):
        model_shoot.views_there(failed, {}, tmp_path, ask=lambda _: next(answers))  # type: ignore[arg-type]
    assert failed.models.asked == [wait, {"again": False, **wait}, {"again": False, **wait}]
