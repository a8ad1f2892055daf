"""The GenICam driver on a GigE Vision camera over loopback, or on a relay before it, before a staged projector."""

from __future__ import annotations

import atexit
import importlib
import select
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from filelock import FileLock

from drivers.genicam import GenicamCamera, open_camera
from slrig.devices import Camera, CameraInfo, Trigger
from slrig.model import Pixels, Size
from tests.contract.genicam_peer import ANSWERED, ASKED, BEGIN, DELAY, END, INTERFACE, PIXEL_FORMATS, read_exactly
from tests.contract.stage import Stage, StagedProjector
from tests.contract.suite import Bench, BenchHead, sequence_for
from tests.npm import lacking
from tests.unit.capture.fake_rig import Scene

CAMERA, PROJECTOR = Size(120, 90), Size(64, 48)
ROOT = Path(__file__).resolve().parents[2]
_LONG_S = 20.0


def require_aravis() -> None:
    """Skip where Aravis is not installed; fail instead where CI=true, which has to install it."""
    try:
        importlib.import_module("gi").require_version("Aravis", "0.8")
    except (ImportError, ValueError) as missing:
        lacking(
            f"needs Aravis ({missing}): apt install gir1.2-aravis-0.8 libgirepository1.0-dev libcairo2-dev gcc "
            "pkg-config python3-dev, then pip install 'PyGObject<3.51'"
        )


@dataclass(frozen=True)
class Fate:
    """What becomes of a frame: exposed so much late, then held in the camera, and a share of its packets lost."""

    delay_s: float = 0.0
    lost: float = 0.0
    held_s: float = 0.0


class FakeGigE:
    """A fake GigE Vision camera in a process of its own, that sees a stage. A context manager.

    GigE Vision has one port: one camera runs at a time, on this machine. Another one of this process ends it, one of
    another process waits for its end.

    kind : "stock", as Aravis makes it; "sfnc", in the names of SFNC 2, with a trigger line and more pixel formats;
    "exposure start", the same, its trigger selector named as IDS' cameras name it. fate : asked once per frame.
    packed : makes the bytes of an image, by the name of the pixel format; as they are in memory where absent.
    """

    _running: FakeGigE | None = None

    def __init__(
        self,
        stage: Stage,
        *,
        kind: str = "stock",
        fate: Callable[[], Fate] = Fate,
        packed: Mapping[str, Callable[[Pixels], bytes]] | None = None,
    ) -> None:
        self.stage = stage
        self.fate = fate
        self.exposures: list[tuple[int, int]] = []
        self._kind = kind
        self._packed = packed or {}
        self._process: subprocess.Popen[str] | None = None
        self._lock = FileLock(Path(tempfile.gettempdir()) / "slrig-test-gige.lock")
        self._never = threading.Event()

    def start(self) -> None:
        """Run, if it does not yet; a camera that another test left running ends."""
        if self._process is not None and self._process.poll() is None:
            return
        if FakeGigE._running is not None:
            FakeGigE._running.stop()
        self._lock.acquire()
        ours, theirs = socket.socketpair()
        command = [sys.executable, "-m", "tests.contract.genicam_peer", str(theirs.fileno()), self._kind]
        self._process = subprocess.Popen(  # noqa: S603 - our own module
            command, stdin=subprocess.PIPE, pass_fds=(theirs.fileno(),), cwd=ROOT, text=True
        )
        theirs.close()
        ours.settimeout(_LONG_S)
        assert len(read_exactly(ours, ASKED.size)) == ASKED.size, "the fake GigE Vision camera did not start"
        ours.settimeout(None)
        self._thread = threading.Thread(target=self._serve, args=(ours,), daemon=True)
        self._thread.start()
        FakeGigE._running = self
        atexit.register(self.stop)

    def pulse(self) -> None:
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write("pulse\n")
        self._process.stdin.flush()

    def stop(self) -> None:
        """Pull the plug. Idempotent."""
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        process.wait(_LONG_S)
        if process.stdin is not None:
            process.stdin.close()
        self._thread.join(_LONG_S)
        self._lock.release()
        FakeGigE._running = None
        atexit.unregister(self.stop)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _serve(self, peer: socket.socket) -> None:
        fate = Fate()
        names = {code: name for name, code in PIXEL_FORMATS.items()}
        with peer:
            while len(asked := read_exactly(peer, ASKED.size)) == ASKED.size:
                kind, start_ns, end_ns, gain, pixel_format, width_px, height_px = ASKED.unpack(asked)
                if kind == BEGIN:
                    fate = self.fate()
                    answer = DELAY.pack(fate.delay_s)
                else:
                    assert kind == END
                    self.exposures.append((start_ns, end_ns))
                    if fate.held_s:
                        self._never.wait(fate.held_s)
                    seen = self.stage.exposed(start_ns, end_ns, gain=float(gain))[:height_px, :width_px]
                    packed = self._packed.get(names[pixel_format])
                    data = seen.tobytes() if packed is None else packed(seen)
                    answer = ANSWERED.pack(fate.lost, len(data)) + data
                try:
                    peer.sendall(answer)
                except OSError:
                    return


def table(**options: object) -> dict[str, object]:
    region = {"width_px": CAMERA.width_px, "height_px": CAMERA.height_px}
    return {"device": INTERFACE, "region": region, **options}


def scene(**options: int | float) -> Scene:
    return Scene(camera=CAMERA, projector=PROJECTOR, columns_per_px=0.5, rows_per_px=0.5, white=0.4, **options)  # type: ignore[arg-type]


def opened(**options: object) -> GenicamCamera:
    camera = open_camera("left", table(**options), Path())
    assert isinstance(camera, GenicamCamera)
    return camera


class FreeOnly:
    """A camera that hides its other triggers, so that it is let run free."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self.configure, self.arm, self.disarm = camera.configure, camera.arm, camera.disarm
        self.trigger, self.read, self.close = camera.trigger, camera.read, camera.close

    @property
    def info(self) -> CameraInfo:
        return replace(self._camera.info, triggers=frozenset({Trigger.FREE}))


def bench(folder: Path) -> Bench:
    """The driver on Aravis' fake GigE Vision camera, as it comes."""
    del folder
    require_aravis()
    peer = FakeGigE(Stage(scene(noise_dn=0.5), latency_s=0.002, jitter_s=0.002))

    def open_head() -> BenchHead:
        peer.start()
        return BenchHead({"left": opened()}, StagedProjector(peer.stage))

    return Bench(open_head, sequence_for(PROJECTOR), peer.stop)


PORT = 3956
DISCOVERY_ACK, READ_REGISTER, WRITE_REGISTER = 0x0003, 0x0080, 0x0082
LATCH, HIGH, LOW = 0x0944, 0x0948, 0x094C
CURRENT_ADDRESS = 0x24
DENIED = 0x8006
HEADER = struct.Struct(">BBHHH")
ACK = struct.Struct(">HHHH")


class Relay:
    """A GigE Vision camera at an address of its own, whose clock, the wall's, is latched on request."""

    def __init__(self, address: str = "127.0.0.2", camera: str = "127.0.0.1") -> None:
        self.address = address
        self.latches: list[int] = []
        self.denied: set[int] = set()
        self._camera = (camera, PORT)
        self._host: tuple[str, int] | None = None
        self._near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._near.bind((address, PORT))
        self._far = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._far.connect(self._camera)
        self._ours, self._stop = socket.socketpair()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.send(b".")
        self._thread.join()
        for end in (self._near, self._far, self._ours, self._stop):
            end.close()

    def _run(self) -> None:
        while True:
            ready, _, _ = select.select([self._near, self._far, self._ours], [], [])
            if self._ours in ready:
                return
            if self._near in ready:
                packet, host = self._near.recvfrom(65536)
                self._host = host
                answer = self._answer(packet)
                if answer is None:
                    self._far.send(packet)
                else:
                    self._near.sendto(answer, host)
            if self._far in ready:
                try:
                    packet = self._far.recv(65536)
                except ConnectionError:
                    continue
                if self._host is not None:
                    self._near.sendto(self._readdressed(packet), self._host)

    def _answer(self, packet: bytes) -> bytes | None:
        """What the relay answers by itself; None if the camera is to be asked."""
        _, _, command, _, request = HEADER.unpack_from(packet)
        if command not in {READ_REGISTER, WRITE_REGISTER}:
            return None
        (register,) = struct.unpack_from(">I", packet, HEADER.size)
        if register in self.denied:
            return ACK.pack(DENIED, command + 1, 0, request)
        if command == WRITE_REGISTER and register == LATCH:
            self.latches.append(time.time_ns())
            return ACK.pack(0, command + 1, 4, request) + struct.pack(">I", 1)
        if command == READ_REGISTER and register in {HIGH, LOW} and self.latches:
            value = self.latches[-1] >> 32 if register == HIGH else self.latches[-1] & 0xFFFFFFFF
            return ACK.pack(0, command + 1, 4, request) + struct.pack(">I", value)
        return None

    def _readdressed(self, packet: bytes) -> bytes:
        _, command, _, _ = ACK.unpack_from(packet)
        if command != DISCOVERY_ACK:
            return packet
        at = ACK.size + CURRENT_ADDRESS
        return packet[:at] + socket.inet_aton(self.address) + packet[at + 4 :]
