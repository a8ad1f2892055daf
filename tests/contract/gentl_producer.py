"""A GenTL producer of our own, before a GenICam camera in memory. Names: GenICam GenTL Standard, version 1.5."""

# ruff: noqa: ARG002, N802 - methods have GenTL's names and arguments

from __future__ import annotations

import ctypes
import shutil
import struct
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from ctypes import c_char_p, c_int32, c_size_t, c_uint32, c_uint64, c_void_p
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from slrig.model import Size
from tests.contract.genicam_bench import Fate
from tests.contract.stage import Stage

UNKNOWN, IN_USE, DENIED, BAD_HANDLE, IO = -1003, -1004, -1005, -1006, -1010
LATE, UNAVAILABLE, BAD_ADDRESS, TOO_SMALL = -1011, -1014, -1015, -1016
TL, INTERFACE, DEVICE, PORT, STREAM, NEW_BUFFER = 1, 2, 3, 4, 5, 6
_TEXT, _I32, _U32, _U64, _POINTER, _BOOL, _SIZE = 1, 5, 6, 8, 10, 11, 12
_PACKED = {_U32: "<I", _U64: "<Q", _SIZE: "<Q", _BOOL: "<B", _I32: "<i", _POINTER: "<Q"}

_TYPES = {"p": c_void_p, "i": c_int32, "I": c_uint32, "Q": c_uint64, "z": c_size_t, "s": c_char_p}
_TABLE = """
GCInitLib: GCCloseLib: GCGetInfo:ippp GCGetLastError:ppp GCReadPort:pQpp GCWritePort:pQpp GCGetPortURL:ppp
GCGetPortInfo:pippp GCGetNumPortURLs:pp GCGetPortURLInfo:pIippp GCReadPortStacked:ppp GCWritePortStacked:ppp
GCRegisterEvent:pip GCUnregisterEvent:pi EventGetData:pppQ EventGetDataInfo:ppzippp EventGetInfo:pippp
EventFlush:p EventKill:p TLOpen:p TLClose:p TLGetInfo:pippp TLGetNumInterfaces:pp TLGetInterfaceID:pIpp
TLGetInterfaceInfo:psippp TLOpenInterface:psp TLUpdateInterfaceList:ppQ IFClose:p IFGetInfo:pippp
IFGetNumDevices:pp IFGetDeviceID:pIpp IFUpdateDeviceList:ppQ IFGetDeviceInfo:psippp IFOpenDevice:psip
DevGetPort:pp DevGetNumDataStreams:pp DevGetDataStreamID:pIpp DevOpenDataStream:psp DevGetInfo:pippp
DevClose:p DSAnnounceBuffer:ppzpp DSAllocAndAnnounceBuffer:pzpp DSFlushQueue:pi DSStartAcquisition:piQ
DSStopAcquisition:pi DSGetInfo:pippp DSGetBufferID:pIp DSClose:p DSRevokeBuffer:pppp DSQueueBuffer:pp
DSGetBufferInfo:ppippp DSGetBufferChunkData:pppp IFGetParentTL:pp DevGetParentIF:pp DSGetParentDev:pp
"""
_CALLS = _TABLE.split()
"""The functions of GenTL 1.5 that harvesters' wheel asks for, and the types of their arguments."""

_SEVEN = ", ".join(f"void *{name}" for name in "abcdefg")


def build(folder: Path) -> Path:
    """Compile the shared library that calls on. Needs gcc."""
    source, library = folder / "producer.c", folder / "producer.cti"
    lines = [f"typedef int (*call)({_SEVEN}); static call calls[{len(_CALLS)}];"]
    lines.append("void call_on(int index, call to) { calls[index] = to; }")
    for at, call in enumerate(_CALLS):
        lines.append(f"int {call.split(':')[0]}({_SEVEN}) {{ return calls[{at}](a, b, c, d, e, f, g); }}")
    source.write_text("\n".join(lines), encoding="ascii")
    compiler = shutil.which("gcc")
    assert compiler is not None
    subprocess.run([compiler, "-shared", "-fPIC", "-o", str(library), str(source)], check=True)  # noqa: S603
    return library


class GentlFaultError(Exception):
    """An error that a function returns."""

    def __init__(self, code: int) -> None:
        super().__init__(f"GenTL error {code}")
        self.code = code


class FakeProducer:
    """The producer in a file that `build` made, which serves one camera after another."""

    def __init__(self, file: Path, camera: MemoryCamera) -> None:
        self.file = file
        self.loaded = False
        self._library = ctypes.CDLL(str(file))
        self._called = []
        for index, call in enumerate(_CALLS):
            name, types = call.split(":")
            prototype = ctypes.CFUNCTYPE(c_int32, *(_TYPES[each] for each in types))
            called = prototype(self._answering(getattr(self, f"_{name}", None) or _GIVEN.get(name)))
            self._called.append(called)
            self._library.call_on(c_int32(index), called)
        self._came = threading.Condition()
        self.serve(camera)

    def serve(self, camera: MemoryCamera) -> None:
        """Be there for a camera from now on."""
        self.camera = camera
        self.opened = False
        self.longest_wait_ms = 0
        camera.deliver = self._deliver
        self._memory: dict[int, tuple[int, int, int]] = {}
        self._free: deque[int] = deque()
        self._filled: deque[int] = deque()
        self._frames: dict[int, Exposed] = {}
        self._grabbing = False

    def _deliver(self, frame: Exposed) -> None:
        with self._came:
            # Without a free buffer a frame is lost, as everywhere.
            if self._grabbing and self._free:
                buffer = self._free.popleft()
                address, size, _ = self._memory[buffer]
                data = frame.data if frame.whole else frame.data[: len(frame.data) // 2]
                ctypes.memmove(address, data, min(len(data), size))
                self._frames[buffer] = frame
                self._filled.append(buffer)
                self._came.notify_all()

    @staticmethod
    def _answering(function: Callable[..., None] | None) -> Callable[..., int]:
        def call(*arguments: Any) -> int:
            if function is None:
                return UNKNOWN
            try:
                function(*arguments)
            except GentlFaultError as fault:
                return fault.code
            return 0

        return call

    # ---- the library

    def _GCInitLib(self) -> None:
        if self.loaded:
            raise GentlFaultError(IN_USE)
        self.loaded = True

    def _GCCloseLib(self) -> None:
        self.loaded = False

    def _GCGetInfo(self, *info: Any) -> None:
        self._TLGetInfo(TL, *info)

    def _GCGetLastError(self, code: int, text: int, size: int) -> None:
        _put(code, "<i", UNAVAILABLE)
        _give(_TEXT, "as it says", 0, text, size)

    # ---- ports

    def _GCReadPort(self, port: int, address: int, data: int, size: int) -> None:
        self._require_there(port)
        (count,) = struct.unpack("<Q", ctypes.string_at(size, 8))
        try:
            read = self.camera.read(address, count)
        except KeyError:
            raise GentlFaultError(BAD_ADDRESS) from None
        ctypes.memmove(data, read, len(read))
        _put(size, "<Q", len(read))

    def _GCWritePort(self, port: int, address: int, data: int, size: int) -> None:
        self._require_there(port)
        (count,) = struct.unpack("<Q", ctypes.string_at(size, 8))
        try:
            self.camera.write(address, ctypes.string_at(data, count))
        except KeyError:
            raise GentlFaultError(BAD_ADDRESS) from None

    def _GCGetPortInfo(self, port: int, what: int, *into: int) -> None:
        names = {TL: "TLPort", INTERFACE: "InterfacePort", DEVICE: "DevicePort", PORT: "Device", STREAM: "StreamPort"}
        text = {0: names[port], 1: "Slrig", 2: "Memory", 3: "Custom", 4: names[port], 11: "1.0", 12: names[port]}
        known: dict[int, tuple[int, Any]] = {each: (_TEXT, told) for each, told in text.items()}
        flags = {5: 1, 6: 0, 7: 1, 8: 1, 9: 0, 10: 0}
        _tell(known | {each: (_BOOL, flag) for each, flag in flags.items()}, what, into)

    def _GCGetNumPortURLs(self, port: int, count: int) -> None:
        if port != PORT:
            # The producer's own modules describe no features.
            raise GentlFaultError(UNAVAILABLE)
        _put(count, "<I", 1)

    def _GCGetPortURLInfo(self, port: int, index: int, what: int, *into: int) -> None:
        size = len(self.camera.xml)
        text = {0: f"Local:memory.xml;{XML_ADDRESS:x};{size:x}", 10: "memory.xml"}
        numbers = {1: 1, 2: 1, 3: 1, 4: 0, 5: 0, 9: 0}
        known: dict[int, tuple[int, Any]] = {each: (_TEXT, told) for each, told in text.items()}
        known |= {each: (_I32, number) for each, number in numbers.items()}
        _tell(known | {7: (_U64, XML_ADDRESS), 8: (_U64, size)}, what, into)

    def _nothing(self, *_: int) -> None:
        """What needs to be done: nothing."""

    _GCUnregisterEvent = _EventKill = _TLClose = _IFClose = _DSClose = _nothing

    # ---- events

    def _GCRegisterEvent(self, module: int, kind: int, event: int) -> None:
        if (module, kind) != (STREAM, 1):
            raise GentlFaultError(UNKNOWN)
        _put(event, "<Q", NEW_BUFFER)

    def _EventGetData(self, event: int, data: int, size: int, timeout_ms: int) -> None:
        self.longest_wait_ms = max(self.longest_wait_ms, timeout_ms)
        with self._came:
            if not self._filled and timeout_ms and self.camera.plugged:
                self._came.wait(timeout_ms / 1e3)
            if not self.camera.plugged:
                raise GentlFaultError(IO)
            if not self._filled:
                raise GentlFaultError(LATE)
            buffer = self._filled.popleft()
            user = self._memory[buffer][2]
        _put(data, "<QQ", buffer, user)
        _put(size, "<Q", 16)

    def _EventGetInfo(self, event: int, what: int, *into: int) -> None:
        _tell({0: (_I32, 1), 1: (_SIZE, len(self._filled)), 2: (_U64, 0), 3: (_SIZE, 16), 4: (_SIZE, 16)}, what, into)

    def _EventFlush(self, event: int) -> None:
        with self._came:
            self._filled.clear()

    # ---- what is there

    def _TLGetInfo(self, handle: int, what: int, *into: int) -> None:
        text = dict(enumerate(("SlrigTL", "Slrig", "Memory", "1.0", "Custom", self.file.name, str(self.file), "TL")))
        known: dict[int, tuple[int, Any]] = {each: (_TEXT, told) for each, told in text.items()}
        _tell(known | {8: (_I32, 0), 9: (_U32, 1), 10: (_U32, 5)}, what, into)

    def _TLUpdateInterfaceList(self, handle: int, changed: int, timeout_ms: int) -> None:
        if changed:
            _put(changed, "<B", 1)

    def _TLGetInterfaceInfo(self, handle: int, name: bytes, what: int, *into: int) -> None:
        self._IFGetInfo(INTERFACE, what, *into)

    def _IFGetInfo(self, handle: int, what: int, *into: int) -> None:
        _tell({0: (_TEXT, "interface"), 1: (_TEXT, "interface"), 2: (_TEXT, "Custom")}, what, into)

    _IFUpdateDeviceList = _TLUpdateInterfaceList

    def _IFGetNumDevices(self, handle: int, count: int) -> None:
        _put(count, "<I", int(self.camera.plugged))

    def _IFGetDeviceID(self, handle: int, index: int, *into: int) -> None:
        _give(_TEXT, self._identity, 0, *into)

    def _IFGetDeviceInfo(self, handle: int, name: bytes, what: int, *into: int) -> None:
        self._DevGetInfo(DEVICE, what, *into)

    def _IFOpenDevice(self, handle: int, name: bytes, access: int, opened: int) -> None:
        if self.opened:
            raise GentlFaultError(DENIED)
        self.opened = True
        _put(opened, "<Q", DEVICE)

    # ---- the device and its stream

    @property
    def _identity(self) -> str:
        return f"slrig-memory-{self.camera.serial}"

    def _DevGetInfo(self, handle: int, what: int, *into: int) -> None:
        text = {
            0: self._identity,
            1: "Slrig",
            2: "Memory",
            3: self.camera.link,
            4: "Memory camera",
            7: self.camera.serial,
        }
        _tell({each: (_TEXT, told) for each, told in text.items()} | {5: (_I32, 1)}, what, into)

    def _DevClose(self, handle: int) -> None:
        self.camera.stop()
        self.opened = False

    def _DSAnnounceBuffer(self, stream: int, memory: int, size: int, user: int | None, buffer: int) -> None:
        with self._came:
            number = max(self._memory, default=100) + 1
            self._memory[number] = (memory, size, user or 0)
        _put(buffer, "<Q", number)

    def _DSQueueBuffer(self, stream: int, buffer: int) -> None:
        with self._came:
            self._free.append(buffer)

    def _DSRevokeBuffer(self, stream: int, buffer: int, memory: int | None, user: int | None) -> None:
        with self._came:
            address, _, private = self._memory.pop(buffer)
        for into, value in ((memory, address), (user, private)):
            if into:
                _put(into, "<Q", value)

    def _DSFlushQueue(self, stream: int, operation: int) -> None:
        with self._came:
            self._free.clear()
            self._filled.clear()

    def _DSStartAcquisition(self, stream: int, flags: int, count: int) -> None:
        self._grabbing = True

    def _DSStopAcquisition(self, stream: int, flags: int) -> None:
        self._grabbing = False

    def _DSGetInfo(self, stream: int, what: int, *into: int) -> None:
        known: dict[int, tuple[int, Any]] = {0: (_TEXT, "stream"), 8: (_BOOL, int(self._grabbing)), 9: (_BOOL, 0)}
        _tell(known | {10: (_TEXT, "Custom"), 12: (_SIZE, 2)}, what, into)

    def _DSGetBufferInfo(self, stream: int, buffer: int, what: int, *into: int) -> None:
        memory, size, user = self._memory[buffer]
        known: dict[int, tuple[int, Any]] = {0: (_POINTER, memory), 1: (_SIZE, size), 2: (_POINTER, user)}
        known |= {5: (_BOOL, int(buffer in self._free)), 8: (_TEXT, "Custom")}
        if (frame := self._frames.get(buffer)) is not None:
            sizes = {9: len(frame.data), 10: frame.size.width_px, 11: frame.size.height_px, 22: frame.size.height_px}
            known |= {each: (_SIZE, number) for each, number in (sizes | {12: 0, 13: 0, 14: 0, 18: 0, 19: 1}).items()}
            known |= {4: (_BOOL, 1), 7: (_BOOL, int(not frame.whole)), 16: (_U64, frame.number)}
            known |= {28: (_U64, frame.stamp_ns)}
        _tell(known, what, into)

    def _require_there(self, port: int) -> None:
        if port != PORT:
            raise GentlFaultError(BAD_HANDLE)
        if not self.camera.plugged:
            raise GentlFaultError(IO)


def _handle(number: int) -> Callable[..., None]:
    return lambda *arguments: _put(arguments[-1], "<Q", number)


def _count(*arguments: int) -> None:
    _put(arguments[-1], "<I", 1)


def _name(name: str) -> Callable[..., None]:
    return lambda *arguments: _give(_TEXT, name, 0, *arguments[-2:])


_GIVEN: dict[str, Callable[..., None]] = {
    **{"TLOpen": _handle(TL), "TLOpenInterface": _handle(INTERFACE), "TLGetNumInterfaces": _count},
    **{"DevGetPort": _handle(PORT), "DevOpenDataStream": _handle(STREAM), "DevGetNumDataStreams": _count},
    **{"TLGetInterfaceID": _name("interface"), "DevGetDataStreamID": _name("stream")},
}
"""Of each kind there is one: functions that always give the same."""


def _put(address: int, code: str, *values: int) -> None:
    data = struct.pack(code, *values)
    ctypes.memmove(address, data, len(data))


def _tell(known: dict[int, tuple[int, Any]], what: int, into: tuple[int, ...]) -> None:
    """Answer what a function of the kind GetInfo asks for; raises GentlFaultError where nothing is known of it."""
    if what not in known:
        raise GentlFaultError(UNAVAILABLE)
    _give(*known[what], *into)


def _give(kind: int, value: Any, kind_into: int | None, into: int | None, size: int) -> None:
    """Give a value of a kind, or the size that it needs."""
    data = value.encode() + b"\0" if kind == _TEXT else struct.pack(_PACKED[kind], value)
    if kind_into:
        _put(kind_into, "<i", kind)
    if into:
        (room,) = struct.unpack("<Q", ctypes.string_at(size, 8))
        if room < len(data):
            raise GentlFaultError(TOO_SMALL)
        ctypes.memmove(into, data, len(data))
    _put(size, "<Q", len(data))


XML_ADDRESS = 0x10000
CLOCK_ZERO_NS = 77_000_000_000
"""What the camera's clock showed when the host's showed 0."""

OVERHEAD_S = 0.001
"""From the end of an exposure to the next one's start, at least."""

PIXEL_FORMATS = {"Mono8": 0x01080001, "Mono12": 0x01100005}
_NAMES = {
    "I": "Width Height PixelFormat PayloadSize AcquisitionMode AcquisitionStart AcquisitionStop TLParamsLocked "
    "TriggerSelector TriggerMode TriggerSource TriggerSoftware ExposureAuto TimestampLatch ReverseX "
    "TriggerActivation TriggerOverlap GammaEnable LUTEnable LineSelector UserSetSelector UserSetLoad "
    "BinningHorizontal DeviceLinkThroughputLimit GevSCPSPacketSize",
    "d": "ExposureTime Gain ResultingFrameRate TriggerDelay SharpnessEnhancement NoiseReduction BlackLevel "
    "LineDebouncerTime",
    "q": "TimestampLatchValue",
    "16s": "DeviceUserID",
}
"""Registers by the code of their content."""

REGISTERS = {
    name: (0x100 + 0x10 * place, code)
    for place, (code, name) in enumerate((code, name) for code, names in _NAMES.items() for name in names.split())
}
_BY_ADDRESS = {address: (name, code) for name, (address, code) in REGISTERS.items()}
_ENUMERATIONS = {
    "PixelFormat": PIXEL_FORMATS,
    "AcquisitionMode": {"Continuous": 0},
    "TriggerSelector": {"FrameStart": 0},
    "TriggerMode": {"Off": 0, "On": 1},
    "TriggerSource": {"Software": 0, "Line1": 1},
    "ExposureAuto": {"Off": 0, "Continuous": 1},
    "TriggerActivation": {"RisingEdge": 0, "FallingEdge": 1},
    "TriggerOverlap": {"Off": 0, "ReadOut": 1, "PreviousFrame": 2},
    "LineSelector": {"Line0": 0, "Line1": 1},
    "UserSetSelector": {"Default": 0, "UserSet1": 1},
}
_RANGES = {
    **{"Width": (8, 640, 4), "Height": (8, 480, 2), "ExposureTime": (20.0, 1e6), "Gain": (1.0, 16.0)},
    **{"TriggerDelay": (29.0, 1e6), "SharpnessEnhancement": (1.0, 4.0), "BinningHorizontal": (1, 4)},
    "DeviceLinkThroughputLimit": (10**6, 125 * 10**6),
}
_COMMANDS = ("AcquisitionStart", "AcquisitionStop", "TriggerSoftware", "TimestampLatch", "UserSetLoad")
_READ_ONLY = ("PayloadSize", "TimestampLatchValue", "ResultingFrameRate", "NoiseReduction")
_BOOLEAN = ("ReverseX", "GammaEnable", "LUTEnable")
_LOCKED = ("TriggerSource", "TriggerActivation", "TriggerOverlap", "ReverseX")
"""What is read-only while the trigger is on."""


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
        locked = "<pIsLocked>TriggerModeRegister</pIsLocked>" if name in _LOCKED else ""
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
            nodes.append(f'<Enumeration Name="{name}">{locked}{entries}{value}</Enumeration>')
        elif name in _COMMANDS:
            nodes.append(f'<Command Name="{name}">{value}<CommandValue>1</CommandValue></Command>')
        elif name in _BOOLEAN:
            nodes.append(f'<Boolean Name="{name}">{locked}{value}<OnValue>1</OnValue><OffValue>0</OffValue></Boolean>')
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

    without : features that it lacks. left : what another program left of its features. stored : what its UserSet1 has.
    link : what it is on, by its GenTL name.
    """

    stage: Stage
    fate: Callable[[], Fate] = Fate
    without: tuple[str, ...] = ()
    left: Mapping[str, float] = field(default_factory=dict)
    stored: Mapping[str, float] = field(default_factory=dict)
    serial: str = "M1"
    link: str = "Custom"
    deliver: Callable[[Exposed], None] = field(default=lambda _: None, repr=False)

    def __post_init__(self) -> None:
        self.exposures: deque[tuple[int, int]] = deque(maxlen=10_000)
        self.plugged = True
        self.xml = description(without=self.without).encode()
        self._values: dict[str, float | bytes] = dict.fromkeys(REGISTERS, 0)
        self._values |= {"Width": 120, "Height": 90, "PixelFormat": PIXEL_FORMATS["Mono8"], "ExposureTime": 5000.0}
        self._values |= {"Gain": 1.0, "ExposureAuto": 1, "DeviceUserID": b"", "TriggerDelay": 29.0}
        self._values |= {"SharpnessEnhancement": 1.0, "BinningHorizontal": 1, "GevSCPSPacketSize": 9000}
        self._values |= {"DeviceLinkThroughputLimit": 125 * 10**6, **self.left}
        self._triggered = threading.Semaphore(0)
        self._running = threading.Event()
        self._exposing = self._reading = False
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
            case "UserSetLoad" if self._values["UserSetSelector"] == 1:
                self._values |= self.stored
            case "TimestampLatch":
                self._values["TimestampLatchValue"] = time.monotonic_ns() + CLOCK_ZERO_NS

    def pulse(self) -> None:
        """An edge on the wire: ignored during an exposure and, unless triggers may overlap it, during read-out."""
        ready = not self._exposing and (self._values["TriggerOverlap"] or not self._reading)
        if ready and self._values["TriggerSource"] == 1:
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
        number = 0
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
            self._exposing, self._reading = False, True
            size = Size(int(self._values["Width"]), int(self._values["Height"]))
            image = self.stage.exposed(start_ns, end_ns, gain=float(self._values["Gain"]))
            data = image[: size.height_px, : size.width_px].tobytes()
            if fate.held_s:
                never.wait(fate.held_s)
            if fate.lost < 1:
                self.deliver(Exposed(number, start_ns + CLOCK_ZERO_NS, data, size, whole=fate.lost == 0))
            number += 1
            self._reading = False
            never.wait(OVERHEAD_S)
