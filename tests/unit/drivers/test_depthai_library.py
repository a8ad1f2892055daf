"""The OAK driver where its library is missing or old. Needs no library."""

from __future__ import annotations

import os
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.depthai import find_devices, open_camera, read_calibration
from drivers.depthai.library import ENVIRONMENT, library
from slrig.errors import LibraryMissingError

OPTIONS = {"device": "14442C10D13EABCE00", "socket": "CAM_B"}

CALLS: list[Callable[[], object]] = [
    find_devices,
    lambda: open_camera("left", OPTIONS, Path()),
    lambda: read_calibration("14442C10D13EABCE00"),
]


@pytest.mark.parametrize("call", CALLS)
def test_a_missing_library_is_said_at_once(call: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "depthai", None)
    begun = time.monotonic()
    with pytest.raises(LibraryMissingError, match="not installed") as error:
        call()
    assert time.monotonic() - begun < 0.5
    assert error.value.install == "pip install 'slrig[depthai]'"


def test_an_old_library_is_said_with_its_version(monkeypatch: pytest.MonkeyPatch) -> None:
    old = types.ModuleType("depthai")
    old.__dict__.update(__version__="2.30.0", Pipeline=object, __spec__=types.SimpleNamespace())
    monkeypatch.setitem(sys.modules, "depthai", old)
    with pytest.raises(LibraryMissingError, match=r"need depthai 3.12 or later, found 2.30.0"):
        find_devices()


def test_the_library_tells_its_maker_nothing_unless_the_user_lets_it(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_a_library_that_cannot_be_loaded_is_said_with_the_cause(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "depthai.py").write_text("raise ImportError('libusb is missing')")
    monkeypatch.delitem(sys.modules, "depthai", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(LibraryMissingError, match=r"cannot be loaded .*libusb is missing"):
        find_devices()
