"""A GenICam camera: settings that are read back, and frames whose exposure is known to lie after an instant.

What is known of an exposure's start, and from where, is in `drivers.genicam.timing`. `Frame.t_start_ns` is the middle
of that interval and `t_err_ns` half of it; `read` returns a frame only if the whole interval lies after `after_ns`:

- software trigger: the exposure began after the call of `trigger` did, so a pattern that was shown before is whole;
- free-running: as the camera's clock says, tied to the host's by latching it; a camera without a latch is trusted to
  send a frame within the option `transfer_s` after its exposure;
- hardware trigger: the same, and a frame that follows a delivered one began after that one's reported end.

With a rolling shutter these are the times of the first row; the others follow it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

from drivers.genicam.aravis import AravisConnection
from drivers.genicam.connection import GenICamConnection
from drivers.genicam.features import differs
from drivers.genicam.gentl import GentlConnection
from drivers.genicam.options import GenICamCameraOptions, GenicamOptions, GentlOptions
from drivers.genicam.pixels import FORMATS
from drivers.genicam.session import Acquisition
from drivers.genicam.setup import choose_trigger_line, set_trigger, set_up_camera
from slrig.bundle.validation import checked
from slrig.devices import AppliedSettings, Camera, CameraInfo, CameraSettings, Trigger
from slrig.errors import UnsupportedByDeviceError
from slrig.model import CameraFormat, Frame

_RESENT_AFTER_NS = 400_000_000
_LATE_S = 0.2
_MAX_BUFFER_BYTES = 1 << 30
_MIN_BUFFERS = 8

_FRAME_RATE_FEATURES = ("AcquisitionResultingFrameRate", "ResultingFrameRate", "ResultingFrameRateAbs")
"""What tells the fastest rate that exposure, read-out and link allow: SFNC has no name for it, makers have theirs."""


class GenicamCamera:
    """Implements `slrig.devices.Camera`.

    Parameters
    ----------
    connection
        The open device; this camera closes it.
    options
        Checked already.

    Raises
    ------
    UnsupportedByDeviceError
        The device does not take an option, or takes it otherwise.
    """

    def __init__(self, connection: GenICamConnection, options: GenICamCameraOptions) -> None:
        self._name = connection.name
        self._options = options
        self._connection = connection
        self._state = self._connection.state
        self._session: Acquisition
        self._owes = False
        try:
            self._size = set_up_camera(self._connection, options)
            self._line = choose_trigger_line(self._connection, options)
            self._info = self._declared()
            self._rate = next((each for each in _FRAME_RATE_FEATURES if self._connection.features.has(each)), None)
            self._applied = self._in_use()
        except BaseException:
            self._connection.close()
            raise

    @property
    def info(self) -> CameraInfo:
        """See `Camera`. `gain` is in the camera's own unit, mostly dB."""
        return self._info

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`. A value that the camera rounds by more than 1 % is refused, with what it would use."""
        self._require_there()
        self._state.check_settings(settings, self._info)
        with self._connection.asking("setting exposure and gain") as camera:
            camera.set_exposure_time(settings.exposure_s * 1e6)
            if camera.is_gain_available():
                camera.set_gain(settings.gain)
        self._applied = self._in_use()
        for what, asked, got in (
            ("exposure_s", settings.exposure_s, self._applied.exposure_s),
            ("gain", settings.gain, self._applied.gain),
        ):
            if differs(got, asked):
                message = (
                    f"camera '{self._name}': asked for {what} {asked:g}, it gives {got:g}; ask for that, or for what "
                    "its other settings allow (frame rate, pixel format)"
                )
                raise UnsupportedByDeviceError(message)
        return self._applied

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`. Opens a stream of its own, so no frame of an earlier arming can come."""
        self._require_there()
        self._state.check_arming(count, trigger, self._info)
        source = {Trigger.FREE: None, Trigger.SOFTWARE: "Software", Trigger.HARDWARE: self._line}[trigger]
        set_trigger(self._connection, source, self._options)
        self._applied = self._in_use()
        session = Acquisition(self._connection, self._options, FORMATS[self._options.pixel_format], self._size)
        session.begin(trigger, self._applied, _MIN_BUFFERS if trigger is Trigger.FREE else self._buffers(count))
        self._session = session
        self._state.armed = trigger
        if self._owes and trigger is not Trigger.FREE:
            # A camera may keep a trigger that came while it was stopped, and expose now.
            session.drain(self._applied.exposure_s + _LATE_S)
            self._owes = False

    def trigger(self) -> None:
        """See `Camera`. While the frame of an earlier trigger is due, waits for that first."""
        self._require_there()
        self._state.require_armed(Trigger.SOFTWARE)
        self._session.settle()
        with self._connection.asking("triggering") as camera:
            begun_ns = time.monotonic_ns()
            camera.software_trigger()
            ended_ns = time.monotonic_ns()
        # A command whose answer was lost is sent again: the camera may have exposed twice.
        self._session.triggered(begun_ns, ended_ns, times=2 if ended_ns - begun_ns > _RESENT_AFTER_NS else 1)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera`, and the head of this module. Exposure and gain are those read back when it was armed."""
        self._require_there()
        self._state.require_armed()
        return self._session.read(after_ns, timeout_s)

    def disarm(self) -> None:
        """See `Camera`."""
        if self._state.armed is not None:
            # One that runs free is in the middle of an exposure, and may send it later than it is told to stop.
            self._owes = self._owes or self._state.armed is Trigger.FREE or self._session.owed()
            self._state.armed = None
            self._session.end()

    def close(self) -> None:
        """See `Camera`."""
        self.disarm()
        self._connection.close()

    def _declared(self) -> CameraInfo:
        with self._connection.asking("asking what it is") as camera:
            model = f"{camera.get_vendor_name()} {camera.get_model_name()}"
            serial = str(camera.get_device_serial_number() or camera.get_device_id())
            least_us, most_us = camera.get_exposure_time_bounds()
            gains = camera.get_gain_bounds() if camera.is_gain_available() else (1.0, 1.0)
            software = bool(camera.is_software_trigger_supported())
        triggers = {Trigger.FREE}
        if software:
            triggers.add(Trigger.SOFTWARE)
        if self._line is not None:
            triggers.add(Trigger.HARDWARE)
        return CameraInfo(
            name=self._name,
            model=model,
            serial=serial,
            format=CameraFormat(self._size, FORMATS[self._options.pixel_format].bit_depth),
            triggers=frozenset(triggers),
            exposure_range_s=(max(least_us, 1.0) / 1e6, most_us / 1e6),
            gain_range=(float(gains[0]), float(gains[1])),
            colour=bool(FORMATS[self._options.pixel_format].mosaic),
        )

    def _in_use(self) -> AppliedSettings:
        with self._connection.asking("reading exposure and gain") as camera:
            gain = float(camera.get_gain()) if camera.is_gain_available() else 1.0
            exposure_s = camera.get_exposure_time() / 1e6
        rate_hz = self._connection.features.number(self._rate) if self._rate is not None else 0.0
        return AppliedSettings(exposure_s, gain, 1 / rate_hz if rate_hz > 0 else None)

    def _buffers(self, count: int) -> int:
        """As many as frames are asked for, so that none is lost while nobody reads; fewer if memory forbids."""
        with self._connection.asking("asking for the size of a frame") as camera:
            payload = int(camera.get_payload())
        return max(_MIN_BUFFERS, min(count + 2, _MAX_BUFFER_BYTES // max(payload, 1)))

    def _require_there(self) -> None:
        self._state.require_open()
        if self._connection.is_lost:
            raise self._connection.gone("noticed before")


def open_camera(name: str, options: Mapping[str, object], folder: Path) -> Camera:
    """Open a GenICam camera from a rig file's `[[camera]]` table.

    Parameters
    ----------
    name
        As the rig file calls it.
    options
        `GenicamOptions`.
    folder
        Not used: a GenICam camera has no files.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    LibraryMissingError
        Aravis or PyGObject is not installed.
    DeviceGoneError
        No such camera answers.
    DeviceBusyError
        Another program controls it.
    UnsupportedByDeviceError
        The camera does not take an option, or takes it otherwise.
    """
    del folder
    table = checked(GenicamOptions, options, f"the [[camera]] table of '{name}' (driver genicam)")
    return GenicamCamera(AravisConnection(name, table), table)


def open_gentl_camera(name: str, options: Mapping[str, object], folder: Path) -> Camera:
    """Open a camera behind a GenTL producer from a rig file's `[[camera]]` table.

    Parameters
    ----------
    name
        As the rig file calls it.
    options
        `GentlOptions`.
    folder
        Where the path of a producer counts from.

    Raises
    ------
    ConfigError
        The options have faults, all of them in one message.
    LibraryMissingError
        harvesters is not installed, or there is no producer.
    DeviceGoneError
        No such camera answers.
    DeviceBusyError
        Another program controls it.
    UnsupportedByDeviceError
        The camera does not take an option, or takes it otherwise.
    """
    table = checked(GentlOptions, options, f"the [[camera]] table of '{name}' (driver gentl)")
    return GenicamCamera(GentlConnection(name, table, folder), table)
