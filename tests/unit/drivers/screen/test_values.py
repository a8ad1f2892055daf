"""What the driver is told: all that needs no X server."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.screen import open_projector
from drivers.screen.options import ScreenOptions
from slrig.errors import ConfigError


def test_all_faults_of_a_table_come_in_one_message() -> None:
    table = {"outputs": "HDMI-1", "backend": "kms", "native_px": [1280, 0], "latency_s": -1.0, "dark_after_s": 1e9}
    with pytest.raises(ConfigError) as caught:
        open_projector(table, Path())
    for word in ("output: missing", "did you mean 'output'?", "backend", "native_px[1]", "latency_s", "dark_after_s"):
        assert word in str(caught.value), word


def test_a_table_needs_no_more_than_its_output() -> None:
    options = ScreenOptions(output="HDMI-1")
    assert (options.backend, options.native, options.latency_s) == ("auto", None, None)
