"""A fake of the kernel's side of a video device: it answers the requests as the kernel and a camera would.

Layouts are offsets as a C compiler gives them for `linux/videodev2.h` on a 64-bit machine. Needs no more than Python's
own library, for it is run by Debian's Python (`v4l2_server`).
"""

from __future__ import annotations

import errno
import json
import os
import random
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

QUERYCAP, ENUM_FMT, G_FMT, S_FMT = 0x80685600, 0xC0405602, 0xC0D05604, 0xC0D05605
REQBUFS, QUERYBUF, QBUF, DQBUF = 0xC0145608, 0xC0585609, 0xC058560F, 0xC0585611
STREAMON, STREAMOFF, G_PARM, S_PARM = 0x40045612, 0x40045613, 0xC0CC5615, 0xC0CC5616
G_CTRL, S_CTRL, QUERYCTRL, ENUM_FRAMESIZES = 0xC008561B, 0xC008561C, 0xC0445624, 0xC02C564A
G_EXT_CTRLS, ENUM_FRAMEINTERVALS = 0xC0205647, 0xC034564B
SIZES = {
    request: request >> 16 & 0x3FFF
    for request in (
        *(QUERYCAP, ENUM_FMT, G_FMT, S_FMT, REQBUFS, QUERYBUF, QBUF, DQBUF, STREAMON, STREAMOFF),
        *(G_PARM, S_PARM, G_CTRL, S_CTRL, QUERYCTRL, ENUM_FRAMESIZES, G_EXT_CTRLS, ENUM_FRAMEINTERVALS),
    )
}

EXPOSURE_AUTO, EXPOSURE_ABSOLUTE, FOCUS, GAIN = 0x009A0901, 0x009A0902, 0x009A090A, 0x00980913
EXPOSURE_LINES = 0x00980911
READ_ONLY = 4
PAGE = 4096
LAG_FRAMES = 3
MOST_BUFFERS = 32
LONGEST_WAIT_NS = 5_000_000
"""A plain file is always ready to be polled, so an empty answer is held back a while, as `poll` would have waited."""

CREEPS_S = 20.0
"""A control that creeps is away from its value by most of its range after so long, and back after as long again."""

STAMP_FLAGS = {"start": 0x12000, "first packet": 0x12000, "end": 0x2000, "none": 0, "other clock": 0x12000}


class Refused(Exception):  # noqa: N818 - an answer of the kernel, not a fault of ours
    """The request fails with this number."""

    def __init__(self, number: int) -> None:
        super().__init__(os.strerror(number))
        self.number = number


@dataclass
class Shot:
    """One frame of the sensor, ns: exposure, and when its last byte has arrived."""

    number: int
    start_ns: int
    exposure_ns: int
    done_ns: int
    lost: bool
    corrupt: bool


@dataclass
class Sensor:
    """A free-running sensor: frames follow one another from the start of the stream, at times that are drawn once."""

    config: dict[str, Any]
    rng: random.Random
    now_ns: Callable[[], int]
    begun_ns: int = 0
    period_ns: int = 0
    exposure_ns: int = 0
    before_ns: int = 0
    coming: Shot | None = None

    def start(self, period_ns: int, exposure_ns: int) -> None:
        self.period_ns = max(period_ns, exposure_ns) if self.config["stretches"] else period_ns
        self.begun_ns = self.now_ns() + round(self.config["first_frame_s"] * 1e9)
        # The settings of the stream before are in use for `LAG_FRAMES` yet.
        self.before_ns, self.exposure_ns = self.exposure_ns or exposure_ns, exposure_ns
        self.coming = self.drawn(0, 0)

    def drawn(self, number: int, not_before_ns: int) -> Shot:
        config = self.config
        start_ns = self.begun_ns + number * self.period_ns
        exposure_ns = self.before_ns if number < LAG_FRAMES else self.exposure_ns
        exposure_ns = min(exposure_ns, self.period_ns)
        late_ns = round(self.rng.random() * config["jitter_s"] * 1e9)
        done_ns = start_ns + exposure_ns + round(config["readout_s"] * 1e9) + late_ns
        lost, corrupt = self.rng.random() < config["lost"], self.rng.random() < config["corrupt"]
        return Shot(number, start_ns, exposure_ns, max(done_ns, not_before_ns), lost, corrupt)

    def done_until(self, now_ns: int) -> Iterator[Shot]:
        while self.coming is not None and self.coming.done_ns <= now_ns:
            done, self.coming = self.coming, self.drawn(self.coming.number + 1, self.coming.done_ns)
            yield done


@dataclass
class Light:
    """What the sensor sees, asked from the test."""

    path: str
    stream: Any = None

    def image_bytes(self, question: dict[str, Any]) -> bytes:
        if self.stream is None:
            link = socket.socket(socket.AF_UNIX)
            link.connect(self.path)
            self.stream = link.makefile("rwb")
        self.stream.write(json.dumps(question).encode() + b"\n")
        self.stream.flush()
        return bytes(self.stream.read(int(self.stream.readline())))


@dataclass
class Device:
    """The kernel's side of one video node. `owner` is the open file that holds the buffers."""

    config: dict[str, Any]
    light: Any
    now_ns: Callable[[], int] = time.monotonic_ns
    memory: Any = None
    owner: object = None
    buffers: int = 0
    room_bytes: int = 0
    streaming: bool = False
    forgotten: set[int] = field(default_factory=set)
    queued: deque[tuple[int, int]] = field(default_factory=deque)
    filled: deque[tuple[int, Shot]] = field(default_factory=deque)

    def __post_init__(self) -> None:
        self.sensor = Sensor(self.config, random.Random(self.config["seed"]), self.now_ns)
        self.controls = {control["id"]: control for control in self.config["controls"]}
        self.values = {number: control["default"] for number, control in self.controls.items()}
        self.code, (self.size, *_) = next(iter(self.config["formats"].items()))
        self.rate = self.rates()[0]

    def rates(self, code: str = "", size: Any = None) -> list[Any]:
        """The times per frame of a format and size, those in use if none are named: (seconds, parts)."""
        width, height = size or self.size
        found = self.config["rates_of"].get(f"{code or self.code} {width} x {height}", self.config["rates"])
        return list(found)

    def has_fault(self, fault: str) -> bool:
        """Whether the test asks for this fault now."""
        return (Path(self.config["faults"]) / fault).exists()

    def was_set(self, control: str, value: int) -> None:
        """Tell the test of a control that was set."""
        with (Path(self.config["faults"]) / "controls.txt").open("a") as told:
            told.write(f"{control} = {value}\n")

    def answer(self, request: int, data: bytearray, file: object) -> int | None:
        """Answer into `data`; return when to ask again (ns) if there is nothing to tell yet. Raises Refused."""
        if self.has_fault("unplugged"):
            # What is plugged in again is another device, for the kernel.
            self.owner, self.buffers, self.streaming = None, 0, False
            raise Refused(errno.ENODEV)
        if request in (STREAMON, STREAMOFF):
            (self.start if request == STREAMON else self.stop)(file)
            return None
        if request == DQBUF:
            return self.dequeue(data)
        handlers = {
            QUERYCAP: self.query,
            ENUM_FMT: self.list_format,
            ENUM_FRAMESIZES: self.list_size,
            G_FMT: self.tell_format,
            G_PARM: self.tell_rate,
            S_PARM: self.set_rate,
            QUERYBUF: self.place,
            QBUF: self.queue,
            QUERYCTRL: self.describe_control,
            G_CTRL: self.tell_control,
            G_EXT_CTRLS: self.tell_long_control,
            ENUM_FRAMEINTERVALS: self.list_rate,
            S_CTRL: self.set_control,
        }
        if request == S_FMT:
            self.set_format(data, file)
        elif request == REQBUFS:
            self.allocate(data, file)
        elif request in handlers:
            handlers[request](data)
        else:
            raise Refused(errno.ENOTTY)
        return None

    def query(self, data: bytearray) -> None:
        struct.pack_into(
            "16s32s32s",
            data,
            0,
            self.config["driver"].encode(),
            self.config["card"].encode(),
            self.config["bus"].encode(),
        )
        struct.pack_into("III", data, 80, 0x60100, 0x84A00001, self.config["capabilities"])

    def list_format(self, data: bytearray) -> None:
        (index,) = struct.unpack_from("I", data, 0)
        codes = list(self.config["formats"])
        if index >= len(codes):
            raise Refused(errno.EINVAL)
        struct.pack_into("4s", data, 44, codes[index].encode())

    def list_size(self, data: bytearray) -> None:
        index, code = struct.unpack_from("I4s", data, 0)
        sizes = self.config["formats"].get(code.decode(), [])
        if index >= len(sizes):
            raise Refused(errno.EINVAL)
        struct.pack_into("III", data, 8, 1, *sizes[index])

    def list_rate(self, data: bytearray) -> None:
        index, code, width, height = struct.unpack_from("I4sII", data, 0)
        rates = self.rates(code.decode(), (width, height))
        if index >= len(rates) or not self.config["tells_rate"]:
            raise Refused(errno.EINVAL)
        struct.pack_into("III", data, 16, 1, *rates[index])

    def set_format(self, data: bytearray, file: object) -> None:
        self.require_free(file)
        if self.buffers:
            raise Refused(errno.EBUSY)
        width, height, code = struct.unpack_from("II4s", data, 8)
        # As the kernel's drivers do: what is not there is replaced in silence by what is.
        # Latin: the high bit of a code says big-endian.
        name = code.decode("latin-1")
        self.code = name if name in self.config["formats"] else next(iter(self.config["formats"]))
        sizes = self.config["formats"][self.code]
        self.size = min(sizes, key=lambda have: abs(have[0] - width) + abs(have[1] - height))
        if self.rate not in self.rates():
            self.rate = self.rates()[0]
        self.tell_format(data)

    def tell_format(self, data: bytearray) -> None:
        width, height = self.size
        stride = self.row_bytes()
        room = stride * height if stride else 2 * width * height + 4096
        struct.pack_into("II4sIII", data, 8, width, height, self.code.encode(), 1, stride, room)
        self.room_bytes = -(-room // PAGE) * PAGE

    def row_bytes(self) -> int:
        if self.code in ("MJPG", "JPEG"):
            return 0
        depth = {"GREY": 8, "BA81": 8, "GBRG": 8, "GRBG": 8, "RGGB": 8, "Y10P": 10, "pRAA": 10, "Y12P": 12}
        return -(-int(self.size[0]) * depth.get(self.code, 16) // 8) + int(self.config["padding_bytes"])

    def set_rate(self, data: bytearray) -> None:
        seconds, parts = struct.unpack_from("II", data, 12)
        if parts and self.config["tells_rate"]:
            asked = seconds / parts
            self.rate = min(self.rates(), key=lambda have: abs(have[0] / have[1] - asked))
        self.tell_rate(data)

    def tell_rate(self, data: bytearray) -> None:
        struct.pack_into("III", data, 4, 0x1000, 0, 0)
        if not self.config["tells_rate"]:
            raise Refused(errno.ENOTTY)
        struct.pack_into("II", data, 12, *self.rate)

    def allocate(self, data: bytearray, file: object) -> None:
        self.require_free(file)
        (count,) = struct.unpack_from("I", data, 0)
        if count == 0:
            self.stop(file)
        self.buffers = min(count, MOST_BUFFERS)
        self.owner = file if count else None
        struct.pack_into("I", data, 0, self.buffers)

    def require_free(self, file: object) -> None:
        if self.has_fault("busy") or (self.owner is not None and self.owner is not file):
            raise Refused(errno.EBUSY)

    def place(self, data: bytearray) -> None:
        (index,) = struct.unpack_from("I", data, 0)
        if index >= self.buffers:
            raise Refused(errno.EINVAL)
        struct.pack_into("I4xI", data, 64, index * self.room_bytes, self.room_bytes)

    def queue(self, data: bytearray) -> None:
        (index,) = struct.unpack_from("I", data, 0)
        now_ns = self.now_ns()
        self.fill_until(now_ns)
        self.queued.append((now_ns, index))

    def start(self, file: object) -> None:
        if self.owner is not file:
            raise Refused(errno.EBUSY)
        if self.has_fault("no bandwidth"):
            raise Refused(errno.ENOSPC)
        # What they were set to stays in the driver's memory.
        self.forgotten = {number for number, each in self.controls.items() if each.get("forgets_at_start")}
        exposure_ns = self.exposure_ns()
        period_ns = round(self.rate[0] / self.rate[1] * 1e9)
        self.sensor.start(period_ns, exposure_ns or period_ns)
        self.streaming = True

    def exposure_ns(self) -> int:
        if EXPOSURE_LINES in self.values:
            return int(self.values[EXPOSURE_LINES] * self.config["line_s"] * 1e9 + 0.5)
        return self.really(EXPOSURE_ABSOLUTE) * 100_000

    def really(self, number: int) -> int:
        """What the camera uses of a control, whatever its driver says."""
        control = self.controls.get(number, {"default": 0})
        value: float = control["default"] if number in self.forgotten else self.values.get(number, 0)
        creeps_s = self.now_ns() / 1e9 % (2 * CREEPS_S)
        value += control.get("creeps", 0) * abs(creeps_s / CREEPS_S - 1)
        most: float = control.get("really_at_most", value)
        return round(min(value, most))

    def stop(self, file: object) -> None:
        if self.owner is file:
            self.streaming = False
            self.queued.clear()
            self.filled.clear()

    def fill_until(self, now_ns: int) -> None:
        """Let the sensor run: each frame goes into the buffer that waited longest, if one did when it began to come."""
        for shot in self.sensor.done_until(now_ns) if self.streaming else ():
            if shot.lost or self.has_fault("silent"):
                continue
            if self.queued and self.queued[0][0] <= shot.start_ns + shot.exposure_ns:
                self.filled.append((self.queued.popleft()[1], shot))

    def dequeue(self, data: bytearray) -> int | None:
        if self.has_fault("dead"):
            raise Refused(errno.EIO)
        if not self.streaming:
            raise Refused(errno.EINVAL)
        now_ns = self.now_ns()
        self.fill_until(now_ns)
        if not self.filled:
            due_ns = self.sensor.coming.done_ns if self.sensor.coming is not None else now_ns
            return min(due_ns, now_ns + LONGEST_WAIT_NS)
        index, shot = self.filled.popleft()
        image = self.light.image_bytes(
            {
                "number": shot.number,
                "start_ns": shot.start_ns,
                "exposure_ns": shot.exposure_ns,
                "gain": self.values.get(GAIN, 0),
                "focus": self.really(FOCUS),
                "corrupt": shot.corrupt,
                "code": self.code,
                "row_bytes": self.row_bytes(),
            }
        )
        offset = index * self.room_bytes
        self.memory[offset : offset + len(image)] = image
        stamp_ns = self.stamp_ns(shot)
        flags = STAMP_FLAGS[self.config["stamp"]] | (0x40 if shot.corrupt and self.config["flags_corrupt"] else 0)
        struct.pack_into("I4xII", data, 0, index, len(image), flags)
        struct.pack_into("qq", data, 24, stamp_ns // 10**9, stamp_ns % 10**9 // 1000)
        struct.pack_into("II", data, 56, shot.number, 1)
        struct.pack_into("I4xI", data, 64, offset, self.room_bytes)
        return None

    def stamp_ns(self, shot: Shot) -> int:
        match self.config["stamp"]:
            case "start":
                return shot.start_ns
            case "first packet":
                return shot.start_ns + shot.exposure_ns
            case "other clock":
                return shot.start_ns + 1_700_000_000 * 10**9
            case _:
                return shot.done_ns

    def describe_control(self, data: bytearray) -> None:
        (asked,) = struct.unpack_from("I", data, 0)
        number = asked & 0x0FFFFFFF
        if asked & 0x80000000:
            number = min((known for known in self.controls if known > number), default=-1)
        if number not in self.controls:
            raise Refused(errno.EINVAL)
        control = self.stalled(number, "describe")
        ranges = (control["minimum"], control["maximum"], control["step"], control["default"])
        kind = control.get("kind", 1)
        struct.pack_into(
            "II32siiiiI", data, 0, number, kind, control["name"].encode(), *ranges, control.get("flags", 0)
        )

    def stalled(self, number: int, request: str) -> dict[str, Any]:
        """The control, unless its firmware answers such requests with a fault."""
        control: dict[str, Any] = self.controls[number]
        if request in control.get("stalls", ()):
            raise Refused(control["errno"])
        return control

    def tell_long_control(self, data: bytearray) -> None:
        (number,) = struct.unpack_from("I", data, 0)
        if number not in self.controls:
            raise Refused(errno.EINVAL)
        struct.pack_into("q", data, 12, self.stalled(number, "get")["long"])

    def tell_control(self, data: bytearray) -> None:
        (number,) = struct.unpack_from("I", data, 0)
        if number not in self.controls:
            raise Refused(errno.EINVAL)
        self.stalled(number, "get")
        struct.pack_into("i", data, 4, self.values[number])

    def set_control(self, data: bytearray) -> None:
        number, value = struct.unpack_from("Ii", data, 0)
        if number not in self.controls:
            raise Refused(errno.EINVAL)
        control = self.stalled(number, "set")
        if control.get("flags", 0) & READ_ONLY:
            raise Refused(errno.EACCES)
        # Automatic exposure rules; and a stubborn control takes what it likes. Neither says so.
        if number in (EXPOSURE_ABSOLUTE, EXPOSURE_LINES) and self.values.get(EXPOSURE_AUTO, 1) != 1:
            return
        if value not in control.get("takes", (value,)):
            raise Refused(errno.ERANGE)
        value = control.get("insists_on", value)
        self.values[number] = min(max(value, control["minimum"]), control["maximum"])
        self.forgotten.discard(number)
        self.was_set(control["name"], self.values[number])
        if self.streaming and number in (EXPOSURE_ABSOLUTE, EXPOSURE_LINES):
            self.sensor.exposure_ns = self.exposure_ns()
