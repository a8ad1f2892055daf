"""Drivers of installed packages, found by entry points; and the opening of the rig that a rig file describes.

A driver package declares factories in the groups below; slrig names no driver. A camera's factory is `open_camera(name,
options, folder) -> Camera`, a projector's `open_projector(options, folder) -> Projector`, a head's `open_head(options,
folder) -> ScannerHead`, a positioner's `open_positioner(options, folder) -> Positioner`; `options` are the
driver's own keys of the rig file, `folder` is the folder of that file. A finder is
`find_devices() -> tuple[FoundDevice, ...]`.

In the group slrig.options, a package may declare a pydantic model of a driver's options. It serves only to write rig
files, and loads neither the driver nor its vendor's library.
"""

from __future__ import annotations

import importlib.metadata
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from slrig.bundle import check_calibration, describe_errors, read_calibration, require_two_rays
from slrig.config import DriverTable, RigConfig
from slrig.devices import (
    Camera,
    CameraInfo,
    CameraSettings,
    Clock,
    FoundDevice,
    HasClock,
    HasPositioner,
    Positioner,
    Projector,
    Rig,
    ScannerHead,
    Synchronisation,
    SystemClock,
    require_camera_info,
    require_found,
    require_projector_info,
)
from slrig.errors import (
    CalibrationError,
    ConfigError,
    DeviceError,
    DriverBrokenError,
    DriverNotFoundError,
    LibraryMissingError,
    RigBusyError,
    SlrigError,
    WrongSystemError,
    is_interrupt,
)
from slrig.model import Calibration, require_millimetres, require_plausible
from slrig.printable import foreign_text

GROUPS: Mapping[str, str] = {
    "camera": "slrig.cameras",
    "projector": "slrig.projectors",
    "head": "slrig.heads",
    "positioner": "slrig.positioners",
    "finder": "slrig.finders",
}
OPTIONS_GROUP = "slrig.options"
DEFAULT_EXPOSURE_S = 1 / 60
"""Exposure of a camera without one in the rig file, or the nearest it can do: one period of most projectors."""


@dataclass(frozen=True, slots=True)
class InstalledDriver:
    """Driver that an installed package declares. fault : the reason why it cannot be loaded; None if it can."""

    kind: str
    name: str
    package: str
    version: str
    target: str
    fault: str | None


@dataclass(frozen=True, slots=True)
class MissingLibrary:
    """Driver that cannot find its devices until the command `install` has been run."""

    driver: str
    install: str
    message: str


@dataclass(frozen=True, slots=True)
class OtherSystem:
    """Driver that works on another operating system only."""

    driver: str
    message: str


@dataclass(frozen=True, slots=True)
class DiscoveredDevices:
    """Devices of all finders, libraries that finders lack, and other failures of finders.

    elsewhere : drivers for other operating systems.
    """

    devices: tuple[FoundDevice, ...]
    missing: tuple[MissingLibrary, ...]
    faults: tuple[DriverBrokenError, ...]
    elsewhere: tuple[OtherSystem, ...] = ()


def installed_drivers() -> tuple[InstalledDriver, ...]:
    """Drivers of all installed packages, sorted by kind and name; each is loaded to find out whether it can be."""
    drivers = []
    for kind, group in GROUPS.items():
        for entry in importlib.metadata.entry_points(group=group):
            fault = None
            try:
                _load(kind, entry)
            except DriverBrokenError as error:
                fault = str(error)
            package, version = _package_version(entry)
            drivers.append(InstalledDriver(kind, entry.name, package, version, entry.value, fault))
    return tuple(sorted(drivers, key=lambda driver: (driver.kind, driver.name, driver.package)))


def discover_devices() -> DiscoveredDevices:
    """Run every installed finder of connected devices; a finder that fails does not affect others."""
    devices: list[FoundDevice] = []
    missing: list[MissingLibrary] = []
    faults: list[DriverBrokenError] = []
    elsewhere: list[OtherSystem] = []
    for entry in sorted(importlib.metadata.entry_points(group=GROUPS["finder"]), key=lambda entry: entry.name):
        try:
            devices.extend(_found_by(entry))
        except LibraryMissingError as error:
            missing.append(MissingLibrary(entry.name, foreign_text(error.install), foreign_text(error)))
        except WrongSystemError as error:
            elsewhere.append(OtherSystem(entry.name, foreign_text(error)))
        except SlrigError as error:
            text = foreign_text(error)
            named = isinstance(error, DriverBrokenError) and entry.name in text
            faults.append(DriverBrokenError(text if named else f"finder '{entry.name}' failed: {text}"))
    return DiscoveredDevices(tuple(devices), tuple(missing), tuple(faults), tuple(elsewhere))


FINDER_LIMIT_S = 30.0
"""Time limit of a finder. After it the search goes on without it; it is not called again before it has returned."""

_MAX_FOUND = 1000
"""Devices of one finder; more is a finder that does not end."""

_looking: dict[str, threading.Thread] = {}
"""Threads of finders that have not returned, by their names."""


def _found_by(entry: importlib.metadata.EntryPoint) -> tuple[FoundDevice, ...]:
    """Devices of one finder, on a thread of its own. Raises its errors; DriverBrokenError: it hangs."""
    finder = _load("finder", entry)
    found: list[tuple[FoundDevice, ...] | SlrigError] = []

    def search() -> None:
        try:
            with _convert_driver_errors(f"finder driver '{entry.name}'", {}):
                found.append(tuple(require_found(each) for each in islice(finder(), _MAX_FOUND)))
        except SlrigError as error:
            found.append(error)

    before = _looking.get(entry.name)
    if before is None or not before.is_alive():
        before = _looking[entry.name] = threading.Thread(target=search, name=f"slrig-finder {entry.name}", daemon=True)
        before.start()
        before.join(FINDER_LIMIT_S)
    if not found:
        message = (
            f"finder '{entry.name}' has not come back for {FINDER_LIMIT_S:.0f} s, and its devices are not listed; "
            "unplug them and plug them in again, and report it to the driver's package"
        )
        raise DriverBrokenError(message)
    (result,) = found
    if isinstance(result, SlrigError):
        raise result
    return result


class DeviceSearch:
    """The search for devices, which touches hardware. Callers make one at a time."""

    def __init__(self) -> None:
        self._found: DiscoveredDevices | None = None

    def found(self, holder: str | None) -> DiscoveredDevices:
        """The connected devices. holder : of the rig; while it is held, the last result is returned.

        Raises RigBusyError: the rig is held, and no search was made before.
        """
        if holder is None:
            self._found = discover_devices()
        if self._found is None:
            message = (
                f"The rig is held by {holder}, and a search for devices would disturb it. Try again when that is over."
            )
            raise RigBusyError(message, holder=holder or "", since="")
        return self._found


def open_rig(config: RigConfig, *, may_lose: bool = False) -> Rig:
    """Open every device of a rig. If one fails, those that are open are closed again.

    may_lose : whether to do without cameras that cannot be opened, as long as the others and the projector can measure;
    `Rig.lost` says why. A fault of the rig file is raised all the same.

    Faults of the rig file are reported for all devices together. The calibration is that of the rig file or, without
    one, that of the head.
    Raises DriverNotFoundError: no installed package provides a driver of that name; DriverBrokenError: a driver cannot
    be loaded, or fails with an error that is not of slrig; ConfigError: a driver refuses the options of the rig file
    (several faults, unknown drivers among them, are one message); CalibrationError: the calibration is malformed, or
    made for devices of another size; DeviceError: a device cannot be opened.
    """
    lost: dict[str, SlrigError] | None = {} if may_lose else None
    with ExitStack() as opened:
        head, projector, cameras, positioner = _open_each(config, opened, lost)
        if config.head is not None:
            table_settings = dict.fromkeys(cameras, (config.head.exposure_s, config.head.gain))
        else:
            table_settings = {table.name: (table.exposure_s, table.gain) for table in config.cameras}
        settings = {
            name: CameraSettings(_exposure_s(camera.info, table_settings[name][0], config), table_settings[name][1])
            for name, camera in cameras.items()
        }
        try:
            calibration = _calibration(config, head, projector, cameras)
        except CalibrationError:
            # Alone, what is left of the cameras may have no depth.
            for error in (lost or {}).values():
                raise error from None
            raise
        rig = Rig(
            config.name,
            cameras,
            projector,
            settings,
            calibration,
            head,
            _synchronisation(config, [*cameras, *(lost or {})]),
            _clock(head),
            positioner,
            lost={name: str(error) for name, error in (lost or {}).items()},
        )
        opened.pop_all()
        return rig


def _open_each(
    config: RigConfig, opened: ExitStack, lost: dict[str, SlrigError] | None
) -> tuple[ScannerHead | None, Projector, Mapping[str, Camera], Positioner | None]:
    """Open every device of a rig; `opened` closes them again. lost : is filled with the errors of cameras that cannot
    be opened while others can; None has them raised. Raises as `open_rig`.
    """
    faults: list[ConfigError] = []

    def attempt(kind: str, table: DriverTable, protocol: type[Any], *name: str) -> Any:
        try:
            device = _open(kind, table, protocol, config.folder, *name)
        except ConfigError as error:
            faults.append(error)
            return None
        except SlrigError as error:
            # After a fault of the file, the other devices are opened only to collect their faults of the file.
            if faults:
                return None
            if kind != "camera" or lost is None:
                raise
            lost.update(dict.fromkeys(name, error))
            return None
        for each in (device.projector, *device.cameras.values()) if kind == "head" else (device,):
            opened.callback(_close_quietly, each)
        return device

    head: ScannerHead | None = None if config.head is None else attempt("head", config.head, ScannerHead)
    if config.head is None:
        if config.projector is None:
            message = f"rig '{config.name}' has neither a head nor a projector; add one of the tables to its file"
            raise ConfigError(message)
        projector = attempt("projector", config.projector, Projector)
        cameras = {table.name: attempt("camera", table, Camera, table.name) for table in config.cameras}
        if lost and len(lost) == len(cameras):
            raise next(iter(lost.values()))
        cameras = {name: camera for name, camera in cameras.items() if name not in (lost or {})}
    positioner = _head_positioner(head)
    if config.positioner is not None:
        if positioner is not None:
            message = f"rig '{config.name}': its head has a positioner, and its file names another; leave one out"
            faults.append(ConfigError(message))
        positioner = attempt("positioner", config.positioner, Positioner)
    if len(faults) == 1:
        raise faults[0]
    if faults:
        listed = "\n".join(str(fault) for fault in faults)
        message = f"rig '{config.name}': {len(faults)} of its tables are wrong; correct each and try again:\n{listed}"
        raise ConfigError(message)
    if head is not None:
        return head, head.projector, dict(head.cameras), positioner
    return None, projector, cameras, positioner


def _exposure_s(camera: CameraInfo, table_s: float | None, config: RigConfig) -> float:
    for exposure_s in (table_s, config.scan.exposure_s):
        if exposure_s is not None:
            return exposure_s
    min_s, max_s = camera.exposure_range_s
    return min(max(DEFAULT_EXPOSURE_S, min_s), max_s)


def _clock(head: object) -> Clock:
    return head.clock if isinstance(head, HasClock) else SystemClock()


def _head_positioner(head: object) -> Positioner | None:
    return head.positioner if isinstance(head, HasPositioner) else None


def _synchronisation(config: RigConfig, cameras: Collection[str]) -> Synchronisation | None:
    table = config.synchronisation
    if table is None:
        return None
    for key in ("line_time_s", "stamp_error_s"):
        unknown = sorted(set(getattr(table, key)) - set(cameras))
        if unknown:
            raise ConfigError(
                f"rig '{config.name}': synchronisation.{key} names {', '.join(unknown)}, the rig's cameras are "
                f"{', '.join(sorted(cameras))}; correct it, or measure again: slrig latency"
            )
    return Synchronisation(**table.model_dump())


def _calibration(
    config: RigConfig, head: ScannerHead | None, projector: Projector, cameras: Mapping[str, Camera]
) -> Calibration | None:
    if config.calibration is not None:
        calibration: Calibration | None = read_calibration(config.calibration)
        source = str(config.calibration)
    else:
        calibration = head.calibration if head is not None else None
        source = f"the head of rig '{config.name}'"
        if calibration is not None:
            require_plausible(calibration, source)
    if calibration is not None:
        require_millimetres(calibration, source)
        sizes = {name: camera.info.format.size for name, camera in cameras.items()}
        check_calibration(calibration, projector.info.size, sizes, source)
        require_two_rays(calibration, sizes, source)
    return calibration


def _close_quietly(device: Camera | Projector | Positioner) -> None:
    # The error that caused the closing matters, not those of closing.
    with suppress(BaseException):
        device.close()


def _open(kind: str, table: DriverTable, protocol: type[Any], folder: Path, *name: str) -> Any:
    entries = list(importlib.metadata.entry_points(group=GROUPS[kind], name=table.driver))
    if not entries:
        names = sorted({entry.name for entry in importlib.metadata.entry_points(group=GROUPS[kind])})
        installed = ", ".join(names) or "none"
        raise DriverNotFoundError(
            f"no installed package provides the {kind} driver '{table.driver}' (group {GROUPS[kind]}); installed: "
            f"{installed}; correct the name or install the driver's package"
        )
    if len(entries) > 1:
        packages = ", ".join(sorted(_package_version(entry)[0] for entry in entries))
        message = f"{kind} driver '{table.driver}' is provided by several packages: {packages}; uninstall all but one"
        raise DriverBrokenError(message)
    factory = _load(kind, entries[0])
    label = "".join(f"{kind} '{each}': " for each in name) + f"{kind} driver '{table.driver}'"
    with ExitStack() as opened:
        with _convert_driver_errors(label, table.options, " to open its device"), _convert_os_errors(label):
            device = factory(*name, table.options, folder)
            if hasattr(device, "close"):
                opened.callback(_close_quietly, device)
        # That reads all declarations of the device.
        with _convert_driver_errors(label, table.options, " in info"):
            if not isinstance(device, protocol):
                raise DriverBrokenError(
                    f"{label} opened its device and returned {type(device).__name__}, which is not a "
                    f"{protocol.__name__}; report it to the driver's package"
                )
            _require_described(kind, device)
        opened.pop_all()
        return device


def _require_described(kind: str, device: Any) -> None:
    """Raise TypeError or ValueError where what a device declares is nothing that a device has."""
    if kind == "camera":
        require_camera_info(device.info)
    elif kind == "projector":
        require_projector_info(device.info)
    elif kind == "head":
        _require_described("projector", device.projector)
        for camera in device.cameras.values():
            _require_described("camera", camera)


def _load(kind: str, entry: importlib.metadata.EntryPoint) -> Callable[..., Any]:
    package, version = _package_version(entry)
    try:
        factory = entry.load()
    except BaseException as cause:  # importing a package must not end the service
        if is_interrupt(cause):
            raise
        raise DriverBrokenError(
            f"{kind} driver '{entry.name}' of {package} {version} cannot be loaded ({entry.value}): "
            f"{type(cause).__name__}: {foreign_text(cause)}; install what it needs or uninstall it"
        ) from cause
    if not callable(factory):
        raise DriverBrokenError(
            f"{kind} driver '{entry.name}' of {package} {version}: {entry.value} cannot be called; report it there"
        )
    loaded: Callable[..., Any] = factory
    return loaded


@contextmanager
def _convert_os_errors(label: str) -> Iterator[None]:
    """Convert an error of the operating system while a device is opened to a fault of the device, not of its driver."""
    try:
        yield
    except OSError as cause:
        raise DeviceError(
            f"{label} failed to open its device: {foreign_text(cause)}; check cable, power and "
            "permissions, and that no other program holds it"
        ) from cause


@contextmanager
def _convert_driver_errors(label: str, options: Mapping[str, object], doing: str = "") -> Iterator[None]:
    """Convert the errors of a driver's factory to errors of slrig with the driver's name and kind, its `label`."""
    try:
        yield
    except SlrigError:
        raise
    except ValidationError as cause:
        message = f"{label} refuses these options:\n{describe_errors(cause, options, {})}"
        raise ConfigError(message) from cause
    except BaseException as cause:
        if is_interrupt(cause):
            raise
        text = f"{type(cause).__name__}: {foreign_text(cause)}"
        message = f"{label} failed{doing}: {text}; report it to the driver's package"
        raise DriverBrokenError(message) from cause


def _package_version(entry: importlib.metadata.EntryPoint) -> tuple[str, str]:
    found = entry.dist
    return ("an unknown package", "") if found is None else (found.name, found.version)


def driver_kinds(driver: str) -> tuple[str, ...]:
    """Return the kinds of device that a driver of that name opens: "camera", "projector", "head", "positioner".
    Raises DriverNotFoundError: no installed package provides a driver of that name.
    """
    names = {
        kind: {entry.name for entry in importlib.metadata.entry_points(group=group)}
        for kind, group in GROUPS.items()
        if kind != "finder"
    }
    kinds = tuple(kind for kind, known in names.items() if driver in known)
    if not kinds:
        installed = ", ".join(sorted(set().union(*names.values()))) or "none"
        message = (
            f"no installed package provides a driver '{driver}'; installed: {installed}; correct the name or install "
            "the driver's package"
        )
        raise DriverNotFoundError(message)
    return kinds


def option_model(driver: str) -> type[BaseModel] | None:
    """Return the model of a driver's options; None if its package declares none.
    Raises DriverBrokenError: it cannot be loaded, is not a pydantic model, or several packages declare one.
    """
    entries = list(importlib.metadata.entry_points(group=OPTIONS_GROUP, name=driver))
    if not entries:
        return None
    packages = ", ".join(sorted(_package_version(each)[0] for each in entries))
    if len(entries) > 1:
        message = f"the options of driver '{driver}' come from several packages: {packages}; uninstall all but one"
        raise DriverBrokenError(message)
    try:
        model: object = entries[0].load()
    except BaseException as cause:  # importing a package must not end the command
        if is_interrupt(cause):
            raise
        message = (
            f"the options of driver '{driver}' of {packages} cannot be loaded ({entries[0].value}): "
            f"{type(cause).__name__}: {foreign_text(cause)}; report it there"
        )
        raise DriverBrokenError(message) from cause
    if not (isinstance(model, type) and issubclass(model, BaseModel)):
        message = f"the options of driver '{driver}' of {packages} are not a pydantic model; report it there"
        raise DriverBrokenError(message)
    return model


def drivers_with_options(package: str) -> tuple[str, ...]:
    """Names of the drivers for which a package declares an option model, sorted."""
    entries = importlib.metadata.entry_points(group=OPTIONS_GROUP)
    return tuple(sorted({entry.name for entry in entries if _package_version(entry)[0] == package}))
