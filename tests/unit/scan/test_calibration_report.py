"""A scan carries its calibration: which one, how old, and its share of every vertex's standard deviation."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from slrig.bundle import BundleWriter, read_bundle, read_calibration, write_calibration
from slrig.bundle.description import read_description
from slrig.errors import BundleError
from slrig.model import Calibration, Solved
from slrig.scan.artefacts import write_converted
from slrig.scan.plan import ReconstructionPlan
from slrig.scan.reconstruct import reconstruct_bundle
from slrig.scan.report import calibration_report
from tests.prepared_bundles import prepared_bundle

BOX = np.array([[-40.0, -40, -40], [40, 40, 40]])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepared_bundle(tmp_path_factory, "ball")


def stating(calibration: Calibration, scale: float = 1.0, solved_at: str = "2026-01-02T03:04:05+00:00") -> Calibration:
    """The calibration with an error of its own: the projector's principal point and place, in px and mm."""
    deviations = np.zeros(30)
    deviations[[15 + 2, 15 + 12, 15 + 14]] = 0.05 * scale, 0.02 * scale, 0.03 * scale
    return replace(calibration, solved=Solved("solve-7", solved_at, np.diag(deviations**2), BOX, 0.0123))


def run(bundle: Path, output: Path, calibration: Path | None = None) -> dict[str, Any]:
    report = reconstruct_bundle(
        bundle, output, plan=ReconstructionPlan(), calibration=calibration, progress=lambda *_: None,
        cancelled=lambda: False,
    )  # fmt: skip
    written: dict[str, Any] = json.loads((output / "report.json").read_text())
    assert written["calibration"] == report["calibration"]
    return written


def vertices(path: Path) -> dict[str, NDArray[Any]]:
    data = trimesh.load(path, process=False).metadata["_ply_raw"]["vertex"]["data"]
    return {name: data[name].ravel() for name in data.dtype.names}


@pytest.fixture(scope="module")
def exact(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    output = tmp_path_factory.mktemp("exact") / "out"
    return output, run(recorded, output)


@pytest.fixture(scope="module")
def solved(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("solved")
    write_calibration(folder / "solved.json", stating(read_calibration(recorded / "calibration.json")))
    return folder / "out", run(recorded, folder / "out", folder / "solved.json")


@pytest.mark.slow
def test_every_vertex_states_its_share(
    recorded: Path, exact: tuple[Path, dict[str, Any]], solved: tuple[Path, dict[str, Any]]
) -> None:
    output, report = solved
    for name in ("mesh.ply", "points.ply"):
        before, found = vertices(exact[0] / name), vertices(output / name)
        assert [key for key in found if key not in before] == ["sigma_calibration_mm"]
        share = found["sigma_calibration_mm"]
        assert np.isfinite(share).all()
        assert (share > 0).all()
        assert found["sigma_mm"] == pytest.approx(np.hypot(before["sigma_mm"], share), rel=1e-5)
        for key in before:
            # The points themselves are the same.
            assert key == "sigma_mm" or np.array_equal(found[key], before[key], equal_nan=True)
    data = vertices(output / "mesh.ply")
    told = report["calibration"]
    assert exact[1]["calibration"]["absent"]
    assert told["id"] == "solve-7"
    assert told["solved_at"] == "2026-01-02T03:04:05+00:00"
    assert told["expected_error_mm"] == 0.0123
    assert told["sigma_share"] == pytest.approx(
        np.median((data["sigma_calibration_mm"] / data["sigma_mm"]) ** 2), rel=1e-4
    )
    assert told["sigma_calibration_mm"] == pytest.approx(np.median(data["sigma_calibration_mm"]), rel=1e-4)
    captured_at = read_description(recorded).captured_at
    assert captured_at is not None
    assert told["age_days"] == pytest.approx(captured_at.timestamp() / 86400 - 1767323045 / 86400, abs=1e-3)
    write_converted(output, "mesh.stl")
    write_converted(exact[0], "mesh.stl")
    assert (output / "mesh.stl").read_bytes() == (exact[0] / "mesh.stl").read_bytes()


@pytest.mark.slow
def test_twice_the_error_has_twice_the_share(
    recorded: Path, solved: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    write_calibration(tmp_path / "twice.json", stating(read_calibration(recorded / "calibration.json"), 2.0))
    run(recorded, tmp_path / "out", tmp_path / "twice.json")
    once, twice = (vertices(each / "mesh.ply")["sigma_calibration_mm"] for each in (solved[0], tmp_path / "out"))
    assert twice == pytest.approx(2 * once, rel=1e-4)


def test_a_calibration_that_says_nothing_of_its_error_has_an_id_and_words(recorded: Path) -> None:
    calibration = read_calibration(recorded / "calibration.json")
    told = calibration_report(calibration, recorded, np.ones(3, dtype=np.float32), None)
    assert told.pop("id") == calibration.digest
    assert "says nothing of its own error" in str(told.pop("absent"))
    assert told == dict.fromkeys(("solved_at", "age_days", "expected_error_mm", "sigma_share"))


@pytest.mark.parametrize(
    ("solved_at", "words"),
    [
        ("2026-01-02T03:04:05", "without the offset from UTC"),
        ("last week", "says 'last week' where the date of its solve should be"),
    ],
)
def test_an_age_that_is_not_known_is_null_with_the_reason(recorded: Path, solved_at: str, words: str) -> None:
    calibration = stating(read_calibration(recorded / "calibration.json"), solved_at=solved_at)
    told = calibration_report(calibration, recorded, np.ones(3, dtype=np.float32), np.full(3, 0.5))
    assert told["age_days"] is None
    assert words in str(told["age_absent"])
    assert told["sigma_share"] == 0.25


def test_a_bundle_that_does_not_say_when_it_was_captured(recorded: Path, tmp_path: Path) -> None:
    bundle = read_bundle(recorded)
    capture = bundle.capture
    with BundleWriter(tmp_path / "old", capture.projector, capture.patterns, capture.cameras) as writer:
        writer.add(capture.shots[0])
    assert "captured_at" not in (tmp_path / "old" / "bundle.json").read_text()
    calibration = stating(read_calibration(recorded / "calibration.json"))
    told = calibration_report(calibration, tmp_path / "old", np.ones(3, dtype=np.float32), np.full(3, np.nan))
    assert told["age_absent"] == "the bundle does not say when it was captured"
    assert told["sigma_share"] is None


def test_a_time_of_capture_without_offset_is_refused(recorded: Path, tmp_path: Path) -> None:
    data = json.loads((recorded / "bundle.json").read_text())
    (tmp_path / "bundle.json").write_text(json.dumps({**data, "captured_at": "2026-11-22T06:00:00"}))
    with pytest.raises(BundleError, match="captured_at"):
        read_description(tmp_path)
