"""Rig files with the values of an examination: whole, readable, and otherwise what they were."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from slrig.config import read_rig
from slrig.devices import Synchronisation
from slrig.doctor.advice import ExposureAdvice
from slrig.doctor.doctor import Diagnosis
from slrig.doctor.findings import fault, ok
from slrig.doctor.rig_file import write_rig_file
from slrig.errors import ConfigError, StorageError

OLD = """
# A comment that is not kept.
name = "bench \\u007f \\"two\\""
calibration = "calibrations/bench.json"

[projector]
driver = "screen"
output = "DP-2"
odd-key = {"a b" = [1, 2.5, true], when = 2026-02-03T04:05:06Z}
nested = [[1, 2], ["x"]]
[projector.timing]
latency_s = 0.03

[[camera]]
name = "left"
driver = "v4l2"
device = "usb-1"
exposure_s = 0.5
[camera.controls]
focus = 7
[[camera.list]]
value = 1
[[camera.list]]
value = 1e-07

[[camera]]
name = "right"
driver = "v4l2"
device = "usb-2"
gain = 2.0

[scan]
line_shift_period_px = 12
exposure_s = 0.25
"""


def diagnosis(*, synchronisation: Synchronisation | None = None, cameras: tuple[str, ...] = ("left",)) -> Diagnosis:
    return Diagnosis(
        rig="bench",
        findings=(
            fault("timing.late", "projector", "light comes late, by\nfar", "write it down"),
            ok("light.part", "camera 'left'", "all is lit"),
        ),
        exposures={
            name: ExposureAdvice(1 / 60 + index / 100, "1 × the refresh period", (0.002, 0.03))
            for index, name in enumerate(cameras)
        },
        synchronisation=synchronisation,
        refresh_hz=60.0,
        response=None,
        flickers=(),
    )


@pytest.fixture
def old(tmp_path: Path) -> Path:
    (tmp_path / "calibrations").mkdir()
    (tmp_path / "calibrations" / "bench.json").write_text("{}")
    path = tmp_path / "old.toml"
    path.write_text(OLD)
    return path


def test_the_new_file_is_the_old_one_with_what_was_measured(old: Path) -> None:
    new = old.with_name("new.toml")
    measured = Synchronisation(0.0412345678, 0.0031, {"left": 3.0004e-5})
    write_rig_file(diagnosis(synchronisation=measured), old, new, force=False)
    expected = tomllib.loads(OLD)
    expected["camera"][0]["exposure_s"] = 0.0166667
    # One exposure of all scans would hide that of the camera.
    del expected["scan"]["exposure_s"]
    expected["synchronisation"] = {
        "latency_s": 0.041235,
        "latency_error_s": 0.0031,
        "line_time_s": {"left": 3.0004e-5},
    }
    assert tomllib.loads(new.read_text()) == expected
    read = read_rig(new)
    assert read.synchronisation is not None
    assert read.cameras[0].exposure_s == 0.0166667
    assert read.calibration == old.parent / "calibrations" / "bench.json"
    # Every value has a comment that says why.
    lines = new.read_text().splitlines()
    for key, words in (
        ("exposure_s = 0.0166667", "# 1 × the refresh period; usable are 2 ms to 30 ms"),
        ("latency_s = 0.041235", "# measured by flashes"),
        ("latency_error_s = 0.0031", "# and how much later"),
    ):
        assert lines[lines.index(key) - 1].startswith(words)
    assert lines[0] == "# Written by slrig doctor, from old.toml."
    assert "# Fault, projector: light comes late, by far. Do: write it down." in lines


def test_paths_count_from_the_new_folder(old: Path) -> None:
    folder = old.parent / "elsewhere"
    folder.mkdir()
    write_rig_file(diagnosis(), old, folder / "new.toml", force=False)
    read = read_rig(folder / "new.toml")
    assert read.calibration is not None
    assert read.calibration.resolve() == (old.parent / "calibrations" / "bench.json").resolve()
    # What names no file stays.
    assert read.cameras[0].options["device"] == "usb-1"


def test_a_head_has_one_exposure_the_shortest(tmp_path: Path) -> None:
    old = tmp_path / "old.toml"
    old.write_text('name = "head"\n[head]\ndriver = "simulated"\n')
    write_rig_file(diagnosis(cameras=("left", "right")), old, tmp_path / "new.toml", force=False)
    read = read_rig(tmp_path / "new.toml")
    assert read.head is not None
    assert read.head.exposure_s == 0.0166667


def test_a_file_is_overwritten_only_by_force(old: Path) -> None:
    new = old.with_name("new.toml")
    new.write_text("precious")
    with pytest.raises(ConfigError, match="exists, and is kept; choose another name"):
        write_rig_file(diagnosis(), old, new, force=False)
    assert new.read_text() == "precious"
    write_rig_file(diagnosis(), old, new, force=True)
    assert read_rig(new).cameras[0].exposure_s == 0.0166667
    with pytest.raises(StorageError, match="create the folder first"):
        write_rig_file(diagnosis(), old, old.parent / "absent" / "new.toml", force=False)
    assert sorted(each.name for each in old.parent.iterdir()) == ["calibrations", "new.toml", "old.toml"]
