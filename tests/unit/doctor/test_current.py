"""The doctor finds out which way a light engine's current goes, before a camera of which it knows nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from drivers.dlpc350.planes import MIRRORS
from slrig.devices import CameraSettings
from slrig.doctor.doctor import doctor_sequence, examine
from slrig.doctor.findings import Severity
from tests.contract.dlpc350_bench import Table
from tests.contract.suite import rig_of


@pytest.mark.slow
def test_the_sense_of_the_current_is_found_and_all_else_waits_for_it(tmp_path: Path) -> None:
    # Not as on the LightCrafter 4500.
    inverted = False
    shown = doctor_sequence(MIRRORS)
    table = Table(tmp_path, shown, led_inverted=inverted)
    head = table.connected(led_current_inverted=None, image_load_s=0.05)
    settings = dict.fromkeys(head.cameras, CameraSettings(0.03))
    with replace(rig_of(head), settings=settings) as rig:
        diagnosis = examine(rig, own_sequence=shown, search_s=0.1)
        assert table.engine.lit is None
    (told,) = (each for each in diagnosis.findings if each.name == "light.current")
    assert told.severity is Severity.NOTE
    assert f"led_current_inverted = {str(inverted).lower()}" in told.remedy
    assert diagnosis.synchronisation is None
    assert not diagnosis.exposures
