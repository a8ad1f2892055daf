"""Drivers come from entry points of installed packages: here of one whose metadata is written for the test."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import pytest
from pydantic import BaseModel, ConfigDict

from slrig.bundle import write_calibration
from slrig.config import read_rig
from slrig.devices import (
    AppliedSettings,
    Camera,
    CameraInfo,
    CameraSettings,
    FoundDevice,
    Projector,
    ProjectorInfo,
    Rig,
    Shown,
    Trigger,
)
from slrig.discovery import found_devices, installed_drivers, open_rig
from slrig.errors import (
    CalibrationError,
    ConfigError,
    DeviceError,
    DeviceGoneError,
    DeviceStateError,
    DriverBrokenError,
    DriverNotFoundError,
)
from slrig.model import Calibration, CameraFormat, Frame, PatternSequence, Size, Truth
from tests.samples import CAMERA, PROJECTOR, sample_calibration

OPENED: list[FakeDevice] = []


class FakeDevice:
    """Remembers how it was opened and whether it was closed."""

    def __init__(self, name: str, options: Mapping[str, object], folder: Path) -> None:
        self.name, self.options, self.folder, self.closed = name, options, folder, 0
        OPENED.append(self)

    def close(self) -> None:
        self.closed += 1
        if self.options.get("close") == "fails":
            message = "unplugged"
            raise DeviceGoneError(message)
        if self.options.get("close") == "breaks":
            message = "Input/output error"
            raise OSError(message)


class FakeCamera(FakeDevice):
    """A camera that shows nothing."""

    @property
    def info(self) -> CameraInfo:
        size = Size(CAMERA.width_px, int(str(self.options.get("rows", CAMERA.height_px))))
        return CameraInfo(
            self.name, "fake", "1", CameraFormat(size, 8), frozenset({Trigger.SOFTWARE}), (0.02, 0.5), (1, 4)
        )

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        return AppliedSettings(settings.exposure_s, settings.gain)

    def arm(self, count: int, trigger: Trigger) -> None:
        del count, trigger

    def trigger(self) -> None:
        pass

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        del after_ns, timeout_s
        message = "not armed"
        raise DeviceStateError(message)

    def disarm(self) -> None:
        pass


class FakeProjector(FakeDevice):
    """A projector that stays dark."""

    @property
    def info(self) -> ProjectorInfo:
        return ProjectorInfo(self.name, "fake", "1", PROJECTOR, plays=False, latency_s=0.0)

    def load(self, sequence: PatternSequence) -> None:
        del sequence

    def show(self, index: int) -> Shown:
        return Shown(index, 0, 0)

    def play(self, exposure_s: float, period_s: float) -> None:
        del exposure_s, period_s

    def stop(self) -> None:
        pass

    def blank(self) -> None:
        pass


class FakeHead:
    """Both in one."""

    def __init__(self, options: Mapping[str, object], folder: Path) -> None:
        self.projector: Projector = FakeProjector("projector", options, folder)
        self.cameras: Mapping[str, Camera] = {name: FakeCamera(name, options, folder) for name in ("left", "right")}
        self.calibration: Calibration | None = sample_calibration()

    def truth(self) -> Truth | None:
        return None


class FakeStage(FakeDevice):
    """A positioner that moves nothing."""

    poses = ("home",)

    def __init__(self, options: Mapping[str, object], folder: Path) -> None:
        super().__init__("stage", options, folder)

    def move(self, index: int) -> None:
        del index


class FakeStagedHead(FakeHead):
    """An instrument with a positioner of its own."""

    def __init__(self, options: Mapping[str, object], folder: Path) -> None:
        super().__init__(options, folder)
        self.positioner = FakeStage(options, folder)


class _Options(BaseModel):
    model_config = ConfigDict(extra="forbid")
    port: int


def open_camera(name: str, options: Mapping[str, object], folder: Path) -> Camera:
    return FakeCamera(name, options, folder)


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:
    return FakeProjector("projector", options, folder)


def open_lost(name: str, options: Mapping[str, object], folder: Path) -> NoReturn:
    del options, folder
    message = f"{name} is not there"
    raise DeviceGoneError(message)


def open_crashing(name: str, options: Mapping[str, object], folder: Path) -> NoReturn:
    del options, folder
    raise ZeroDivisionError(name)


def open_strict(name: str, options: Mapping[str, object], folder: Path) -> Camera:
    return FakeCamera(name, dict(_Options.model_validate(options)), folder)


def open_nothing(name: str, options: Mapping[str, object], folder: Path) -> object:
    return (name, options, folder)


def find_devices() -> tuple[FoundDevice, ...]:
    return (FoundDevice("fake", "usb-1", "a fake camera"),)


def find_crashing() -> NoReturn:
    message = "no bus"
    raise OSError(message)


HERE = __name__
DECLARED = f"""
[slrig.cameras]
fake = {HERE}:open_camera
lost = {HERE}:open_lost
crashing = {HERE}:open_crashing
strict = {HERE}:open_strict
nothing = {HERE}:open_nothing
broken = no_such_module:open_camera
constant = {HERE}:HERE
[slrig.projectors]
fake = {HERE}:open_projector
[slrig.heads]
fake = {HERE}:FakeHead
staged = {HERE}:FakeStagedHead
[slrig.positioners]
fake = {HERE}:FakeStage
[slrig.finders]
fake = {HERE}:find_devices
lost = {HERE}:find_crashing
"""


def _install(site: Path, package: str, declared: str) -> None:
    metadata = site / f"{package}-1.2.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
    (metadata / "entry_points.txt").write_text(declared)


@pytest.fixture(autouse=True)
def _site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    OPENED.clear()
    _install(tmp_path / "site", "fake_drivers", DECLARED)
    monkeypatch.syspath_prepend(tmp_path / "site")


def _camera(name: str, driver: str = "fake", more: str = "") -> str:
    return f'[[camera]]\nname = "{name}"\ndriver = "{driver}"\n{more}\n'


def _open(folder: Path, *cameras: str, top: str = "", projector: str = "fake") -> Rig:
    text = f'name = "bench"\n{top}\n[projector]\ndriver = "{projector}"\nport = 3\n' + "".join(cameras)
    (folder / "rig.toml").write_text(text)
    return open_rig(read_rig(folder / "rig.toml"))


def test_a_rig_is_opened_with_its_options(tmp_path: Path) -> None:
    rig = _open(tmp_path, _camera("left", more="exposure_s = 0.03\ngain = 2.0\nspeed = 5"), _camera("right"))
    assert rig.name == "bench"
    assert list(rig.cameras) == ["left", "right"]
    assert [(device.name, dict(device.options), device.folder) for device in OPENED] == [
        ("projector", {"port": 3}, tmp_path),
        ("left", {"speed": 5}, tmp_path),
        ("right", {}, tmp_path),
    ]
    assert rig.settings["left"] == CameraSettings(0.03, 2.0)
    # 1/60 s is below what the fake can do.
    assert rig.settings["right"] == CameraSettings(0.02, 1.0)
    assert rig.calibration is None
    rig.close()
    assert [device.closed for device in OPENED] == [1, 1, 1]


def test_the_scans_exposure_is_that_of_cameras_without_one(tmp_path: Path) -> None:
    rig = _open(tmp_path, _camera("left"), _camera("right", more="exposure_s = 0.3"), "[scan]\nexposure_s = 0.1\n")
    assert [settings.exposure_s for settings in rig.settings.values()] == [0.1, 0.3]


def test_a_head_brings_its_cameras_and_calibration(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text('name = "demo"\n[head]\ndriver = "fake"\ngain = 3.0\nseed = 1\n')
    rig = open_rig(read_rig(tmp_path / "rig.toml"))
    assert list(rig.cameras) == ["left", "right"]
    assert {settings.gain for settings in rig.settings.values()} == {3.0}
    assert rig.calibration is not None
    assert rig.head is not None
    assert dict(OPENED[0].options) == {"seed": 1}


STAGE = '[positioner]\ndriver = "fake"\nport = "a"\n'


def test_either_kind_of_rig_may_have_a_positioner(tmp_path: Path) -> None:
    rig = _open(tmp_path, _camera("left"), STAGE)
    assert isinstance(rig.positioner, FakeStage)
    assert dict(OPENED[-1].options) == {"port": "a"}
    rig.close()
    assert [device.closed for device in OPENED] == [1, 1, 1]
    (tmp_path / "rig.toml").write_text(f'name = "demo"\n[head]\ndriver = "fake"\n{STAGE}')
    assert isinstance(open_rig(read_rig(tmp_path / "rig.toml")).positioner, FakeStage)


def test_a_second_positioner_is_refused_and_all_is_closed_again(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(f'name = "demo"\n[head]\ndriver = "staged"\n{STAGE}')
    with pytest.raises(ConfigError, match="its head has a positioner, and its file names another; leave one out"):
        open_rig(read_rig(tmp_path / "rig.toml"))
    assert [device.closed for device in OPENED if device.options] == [1]
    OPENED.clear()
    with pytest.raises(ConfigError, match=r"(?s)2 of its tables.*camera driver 'fkae'.*positioner driver 'tabel'"):
        _open(tmp_path, _camera("left", "fkae"), STAGE.replace("fake", "tabel"))
    assert [device.closed for device in OPENED] == [1]


def test_the_rig_files_calibration_comes_before_the_heads(tmp_path: Path) -> None:
    write_calibration(tmp_path / "own.json", sample_calibration(cameras=("right",)))
    (tmp_path / "rig.toml").write_text('name = "demo"\ncalibration = "own.json"\n[head]\ndriver = "fake"\n')
    calibration = open_rig(read_rig(tmp_path / "rig.toml")).calibration
    assert calibration is not None
    assert list(calibration.cameras) == ["right"]


def test_a_calibration_of_one_camera_alone_is_refused_before_a_scan_fails_by_it(tmp_path: Path) -> None:
    write_calibration(tmp_path / "own.json", replace(sample_calibration(cameras=("right",)), projector=None))
    (tmp_path / "rig.toml").write_text('name = "demo"\ncalibration = "own.json"\n[head]\ndriver = "fake"\n')
    with pytest.raises(CalibrationError, match=r"own\.json: .*of camera 'right' alone, without a projector"):
        open_rig(read_rig(tmp_path / "rig.toml"))


def test_an_unknown_driver_is_told_with_those_installed(tmp_path: Path) -> None:
    with pytest.raises(DriverNotFoundError, match=r"camera driver 'fkae'.*broken, constant, crashing.*, fake, .*lost"):
        _open(tmp_path, _camera("left"), _camera("right", "fkae"))
    assert [device.closed for device in OPENED] == [1, 1]


def test_faults_of_several_tables_are_told_together_and_all_is_closed(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        _open(
            tmp_path,
            _camera("left", "fkae"),
            _camera("middle", "lost"),
            _camera("right", "strict", 'port = "x"\nspeed = 5'),
            _camera("top"),
            projector="skreen",
        )
    told = str(caught.value)
    assert told.startswith("rig 'bench': 3 of its tables are wrong; correct each and try again:\n")
    order = [
        "projector driver 'skreen'",
        "camera driver 'fkae'",
        "camera driver 'strict' does not take",
        "speed: unknown",
    ]
    places = [told.index(part) for part in order]
    assert places == sorted(places)
    assert "is not there" not in told
    assert [(device.name, device.closed) for device in OPENED] == [("top", 1)]


@pytest.mark.parametrize(
    ("driver", "error", "part"),
    [
        ("lost", DeviceGoneError, "right is not there"),
        ("crashing", DriverBrokenError, "'crashing' failed: ZeroDivisionError: right; report it"),
        ("broken", DriverBrokenError, r"of fake_drivers 1\.2 cannot be loaded \(no_such_module:open_camera\)"),
        ("constant", DriverBrokenError, "cannot be called"),
        ("nothing", DriverBrokenError, "returned tuple, which is no Camera"),
    ],
)
def test_devices_already_open_are_closed_when_one_fails(
    tmp_path: Path, driver: str, error: type[DeviceError], part: str
) -> None:
    with pytest.raises(error, match=part):
        _open(tmp_path, _camera("left"), _camera("right", driver))
    assert [(device.name, device.closed) for device in OPENED] == [("projector", 1), ("left", 1)]


@pytest.mark.parametrize("how", ["fails", "breaks"])
def test_a_device_that_cannot_be_closed_does_not_hide_the_error(tmp_path: Path, how: str) -> None:
    with pytest.raises(DeviceGoneError, match="right is not there"):
        _open(tmp_path, _camera("left", more=f'close = "{how}"'), _camera("right", "lost"))
    assert [device.closed for device in OPENED] == [1, 1]


@pytest.mark.parametrize("how", ["fails", "breaks"])
def test_a_device_that_cannot_be_closed_keeps_no_other_open(tmp_path: Path, how: str) -> None:
    rig = _open(tmp_path, _camera("left", more=f'close = "{how}"'), _camera("right"))
    assert [str(fault) for fault in rig.close()] == ["unplugged" if how == "fails" else "Input/output error"]
    assert [device.closed for device in OPENED] == [1, 1, 1]


def test_options_a_driver_does_not_take_are_all_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        _open(tmp_path, _camera("left", "strict", 'port = "x"\nspeed = 5'))
    assert "camera driver 'strict' does not take these options" in str(caught.value)
    assert "  speed: unknown key; remove it" in str(caught.value).splitlines()
    assert "  port: " in str(caught.value)
    assert [device.closed for device in OPENED] == [1]


def test_a_calibration_for_another_camera_is_refused_and_all_is_closed(tmp_path: Path) -> None:
    write_calibration(tmp_path / "own.json", sample_calibration())
    with pytest.raises(CalibrationError, match=r"own\.json: .*\n.*cameras\.left: expected 40 x 99"):
        _open(tmp_path, _camera("left", more="rows = 99"), top='calibration = "own.json"')
    assert [device.closed for device in OPENED] == [1, 1]


def test_a_missing_calibration_is_told_and_all_is_closed(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"own\.json: expected a readable file"):
        _open(tmp_path, _camera("left"), top='calibration = "own.json"')
    assert [device.closed for device in OPENED] == [1, 1]


def test_a_driver_provided_twice_is_refused(tmp_path: Path) -> None:
    _install(tmp_path / "site", "other_drivers", f"[slrig.cameras]\nfake = {HERE}:open_camera\n")
    with pytest.raises(DriverBrokenError, match="several packages: fake_drivers, other_drivers"):
        _open(tmp_path, _camera("left"))


def test_a_broken_driver_does_not_hide_the_others() -> None:
    drivers = {(one.kind, one.name): one for one in installed_drivers() if one.package == "fake_drivers"}
    assert len(drivers) == 13
    faulty = {key for key, one in drivers.items() if one.fault is not None}
    assert faulty == {("camera", "broken"), ("camera", "constant")}
    broken = drivers["camera", "broken"]
    assert (broken.package, broken.version, broken.target) == ("fake_drivers", "1.2", "no_such_module:open_camera")
    assert "ModuleNotFoundError" in str(broken.fault)


def test_the_rendered_rig_is_installed() -> None:
    simulated = [one for one in installed_drivers() if (one.kind, one.name) == ("head", "simulated")]
    assert [one.fault for one in simulated] == [None]


def test_a_failing_finder_does_not_hide_what_others_found() -> None:
    findings = found_devices()
    assert FoundDevice("fake", "usb-1", "a fake camera") in findings.devices
    assert ["finder driver 'lost' failed: OSError: no bus" in str(fault) for fault in findings.faults] == [True]


def test_the_fakes_are_what_the_protocols_ask_for() -> None:
    assert isinstance(FakeCamera("left", {}, Path()), Camera)
    assert isinstance(FakeProjector("projector", {}, Path()), Projector)
