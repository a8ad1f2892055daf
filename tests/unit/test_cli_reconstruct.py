"""`slrig reconstruct` of several bundles: which are meant, what fails alone, and what is told at the end."""

from __future__ import annotations

import gc
import json
import shutil
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import Result

from slrig.bundle import write_bundle
from slrig.cli.commands import INTERRUPTED
from slrig.errors import NothingToReconstructError
from slrig.jobs.listener import Listener
from slrig.scan.artefacts import staged_folder
from slrig.scan.preparation import sample_scan
from tests.unit.command import slrig


class Report(dict[str, object]):
    """A report that tells when it is gone."""


class Reconstruction:
    """Stands in for the reconstruction: writes a mesh, and does to some bundles what a test wants."""

    def __init__(self) -> None:
        self.prepared = 0
        self.seen: list[str] = []
        self.counts_kept = False
        self.kept: list[int] = []
        self.wanted: dict[str, Callable[[], None]] = {}
        self._reports: list[weakref.ref[Report]] = []

    def prepare(self, _display: object) -> int:
        self.prepared += 1
        return 0

    def __call__(self, bundle: Path, output: Path, listener: Listener, **_: object) -> Report:
        if self.counts_kept:
            gc.collect()
            self.kept.append(sum(each() is not None for each in self._reports))
        self.seen.append(bundle.name)
        with staged_folder(output) as staging:
            (staging / "mesh.ply").write_text(bundle.name)
            listener.report("decode", 0.5, "")
            self.wanted.get(bundle.name, lambda: None)()
            (staging / "report.json").write_text('{"format": "slrig-report"}')
        listener.report("done", 1.0, "")
        mesh = {
            "figures": {"triangles": 1234, "vertices": 617},
            "sigma_mm": {"p50": 0.0123},
            "covers_of_decoded": 0.875,
        }
        report = Report(mesh=mesh, notes=["look"] if bundle.name == "scan-2" else [])
        self._reports.append(weakref.ref(report))
        return report


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> Reconstruction:
    work = Reconstruction()
    monkeypatch.setattr("slrig.scan.reconstruct.reconstruct_bundle", work)
    monkeypatch.setattr("slrig.cli.reconstruct.prepare_kernels", work.prepare)
    return work


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "bundle"
    write_bundle(folder, *sample_scan())
    return folder


@pytest.fixture
def scans(tmp_path: Path, recorded: Path) -> Path:
    """scan-1, scan-2 and scan-10, and a folder that is no bundle."""
    for name in ("scan-10", "scan-1", "scan-2"):
        shutil.copytree(recorded, tmp_path / "scans" / name)
    (tmp_path / "scans" / "notes").mkdir()
    (tmp_path / "scans" / ".scan-3.part").mkdir()
    return tmp_path / "scans"


def run(*words: object) -> Result:
    return slrig("reconstruct", *words)


def rows(result: Result) -> list[list[str]]:
    return [line.split() for line in result.stdout.partition("\n\n")[0].splitlines()[1:]]


def within(folder: Path) -> list[str]:
    return sorted(each.name for each in folder.iterdir())


@pytest.mark.slow
def test_bundles_are_reconstructed_with_the_files_and_the_calibration_that_were_given(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("slrig.cli.reconstruct.prepare_kernels", lambda _: 0)
    out = tmp_path / "out"
    for name in ("scan-1", "scan-2"):
        calibration = (scans / name / "calibration.json").rename(tmp_path / "elsewhere.json")
    chosen = [word for name in ("points-sample.npz", "mesh.stl", "mesh.ply") for word in ("--file", name)]
    result = run(scans / "scan-1", scans / "scan-2", "--output", out, "--calibration", calibration, *chosen)
    assert result.exit_code == 0, result.output
    triangles = json.loads((out / "scan-1" / "report.json").read_text())["mesh"]["figures"]["triangles"]
    assert [row[:2] for row in rows(result)] == [["scan-1", f"{triangles:,}"], ["scan-2", f"{triangles:,}"]]
    assert (out / "scan-1" / "mesh.ply").read_bytes() == (out / "scan-2" / "mesh.ply").read_bytes()
    assert within(out / "scan-1") == within(out / "scan-2")
    assert f"npz       {out / '*' / 'points-sample.npz'}" in result.stdout
    assert result.stdout.count("mesh.ply") == 1
    assert (out / "scan-1" / "mesh.stl").is_file()
    with np.load(out / "scan-1" / "points-sample.npz") as cloud:
        assert np.isfinite(cloud["points_mm"]).all(axis=2).mean() > 0.5


def test_folder_of_bundles_is_worked_through_in_natural_order(
    scans: Path, tmp_path: Path, work: Reconstruction
) -> None:
    out = tmp_path / "out"
    result = run(scans, "--output", out)
    assert result.exit_code == 0, result.output
    assert (work.seen, work.prepared) == (["scan-1", "scan-2", "scan-10"], 1)
    assert within(out) == ["scan-1", "scan-10", "scan-2"]
    assert f"skipped   no bundle.json in notes of {scans}" in result.stderr
    assert "2 of 3: scan-2" in result.stderr
    assert rows(result)[1][:5] == ["scan-2", "1,234", "0.0123", "mm", "87.5%"]
    assert rows(result)[1][6:] == ["1", "note", "in", "report.json"]
    words = ["", "bundles   3 done", *(f"{what:<10}{out}/*/{name}" for what, name in (
        ("mesh", "mesh.ply"), ("preview", "preview.png"), ("report", "report.json"),
    ))]  # fmt: skip
    assert result.stdout.splitlines()[4:] == words


@pytest.mark.usefixtures("work")
def test_bundles_are_named_by_folder_pattern_scan_or_place(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for scan in ("scan-1", "scan-2"):
        shutil.copytree(scans / scan, tmp_path / "data" / f"id-{scan}" / "bundle")
    monkeypatch.chdir(scans / "scan-1")
    for number, (words, names) in enumerate(
        (
            ((tmp_path / "data",), ["id-scan-1", "id-scan-2"]),
            (sorted((tmp_path / "data").glob("*/bundle")), ["id-scan-1", "id-scan-2"]),
            # A pattern that no shell expanded; one bundle is one, however it was named.
            ((scans / "scan-1*", scans / "scan-1"), ["scan-1", "scan-10"]),
            ((".", "../scan-2"), ["scan-1", "scan-2"]),
        )
    ):
        out = tmp_path / f"out-{number}"
        result = run(*words, "--output", out)
        assert (result.exit_code, within(out)) == (0, names), result.output
    assert run(scans / "*-2", "--output", tmp_path / "one").exit_code == 0
    assert (tmp_path / "one" / "mesh.ply").read_text() == "scan-2"


def test_broken_bundles_do_not_stop_the_others(scans: Path, tmp_path: Path, work: Reconstruction) -> None:
    (scans / "scan-2" / "bundle.json").write_text("{}")
    shutil.copytree(scans / "scan-10", scans / "scan-3")

    def dark() -> None:
        raise NothingToReconstructError("the lens cap is on")

    work.wanted["scan-3"] = dark
    out = tmp_path / "out"
    result = run(scans, scans / "absent", "--output", out)
    assert result.exit_code == 2, result.output
    assert work.seen == ["scan-1", "scan-3", "scan-10"]
    assert within(out) == ["scan-1", "scan-10"]
    assert {row[0]: row[-2:] for row in rows(result) if "failed:" in row} == {
        "scan-2": ["failed:", "bundle"],
        "scan-3": ["failed:", "nothing-to-reconstruct"],
        "absent": ["failed:", "bundle"],
    }
    assert [row[0] for row in rows(result)] == ["scan-1", "scan-2", "scan-3", "scan-10", "absent"]
    assert "bundles   2 done, 3 failed" in result.stdout
    # Files are looked at before anything is computed, and each error is told when it comes.
    first_done = result.stderr.index("1 of 5: scan-1")
    assert result.stderr.index(f"error: {scans / 'scan-2' / 'bundle.json'} is not a valid") < first_done
    assert result.stderr.index(f"error: {scans / 'absent'} is not a scan bundle") < first_done
    assert result.stderr.index(f"error: {scans / 'scan-3'}: the lens cap is on") > first_done
    # The one that comes next begins with the stage that failed, and is told all the same.
    assert result.stderr.count("decode ") == 3


def test_defect_is_shown_with_its_place_and_is_the_worst(scans: Path, tmp_path: Path, work: Reconstruction) -> None:
    (scans / "scan-1" / "bundle.json").write_text("{}")

    def defect() -> None:
        raise ZeroDivisionError("of nobody's doing")

    work.wanted["scan-2"] = defect
    result = run(scans, "--output", tmp_path / "out")
    assert result.exit_code == 1
    assert work.seen == ["scan-2", "scan-10"]
    assert rows(result)[1] == ["scan-2", "failed:", "unexpected"]
    assert "ZeroDivisionError: of nobody's doing" in result.stderr


def test_nothing_is_computed_that_could_only_be_refused(scans: Path, tmp_path: Path, work: Reconstruction) -> None:
    out, one, file = tmp_path / "out", tmp_path / "one", tmp_path / "file"
    file.write_text("")
    assert run(scans / "scan-1", "--output", one).exit_code == 0
    work.prepared, work.seen = 0, []
    shutil.copytree(scans / "scan-1", tmp_path / "other" / "Scan-1")
    (tmp_path / "empty" / "inner").mkdir(parents=True)
    names = f"the same name: {scans / 'scan-1'}, {tmp_path / 'other' / 'Scan-1'}. Rename"
    for words, expected in (
        *(
            ((scans / "scan-1", "--output", out, "--file", name), f"it gives no {name}. There are: mesh.ply, ")
            for name in ("points-left.npz", "bundle.zip", "../mesh.stl")
        ),
        (
            (tmp_path / "empty", "--output", out),
            "there is no bundle.json in it; give the folder that holds bundle.json",
        ),
        ((scans, tmp_path / "other" / "Scan-1", "--output", out), names),
        ((scans, "--output", file), "name a new folder"),
        ((scans, "--output", one), "name a new folder"),
    ):
        result = run(*words)
        assert (result.exit_code, expected in result.stderr) == (2, True), result.stderr
    for each in scans.glob("scan-*"):
        (each / "bundle.json").write_text("{}")
    result = run(scans, "--output", out)
    assert (result.exit_code, result.stdout.splitlines()[-1]) == (2, "bundles   3 failed")
    assert (work.prepared, work.seen) == (0, [])


def test_ctrl_c_ends_all_and_shows_what_is_done(scans: Path, tmp_path: Path, work: Reconstruction) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    work.wanted["scan-2"] = interrupted
    result = run(scans, "--output", tmp_path / "out")
    assert result.exit_code == INTERRUPTED
    assert work.seen == ["scan-1", "scan-2"]
    assert within(tmp_path / "out") == ["scan-1"]
    assert [row[0] for row in rows(result)] == ["scan-1"]
    assert "bundles   1 done, 2 not done" in result.stdout


@pytest.mark.slow
def test_nothing_of_a_bundle_is_kept_while_the_next_is_worked_on(
    scans: Path, tmp_path: Path, work: Reconstruction
) -> None:
    large: list[weakref.ref[Any]] = []

    class Held:
        pass

    def fails() -> None:
        held = Held()
        large.append(weakref.ref(held))
        raise NothingToReconstructError(str(held))

    work.wanted["scan-2"], work.counts_kept = fails, True
    assert run(scans, "--output", tmp_path / "out").exit_code == 2
    assert work.kept == [0, 0, 0]
    assert [each() for each in large] == [None]


def test_several_are_decoded_alone_too(scans: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (scans / "scan-2" / "bundle.json").write_text("{}")
    for each in scans.glob("scan-*"):
        (each / "calibration.json").unlink()
    result = run(scans, "--output", out, "--decode-only")
    assert result.exit_code == 2, result.output
    assert [row[:3] for row in rows(result)] == [
        ["scan-1", "sample,", "columns"],
        ["scan-2", "failed:", "bundle"],
        ["scan-10", "sample,", "columns"],
    ]
    assert within(out) == ["scan-1", "scan-10"]
    assert (out / "scan-10" / "position-sample-column.tiff").is_file()
    assert result.stdout.splitlines()[-1] == f"pictures  {out}/*"
