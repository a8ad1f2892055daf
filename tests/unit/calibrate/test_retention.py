"""Old calibrations removed: the newest, the one in use, one under way and those that scans name are kept."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from uuid import UUID, uuid4

import pytest
from structlog.testing import capture_logs

from slrig.bundle.calibration_file import write_calibration
from slrig.calibrate.retention import Retention, named_by_scans
from tests.unit.calibrate.calibration_bench import CalibrationBench, tame_calibration


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[CalibrationBench]:
    bench = CalibrationBench(tmp_path)
    bench.runner.start()
    yield bench
    bench.close()


def ids(bench: CalibrationBench) -> list[UUID]:
    return [record.id for record in bench.calibrations.latest()]


def a_scan(bench: CalibrationBench, *, report: object = None, bundle: UUID | None = None) -> None:
    """The folder of a scan that names a calibration in its report, or has its file in its bundle."""
    folder = bench.folder.scan(uuid4())
    (folder / "bundle").mkdir(parents=True)
    if report is not None:
        (folder / "report.json").write_text(json.dumps(report))
    if bundle is not None:
        store = bench.calibrations.store
        shutil.copy(store.solve(bundle, 1) / "calibration.json", folder / "bundle" / "calibration.json")


def test_only_what_is_neither_new_nor_needed_is_removed(bench: CalibrationBench) -> None:
    in_report, twice, in_bundle, active, empty, unused, newest = (
        *(bench.solved() for _ in range(4)), bench.session(), bench.solved(), bench.session(),
    )  # fmt: skip
    bench.calibrations.solves.solve(twice)
    bench.until_session(twice, lambda found: found.solve == 2)
    bench.calibrations.activate(active)
    a_scan(bench, report={"calibration": {"id": str(in_report)}})
    a_scan(bench, report={"calibration": {"id": f"{twice}.2"}})
    a_scan(bench, bundle=in_bundle)
    nothings: list[object] = [{}, [], "not a report"]
    for nothing in nothings:
        a_scan(bench, report=nothing)
    places = [bench.calibrations.store.folder(each) for each in (empty, unused)]
    assert all(place.is_dir() for place in places)
    assert Retention(bench.calibrations, bench.folder, keep=7)() == ()
    with capture_logs() as log:
        assert Retention(bench.calibrations, bench.folder, keep=1)() == (empty, unused)
    told = [each["calibration"] for each in log if each["event"] == "old calibration removed"]
    assert told == [str(empty), str(unused)]
    assert not any(place.exists() for place in places)
    assert ids(bench) == [newest, active, in_bundle, twice, in_report]
    assert Retention(bench.calibrations, bench.folder, keep=1)() == ()


def test_a_pose_under_way_keeps_its_session(bench: CalibrationBench) -> None:
    old = bench.session()
    bench.held_pose(old)
    bench.session()
    tidy = Retention(bench.calibrations, bench.folder, keep=1)
    assert tidy() == ()
    bench.gate.set()
    bench.until_pose(old, 1)
    assert tidy() == (old,)


def test_one_that_states_no_error_is_known_by_its_numbers(bench: CalibrationBench, tmp_path: Path) -> None:
    given = tmp_path / "given.json"
    kept, gone = (tame_calibration(focal_px=focal) for focal in (80.0, 90.0))
    imported = []
    for each in (kept, gone):
        write_calibration(given, each)
        document = json.loads(given.read_text())
        document.pop("solved")
        imported.append(bench.calibrations.submit(json.dumps(document).encode(), ".json").id)
    bench.session()
    a_scan(bench, report={"calibration": {"id": kept.digest}})
    assert named_by_scans(bench.folder.scans) == {kept.digest}
    tidy = Retention(bench.calibrations, bench.folder, keep=1, named=lambda: {gone.digest})
    # Others than scans name them too.
    assert tidy() == ()
    assert Retention(bench.calibrations, bench.folder, keep=1)() == (imported[1],)
