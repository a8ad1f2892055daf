"""A GigE Vision camera in a process of its own: Aravis' fake one, whose photons come from the process that started it.

Protocol, registers, packets and stream are Aravis'. When a frame is due, its exposure begins, lasts as long as the
register says, and the starter is asked what the sensor saw meanwhile. Run with a file descriptor of a socket pair and
the kind of camera; commands come on standard input, and its end is the end.
"""

from __future__ import annotations

import ctypes
import importlib
import re
import socket
import struct
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

INTERFACE, SERIAL = "127.0.0.1", "SLRIG1"
BEGIN, END, READY = b"B", b"E", b"R"
ASKED = struct.Struct("<cqqIIII")
"""Kind of question, start and end of the exposure (ns), gain, pixel format, width, height."""
DELAY = struct.Struct("<d")
ANSWERED = struct.Struct("<dI")
"""Share of the packets that are lost, and bytes of the image, which follow."""

TRIGGERS_HZ = 250.0
"""How often the fake camera looks for a trigger; it does not sleep between looks that are less than 1 ms apart."""

CLOCK_TIGHT_NS = 20_000

HARD_WIRE = 0x350
"""Where the SFNC camera keeps its trigger source; the fake's own register always says software."""

PIXEL_FORMATS = {
    "Mono10": 0x01100003,
    "Mono12": 0x01100005,
    "Mono10Packed": 0x010C0004,
    "Mono12Packed": 0x010C0006,
    "Mono10p": 0x010A0046,
    "Mono12p": 0x010C0047,
    "BayerRG12": 0x01100011,
    "BayerGR8": 0x01080008,
    "Mono8": 0x01080001,
    "Mono16": 0x01100007,
    "RGB8": 0x02180014,
}

_GAIN = """
<Float Name="Gain" NameSpace="Standard"><pValue>GainConverter</pValue><Min>0</Min><Max>10</Max></Float>
<Converter Name="GainConverter" NameSpace="Custom"><FormulaTo>FROM</FormulaTo><FormulaFrom>TO</FormulaFrom>
<pValue>GainRawRegister</pValue></Converter>
"""


def read_exactly(stream: socket.socket, count: int) -> bytes:
    """So many bytes; fewer if the other side has gone."""
    got = b""
    while len(got) < count:
        part = stream.recv(count - len(got))
        if not part:
            break
        got += part
    return got


# As fast as exposure and 2 ms of read-out, one after the other, allow.
_RATE = """
<SwissKnife Name="ResultingFrameRate"><pVariable Name="EXPOSURE">ExposureTimeRegister</pVariable>
<Formula>1000000.0 / (EXPOSURE + 2000.0)</Formula></SwissKnife>
"""


def sfnc(xml: str, *, start: str = "FrameStart") -> str:
    """The fake camera's description in today's names (SFNC 2), with more pixel formats, a trigger line, and the rate
    that its settings result in. start : the trigger selector of what starts a frame.
    """
    formats = "".join(
        f'<EnumEntry Name="{name}" NameSpace="Standard"><Value>{code}</Value></EnumEntry>'
        for name, code in PIXEL_FORMATS.items()
    )
    edits = (
        ("ExposureTimeAbs", "ExposureTime"),
        (r'(?s)<Integer Name="GainRaw".*?</Integer>', _GAIN),
        ("<pFeature>GainRaw</pFeature>", "<pFeature>Gain</pFeature>"),
        (r'(?s)(<Enumeration Name="PixelFormat".*?</DisplayName>).*?(<pValue>)', rf"\1{formats}\2"),
        ('EnumEntry Name="Line0"', 'EnumEntry Name="Line1"'),
        ("<Address>0x304</Address>", f"<Address>{HARD_WIRE:#x}</Address>"),
        ('(?=<Float Name="AcquisitionFrameRate">)', _RATE),
        ('EnumEntry Name="FrameStart"', f'EnumEntry Name="{start}"'),
    )
    for old, new in edits:
        xml, found = re.subn(old, new, xml)
        assert found, old
    return xml


class Sensor:
    """What the fake camera calls to fill a buffer, on its own thread."""

    def __init__(self, library: ctypes.CDLL, fake: Any, starter: socket.socket) -> None:
        self._library = library
        self._fake = fake
        self._starter = starter
        self._never = threading.Event()

    def fill(self, buffer: int, _: object, exposure_us: int, gain: int, pixel_format: int) -> None:
        camera = self._fake.get_fake_camera()
        registers = importlib.import_module("gi.repository.Aravis")
        _, width = camera.read_register(registers.FAKE_CAMERA_REGISTER_WIDTH)
        _, height = camera.read_register(registers.FAKE_CAMERA_REGISTER_HEIGHT)
        self._starter.sendall(ASKED.pack(BEGIN, 0, 0, gain, pixel_format, width, height))
        (delay_s,) = DELAY.unpack(read_exactly(self._starter, DELAY.size))
        if delay_s:
            self._never.wait(delay_s)
        start_ns = time.monotonic_ns()
        # The camera's clock is the wall clock, with another zero than ours: read beside ours, not just after it.
        wall_ns, now_ns = time.time_ns(), time.monotonic_ns()
        while now_ns - start_ns > CLOCK_TIGHT_NS:
            start_ns, wall_ns, now_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        self._library.arv_buffer_set_timestamp(buffer, wall_ns)
        end_ns = start_ns + exposure_us * 1000
        while (left_ns := end_ns - time.monotonic_ns()) > 0:
            self._never.wait(left_ns / 1e9)
        self._starter.sendall(ASKED.pack(END, start_ns, end_ns, gain, pixel_format, width, height))
        lost, count = ANSWERED.unpack(read_exactly(self._starter, ANSWERED.size))
        image = read_exactly(self._starter, count)
        size = ctypes.c_size_t()
        at = self._library.arv_buffer_get_data(buffer, ctypes.byref(size))
        ctypes.memmove(at, image, count)
        self._fake.set_property("gvsp-lost-ratio", lost)


def main(descriptor: int, kind: str) -> None:
    gi = importlib.import_module("gi")
    gi.require_version("Aravis", "0.8")
    aravis = importlib.import_module("gi.repository.Aravis")
    starter = socket.socket(fileno=descriptor)
    if kind != "stock":
        text = aravis.FakeCamera.new(SERIAL).get_genicam_xml()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "camera.xml"
            start = "ExposureStart" if kind == "exposure start" else "FrameStart"
            path.write_text(sfnc(text if isinstance(text, str) else text[0], start=start), encoding="utf-8")
            fake = aravis.GvFakeCamera.new_full(INTERFACE, SERIAL, str(path))
    else:
        fake = aravis.GvFakeCamera.new(INTERFACE, SERIAL)
    if not fake.is_running():
        sys.exit("the GigE Vision port of the loopback interface is taken")
    camera = fake.get_fake_camera()
    camera.set_trigger_frequency(TRIGGERS_HZ)
    if kind != "stock":
        camera.write_register(aravis.FAKE_CAMERA_REGISTER_TRIGGER_SOURCE, 1)
    library = ctypes.CDLL("libaravis-0.8.so.0")
    # Introspection keeps a callback for the length of the call only, so this one is given by hand.
    prototype = ctypes.CFUNCTYPE(
        None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
    )
    library.arv_buffer_get_data.restype = ctypes.c_void_p
    library.arv_buffer_get_data.argtypes = [ctypes.c_void_p, ctypes.POINTER(ctypes.c_size_t)]
    library.arv_buffer_set_timestamp.argtypes = [ctypes.c_void_p, ctypes.c_uint64]
    library.arv_fake_camera_set_fill_pattern.argtypes = [ctypes.c_void_p, prototype, ctypes.c_void_p]
    fill = prototype(Sensor(library, fake, starter).fill)
    # The hash of an introspected object is its address.
    library.arv_fake_camera_set_fill_pattern(hash(camera), fill, None)
    starter.sendall(ASKED.pack(READY, 0, 0, 0, 0, 0, 0))
    for line in sys.stdin:
        if line.strip() == "pulse":
            camera.write_register(aravis.FAKE_CAMERA_REGISTER_TRIGGER_SOFTWARE, 1)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
