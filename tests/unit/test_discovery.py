"""Drivers come from entry points of installed packages: here of one whose metadata is written for the test."""

from __future__ import annotations

import importlib.metadata
import itertools
import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import pytest
from pydantic import BaseModel, ConfigDict

from slrig import discovery
from slrig.bundle import write_calibration
from slrig.config import read_rig
from slrig.devices import (
    Camera,
    CameraInfo,
    CameraSettings,
    FoundDevice,
    Projector,
    ProjectorInfo,
    Rig,
    Trigger,
)
from slrig.discovery import DeviceSearch, DiscoveredDevices, discover_devices, installed_drivers, open_rig
from slrig.errors import (
    CalibrationError,
    ConfigError,
    DeviceError,
    DeviceGoneError,
    DriverBrokenError,
    RigBusyError,
)
from slrig.model import Calibration, CameraFormat, Size, Truth
from tests.samples import CAMERA, PROJECTOR, sample_calibration
from tests.unit.scan.fakes import TameCamera, TameProjector

OPENED: list[FakeDevice] = []
FAULTS = {"fails": DeviceGoneError("unplugged"), "breaks": OSError("Input/output error")}


class FakeDevice:
    """Remembers how it was opened and how often it was closed."""

    def __init__(self, name: str, options: Mapping[str, object], folder: Path) -> None:
        self.name, self.options, self.folder, self.closings = name, options, folder, 0
        OPENED.append(self)

    def close(self) -> None:
        self.closings += 1
        if fault := FAULTS.get(str(self.options.get("close"))):
            raise fault


class FakeCamera(FakeDevice, TameCamera):
    """A camera that shows nothing."""

    def __init__(self, name: str, options: Mapping[str, object], folder: Path) -> None:
        super().__init__(name, options, folder)
        form = CameraFormat(Size(CAMERA.width_px, int(str(options.get("rows", CAMERA.height_px)))), 8)
        self.info = CameraInfo(name, "fake", "1", form, frozenset({Trigger.SOFTWARE}), (0.02, 0.5), (1, 4))


class FakeProjector(FakeDevice, TameProjector):
    """A projector that stays dark."""

    def __init__(self, name: str, options: Mapping[str, object], folder: Path) -> None:
        super().__init__(name, options, folder)
        self.blank_error = None
        self.info = ProjectorInfo(name, "fake", "1", PROJECTOR, plays=False, latency_s=0.0)


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

    def move(self, index: int) -> None:
        del index

    def __init__(self, options: Mapping[str, object], folder: Path) -> None:
        super().__init__("stage", options, folder)


class FakeStagedHead(FakeHead):
    """An instrument with a positioner of its own."""

    def __init__(self, options: Mapping[str, object], folder: Path) -> None:
        super().__init__(options, folder)
        self.positioner = FakeStage(options, folder)


class _Options(BaseModel):
    model_config = ConfigDict(extra="forbid")
    port: int


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
fake = {HERE}:FakeCamera
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


def _open(folder: Path, *cameras: str, top: str = "", projector: str = "fake", may_lose: bool = False) -> Rig:
    text = f'name = "bench"\n{top}\n[projector]\ndriver = "{projector}"\nport = 3\n' + "".join(cameras)
    (folder / "rig.toml").write_text(text)
    return open_rig(read_rig(folder / "rig.toml"), may_lose=may_lose)


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
    assert [device.closings for device in OPENED] == [1, 1, 1]
    # The scan's exposure is that of cameras without one.
    own = _camera("right", more="exposure_s = 0.3")
    rig = _open(tmp_path, _camera("left"), own, "[scan]\nexposure_s = 0.1\n")
    assert [settings.exposure_s for settings in rig.settings.values()] == [0.1, 0.3]


def test_a_head_brings_its_cameras_and_calibration(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text('name = "demo"\n[head]\ndriver = "fake"\ngain = 3.0\nseed = 1\n')
    rig = open_rig(read_rig(tmp_path / "rig.toml"))
    assert list(rig.cameras) == ["left", "right"]
    assert {settings.gain for settings in rig.settings.values()} == {3.0}
    assert rig.calibration is not None
    assert rig.head is not None
    assert dict(OPENED[0].options) == {"seed": 1}
    # The rig file's calibration comes before the head's.
    write_calibration(tmp_path / "own.json", sample_calibration(cameras=("right",)))
    (tmp_path / "rig.toml").write_text('name = "demo"\ncalibration = "own.json"\n[head]\ndriver = "fake"\n')
    calibration = open_rig(read_rig(tmp_path / "rig.toml")).calibration
    assert calibration is not None
    assert list(calibration.cameras) == ["right"]


STAGE = '[positioner]\ndriver = "fake"\nport = "a"\n'


def test_either_kind_of_rig_may_have_one_positioner_and_all_is_closed(tmp_path: Path) -> None:
    rig = _open(tmp_path, _camera("left"), STAGE)
    assert isinstance(rig.positioner, FakeStage)
    assert dict(OPENED[-1].options) == {"port": "a"}
    rig.close()
    assert [device.closings for device in OPENED] == [1, 1, 1]
    (tmp_path / "rig.toml").write_text(f'name = "demo"\n[head]\ndriver = "fake"\n{STAGE}')
    assert isinstance(open_rig(read_rig(tmp_path / "rig.toml")).positioner, FakeStage)
    OPENED.clear()
    (tmp_path / "rig.toml").write_text(f'name = "demo"\n[head]\ndriver = "staged"\n{STAGE}')
    with pytest.raises(ConfigError, match="its head has a positioner, and its file names another; leave one out"):
        open_rig(read_rig(tmp_path / "rig.toml"))
    assert [device.closings for device in OPENED if device.options] == [1]


@pytest.mark.parametrize(
    ("calibration", "words"),
    [
        (sample_calibration(), r"own\.json: .*\n.*cameras\.left: expected 40 x 99"),
        (
            replace(sample_calibration(cameras=("left",)), projector=None),
            r"own\.json: .*of camera 'left' alone, without a projector",
        ),
        (None, r"own\.json: no such file"),
    ],
)
def test_calibration_that_does_not_fit_is_refused_and_all_is_closed(
    tmp_path: Path, calibration: Calibration | None, words: str
) -> None:
    if calibration is not None:
        write_calibration(tmp_path / "own.json", calibration)
    rows = "rows = 99" if calibration is not None and calibration.projector else ""
    with pytest.raises(CalibrationError, match=words):
        _open(tmp_path, _camera("left", more=rows), top='calibration = "own.json"')
    assert [device.closings for device in OPENED] == [1, 1]


def test_faults_of_several_tables_are_reported_together_and_all_is_closed(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        _open(
            tmp_path,
            _camera("left", "fkae"),
            _camera("middle", "lost"),
            _camera("right", "strict", 'port = "x"\nspeed = 5'),
            _camera("top"),
            STAGE.replace("fake", "tabel"),
            projector="skreen",
        )
    message = str(caught.value)
    assert message.startswith("rig 'bench': 4 of its tables are wrong; correct each and try again:\n")
    assert re.search(r"camera driver 'fkae'.*broken, constant, crashing.*, fake, .*lost", message)
    assert "  port: " in message
    order = [
        "projector driver 'skreen'",
        "camera driver 'fkae'",
        "camera driver 'strict' refuses",
        "  speed: unknown key; remove it",
        "positioner driver 'tabel'",
    ]
    places = [message.index(part) for part in order]
    assert places == sorted(places)
    assert "is not there" not in message
    assert [(device.name, device.closings) for device in OPENED] == [("top", 1)]


@pytest.mark.parametrize(
    ("driver", "error", "part"),
    [
        ("lost", DeviceGoneError, "right is not there"),
        ("crashing", DriverBrokenError, "'crashing' failed to open its device: ZeroDivisionError: right; report it"),
        ("broken", DriverBrokenError, r"of fake_drivers 1\.2 cannot be loaded \(no_such_module:open_camera\)"),
        ("constant", DriverBrokenError, "cannot be called"),
        ("nothing", DriverBrokenError, "returned tuple, which is not a Camera"),
    ],
)
def test_devices_already_open_are_closed_when_one_fails(
    tmp_path: Path, driver: str, error: type[DeviceError], part: str
) -> None:
    with pytest.raises(error, match=part):
        _open(tmp_path, _camera("left"), _camera("right", driver))
    assert [(device.name, device.closings) for device in OPENED] == [("projector", 1), ("left", 1)]
    OPENED.clear()
    timing = "[synchronisation]\nlatency_s = 0.01\nlatency_error_s = 0.0\nline_time_s = { right = 1e-5 }\n"
    rig = _open(tmp_path, _camera("left"), _camera("right", driver), timing, may_lose=True)
    assert list(rig.cameras) == list(rig.settings) == ["left"]
    assert re.search(part, rig.lost["right"])
    assert [(device.name, device.closings) for device in OPENED] == [("projector", 0), ("left", 0)]


def test_without_what_can_measure_a_lost_camera_ends_the_opening(tmp_path: Path) -> None:
    with pytest.raises(DeviceGoneError, match="left is not there"):
        _open(tmp_path, _camera("left", "lost"), may_lose=True)
    with pytest.raises(ConfigError, match="strict"):
        _open(tmp_path, _camera("left"), _camera("right", "lost"), _camera("third", "strict"), may_lose=True)
    write_calibration(tmp_path / "own.json", replace(sample_calibration(), projector=None))
    with pytest.raises(DeviceGoneError, match="right is not there"):
        _open(tmp_path, _camera("left"), _camera("right", "lost"), top='calibration = "own.json"', may_lose=True)
    assert {device.closings for device in OPENED} == {1}


@pytest.mark.parametrize(("how", "words"), [("fails", "unplugged"), ("breaks", "Input/output error")])
def test_device_that_cannot_be_closed_hides_no_error_and_keeps_no_other_open(
    tmp_path: Path, how: str, words: str
) -> None:
    left = _camera("left", more=f'close = "{how}"')
    with pytest.raises(DeviceGoneError, match="right is not there"):
        _open(tmp_path, left, _camera("right", "lost"))
    assert [device.closings for device in OPENED] == [1, 1]
    OPENED.clear()
    rig = _open(tmp_path, left, _camera("right"))
    assert [str(fault) for fault in rig.close()] == [words]
    assert [device.closings for device in OPENED] == [1, 1, 1]


def test_a_broken_driver_does_not_hide_the_others_and_one_of_two_packages_is_refused(tmp_path: Path) -> None:
    found = installed_drivers()
    assert [one.fault for one in found if (one.kind, one.name) == ("head", "simulated")] == [None]
    drivers = {(one.kind, one.name): one for one in found if one.package == "fake_drivers"}
    assert len(drivers) == 13
    faulty = {key for key, one in drivers.items() if one.fault is not None}
    assert faulty == {("camera", "broken"), ("camera", "constant")}
    broken = drivers["camera", "broken"]
    assert (broken.package, broken.version, broken.target) == ("fake_drivers", "1.2", "no_such_module:open_camera")
    assert "ModuleNotFoundError" in str(broken.fault)
    _install(tmp_path / "site", "other_drivers", f"[slrig.cameras]\nfake = {HERE}:FakeCamera\n")
    with pytest.raises(DriverBrokenError, match="several packages: fake_drivers, other_drivers"):
        _open(tmp_path, _camera("left"))


def test_a_failing_finder_does_not_hide_the_devices_of_others() -> None:
    findings = discover_devices()
    assert FoundDevice("fake", "usb-1", "a fake camera") in findings.devices
    assert ["finder driver 'lost' failed: OSError: no bus" in str(fault) for fault in findings.faults] == [True]


class WordlessError(BaseException):
    """An error that has no text."""

    def __str__(self) -> str:
        raise SystemExit(3)


def raising(error: BaseException) -> Callable[[], object]:
    def find() -> object:
        raise error

    return find


@pytest.fixture
def finders(monkeypatch: pytest.MonkeyPatch) -> dict[str, Callable[[], object]]:
    """Finders in place of the installed ones, by name."""
    found: dict[str, Callable[[], object]] = {"whole": lambda: [FoundDevice("whole", "usb-1", "a camera\x1b[2J")]}

    class Entry(importlib.metadata.EntryPoint):
        def load(self) -> object:
            return found[self.name]

    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [Entry(name, "m:f", group) for name in found])
    return found


@pytest.mark.parametrize(
    ("find", "words"),
    [
        (raising(SystemExit(3)), "SystemExit: 3"),
        (raising(KeyboardInterrupt()), "KeyboardInterrupt"),
        (raising(WordlessError()), "WordlessError"),
        (raising(RuntimeError("/dev/\udcff")), "RuntimeError: /dev/\\udcff"),
        (raising(RuntimeError("x" * 10**6)), "RuntimeError: xxx"),
        (raising(DeviceError("no \udcff bus")), "no \\udcff bus"),
        (lambda: None, "TypeError"),
        (lambda: ["usb-1"], "a FoundDevice is expected"),
        (lambda: [FoundDevice("odd", 5, "a camera")], "a str is expected"),  # type: ignore[arg-type]
        (lambda: itertools.repeat(5), "a FoundDevice is expected"),
    ],
)
def test_whatever_a_finder_does_is_told_in_words_and_hides_no_other(
    finders: dict[str, Callable[[], object]], find: Callable[[], object], words: str
) -> None:
    finders["odd"] = find
    found = discover_devices()
    assert found.devices == (FoundDevice("whole", "usb-1", "a camera\\u001b[2J"),)
    (fault,) = found.faults
    assert "odd" in str(fault)
    assert words in str(fault)
    assert len(str(fault)) < 3000
    str(fault).encode()


def test_a_finder_that_hangs_is_left_behind_until_it_returns(
    finders: dict[str, Callable[[], object]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(discovery, "FINDER_LIMIT_S", 0.01)
    calls, go = list[int](), threading.Event()

    def find() -> object:
        calls.append(1)
        go.wait()
        return ()

    finders["odd"] = find
    for _ in range(2):
        found = discover_devices()
        assert len(found.devices) == 1
        assert "finder 'odd' has not come back" in str(found.faults[0])
    assert len(calls) == 1
    go.set()
    discovery._looking["odd"].join()
    monkeypatch.setattr(discovery, "FINDER_LIMIT_S", 30.0)
    assert discover_devices().faults == ()


def test_devices_are_never_searched_beside_a_job(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [DiscoveredDevices((), (), ()), DiscoveredDevices((), (), ())]
    left = list(found)
    monkeypatch.setattr(discovery, "discover_devices", lambda: left.pop(0))
    devices = DeviceSearch()
    with pytest.raises(RigBusyError, match="held by scan 7"):
        devices.found("scan 7")
    assert (devices.found(None), devices.found("scan 7"), left) == (found[0], found[0], found[1:])
    assert devices.found(None) is found[1]
