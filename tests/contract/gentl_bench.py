"""The gentl driver on a GenTL producer of our own, before a staged projector."""

from __future__ import annotations

import atexit
import importlib.util
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

from drivers.genicam import GenicamCamera, open_gentl_camera
from tests.contract.genicam_bench import CAMERA, PROJECTOR, scene
from tests.contract.gentl_producer import FakeProducer, MemoryCamera, build
from tests.contract.stage import Stage, StagedProjector
from tests.contract.suite import Bench, BenchHead, sequence_for
from tests.npm import lacking


def require_harvesters() -> None:
    """Skip where harvesters or a C compiler is not installed; fail instead where CI=true, which has to install it."""
    missing = [name for name in ("harvesters", "genicam") if importlib.util.find_spec(name) is None]
    if missing or shutil.which("gcc") is None:
        lacking(f"needs {', '.join(missing) or 'gcc'}: pip install 'slrig[gentl]', apt install gcc")


@lru_cache(maxsize=1)
def _producer() -> FakeProducer:
    # A process loads a producer once.
    folder = Path(tempfile.mkdtemp(prefix="slrig-gentl-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return FakeProducer(build(folder), MemoryCamera(Stage(scene())))


@contextmanager
def serving(camera: MemoryCamera) -> Iterator[FakeProducer]:
    require_harvesters()
    producer = _producer()
    producer.serve(camera)
    yield producer
    camera.stop()


def opened(served: FakeProducer, **options: object) -> GenicamCamera:
    region = {"width_px": CAMERA.width_px, "height_px": CAMERA.height_px}
    device = f"slrig-memory-{served.camera.serial}"
    table = {"device": device, "producer": str(served.file), "region": region, **options}
    camera = open_gentl_camera("left", table, Path())
    assert isinstance(camera, GenicamCamera)
    return camera


def bench(folder: Path) -> Bench:
    """The driver before a stage, with a software trigger, a wire and a clock that can be latched."""
    del folder
    serves = serving(MemoryCamera(Stage(scene(noise_dn=0.5), latency_s=0.002, jitter_s=0.002)))
    producer = serves.__enter__()

    def open_head() -> BenchHead:
        return BenchHead({"left": opened(producer)}, StagedProjector(producer.camera.stage))

    return Bench(open_head, sequence_for(PROJECTOR), lambda: serves.__exit__(None, None, None))
