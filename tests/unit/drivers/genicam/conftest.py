"""Fake GenICam cameras behind either library: GigE Vision through Aravis, a GenTL producer through harvesters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import pytest

from drivers.genicam import GenicamCamera
from slrig.devices import CameraSettings
from slrig.model import Pixels
from tests.contract import genicam_bench, gentl_bench
from tests.contract.genicam_bench import FakeGigE, Fate, require_aravis, scene
from tests.contract.genicam_peer import PIXEL_FORMATS
from tests.contract.gentl_producer import MemoryCamera
from tests.contract.stage import Stage

EXPOSURE_S = 0.005
NO_LATCH = ("TimestampLatch", "TimestampLatchValue")


@dataclass
class Device:
    """A camera before a dark stage, and the driver that opens it."""

    camera: FakeGigE | MemoryCamera
    opened: Callable[..., GenicamCamera]
    unplug: Callable[[], object]
    plug: Callable[[], object]
    closing: ExitStack = field(default_factory=ExitStack)

    def open(self, **options: object) -> GenicamCamera:
        """The driver's camera, set to 5 ms; closed after the test."""
        camera = self.opened(**options)
        self.closing.callback(camera.close)
        camera.configure(CameraSettings(EXPOSURE_S))
        return camera


@pytest.fixture(scope="module")
def gige() -> Iterator[FakeGigE]:
    """One for a whole file. Skips where Aravis is not installed."""
    require_aravis()
    packed = {name: partial(encoded, name=name) for name in PIXEL_FORMATS}
    with FakeGigE(Stage(scene()), kind="sfnc", packed=packed) as peer:
        yield peer


@pytest.fixture(params=["genicam", "gentl"])
def device(request: pytest.FixtureRequest) -> Iterator[Device]:
    """A camera of each kind; "gentl, no latch" has a clock that cannot be looked at."""
    with ExitStack() as leaving:
        if request.param == "genicam":
            peer: FakeGigE = request.getfixturevalue("gige")
            peer.stage, peer.fate = Stage(scene()), Fate
            peer.exposures.clear()
            peer.start()
            found = Device(peer, genicam_bench.opened, peer.stop, peer.start)
        else:
            memory = MemoryCamera(Stage(scene()), without=NO_LATCH if "no latch" in request.param else ())
            producer = leaving.enter_context(gentl_bench.serving(memory))
            plugged = partial(setattr, memory, "plugged")
            found = Device(
                memory, partial(gentl_bench.opened, producer), partial(plugged, False), partial(plugged, True)
            )
        leaving.enter_context(found.closing)
        yield found


def encoded(image: Pixels, name: str) -> bytes:
    """The bytes of an (H, W) image in a PFNC format."""
    samples = [int(sample) for sample in image.ravel()]
    if name.endswith("Packed"):
        depth = 10 if "10" in name else 12
        low_bits = depth - 8
        if len(samples) % 2:
            samples.append(0)
        pairs = zip(samples[::2], samples[1::2], strict=True)
        mask = (1 << low_bits) - 1
        packed = b"".join(
            bytes([one >> low_bits, (one & mask) | (other & mask) << 4, other >> low_bits]) for one, other in pairs
        )
        return packed[: -(-12 * image.size // 8)]
    if name.endswith("p"):
        depth = 10 if "10" in name else 12
        stream = sum(sample << depth * index for index, sample in enumerate(samples))
        return stream.to_bytes(-(-depth * len(samples) // 8), "little")
    if name.endswith("8"):
        return image.astype(np.uint8).tobytes()
    return image.astype("<u2").tobytes()
