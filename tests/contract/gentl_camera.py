"""A GenICam camera in memory: a description of its features, the registers behind them, and a sensor before a stage."""

from __future__ import annotations

import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from slrig.model import Size
from tests.contract.genicam_bench import Fate
from tests.contract.stage import Stage

XML_ADDRESS = 0x10000
CLOCK_ZERO_NS = 77_000_000_000
"""What the camera's clock showed when the host's showed 0."""

OVERHEAD_S = 0.001
"""From the end of an exposure to the next one's start, at least."""

PIXEL_FORMATS = {"Mono8": 0x01080001, "Mono12": 0x01100005}
REGISTERS = {
    "Width": (0x100, "I"),
    "Height": (0x104, "I"),
    "PixelFormat": (0x108, "I"),
    "PayloadSize": (0x10C, "I"),
    "AcquisitionMode": (0x110, "I"),
    "AcquisitionStart": (0x114, "I"),
    "AcquisitionStop": (0x118, "I"),
    "TLParamsLocked": (0x11C, "I"),
    "TriggerSelector": (0x120, "I"),
    "TriggerMode": (0x124, "I"),
    "TriggerSource": (0x128, "I"),
    "TriggerSoftware": (0x12C, "I"),
    "ExposureAuto": (0x130, "I"),
    "TimestampLatch": (0x134, "I"),
    "TimestampLatchValue": (0x140, "q"),
    "ExposureTime": (0x148, "d"),
    "Gain": (0x150, "d"),
    "ResultingFrameRate": (0x158, "d"),
    "ReverseX": (0x160, "I"),
    "DeviceUserID": (0x180, "16s"),
}
_BY_ADDRESS = {address: (name, code) for name, (address, code) in REGISTERS.items()}
_ENUMERATIONS = {
    "PixelFormat": PIXEL_FORMATS,
    "AcquisitionMode": {"Continuous": 0},
    "TriggerSelector": {"FrameStart": 0},
    "TriggerMode": {"Off": 0, "On": 1},
    "TriggerSource": {"Software": 0, "Line1": 1},
    "ExposureAuto": {"Off": 0, "Continuous": 1},
}
_RANGES = {"Width": (8, 640, 4), "Height": (8, 480, 2), "ExposureTime": (20.0, 1e6), "Gain": (1.0, 16.0)}
_COMMANDS = ("AcquisitionStart", "AcquisitionStop", "TriggerSoftware", "TimestampLatch")
_READ_ONLY = ("PayloadSize", "TimestampLatchValue", "ResultingFrameRate")


def description(*, without: tuple[str, ...] = ()) -> str:
    """The camera's features as GenApi reads them; some may be left out."""
    nodes = []
    names = [name for name in REGISTERS if name not in without]
    for name in names:
        address, code = REGISTERS[name]
        mode = "RO" if name in _READ_ONLY else "WO" if name in _COMMANDS else "RW"
        # Cached, as cameras' descriptions ask for: who reads back must ask for the camera's own word.
        cache = "NoCache" if name in {*_READ_ONLY, *_COMMANDS} else "WriteThrough"
        place = (
            f"<Address>{address:#x}</Address><Length>{struct.calcsize(code)}</Length><AccessMode>{mode}</AccessMode>"
        )
        place += f"<pPort>Device</pPort><Cachable>{cache}</Cachable>"
        value = f"<pValue>{name}Register</pValue>"
        least, most, *step = _RANGES.get(name, (0, 2**31))
        bounds = f"<Min>{least}</Min><Max>{most}</Max>"
        if code == "16s":
            nodes.append(f'<StringReg Name="{name}">{place}</StringReg>')
            continue
        if name in _ENUMERATIONS:
            entries = "".join(
                f'<EnumEntry Name="{entry}"><Value>{number}</Value></EnumEntry>'
                for entry, number in _ENUMERATIONS[name].items()
            )
            nodes.append(f'<Enumeration Name="{name}">{entries}{value}</Enumeration>')
        elif name in _COMMANDS:
            nodes.append(f'<Command Name="{name}">{value}<CommandValue>1</CommandValue></Command>')
        elif name == "ReverseX":
            nodes.append(f'<Boolean Name="{name}">{value}<OnValue>1</OnValue><OffValue>0</OffValue></Boolean>')
        elif code == "d":
            nodes.append(f'<Float Name="{name}">{value}{bounds if name in _RANGES else ""}</Float>')
        else:
            inc = f"<Inc>{step[0]}</Inc>" if step else ""
            nodes.append(f'<Integer Name="{name}">{value}{bounds if name in _RANGES else ""}{inc}</Integer>')
        if code == "d":
            nodes.append(f'<FloatReg Name="{name}Register">{place}<Endianess>LittleEndian</Endianess></FloatReg>')
        else:
            sign = "<Sign>Unsigned</Sign><Endianess>LittleEndian</Endianess>"
            nodes.append(f'<IntReg Name="{name}Register">{place}{sign}</IntReg>')
    features = "".join(f"<pFeature>{name}</pFeature>" for name in names)
    schema = "http://www.genicam.org/GenApi/Version_1_1"
    return (
        '<?xml version="1.0" encoding="utf-8"?><RegisterDescription ModelName="Memory" VendorName="Slrig" '
        'StandardNameSpace="None" SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" '
        'MajorVersion="1" MinorVersion="0" SubMinorVersion="0" ToolTip="" '
        'ProductGuid="1A2B3C4D-0000-4000-8000-000000000001" VersionGuid="1A2B3C4D-0000-4000-8000-000000000002" '
        f'xmlns="{schema}" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" '
        f'xsi:schemaLocation="{schema} {schema}/GenApiSchema.xsd">'
        f'<Category Name="Root">{features}</Category>{"".join(nodes)}<Port Name="Device"/></RegisterDescription>'
    )


@dataclass(frozen=True)
class Exposed:
    """A frame that was made: its number, its time by the camera's clock, its bytes, and whether it came whole."""

    number: int
    stamp_ns: int
    data: bytes
    size: Size
    whole: bool


@dataclass
class MemoryCamera:
    """The camera. `deliver` takes each frame that leaves it.

    first_frame : the number of the first frame after a start. without : features that it lacks.
    """

    stage: Stage
    fate: Callable[[], Fate] = Fate
    first_frame: int = 0
    without: tuple[str, ...] = ()
    serial: str = "M1"
    deliver: Callable[[Exposed], None] = field(default=lambda _: None, repr=False)

    def __post_init__(self) -> None:
        self.exposures: deque[tuple[int, int]] = deque(maxlen=10_000)
        self.plugged = True
        self.xml = description(without=self.without).encode()
        self._values: dict[str, float | bytes] = dict.fromkeys(REGISTERS, 0)
        self._values |= {"Width": 120, "Height": 90, "PixelFormat": PIXEL_FORMATS["Mono8"], "ExposureTime": 5000.0}
        self._values |= {"Gain": 1.0, "ExposureAuto": 1, "DeviceUserID": b""}
        self._triggered = threading.Semaphore(0)
        self._running = threading.Event()
        self._exposing = False
        self._thread: threading.Thread | None = None

    def read(self, address: int, count: int) -> bytes:
        if address >= XML_ADDRESS:
            at = address - XML_ADDRESS
            return self.xml[at : at + count]
        name, code = _BY_ADDRESS[address]
        return struct.pack(f"<{code}", self._value(name))[:count]

    def write(self, address: int, data: bytes) -> None:
        """Write a register; a command is carried out. Raises KeyError: there is nothing."""
        name, code = _BY_ADDRESS[address]
        (value,) = struct.unpack(f"<{code}", data)
        if name == "ExposureTime":
            value = round(value / 20) * 20.0
        elif name == "Gain":
            value = round(value * 2) / 2
        self._values[name] = value
        match name:
            case "AcquisitionStart":
                self.stop()
                self._running.set()
                self._thread = threading.Thread(target=self._run, daemon=True)
                self._thread.start()
            case "AcquisitionStop":
                self.stop()
            case "TriggerSoftware" if not self._exposing and self._values["TriggerSource"] == 0:
                self._triggered.release()
            case "TimestampLatch":
                self._values["TimestampLatchValue"] = time.monotonic_ns() + CLOCK_ZERO_NS

    def pulse(self) -> None:
        if not self._exposing and self._values["TriggerSource"] == 1:
            self._triggered.release()

    def stop(self) -> None:
        self._running.clear()
        self._triggered.release()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        while self._triggered.acquire(blocking=False):
            pass

    def _value(self, name: str) -> float | bytes:
        if name == "PayloadSize":
            deep = 1 if self._values["PixelFormat"] == PIXEL_FORMATS["Mono8"] else 2
            return int(self._values["Width"]) * int(self._values["Height"]) * deep
        if name == "ResultingFrameRate":
            return 1 / (float(self._values["ExposureTime"]) / 1e6 + OVERHEAD_S)
        return self._values[name]

    def _run(self) -> None:
        number = self.first_frame
        never = threading.Event()
        while True:
            if self._values["TriggerMode"]:
                self._triggered.acquire()
            if not self._running.is_set():
                return
            self._exposing = True
            fate = self.fate()
            if fate.delay_s:
                never.wait(fate.delay_s)
            start_ns = time.monotonic_ns()
            end_ns = start_ns + round(float(self._values["ExposureTime"]) * 1000)
            while (left_ns := end_ns - time.monotonic_ns()) > 0:
                never.wait(left_ns / 1e9)
            self.exposures.append((start_ns, end_ns))
            self._exposing = False
            size = Size(int(self._values["Width"]), int(self._values["Height"]))
            image = self.stage.exposed(start_ns, end_ns, gain=float(self._values["Gain"]))
            data = image[: size.height_px, : size.width_px].tobytes()
            if fate.held_s:
                never.wait(fate.held_s)
            if fate.lost < 1:
                self.deliver(Exposed(number, start_ns + CLOCK_ZERO_NS, data, size, whole=fate.lost == 0))
            number += 1
            never.wait(OVERHEAD_S)
