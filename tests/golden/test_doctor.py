"""Defects planted in a rendered rig are each named by `slrig doctor`, and none is invented."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner

from simulated_rig.device import SimulatedHead
from slrig.capture.sequencer import capture
from slrig.cli.commands import app
from slrig.config import read_rig
from slrig.devices import FoundDevice, Rig
from slrig.discovery import open_rig
from slrig.doctor.doctor import Diagnosis, examine
from slrig.doctor.light import Severity
from slrig.errors import ScanEvidenceError
from slrig.model import PatternSequence
from slrig.patterns.sequence import encode, scan_patterns

pytestmark = pytest.mark.slow
BOARD = """
name = "board"
[[object]]
name = "board"
shape = "plane"
size_mm = [400.0, 400.0]
rotation_deg = [6.0, -10.0, 0.0]
albedo = 0.8
texture = { kind = "checker", contrast = 0.6, scale_mm = 35.0 }
"""

RIG = """
name = "bench"
[head]
driver = "simulated"
scene = "board.toml"
seed = 1
ambient = 0.03
exposure_s = 0.0166666667
# head
[head.projector]
size_px = [256, 192]
focal_px = [520.0, 520.0]
position_mm = [90.0, 0.0, -500.0]
target_mm = [0.0, 0.0, 0.0]
blur_px = 0.5
# projector
[head.faults]
# faults
[[head.camera]]
name = "left"
size_px = [240, 192]
focal_px = [600.0, 600.0]
position_mm = [-60.0, 0.0, -500.0]
target_mm = [0.0, 0.0, 0.0]
saturation_s = 0.022
blur_px = 0.5
# camera
"""


@dataclass(frozen=True)
class Planted:
    """Options of the rig file, by their place, and the notes and faults that they must bring, and no others."""

    options: tuple[tuple[str, str], ...]
    named: frozenset[str] = frozenset()


def planted(*named: str, **options: str) -> Planted:
    return Planted(tuple(options.items()), frozenset(named))


MAINS = "ambient_flicker_hz = {hz}\nambient_flicker_depth = 0.8"

DEFECTS = {
    "clean": planted(),
    "gamma 2.2": planted("response.gamma", projector="gamma = 2.2"),
    "40 ms latency": planted("timing.late", faults="light_delay_s = 0.04"),
    "50 Hz flicker": planted("flicker.room", head=MAINS.format(hz=50.0)),
    "saturation": planted("exposure.saturated", head="exposure_s = 0.08"),
    "defocus of the projector": planted("focus.projector", projector="blur_px = 4.0"),
    "defocus of the camera": planted("focus.camera", camera="blur_px = 4.0"),
    "mirrored image": planted("picture.mirrored", faults='picture = "mirrored"'),
    "second display swapped": planted("display.other", faults="other_display = true"),
    "clean, 60 Hz display": planted(projector="refresh_hz = 60.0"),
    "clean, rolling shutter, 12 bits": planted(camera="line_time_s = 3e-5\nbit_depth = 12", head="ambient = 0.2"),
    "clean, noisy": planted(camera="read_noise_e = 60.0", head="seed = 7"),
    "clean, latency known": planted(
        faults="light_delay_s = 0.04", camera="[synchronisation]\nlatency_s = 0.04\nlatency_error_s = 0.002"
    ),
    "mains of 50 Hz": planted("flicker.room", head=MAINS.format(hz=100.0)),
    "mains of 60 Hz": planted("flicker.room", head=MAINS.format(hz=120.0) + "\nexposure_s = 0.02"),
    "mains, rolling shutter": planted("flicker.room", head=MAINS.format(hz=100.0), camera="line_time_s = 3e-5"),
    "colour wheel": planted("flicker.projector", projector="flicker_hz = 180.0\nflicker_depth = 0.5"),
    "exposure beside the refresh": planted("exposure.refresh", projector="refresh_hz = 60.0", head="exposure_s = 0.02"),
    "too short": planted("exposure.short", head="exposure_s = 0.004"),
    "far too short": planted("exposure.dark", head="exposure_s = 0.0004"),
    "upside down": planted("picture.mirrored", faults='picture = "upside_down"'),
    "half a turn": planted("picture.turned", faults='picture = "rotated"'),
    "a little blurred": planted("focus.projector", projector="blur_px = 1.6"),
    "another display's glow": planted("display.other", faults="other_display = true\nother_display_glow = 0.05"),
    "lamp off": planted("light.none", faults="lamp_off = true"),
    "four at once": planted(
        "response.gamma",
        "timing.late",
        "flicker.room",
        "picture.mirrored",
        projector="gamma = 2.2",
        faults='light_delay_s = 0.04\npicture = "mirrored"',
        head=MAINS.format(hz=100.0),
    ),
}


def write_rig_file(folder: Path, defect: Planted) -> Path:
    """A rig file with the defect; an option that is there already is replaced."""
    (folder / "board.toml").write_text(BOARD)
    text = RIG
    for place, options in defect.options:
        before, mark, after = text.partition(f"# {place}\n")
        assert mark
        for option in options.splitlines():
            key = option.partition(" = ")[0]
            lines, own = before.splitlines(), before.rpartition("\n[")[2]
            if f"\n{key} = " in own:
                last = max(number for number, line in enumerate(lines) if line.startswith(f"{key} = "))
                before = "\n".join([*lines[:last], *lines[last + 1 :], ""])
        text = f"{before}{options}\n{mark}{after}"
    path = folder / "rig.toml"
    path.write_text(text)
    return path


def own_sequence(rig: Rig) -> PatternSequence:
    size = rig.projector.info.size
    patterns = scan_patterns(
        size, line_shift=True, period_px=8, line_width_px=1, gray_cell_px=None, gray_offset_px=0, rows=False
    )
    return encode(patterns, size)


def run_doctor(path: Path) -> Diagnosis:
    """Examine a rig, and see that its projector is dark afterwards."""
    displays = (FoundDevice("screen", "DP-2", "a projector (1280 x 800)"),)
    with open_rig(read_rig(path)) as rig:
        diagnosis = examine(rig, own_sequence=own_sequence(rig), displays=displays)
        assert isinstance(rig.head, SimulatedHead)
        assert rig.head.projector.shown_pattern is None
        assert not rig.head.projector.is_lit
        return diagnosis


@pytest.mark.parametrize("name", DEFECTS)
def test_a_planted_defect_is_named_and_none_is_invented(tmp_path: Path, name: str) -> None:
    diagnosis = run_doctor(write_rig_file(tmp_path, DEFECTS[name]))
    findings = [each for each in diagnosis.findings if each.severity is not Severity.OK]
    words = "; ".join(f"{each.severity} {each.name}: {each.found}" for each in findings) or "nothing"
    sys.stdout.write(f"{name:32} {words[:150]}\n")
    assert {each.name for each in findings} == DEFECTS[name].named
    assert all(each.remedy for each in findings)
    if name == "second display swapped":
        assert "DP-2 (a projector (1280 x 800))" in findings[0].remedy


def test_the_planted_values_are_measured(tmp_path: Path) -> None:
    defect = planted(
        projector="gamma = 2.2\nrefresh_hz = 60.0",
        faults="light_delay_s = 0.04",
        head=MAINS.format(hz=100.0),
    )
    found = run_doctor(write_rig_file(tmp_path, defect))
    assert found.response is not None
    assert found.response.gamma == pytest.approx(2.2, abs=0.06)
    assert found.refresh_hz == pytest.approx(60.0, abs=0.02)
    assert found.synchronisation is not None
    assert found.synchronisation.latency_s == pytest.approx(0.04, abs=0.3e-3)
    [swing] = found.flickers
    assert (swing.source, swing.frequency_hz) == ("room", 100.0)
    # A board that faces the projector less than fully reflects less of it, and as much of the room.
    assert swing.share == pytest.approx(0.8 * 0.03, rel=0.3)
    # One refresh period lets 0.5 % of white through; two, that let less through, saturate.
    assert found.exposures["left"].exposure_s == pytest.approx(1 / 60, rel=1e-3)


def test_the_rig_file_that_it_writes_scans_where_the_old_one_did_not(tmp_path: Path) -> None:
    defect = planted(faults="light_delay_s = 0.04", head="exposure_s = 0.08")
    path = write_rig_file(tmp_path, defect)
    (tmp_path / "new").mkdir()
    better = tmp_path / "new" / "better.toml"
    shown = CliRunner().invoke(app, ["doctor", str(path), "--output", str(better)])
    assert shown.exit_code == 1, shown.output
    output = " ".join(shown.stdout.split())
    assert "2 faults, no notes" in output
    assert "white is saturated on" in output
    assert "do use the table [synchronisation] of the rig file" in output
    with open_rig(read_rig(path)) as rig, pytest.raises(ScanEvidenceError):
        list(capture(rig, own_sequence(rig)))
    with open_rig(read_rig(better)) as rig:
        shots = list(capture(rig, own_sequence(rig)))
    assert len(shots) == len(own_sequence(rig))
    # The better rig is well, and its exit code says so.
    again = CliRunner().invoke(app, ["doctor", str(better), "--json"])
    assert again.exit_code == 0, again.output
    document = json.loads(again.stdout)
    assert document["healthy"] is True
    assert {each["severity"] for each in document["findings"]} == {"ok"}
    assert len(document["response"]["light"]) == 33


def test_a_projector_that_is_unplugged_is_a_finding(tmp_path: Path) -> None:
    path = write_rig_file(tmp_path, planted(faults="unplug_projector_at_show = 60"))
    with open_rig(read_rig(path)) as rig:
        diagnosis = examine(rig, own_sequence=own_sequence(rig))
    [finding] = diagnosis.with_severity(Severity.FAULT)
    assert finding.name == "device.failed"
    assert "the projector is gone" in finding.found
    # Earlier findings are reported too.
    assert any(each.name == "exposure.range" for each in diagnosis.findings)
