"""The rig files that we ship for live devices, and what config/README.md says about rig files."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from drivers.serial_projector.device import main as box
from slrig.cli.init import failure_of
from slrig.config import RigConfig, read_rig
from slrig.option_models import described_drivers

CONFIG = Path(__file__).resolve().parents[2] / "config"
README = (CONFIG / "README.md").read_text(encoding="utf-8")
LIVE = {
    "webcams-and-hdmi": ("screen", ["v4l2", "v4l2"]),
    "oak-and-screen": ("screen", ["depthai", "depthai"]),
    "trigger-box-and-genicam": ("serial_projector", ["genicam"]),
    "lightcrafter-4500-and-two-cameras": ("dlpc350", ["genicam", "genicam"]),
    "lightcrafter-6500-and-two-cameras": ("dlpc900", ["genicam", "genicam"]),
}


def taken_by_its_drivers(path: Path) -> RigConfig:
    rig = read_rig(path)
    tables = [table for table in (rig.head, rig.projector, *rig.cameras) if table is not None]
    assert tables
    for table in tables:
        assert table.driver in described_drivers("slrig")
        assert failure_of(table.driver, table.options) == ""
    return rig


@pytest.mark.parametrize("path", sorted((CONFIG / "rigs").glob("*.toml")), ids=lambda path: path.stem)
def test_every_rig_file_is_taken_by_its_drivers(path: Path) -> None:
    taken_by_its_drivers(path)


@pytest.mark.parametrize("name", LIVE)
def test_the_usual_kits_have_a_rig_file_with_comments(name: str) -> None:
    path = CONFIG / "rigs" / f"{name}.toml"
    rig = taken_by_its_drivers(path)
    assert rig.name == name
    assert rig.projector is not None
    assert (rig.projector.driver, [camera.driver for camera in rig.cameras]) == LIVE[name]
    assert f"(rigs/{name}.toml)" in README
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0] == "#:schema ../schema.json"
    assert (path.parent / "../schema.json").is_file()
    assert sum("#" in line for line in lines) > len(lines) / 3
    for camera in rig.cameras:
        assert camera.exposure_s is not None
        if rig.projector.driver == "screen":
            periods = camera.exposure_s * 60
            assert abs(periods - round(periods)) < 0.01


def test_what_is_commented_out_in_a_rig_file_could_be_used(tmp_path: Path) -> None:
    for name in LIVE:
        text = (CONFIG / "rigs" / f"{name}.toml").read_text(encoding="utf-8")
        used = re.sub(r"^# ((?:\[\w+\]|\w+ = ).*)$", r"\1", text, flags=re.MULTILINE)
        assert used != text
        (tmp_path / "rig.toml").write_text(used, encoding="utf-8")
        taken_by_its_drivers(tmp_path / "rig.toml")


def test_the_rig_file_of_the_readme_is_one(tmp_path: Path) -> None:
    blocks = re.findall(r"```toml\n(.*?)```", README, re.DOTALL)
    (tmp_path / "rig.toml").write_text(blocks[0], encoding="utf-8")
    rig = taken_by_its_drivers(tmp_path / "rig.toml")
    assert rig.synchronisation is not None
    assert rig.refuse_when_stale
    assert all(tomllib.loads(block) is not None for block in blocks)


@pytest.mark.parametrize("pin", ["STEP", "HOME", "LAMP", "CAMERA", "READY", "SERVICE"])
def test_the_wiring_of_the_readme_is_that_of_the_firmware(pin: str) -> None:
    assert f"| GP{getattr(box, f'{pin}_PIN')} | {pin}, " in README
    assert "912 × 1140" in README
    assert (box.WIDTH_PX, box.HEIGHT_PX) == (912, 1140)


def test_the_readme_stays_short() -> None:
    assert len(README.splitlines()) <= 200
