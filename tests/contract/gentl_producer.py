"""A GenTL producer of our own: what a vendor's .cti file is to harvesters, before a camera in memory.

A shared library in C calls on what is done here. Names, numbers, meanings: EMVA's GenICam GenTL Standard, version 1.5.
"""

# ruff: noqa: ARG002, N802 - methods have GenTL's names and arguments

from __future__ import annotations

import ctypes
import shutil
import struct
import subprocess
import threading
from collections import deque
from collections.abc import Callable
from ctypes import c_char_p, c_int32, c_size_t, c_uint32, c_uint64, c_void_p
from pathlib import Path
from typing import Any

from tests.contract.gentl_camera import XML_ADDRESS, Exposed, MemoryCamera

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
        text = {0: self._identity, 1: "Slrig", 2: "Memory", 3: "Custom", 4: "Memory camera", 7: self.camera.serial}
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
