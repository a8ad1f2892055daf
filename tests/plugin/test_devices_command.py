"""`slrig devices`: whole commands, clean JSON, and how long it takes where nothing is plugged in or installed."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from slrig.cli import rig_file as devices
from slrig.cli.commands import app
from slrig.devices import FoundDevice
from slrig.discovery import DiscoveredDevices, InstalledDriver, MissingLibrary
from slrig.errors import DriverBrokenError

LIMIT_S = 2.0
LIBRARIES = ("depthai", "gi", "harvesters", "picamera2")
"""What the extras bring: the child is told that there is none of it."""

FINDERS = ("depthai", "genicam", "gentl", "picamera2")
NOTHING = DiscoveredDevices((), (), ())
INSTALL = "pip install 'slrig[depthai]'"


def told(monkeypatch: pytest.MonkeyPatch, drivers: tuple[InstalledDriver, ...], found: DiscoveredDevices) -> str:
    monkeypatch.setattr(devices, "installed_drivers", lambda: drivers)
    monkeypatch.setattr(devices, "discover_devices", lambda: found)
    result = CliRunner().invoke(app, ["devices"], env={"COLUMNS": "60"})
    assert result.exit_code == 0, result.output
    return result.stdout


def driver(name: str, package: str, *, kind: str = "camera", fault: str | None = None) -> InstalledDriver:
    return InstalledDriver(kind, name, package, "1.0", f"{name}:open", fault)


def test_a_command_to_copy_is_neither_wrapped_nor_styled_away(monkeypatch: pytest.MonkeyPatch) -> None:
    long = f"sudo apt install {' '.join(f'package-{number}' for number in range(20))} && {INSTALL}"
    found = DiscoveredDevices((), (MissingLibrary("depthai", INSTALL, "…"), MissingLibrary("genicam", long, "…")), ())
    shown = told(monkeypatch, (driver("depthai", "slrig"), driver("genicam", "slrig")), found)
    assert f"  depthai: {INSTALL}\n" in shown
    assert f"  genicam: {long}\n" in shown
    assert "No device is plugged in" in shown
    assert "slrig demo" in shown.replace("\n", " ")


def test_it_says_which_devices_it_looks_for(monkeypatch: pytest.MonkeyPatch) -> None:
    drivers = (driver("v4l2", "slrig", kind="finder"), driver("gone", "slrig", kind="finder", fault="no library"))
    monkeypatch.setattr(devices, "installed_drivers", lambda: drivers)
    monkeypatch.setattr(devices, "discover_devices", lambda: DiscoveredDevices((), (), ()))
    assert CliRunner().invoke(app, ["devices"]).stderr.startswith("Looking for devices of v4l2 …")


def test_a_broken_package_is_listed_once_with_its_cause_and_its_removal(monkeypatch: pytest.MonkeyPatch) -> None:
    faults = {kind: f"{kind} driver 'x' cannot be loaded: OSError: [/etc] is shut" for kind in ("camera", "finder")}
    drivers = tuple(driver("x", "x-package", kind=kind, fault=fault) for kind, fault in faults.items())
    fault = DriverBrokenError("finder driver 'y' failed: OSError: no bus")
    found = DiscoveredDevices((), (), (DriverBrokenError(faults["finder"]), fault))
    shown = told(monkeypatch, (*drivers, driver("y", "y-package")), found)
    assert shown.count("is shut") == 1
    assert faults["camera"] in shown
    assert "to remove it: pip uninstall x-package\n" in shown
    assert "Not looked for: finder driver 'y' failed: OSError: no bus\n" in shown
    assert "its search failed" in " ".join(shown.split())
    assert devices.broken_packages(drivers) == (
        devices.BrokenPackage("x-package", ("x",), faults["camera"], "pip uninstall x-package"),
    )
    assert devices.broken_packages(()) == ()


def test_devices_are_shown_as_a_rig_file_takes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    found = DiscoveredDevices((FoundDevice("v4l2", "usb-[bus]-video-index0", "[red]webcam"),), (), ())
    shown = told(monkeypatch, (driver("v4l2", "slrig"),), found)
    assert "usb-[bus]-video-index0" in shown
    assert "[red]webcam" in shown
    assert "No device" not in shown


def test_what_drivers_print_is_not_part_of_the_answer(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def chatty() -> DiscoveredDevices:
        sys.stdout.write("from Python\n")
        # As a library that is not Python does.
        os.write(1, b"from below\n")
        return NOTHING

    monkeypatch.setattr(devices, "installed_drivers", lambda: ())
    monkeypatch.setattr(devices, "discover_devices", chatty)
    devices.list_devices(as_json=True)
    shown = capfd.readouterr()
    assert json.loads(shown.out)["devices"] == []
    assert "from below" in shown.err
    assert "from Python" in shown.err


@pytest.mark.realtime
def test_with_nothing_plugged_in_and_no_library_it_answers_at_once_and_says_what_to_do(tmp_path: Path) -> None:
    code = f"import sys\nsys.modules.update(dict.fromkeys({LIBRARIES}))\nfrom slrig.cli.commands import main\nmain()\n"

    def run(*arguments: str) -> tuple[str, float, float]:
        before, begun_s = os.times(), time.monotonic()
        done = subprocess.run(  # noqa: S603 - our own command
            [sys.executable, "-c", code, "devices", *arguments],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=True,
        )
        wall_s, after = time.monotonic() - begun_s, os.times()
        assert "Traceback" not in done.stdout + done.stderr
        processor_s = after.children_user + after.children_system - before.children_user - before.children_system
        return done.stdout, processor_s, wall_s

    document = json.loads(run("--json")[0])
    missing = {library["driver"]: library["install"] for library in document["missing"]}
    assert set(missing) >= set(FINDERS)
    runs = [run() for _ in range(3)]
    processor_s = statistics.median(each[1] for each in runs)
    wall_s = statistics.median(each[2] for each in runs)
    sys.stdout.write(f"slrig devices: {processor_s:.2f} s of processor, {wall_s:.2f} s on the wall\n")
    # The wall's time on a machine that does other things as well says nothing.
    assert processor_s < LIMIT_S
    shown = runs[0][0]
    for name in FINDERS:
        assert f"  {name}: {missing[name]}\n" in shown
        assert "install" in missing[name]
    assert ("No device is plugged in" in shown) == (document["devices"] == [])
