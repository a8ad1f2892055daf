"""What a rig file may say about a GenICam camera, and what is said where Aravis is not installed."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.genicam import GenicamOptions, find_devices, open_camera
from drivers.genicam.library import install_command, library
from slrig.errors import ConfigError, LibraryMissingError


def test_every_fault_is_in_one_message() -> None:
    table = {
        "devise": "GV01",
        "region": {"width_px": 0, "height_px": 10},
        "time_stamp": "sometimes",
        "transfer_s": -1,
        "packet_resend": "yes",
    }
    with pytest.raises(ConfigError) as caught:
        open_camera("left", table, Path())
    message = str(caught.value)
    assert "the [[camera]] table of 'left' (driver genicam) is wrong" in message
    for part in ("device: missing", "did you mean 'device'", "region.width_px", "time_stamp", "transfer_s", "resend"):
        assert part in message


def test_features_that_the_driver_sets_itself_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"features names ExposureTime, TriggerMode.*use exposure_s"):
        open_camera(
            "left", {"device": "x", "features": {"TriggerMode": "On", "Gamma": 1.0, "ExposureTime": 5.0}}, Path()
        )


def test_a_device_is_enough() -> None:
    assert GenicamOptions(device="Aravis-Fake-GV01").pixel_format == "Mono8"


@pytest.fixture
def unloaded() -> Iterator[None]:
    library.cache_clear()
    yield
    library.cache_clear()


@pytest.mark.usefixtures("unloaded")
@pytest.mark.parametrize("missing", ["gi", "gi.repository.Aravis"])
def test_a_missing_library_is_named_with_its_command(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if missing != "gi":
        pytest.importorskip("gi", reason="PyGObject is not installed")
    # None in this table makes an import fail, as a package that is not installed does.
    monkeypatch.setitem(sys.modules, missing, None)
    for call in (find_devices, lambda: open_camera("left", {"device": "x"}, Path())):
        with pytest.raises(LibraryMissingError, match="Aravis") as caught:
            call()
        assert caught.value.install == install_command()
        assert caught.value.install in str(caught.value)


def test_the_command_fits_the_python_in_use() -> None:
    assert "libgirepository1.0-dev" in install_command((3, 12))
    assert "libgirepository-2.0-dev" in install_command((3, 14))
    for python in ((3, 11), (3, 13)):
        assert "pip install 'slrig[genicam]'" in install_command(python)
