"""The files of config/deploy agree with the drivers, with the service, and with the programs that read them."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

from drivers.depthai import library
from drivers.dlpc350.projector import DLPC350
from drivers.dlpc900.projector import DLPC900
from drivers.pattern_engine.usb import TI
from drivers.serial_projector.link import MICROPYTHON_RP2
from tests.npm import lacking

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "config" / "deploy"
UNIT = (DEPLOY / "slrig.service").read_text(encoding="utf-8")
RULES = (DEPLOY / "70-slrig.rules").read_text(encoding="utf-8")

MOST_EXPOSURE = 3.0

CLASSES = {
    "v4l2": {"video4linux"},
    "opencv": {"video4linux"},
    "depthai": {"usb_device"},
    "genicam": {"usb_device"},
    "gentl": {"usb_device"},
    "dlpc347x": {"i2c"},
    "dlpc350": {"hidraw"},
    "dlpc900": {"hidraw"},
    "serial_projector": {"ttyACM", "ttyUSB", "ttyS", "ttyAMA"},
}
"""Of each driver, the classes of device nodes that it opens."""

NO_NODE = {
    "kms": "graphics cards: in slrig-kms.conf, for most rigs have no use for them",
    "screen": "speaks to an X server through its socket: slrig-screen.conf",
    "picamera2": "media and DMA nodes of one kind of computer: in the README beside the unit",
    "replay": "reads files",
    "simulated": "computes its pictures",
}


def drivers() -> set[str]:
    points = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
    return {name for kind in ("heads", "cameras", "projectors") for name in points[f"slrig.{kind}"]}


def test_every_driver_has_its_devices_in_the_unit_or_a_reason() -> None:
    assert CLASSES.keys() | NO_NODE.keys() == drivers()
    allowed = re.findall(r"(?:^# (.+)\n)?((?:^DeviceAllow=char-\w+ rw\n)+)", UNIT, re.MULTILINE)
    named = {
        driver: set(re.findall(r"char-(\w+)", lines))
        for comment, lines in allowed
        for driver in CLASSES
        if re.search(rf"\b{driver}\b", comment)
    }
    assert named == CLASSES


def test_classes_are_there_before_their_first_device() -> None:
    modules = (DEPLOY / "slrig.modules").read_text(encoding="utf-8").splitlines()
    by_module = {"video4linux": "videodev", "hidraw": "hid", "i2c": "i2c-dev"}
    by_module |= {"ttyACM": "cdc_acm", "ttyUSB": "usbserial"}
    built_in = {"usb_device", "ttyS", "ttyAMA"}
    assert set().union(*CLASSES.values()) == by_module.keys() | built_in
    assert {line for line in modules if line and not line.startswith("#")} == set(by_module.values())


def test_rules_name_the_devices_that_the_drivers_open() -> None:
    rules = [line for line in RULES.splitlines() if line and not line.startswith("#")]
    ids = {(vendor, product) for line in rules for vendor, product in [_ids(line)] if vendor}
    vendor = re.search(r'idVendor\}=="(\w+)"', library.UDEV_RULE)
    assert vendor is not None
    assert ids == {
        (vendor.group(1), None),
        *((f"{TI:04x}", f"{kind.product:04x}") for kind in (DLPC350, DLPC900)),
        tuple(f"{part:04x}" for part in MICROPYTHON_RP2),
    }
    # One equals sign assigns, two compare: "GROUP==" would be a rule that never holds.
    term = (
        r'(?:(?:SUBSYSTEM|KERNEL|ATTRS?\{\w+\}|ENV\{\w+\})=="[^"]+"|(?:GROUP|MODE|ENV\{\w+\})="[^"]+"|TAG\+="uaccess")'
    )
    for line in rules:
        assert re.fullmatch(rf"{term}(?:, {term})*", line), line
        assert 'MODE="0660"' in line


def _ids(rule: str) -> tuple[str | None, str | None]:
    vendor, product = (re.search(rf'{name}\}}=="(\w+)"', rule) for name in ("idVendor", "idProduct"))
    return vendor and vendor.group(1), product and product.group(1)


def test_udev_reads_the_rules() -> None:
    if shutil.which("udevadm") is None or "verify" not in _said("udevadm", "--help"):
        pytest.skip("needs udevadm verify, of systemd 254 or newer")
    assert "Fail: 0" in _said("udevadm", "verify", str(DEPLOY / "70-slrig.rules"))


def test_exposure_of_the_unit_is_low(tmp_path: Path) -> None:
    _require_systemd()
    units = tmp_path / "units"
    _lay_out(units)
    limit = f"--threshold={10 * MOST_EXPOSURE:.0f}"
    for unit in ("slrig.service", "slrig-screen.service", "slrig-kms.service"):
        found = _said("systemd-analyze", "security", "--offline=true", "--no-pager", limit, str(units / unit))
        level = re.search(r"exposure level for \S+: ([\d.]+)", found)
        assert level is not None, found
        assert float(level.group(1)) <= MOST_EXPOSURE, found


def test_systemd_reads_the_unit(tmp_path: Path) -> None:
    _require_systemd()
    _lay_out(tmp_path)
    assert _said("systemd-analyze", "verify", "--man=no", str(tmp_path / "slrig.service")) == ""
    for unit in ("slrig-screen.service", "slrig-kms.service", "slrig-xorg.service"):
        assert _said("systemd-analyze", "verify", "--man=no", str(tmp_path / unit)) == "", unit


def test_graphics_cards_are_allowed_where_a_driver_opens_them() -> None:
    alone = (DEPLOY / "slrig-kms.conf").read_text(encoding="utf-8")
    assert re.findall(r"^DeviceAllow=(.+)$", alone, re.MULTILINE) == ["char-drm rw"]
    # The guard has to outlive the service.
    assert re.findall(r"^KillMode=(.+)$", alone, re.MULTILINE) == ["process"]
    assert "char-drm" not in UNIT


def _require_systemd() -> None:
    if shutil.which("systemd-analyze") is None:
        lacking("needs systemd-analyze: apt install systemd")
    if int(_said("systemd-analyze", "--version").split()[1]) < 250:
        pytest.skip("needs systemd 250 or newer")


def _lay_out(folder: Path) -> None:
    """The unit by itself, and with its drop-in as one file; the program that it starts is one that is there."""
    folder.mkdir(exist_ok=True)
    unit = UNIT.replace("/opt/slrig/bin/slrig", "/bin/true")
    assert unit != UNIT
    (folder / "slrig.service").write_text(unit, encoding="utf-8")
    for name in ("slrig-screen", "slrig-kms"):
        added = (DEPLOY / f"{name}.conf").read_text(encoding="utf-8")
        (folder / f"{name}.service").write_text(unit + added, encoding="utf-8")
    server = (DEPLOY / "slrig-xorg.service").read_text(encoding="utf-8")
    (folder / "slrig-xorg.service").write_text(server.replace("/usr/lib/xorg/Xorg", "/bin/true"), encoding="utf-8")


def _said(*command: str) -> str:
    """What a program says, on both channels."""
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)  # noqa: S603
    return (ended.stdout + ended.stderr).strip()
