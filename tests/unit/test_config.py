"""Rig files and service settings: every fault in one message, nothing converted in silence."""

from __future__ import annotations

import re
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest

from drivers.serial_projector.device import main as box
from slrig.bundle.options import ScanDefaults
from slrig.cli.rig_file import failure_of
from slrig.config import RigConfig, is_loopback, read_rig, read_settings
from slrig.discovery import drivers_with_options
from slrig.errors import ConfigError
from slrig.examples import EXAMPLES
from slrig.model import FlipRule
from slrig.scan.plan import PatternPlan, ReconstructionPlan, ScanPlan

BENCH = """
name = "bench"
calibration = "bench.json"
[projector]
driver = "serial_projector"
port = "/dev/serial/by-id/usb-1"
[[camera]]
name = "left"
driver = "v4l2"
device = "usb-2"
exposure_s = 0.0167
[[camera]]
name = "right"
driver = "v4l2"
device = "usb-3"
gain = 2
[scan]
line_shift_period_px = 8
depth_edge_ratio = 6
"""


def _rig(folder: Path, text: str) -> Path:
    (folder / "rig.toml").write_text(text)
    return folder / "rig.toml"


def test_a_bench_is_read(tmp_path: Path) -> None:
    rig = read_rig(_rig(tmp_path, BENCH))
    assert rig.name == "bench"
    assert rig.folder == tmp_path
    assert rig.calibration == tmp_path / "bench.json"
    assert rig.head is None
    assert rig.projector is not None
    assert rig.projector.driver == "serial_projector"
    assert rig.projector.options == {"port": "/dev/serial/by-id/usb-1"}
    assert [camera.name for camera in rig.cameras] == ["left", "right"]
    assert rig.cameras[0].options == {"device": "usb-2"}
    assert (rig.cameras[0].exposure_s, rig.cameras[0].gain) == (0.0167, 1.0)
    assert (rig.cameras[1].exposure_s, rig.cameras[1].gain) == (None, 2.0)
    assert rig.scan.line_shift_period_px == 8
    assert rig.scan.rows is None


def test_a_head_is_read(tmp_path: Path) -> None:
    rig = read_rig(_rig(tmp_path, 'name = "demo"\n[head]\ndriver = "simulated"\nexposure_s = 0.01\nseed = 3\n'))
    assert rig.head is not None
    assert rig.head.options == {"seed": 3}
    assert rig.head.exposure_s == 0.01
    assert rig.cameras == ()
    assert rig.calibration is None


def test_the_rules_of_the_mesh_are_read(tmp_path: Path) -> None:
    text = BENCH.replace("depth_edge_ratio = 6", 'flip_rule = "delaunay"\nsmooth_boundary = false')
    scan = read_rig(_rig(tmp_path, text)).scan
    assert (scan.flip_rule, scan.smooth_boundary) == (FlipRule.DELAUNAY, False)


def test_scan_defaults_are_the_fields_of_a_plan() -> None:
    plan = {field.name for part in (PatternPlan, ReconstructionPlan, ScanPlan) for field in fields(part)}
    # A pose may be shot without codes, a scan may not; a request makes a series, names a preset and turns a stage, no
    # rig file; a rig that is guessed has no calibration to give.
    of_requests = {"series", "preset", "turn_deg", "turned_by", "rig_in_base", "uncalibrated"}
    assert set(ScanDefaults.model_fields) == plan - {"patterns", "reconstruction", "codes"} - of_requests


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ('name = "bench"', 'nmae = "bench"', "nmae: unknown key; did you mean 'name'?"),
        ('name = "bench"', "", "name: missing; add it"),
        ("[projector]", "[projektor]", "projektor: unknown key; did you mean 'projector'?"),
        ('driver = "serial_projector"', "", "projector.driver: missing"),
        ('name = "right"', 'name = "left"', "found left twice"),
        ('name = "right"', 'name = "../right"', "camera[1].name"),
        ('name = "right"', 'name = "projector"', "camera[1].name: expected a camera's own name, found 'projector'"),
        ("exposure_s = 0.0167", "exposure_s = 0", "camera[0].exposure_s"),
        ("exposure_s = 0.0167", 'exposure_s = "0.0167"', "camera[0].exposure_s"),
        ("exposure_s = 0.0167", "exposure_s = nan", "camera[0].exposure_s"),
        ("gain = 2", "gain = true", "camera[1].gain"),
        ("line_shift_period_px = 8", "line_shift_period_px = 3", "scan.line_shift_period_px"),
        ("line_shift_period_px = 8", "line_shift_periode_px = 8", "did you mean 'line_shift_period_px'?"),
        ("depth_edge_ratio = 6", 'flip_rule = "dyer"', "scan.flip_rule"),
        ("depth_edge_ratio = 6", "smooth_boundary = 1", "scan.smooth_boundary"),
        ("[scan]", '[head]\ndriver = "x"\n[scan]', "expected [head] alone"),
        (BENCH, 'name = "x"', "found no [projector]"),
        (BENCH, 'name = "x"\n[projector]\ndriver = "y"', "found no [[camera]]"),
        (BENCH, 'name = "x"\nname = "y"', "expected TOML, found a fault: Cannot overwrite"),
        (BENCH, "name = ", "expected TOML, found a fault"),
    ],
)
def test_fault_of_a_rig_file_is_named_with_its_key(tmp_path: Path, old: str, new: str, part: str) -> None:
    assert old in BENCH
    path = _rig(tmp_path, BENCH.replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        read_rig(path)
    assert str(path) in str(caught.value)
    assert part in str(caught.value)


def test_every_fault_of_a_rig_is_in_one_message(tmp_path: Path) -> None:
    text = BENCH.replace('name = "left"', "").replace("gain = 2", 'gain = "2"').replace("depth_edge_ratio", "ratio")
    with pytest.raises(ConfigError) as caught:
        read_rig(_rig(tmp_path, text))
    assert len(str(caught.value).splitlines()) == 4
    with pytest.raises(ConfigError, match=r"none\.toml: no such file"):
        read_rig(tmp_path / "none.toml")


def test_settings_are_closed_by_default(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    settings = read_settings()
    assert (settings.host, settings.port, settings.require_key) == ("127.0.0.1", 8731, True)
    assert settings.queue_length == 16
    assert settings.data_dir == tmp_path / "slrig"
    assert settings.key_path.parent == settings.data_dir


def test_the_call_comes_before_the_environment_and_that_before_the_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "service.toml").write_text('port = 1\nqueue_length = 2\nmax_event_streams = 3\nrig = "rigs/a.toml"\n')
    monkeypatch.setenv("SLRIG_PORT", "10")
    monkeypatch.setenv("SLRIG_QUEUE_LENGTH", "20")
    monkeypatch.setenv("SLRIG_ALLOWED_HOSTS", "bench.local, bench")
    settings = read_settings(tmp_path / "service.toml", port=100)
    assert (settings.port, settings.queue_length, settings.max_event_streams) == (100, 20, 3)
    assert settings.rig == tmp_path / "rigs/a.toml"
    assert settings.allowed_hosts == ("bench.local", "bench")


def test_settings_are_checked_all_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "service.toml").write_text('port = 99999\nqueue_lenght = 2\nlog_level = "loud"\n')
    monkeypatch.setenv("SLRIG_SHUTDOWN_S", "soon")
    with pytest.raises(ConfigError) as caught:
        read_settings(tmp_path / "service.toml")
    message = str(caught.value)
    for part in (
        "port:",
        "99999",
        "queue_lenght: unknown key; did you mean 'queue_length'?",
        "log_level",
        "shutdown_s",
    ):
        assert part in message
    assert len(message.splitlines()) == 5


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", "bench.local"])  # noqa: S104 - it must be refused
def test_an_open_service_is_refused_beyond_this_machine(host: str) -> None:
    with pytest.raises(ConfigError, match=r"expected require_key .*; listen on 127\.0\.0\.1 or leave require_key on"):
        read_settings(host=host, require_key=False)
    assert read_settings(host=host).require_key


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "::1", "localhost"])
def test_an_open_service_is_allowed_on_this_machine(host: str) -> None:
    assert is_loopback(host)
    assert not read_settings(host=host, require_key=False).require_key


# ---- The rig files that we ship for live devices, and what config/README.md says about rig files


README = (Path(__file__).resolve().parents[2] / "config" / "README.md").read_text(encoding="utf-8")
LIVE = {
    "webcams-and-hdmi": ("screen", ["v4l2", "v4l2"]),
    "oak-and-screen": ("screen", ["depthai", "depthai"]),
    "trigger-box-and-genicam": ("serial_projector", ["genicam"]),
    "trigger-box-and-picamera2": ("serial_projector", ["picamera2"]),
    "lightcrafter-4500-and-two-cameras": ("dlpc350", ["genicam", "genicam"]),
    "lightcrafter-6500-and-two-cameras": ("dlpc900", ["genicam", "genicam"]),
}


def taken_by_its_drivers(path: Path) -> RigConfig:
    rig = read_rig(path)
    tables = [table for table in (rig.head, rig.projector, *rig.cameras) if table is not None]
    assert tables
    for table in tables:
        assert table.driver in drivers_with_options("slrig")
        assert failure_of(table.driver, table.options) == ""
    return rig


@pytest.mark.parametrize("path", sorted((EXAMPLES / "rigs").glob("*.toml")), ids=lambda path: path.stem)
def test_every_rig_file_is_taken_by_its_drivers(path: Path) -> None:
    taken_by_its_drivers(path)


@pytest.mark.parametrize("name", LIVE)
def test_the_usual_kits_have_a_rig_file_with_comments(name: str) -> None:
    path = EXAMPLES / "rigs" / f"{name}.toml"
    rig = taken_by_its_drivers(path)
    assert rig.name == name
    assert rig.projector is not None
    assert (rig.projector.driver, [camera.driver for camera in rig.cameras]) == LIVE[name]
    assert f"/rigs/{name}.toml)" in README
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0] == "#:schema ../schema.json"
    assert (path.parent / "../schema.json").is_file()
    assert sum("#" in line for line in lines) > len(lines) / 3
    for camera in rig.cameras:
        assert camera.exposure_s is not None
        if rig.projector.driver == "screen":
            periods = camera.exposure_s * 60
            assert abs(periods - round(periods)) < 0.01


def test_commented_lines_of_a_rig_file_are_valid(tmp_path: Path) -> None:
    for name in LIVE:
        text = (EXAMPLES / "rigs" / f"{name}.toml").read_text(encoding="utf-8")
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
    on_arduino = {f"PD{number}": f"D{number}" for number in range(8)} | {"PB1": "D9"}
    port = re.search(rf"\b{pin} = (P[BD]\d)", (Path(box.__file__).parent / "arduino" / "main.c").read_text())
    assert re.search(rf"\| {pin}, \w+ \| {on_arduino[port[1]] if port else '–'} \|", README)
    assert "912 × 1140" in README
    assert (box.WIDTH_PX, box.HEIGHT_PX) == (912, 1140)


def test_the_readme_stays_short() -> None:
    assert len(README.splitlines()) <= 200
