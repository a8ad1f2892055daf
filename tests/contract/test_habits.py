"""Webcams as people have them, below the driver: from the doctor to a scan, with each habit that its camera has."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slrig.capture.latency import measure_latency
from slrig.capture.sequencer import capture
from slrig.devices import CameraSettings, Rig
from slrig.doctor.doctor import Diagnosis, examine
from slrig.doctor.light import Severity
from slrig.model import PatternSequence, Size
from tests.contract.stage import Stage, StagedProjector
from tests.contract.suite import whole_scan
from tests.contract.v4l2_bench import CONTROLS, Faked, VirtualDevice
from tests.contract.v4l2_sensor import GAIN_UNITS
from tests.unit.capture.fake_rig import Scene
from tests.virtual_clock import VirtualClock

CAMERAS = Path(__file__).parent / "cameras"
SIZE = Size(96, 72)


@dataclass(frozen=True)
class Habit:
    """A camera of `CAMERAS` and what is before it. advice : findings of the doctor that have to be there. options : of
    the rig file, as `slrig init` writes them or as the driver's refusal says. changed : keys of the controls that are
    not as in its file.
    """

    camera: str
    changed: dict[str, Any] = field(default_factory=dict)
    scene: dict[str, Any] = field(default_factory=dict)
    faked: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    advice: tuple[str, ...] = ()


HABITS = {
    "takes exposures by powers of two": Habit("lifecam-hd3000"),
    "clamps exposures in silence": Habit("arducam-ov9281", scene={"white": 0.9}, advice=("exposure.clamped",)),
    "moves its lens at the start, and is slow then": Habit(
        "logitech-c920", options={"focus": 60}, faked={"sharp_at": 60}
    ),
    "moves its lens all the time": Habit(
        "logitech-c920", {"Focus, Absolute": {"creeps": 25}}, advice=("picture.steady",)
    ),
    "forgets its exposure at the start": Habit("facetime-hd"),
    "refuses a harmless control, and drops a tenth": Habit("quanta-hd"),
    "sends padded rows": Habit("logitech-c920", faked={"padding_bytes": 24}),
    "sees a dim scene": Habit("logitech-c920", scene={"white": 0.06, "ambient": 0.002}),
}


def faked(habit: Habit, *, code: str = "GREY", size: Size = SIZE) -> Faked:
    known = json.loads((CAMERAS / f"{habit.camera}.json").read_text())
    known.pop("source")
    own = known.pop("controls")
    controls = tuple({**each, **own.get(each["name"], {}), **habit.changed.get(each["name"], {})} for each in CONTROLS)
    rates = tuple((numerator, denominator) for numerator, denominator in known.pop("rates"))
    formats = {code: [(size.width_px, size.height_px)]}
    return Faked(**{"formats": formats, "rates": rates, "controls": controls, **known, **habit.faked})


@contextmanager
def bench(habit: Habit) -> Iterator[tuple[Rig, VirtualDevice]]:
    scene = Scene(
        camera=SIZE, projector=SIZE, first_column_px=2.0, columns_per_px=0.8, rows_per_px=0.8, blur_px=0.6,
        **{"noise_dn": 1.0, "white": 0.5, **habit.scene},
    )  # fmt: skip
    stage = Stage(scene, latency_s=0.02, jitter_s=0.004, clock=VirtualClock(threads={"slrig-frames of left"}))
    with VirtualDevice(stage, faked(habit)) as device:
        camera = device.open_camera(gain_unity=GAIN_UNITS, **habit.options)
        settings = {"left": CameraSettings(1 / 60)}
        yield Rig("habits", {"left": camera}, StagedProjector(stage), settings, None, None, clock=device.clock), device


def wrong_frames(rig: Rig, device: VirtualDevice, sequence: PatternSequence) -> list[int]:
    """Indices of the patterns whose verified frames are another pattern's; every pattern has one."""
    shots = {shot.pattern: shot.image for shot in capture(rig, sequence)}
    assert shots.keys() == set(range(len(sequence)))
    exposed_s = device.sensor.asked[-1]["exposure_ns"] / 1e9
    expected = [device.stage.expected(each, exposure_s=exposed_s) for each in sequence.profiles]
    distances = [np.abs(np.array(expected, np.float64) - image).mean(axis=(1, 2)) for _, image in sorted(shots.items())]
    # Some patterns come twice.
    return [index for index, found in enumerate(distances) if found[index] > found.min() + 1e-9]


def advised(rig: Rig, diagnosis: Diagnosis) -> Rig:
    """The rig as the file that the doctor writes."""
    advice = diagnosis.exposures.get("left")
    settings = rig.settings if advice is None else {"left": CameraSettings(advice.exposure_s)}
    return replace(rig, settings=settings, synchronisation=diagnosis.synchronisation)


@pytest.mark.slow
@pytest.mark.parametrize("name", HABITS)
def test_doctor_advises_and_a_scan_takes_no_wrong_frame(name: str) -> None:
    habit, sequence = HABITS[name], whole_scan(SIZE, period_px=8, line_width_px=1)
    with bench(habit) as (rig, device):
        diagnosis = examine(rig, own_sequence=sequence, search_s=0.1)
        found = {each.name: each for each in diagnosis.findings}
        faults = {each.name for each in diagnosis.findings if each.severity is Severity.FAULT}
        # That nothing was measured before is all that is wrong.
        assert faults - set(habit.advice) <= {"timing.late"}, found
        assert all(found[each].severity is not Severity.OK for each in habit.advice), found
        better = advised(rig, diagnosis)
        assert wrong_frames(better, device, sequence) == []
        # The camera really takes what is advised.
        assert device.sensor.asked[-1]["exposure_ns"] / 1e9 == pytest.approx(
            better.settings["left"].exposure_s, rel=0.1
        )


@pytest.mark.slow
def test_a_lens_that_goes_to_and_fro_is_found_though_it_may_be_back_at_a_look(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.contract.v4l2_kernel.CREEPS_S", 5.0)
    with bench(Habit("logitech-c920", {"Focus, Absolute": {"creeps": 60}})) as (rig, _):
        diagnosis = examine(rig, own_sequence=whole_scan(SIZE, period_px=8, line_width_px=1), search_s=0.1)
    (steady,) = (each for each in diagnosis.findings if each.name == "picture.steady")
    assert "its focus moves by itself" in steady.remedy
    assert [each.name for each in diagnosis.findings if each.name.startswith("focus.")] == []


@pytest.mark.parametrize("stamp", ["end", pytest.param("first packet", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("measured_s", "scanned_s"), [(0.15, 1 / 60), (1 / 60, 0.1)])
def test_scan_at_another_exposure_than_the_latency_was_measured_at_takes_no_wrong_frame(
    stamp: str, measured_s: float, scanned_s: float
) -> None:
    # What the stamps mean is not known: their offset is a share of the exposure.
    scene = {"white": 0.5 * 0.01 / measured_s, "noise_dn": 0.5}
    habit = Habit("logitech-c920", scene=scene, faked={"stamp": stamp})
    with bench(habit) as (rig, device):
        found = measure_latency(rig, trials=12, search_s=0.3, exposure_s=measured_s).synchronisation
        scanning = replace(rig, settings={"left": CameraSettings(scanned_s)}, synchronisation=found)
        device.stage.scene = replace(device.stage.scene, white=0.5 * 0.01 / scanned_s)
        assert wrong_frames(scanning, device, whole_scan(SIZE, period_px=8, line_width_px=1)) == []
