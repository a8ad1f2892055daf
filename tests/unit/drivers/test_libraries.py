"""Drivers whose library is missing, old, or cannot be loaded. Needs none of them."""

from __future__ import annotations

import os
import sys
import types
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers import depthai, genicam, picamera2
from drivers.depthai.library import ENVIRONMENT, library
from drivers.genicam.library import install_command
from drivers.genicam.library import library as aravis
from drivers.genicam.producers import core
from slrig.errors import LibraryMissingError

OAK = {"device": "14442C10D13EABCE00", "socket": "CAM_B"}
LOADED = (aravis, core)
ARAVIS: tuple[Callable[[], object], ...] = (
    genicam.find_devices,
    lambda: genicam.open_camera("left", {"device": "x"}, Path()),
)
MISSING: list[tuple[str, tuple[Callable[[], object], ...], str, str]] = [
    (
        "depthai",
        (
            depthai.find_devices,
            lambda: depthai.open_camera("left", OAK, Path()),
            lambda: depthai.read_calibration(OAK["device"]),
        ),
        "not installed",
        "pip install 'slrig[depthai]'",
    ),
    ("gi", ARAVIS, "Aravis", install_command()),
    ("gi.repository.Aravis", ARAVIS, "Aravis", install_command()),
    (
        "picamera2",
        (picamera2.find_devices, lambda: picamera2.open_camera("left", {"device": "x"}, Path())),
        "--system-site-packages",
        "sudo apt install python3-libcamera && pip install 'slrig[picamera2]'",
    ),
    (
        "harvesters.core",
        (genicam.find_gentl_devices, lambda: genicam.open_gentl_camera("left", {"device": "x"}, Path())),
        "harvesters",
        "pip install 'slrig[gentl]'",
    ),
]


@pytest.mark.parametrize(("module", "calls", "words", "install"), MISSING, ids=[each[0] for each in MISSING])
def test_a_missing_library_is_named_with_the_command_that_installs_it(
    module: str, calls: tuple[Callable[[], object], ...], words: str, install: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if module.startswith("gi."):
        pytest.importorskip("gi", reason="PyGObject is not installed")
    for loaded in LOADED:
        loaded.cache_clear()
    # None in this table makes an import fail, as a package that is not installed does.
    monkeypatch.setitem(sys.modules, module, None)
    for call in calls:
        with pytest.raises(LibraryMissingError, match=words) as missing:
            call()
        assert missing.value.install == install


def test_an_old_library_is_named_with_its_version(monkeypatch: pytest.MonkeyPatch) -> None:
    old = types.ModuleType("depthai")
    old.__dict__.update(__version__="2.30.0", Pipeline=object, __spec__=types.SimpleNamespace())
    monkeypatch.setitem(sys.modules, "depthai", old)
    with pytest.raises(LibraryMissingError, match=r"need depthai 3.12 or later, found 2.30.0"):
        depthai.find_devices()


def test_depthai_reports_nothing_to_its_maker_unless_the_user_asks_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    new = types.ModuleType("depthai")
    pipeline = types.SimpleNamespace(setStopOnDeviceLoss=None)
    new.__dict__.update(__version__="3.12.0", Pipeline=pipeline, __spec__=types.SimpleNamespace())
    monkeypatch.setitem(sys.modules, "depthai", new)
    for variable in ENVIRONMENT:
        # Set, then gone: so that it is restored afterwards, whatever happens to it here.
        monkeypatch.setenv(variable, "")
        monkeypatch.delenv(variable)
    monkeypatch.setenv("DEPTHAI_LEVEL", "debug")
    assert library() is new
    assert os.environ["DEPTHAI_TELEMETRY"] == "0"
    assert os.environ["DEPTHAI_DISABLE_STARTUP_NOTIFICATIONS"] == "1"
    assert os.environ["DEPTHAI_LEVEL"] == "debug"


def test_a_library_that_cannot_be_loaded_is_named_with_the_cause(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "depthai.py").write_text("raise ImportError('libusb is missing')")
    monkeypatch.delitem(sys.modules, "depthai", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(LibraryMissingError, match=r"cannot be loaded .*libusb is missing"):
        depthai.find_devices()
