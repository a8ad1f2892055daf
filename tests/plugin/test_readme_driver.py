"""The example of drivers/README.md is a driver: it passes the contract, and its package can be installed."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from slrig.conformance import CHECKS, Check, CheckOutcome, ConformanceReport, run_checks
from slrig.devices import CameraSettings, Rig
from slrig.errors import DeviceGoneError
from slrig.model import PatternSequence, Pixels, Size
from slrig.patterns.sequence import encode
from tests.contract.stage import Stage, StagedProjector
from tests.plugin.conftest import path_with, pip_install, slrig
from tests.unit.capture.fake_rig import Scene, patterns_for

EXAMPLE = Path(__file__).resolve().parents[2] / "config" / "examples" / "slrig-ramp"
PROJECTOR = Size(128, 96)
CAMERA = Size(160, 120)
MODULE = "slrig_ramp"
RULE = "start_ns - STAMP_ERROR_NS >= after_ns"


def loaded(folder: Path, change: Callable[[str], str] = str) -> ModuleType:
    """Import the example's module from a file, unchanged or with a change."""
    path = folder / f"{MODULE}.py"
    path.write_text(change((EXAMPLE / f"{MODULE}.py").read_text(encoding="utf-8")), encoding="utf-8")
    spec = importlib.util.spec_from_file_location(MODULE, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def before_a_stage(module: ModuleType) -> Callable[[], Rig]:
    """Put a stage before the sensor; what opens the driver's camera before the stage's projector."""

    def opened() -> Rig:
        stage = Stage(Scene(camera=CAMERA, projector=PROJECTOR, noise_dn=0.8), latency_s=0.004)

        class Sensor(module.Sensor):  # type: ignore[misc, name-defined]
            def exposed(self, start_ns: int, end_ns: int) -> Pixels:
                return stage.exposed(start_ns, end_ns)

        camera = module.open_camera("left", {}, Path())
        camera.sensor = Sensor()
        return Rig("example", {"left": camera}, StagedProjector(stage), {"left": CameraSettings(0.01)})

    return opened


def sequence() -> PatternSequence:
    return encode(patterns_for(PROJECTOR), PROJECTOR)


def failures(report: ConformanceReport) -> list[str]:
    return [f"{result.name}: {result.failure}" for result in report.results if result.outcome is CheckOutcome.FAILED]


def named(name: str) -> Check:
    return next(check for check in CHECKS if check.name == name)


@pytest.mark.slow
def test_the_example_conforms(tmp_path: Path) -> None:
    report = run_checks(before_a_stage(loaded(tmp_path)), sequence())
    assert failures(report) == []
    assert report.conforms
    assert report.count(CheckOutcome.PASSED) >= 30


def test_without_its_time_rule_it_would_not(tmp_path: Path) -> None:
    def unruly(text: str) -> str:
        assert text.count(RULE) == 1
        return text.replace(RULE, "True")

    report = run_checks(
        before_a_stage(loaded(tmp_path, unruly)), sequence(), checks=[named("read_passes_over_stale_frames")]
    )
    # Which of the two it is goes by how long the machine takes to come to the frame.
    assert re.search("drop those that began before|delivers frames of an earlier pattern", failures(report)[0])


def test_as_it_stands_it_shows_its_ramp(tmp_path: Path) -> None:
    module = loaded(tmp_path)

    def opened() -> Rig:
        stage = Stage(Scene(camera=CAMERA, projector=PROJECTOR))
        camera = module.open_camera("left", {"device": "ramp-0"}, tmp_path)
        return Rig("example", {"left": camera}, StagedProjector(stage), {"left": CameraSettings(0.01)})

    # It does not see the projector, and a sequence that does not begin with white does not ask it to.
    blind = encode(patterns_for(PROJECTOR)[1:], PROJECTOR)
    report = run_checks(opened, blind)
    assert failures(report) == []
    assert report.count(CheckOutcome.PASSED) >= 20
    assert [device.device for device in module.find_devices()] == ["ramp-0"]
    with pytest.raises(DeviceGoneError, match="asked for 'ramp-1', found ramp-0"):
        module.open_camera("left", {"device": "ramp-1"}, tmp_path)


@pytest.mark.slow
def test_its_package_is_installed_and_found(tmp_path: Path) -> None:
    source = shutil.copytree(EXAMPLE, tmp_path / "package")
    site = pip_install([source], tmp_path)
    done = slrig("devices", "--json", path=path_with(site), folder=tmp_path)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    ramp = next(driver for driver in document["drivers"] if (driver["kind"], driver["name"]) == ("camera", "ramp"))
    assert (ramp["package"], ramp["version"], ramp["fault"]) == ("slrig-ramp", "1.0", None)
    assert {"driver": "ramp", "device": "ramp-0", "label": "grey ramp"} in document["devices"]
