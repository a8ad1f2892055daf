"""An acceptance test: its figures on artefacts of known form, its decisions, its scale, its run and its record."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from io import StringIO
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from slrig.accept import job as acceptance
from slrig.accept.evaluation import AcceptanceResult, Reading, ReadingPoints, reading, scale_by_bar, verdicts
from slrig.accept.plan import (
    AcceptancePlan,
    Artefact,
    Artefacts,
    Certified,
    Limits,
    Quantity,
    Step,
    acceptance_plan,
    usual_limits,
)
from slrig.accept.report import document, report_html
from slrig.accept.store import AcceptanceRecord, AcceptanceState, record_from_json, record_json
from slrig.calibration.artefacts import Decision
from slrig.cli.accept import Person, measure_positions, print_result
from slrig.devices import Rig
from slrig.errors import (
    CalibrationError,
    NothingToReconstructError,
    ScanCancelledError,
    SlrigError,
    UnsupportedByDeviceError,
)
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.store import JobStore
from slrig.model import Calibration, FloatArray, Mesh
from slrig.scan.artefacts import encode_mesh_ply
from tests.core import parametrize_core
from tests.unit.accept.test_plan import GOOD, VOLUME, device
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.jobs.tame_manager import TameManager
from tests.unit.scan.bench import PIPELINE
from tests.unit.scan.fakes import TamePositioner, TameProjector, TameRecording

CAMERA = device()
RIG = Calibration({"left": CAMERA}, CAMERA)
PLAN = acceptance_plan(
    RIG, VOLUME, replace(GOOD, expansion_per_k=0.0), rendered=True, limits=usual_limits(VOLUME, 0.02), repeats=2
)
NOISE_MM = 0.005
GRID = 40


def step_of(artefact: Artefact, number: int = 1) -> Step:
    return next(step for step in PLAN.steps if step.name == f"{artefact}-{number}")


def grid_faces(first: int) -> NDArray[np.int32]:
    corner = first + (np.arange(GRID - 1)[:, None] * GRID + np.arange(GRID - 1)).ravel()
    a, b, c, d = corner, corner + 1, corner + GRID + 1, corner + GRID
    return np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)]).astype(np.int32)


def ball(centre: FloatArray, radius: float, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The front of a ball, to 75 degrees off its middle, and its normals."""
    across, down = np.meshgrid(*[np.deg2rad(np.linspace(-75, 75, GRID))] * 2)
    angle = np.maximum(np.hypot(across, down), 1e-9)
    polar = np.minimum(angle, np.deg2rad(80))
    normal = np.stack([np.sin(polar) * across / angle, np.sin(polar) * down / angle, -np.cos(polar)], axis=-1).reshape(
        -1, 3
    )
    return centre + normal * (radius + noise)[:, None], normal


def flat(step: Step, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    right = np.cross(step.axis, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, step.axis)
    across, down = np.meshgrid(np.linspace(-80, 80, GRID), np.linspace(-55, 55, GRID))
    places = step.centre_mm + across.reshape(-1, 1) * right + down.reshape(-1, 1) * up
    return places + noise[:, None] * step.axis, np.tile(step.axis, (GRID * GRID, 1))


def scan_of(step: Step, *, scale: float = 1.0, noise_mm: float = NOISE_MM, seed: int = 1) -> Mesh:
    """A scan of an artefact in its position by a scanner that measures everything `scale` times too large."""
    rng = np.random.default_rng((seed, *step.name.encode()))

    def noise() -> FloatArray:
        return rng.normal(0, noise_mm, GRID * GRID)

    if step.artefact is Artefact.PLANE:
        parts = [flat(step, noise())]
    elif step.artefact is Artefact.SPHERE:
        parts = [ball(step.centre_mm, 15.0, noise())]
    else:
        parts = [ball(step.centre_mm + side * 55.0 * step.axis, 15.0, noise()) for side in (-1, 1)]
    points = np.concatenate([part[0] for part in parts]) * scale
    count = len(points)
    return Mesh(
        points.astype(np.float32),
        np.concatenate([grid_faces(at * GRID * GRID) for at in range(len(parts))]),
        np.concatenate([part[1] for part in parts]).astype(np.float32),
        np.zeros((count, 3), np.uint8),
        np.zeros(count, np.uint8),
        np.full(count, noise_mm, np.float32),
        np.zeros(count, np.int32),
    )


@pytest.mark.parametrize("artefact", Artefact)
def test_noise_alone_gives_the_form_error_of_noise(artefact: Artefact) -> None:
    found, evidence = reading(scan_of(step_of(artefact)), step_of(artefact), 0, PLAN)
    form = {Artefact.SPHERE: Quantity.FORM, Artefact.PLANE: Quantity.FLATNESS}.get(artefact)
    if form is not None:
        assert 5.0 * NOISE_MM < found.errors_mm[form] < 6.5 * NOISE_MM
    assert found.sigma_mm == pytest.approx(NOISE_MM, rel=0.06)
    assert found.dispersion_mm == pytest.approx(3.92 * NOISE_MM, rel=0.06)
    assert 0.002 < found.rejected_share <= 0.003
    assert found.used == (evidence.artefact > 0).sum() == len(evidence.points_mm)
    assert found.turned == 0


@pytest.mark.parametrize("scale", [0.999, 1.0, 1.002])
def test_scanner_that_measures_too_large_has_that_error(scale: float) -> None:
    sphere, _ = reading(scan_of(step_of(Artefact.SPHERE), scale=scale), step_of(Artefact.SPHERE), 0, PLAN)
    bar, _ = reading(scan_of(step_of(Artefact.BAR), scale=scale), step_of(Artefact.BAR), 0, PLAN)
    assert sphere.errors_mm[Quantity.SIZE] == pytest.approx(30 * (scale - 1), abs=0.001)
    (verdict,) = verdicts([bar], PLAN)
    assert verdict.decision is (Decision.PASSES if scale == 1.0 else Decision.FAILS)
    assert bar.errors_mm[Quantity.SPACING] == pytest.approx(110 * (scale - 1), abs=0.001)


@pytest.mark.parametrize("part", ["steep", "border"])
def test_what_is_steep_or_at_a_border_counts_as_all_else(part: str) -> None:
    step = step_of(Artefact.SPHERE)
    mesh = scan_of(step)
    rays = CAMERA.centre_mm - mesh.vertices_mm
    cosine = (mesh.normals * rays).sum(axis=1) / np.linalg.norm(rays, axis=1)
    row, column = np.divmod(np.arange(GRID * GRID), GRID)
    rim = (np.minimum(row, column) == 0) | (np.maximum(row, column) == GRID - 1)
    spoilt = cosine < np.cos(np.deg2rad(65)) if part == "steep" else rim
    assert 0.01 < spoilt.mean() < 0.5
    outwards = (mesh.vertices_mm - step.centre_mm) / 15
    moved = np.where(spoilt[:, None], mesh.vertices_mm + 0.4 * outwards, mesh.vertices_mm).astype(np.float32)
    found, _ = reading(replace(mesh, vertices_mm=moved), step, 0, PLAN)
    assert found.used == GRID * GRID
    assert found.errors_mm[Quantity.FORM] > 0.3


@pytest.mark.parametrize("artefact", [Artefact.SPHERE, Artefact.BAR])
def test_missing_artefact_is_named_by_its_position(artefact: Artefact) -> None:
    step = step_of(artefact)
    with pytest.raises(NothingToReconstructError, match=f"{step.name}: expected .* of 30 mm, found"):
        reading(scan_of(step_of(Artefact.PLANE)), step, 0, PLAN)


def measured(step: str, take: int, error_mm: float) -> Reading:
    return Reading(step, take, {Quantity.SPACING: error_mm}, 0.005, 0.005, 0.02, 9, 0, 0.0)


def test_the_worst_position_decides_and_scatter_is_only_measured() -> None:
    readings = [measured("bar-1", 0, 0.004), measured("bar-1", 1, 0.006), measured("bar-2", 0, -0.012)]
    (found,) = verdicts(readings, PLAN)
    assert (found.step, found.error_mm, found.repeats) == ("bar-2", -0.012, 2)
    assert found.scatter_mm == pytest.approx(np.std([0.004, 0.006], ddof=1))
    assert found.uncertainty.expanded_mm == pytest.approx(0.002)
    assert found.decision is Decision.PASSES
    (near,) = verdicts([measured("bar-1", 0, 0.019)], PLAN)
    assert np.isnan(near.scatter_mm)
    assert near.decision is Decision.UNDECIDED


@pytest.mark.parametrize("artefact", [Artefact.SPHERE, Artefact.PLANE])
def test_a_noisier_scanner_meets_the_same_limit_and_the_same_uncertainty(artefact: Artefact) -> None:
    step = step_of(artefact)
    quiet, noisy = (
        verdicts([reading(scan_of(step, noise_mm=noise), step, take, PLAN)[0] for take in range(2)], PLAN)
        for noise in (NOISE_MM, 5 * NOISE_MM)
    )
    for better, worse in zip(quiet, noisy, strict=True):
        assert (better.limit_mm, better.uncertainty) == (worse.limit_mm, worse.uncertainty)
    assert quiet[0].decision is Decision.PASSES
    assert noisy[0].decision is Decision.FAILS


def nothing_captured(rig: Rig, _plan: object, folder: Path, _listener: object) -> TameRecording:
    """In place of a capture."""
    assert rig.truth() is None
    folder.mkdir()
    return TameRecording()


Scan = Callable[[Step], Mesh]


def take_scans_from(monkeypatch: pytest.MonkeyPatch, plan: AcceptancePlan, scan: Scan = scan_of) -> None:
    """Have every capture of a plan's step be reconstructed as `scan` says."""

    def reconstruct(bundle: Path, output: Path, _listener: object, /, **_: object) -> Mapping[str, Any]:
        name = bundle.name.rsplit("-", 1)[0]
        output.mkdir()
        step = next(step for step in plan.steps if step.name == name)
        (output / "mesh.ply").write_bytes(encode_mesh_ply(scan(step)))
        return {}

    monkeypatch.setattr(acceptance, "capture_frames", nothing_captured)
    monkeypatch.setattr("slrig.scan.reconstruct.reconstruct_bundle", reconstruct)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., AcceptanceResult]:
    """Run a test with a rig whose scans are made by `scan`."""

    def go(
        plan: AcceptancePlan = PLAN,
        *,
        scan: Scan = scan_of,
        names: tuple[str, ...] | None = None,
        cancelled: Callable[[], bool] = lambda: False,
        calibration: Calibration | None = RIG,
        **asked: Any,
    ) -> AcceptanceResult:
        positioner = TamePositioner(tuple(step.name for step in plan.steps) if names is None else names)
        rig = Rig("tame", {}, TameProjector(), {}, calibration, positioner=positioner)
        take_scans_from(monkeypatch, plan, scan)
        folder = DataFolder(tmp_path / "data")
        database = Database(folder.database)
        manager = TameManager(JobStore(database), folder, rig, TameCompute(PIPELINE))
        manager.cancelled = cancelled
        try:
            stated = replace(plan, rendered=False)
            return measure_positions(manager, stated, tmp_path / "out", **asked)
        finally:
            database.close()
            folder.release()

    return go


def shortened(*names: str, repeats: int = 2) -> AcceptancePlan:
    steps = tuple(step for step in PLAN.steps if step.name in names)
    return replace(PLAN, steps=steps, repeats=repeats)


SHORT = replace(
    shortened("sphere-1", "sphere-2", "bar-1", "plane-1"),
    # The certificates' uncertainties have room below these.
    limits=Limits(form_mm=0.04, size_mm=0.02, spacing_mm=0.02, flatness_mm=0.04),
)


def test_a_run_measures_every_position_and_writes_what_it_found(
    run: Callable[..., AcceptanceResult], tmp_path: Path
) -> None:
    result = run(SHORT)
    assert result.complete
    assert result.decision is Decision.PASSES
    written = json.loads((tmp_path / "out" / "report.json").read_text())
    assert written["format"] == "slrig-acceptance"
    assert written["decision"] == "passes"
    assert "No conformity" in written["manner"]
    assert [each["quantity"] for each in written["quantities"]] == ["PF", "PS", "SD", "F"]
    assert sum(len(position["captures"]) for position in written["positions"]) == 4 + 3
    capture = written["positions"][0]["captures"][0]
    kept = np.load(tmp_path / "out" / capture["points_file"])
    assert (kept["artefact"] == 1).sum() == capture["points_used"]
    # The kept points give the same figure again, without slrig.
    used = kept["points_mm"][kept["artefact"] == 1].astype(np.float64)
    radial = np.linalg.norm(used - SHORT.steps[0].centre_mm, axis=1)
    assert 2 * radial.mean() - 30 == pytest.approx(capture["errors_mm"]["PS"], abs=0.001)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"positions", "report.json", "report.html"}


def test_the_page_holds_everything_and_says_what_it_is_not(
    run: Callable[..., AcceptanceResult], tmp_path: Path
) -> None:
    artefacts = replace(SHORT.artefacts, certificate="<script>alert(1)</script>")
    run(replace(SHORT, notes="after <moving> the bench", artefacts=artefacts))
    page = (tmp_path / "out" / "report.html").read_text()
    assert "No conformity" in page
    assert "after &lt;moving&gt; the bench" in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert page.count("data:image/jpeg;base64,") == 4
    assert "http://" not in page.replace("http://www.w3.org/2000/svg", "")
    assert "<script" not in page


@parametrize_core(
    ("asked", "error", "words"),
    [
        ({"names": ("sphere-1", "pose 2")}, UnsupportedByDeviceError, "needs the positions sphere-2, bar-1, plane-1"),
        ({"names": ()}, UnsupportedByDeviceError, "no positioner"),
        ({"calibration": None}, CalibrationError, "has no calibration"),
    ],
)
def test_rig_that_cannot_be_tested_is_refused_before_anything_is_written(
    run: Callable[..., AcceptanceResult], tmp_path: Path, asked: dict[str, Any], error: type[SlrigError], words: str
) -> None:
    with pytest.raises(error, match=words):
        run(SHORT, **asked)
    assert not (tmp_path / "out").exists()


def test_a_cancelled_test_keeps_its_points_and_writes_no_report(
    run: Callable[..., AcceptanceResult], tmp_path: Path
) -> None:
    # While the first capture of the second position is taken.
    with pytest.raises(ScanCancelledError, match="cancelled before sphere-2"):
        run(SHORT, cancelled=lambda: any((tmp_path / "data").rglob("sphere-1/readings.json")))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["positions"]
    kept = (tmp_path / "out" / "positions" / "sphere-1").iterdir()
    assert sorted(path.name for path in kept) == ["1.npz", "2.npz"]


@pytest.mark.slow
def test_an_artefact_that_was_not_found_is_placed_again(run: Callable[..., AcceptanceResult]) -> None:
    plan = shortened("sphere-1", "sphere-2", repeats=1)
    placed: list[str] = []
    refused: list[str] = []

    def scan(step: Step) -> Mesh:
        # The person had forgotten the sphere.
        forgotten = step.name == "sphere-2" and placed.count("sphere-2") == 1
        return scan_of(step_of(Artefact.PLANE)) if forgotten else scan_of(step)

    class Hand(Person):
        def place(self, step: Step) -> None:
            placed.append(step.name)

        def read(self, step: Step, error: SlrigError) -> None:
            refused.append(f"{step.name} {error}")

    result = run(plan, scan=scan, person=Hand(plan, Console()))
    assert placed == ["sphere-1", "sphere-2", "sphere-2"]
    assert result.complete
    assert len(refused) == 1
    assert "found 0" in refused[0]


RECORD = AcceptanceRecord(
    3,
    UUID(int=7),
    datetime(2026, 11, 22, 8, 30, 0, 250_000, tzinfo=UTC),
    "bench",
    "0123456789ab",
    replace(PLAN, exposure_s=0.02, notes="after the move"),
    AcceptanceState.OPEN,
    (measured("sphere-1", 0, 0.004), replace(measured("sphere-1", 1, -0.001), noise_mm=math.nan)),
    decision=Decision.UNDECIDED,
)


def test_a_record_survives_its_json() -> None:
    text = record_json(RECORD)
    found = record_from_json(text, "test.json")
    assert record_json(found) == text
    assert math.isnan(found.readings[1].noise_mm)
    assert found.readings[0] == RECORD.readings[0]
    assert replace(found, plan=RECORD.plan, readings=()) == replace(RECORD, readings=())
    assert [step.name for step in found.plan.steps] == [step.name for step in PLAN.steps]
    for mine, theirs in zip(found.plan.steps, PLAN.steps, strict=True):
        np.testing.assert_array_equal(mine.centre_mm, theirs.centre_mm)
        np.testing.assert_array_equal(mine.axis, theirs.axis)
    np.testing.assert_array_equal(found.plan.volume_mm, PLAN.volume_mm)
    assert (found.plan.artefacts, found.plan.limits) == (PLAN.artefacts, PLAN.limits)


def test_position_starts_from_its_first_capture_where_repeats_are_missing() -> None:
    one = replace(RECORD, readings=RECORD.readings[:1])
    assert one.from_first_take().readings == ()
    # Both captures of the first position are there, and the second position follows.
    assert RECORD.from_first_take().readings == RECORD.readings
    assert json.loads(record_json(RECORD))["readings"][1]["noise_mm"] is None


LENGTH_MM = 110.0
BAR = replace(GOOD, distance=Certified(LENGTH_MM, 0.002), expansion_per_k=0.0)

POINTS = ReadingPoints(np.array([[0.0, 0.0, 0.0]]), np.ones(1, np.uint8), np.zeros(1), np.zeros(1))


def of_bars(share: float, *, scatter_mm: float = 0.004, places: int = 7, seed: int = 3) -> list[Reading]:
    """A bar in places, the first measured three times, by a rig that measures everything too long by a share."""
    off = np.random.default_rng(seed).normal(share * LENGTH_MM, scatter_mm, places)
    first = [measured("bar-1", take, off[0]) for take in range(3)]
    return [*first, *(measured(f"bar-{place + 1}", 0, off[place]) for place in range(1, places))]


@pytest.mark.parametrize(
    ("share", "words"),
    [(0.002, "longer .* so much smaller"), (-0.009, "shorter .* larger"), (0.0, None), (0.0008, None)],
)
def test_scale_of_a_thousandth_or_more_is_blamed_on_the_board(share: float, words: str | None) -> None:
    found = scale_by_bar(of_bars(share), BAR)
    assert found is not None
    assert found.places == 7
    assert abs(found.share - share) < 3 * found.sigma < 1e-4
    if words is None:
        assert found.words is None
    else:
        assert re.search(words, found.words or "")
        assert f"{abs(found.share):.2%}" in (found.words or "")
    # Two places do not tell it.
    assert scale_by_bar(of_bars(share, places=2), BAR) is None


@pytest.mark.parametrize("artefacts", [BAR, replace(BAR, distance=Certified(LENGTH_MM, 0.2))])
def test_scale_that_places_or_certificate_leave_open_is_not_stated(artefacts: Artefacts) -> None:
    scattered = artefacts is BAR
    found = scale_by_bar(of_bars(0.002, scatter_mm=0.4 if scattered else 0.004), artefacts)
    assert found is not None
    assert found.sigma > 0.0008
    assert found.words is None


def test_wrong_scale_is_shown_on_terminal_and_page() -> None:
    when = datetime(2026, 11, 27, tzinfo=UTC)

    def result(share: float) -> AcceptanceResult:
        readings = tuple(of_bars(share))
        return AcceptanceResult("bench", when, when, PLAN, RIG, readings, verdicts(readings, PLAN))

    for each, wrong in ((result(0.002), True), (result(0.0), False)):
        terminal = Console(file=StringIO(), width=300)
        print_result(each, terminal)
        page = report_html(each, lambda _: POINTS)
        assert isinstance(terminal.file, StringIO)
        for text in (terminal.file.getvalue(), page):
            assert ("The bar measures 0.20" in text) is wrong
        assert document(each)["scale"] == each.scale
