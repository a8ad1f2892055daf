"""What a rig file may say about a GenICam camera, and how Aravis is installed."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.genicam import GenicamOptions, open_camera
from drivers.genicam.library import install_command
from slrig.errors import ConfigError


def test_features_that_the_driver_sets_itself_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"features names ExposureTime, TriggerMode.*use exposure_s"):
        open_camera(
            "left", {"device": "x", "features": {"TriggerMode": "On", "Gamma": 1.0, "ExposureTime": 5.0}}, Path()
        )


def test_a_device_is_enough() -> None:
    assert GenicamOptions(device="Aravis-Fake-GV01").pixel_format == "Mono8"


def test_the_command_fits_the_python_in_use() -> None:
    assert "libgirepository1.0-dev" in install_command((3, 12))
    assert "libgirepository-2.0-dev" in install_command((3, 14))
    for python in ((3, 11), (3, 13)):
        assert "pip install 'slrig[genicam]'" in install_command(python)
