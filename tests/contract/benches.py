"""Every driver that runs without hardware, each as a bench for the contract suite."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from drivers import replay
from simulated_rig import device
from slrig.bundle import write_bundle
from slrig.capture.sequencer import capture
from slrig.model import Capture, Size
from tests.contract import (
    depthai_bench,
    dlpc347x_bench,
    dlpc350_bench,
    dlpc900_bench,
    genicam_bench,
    gentl_bench,
    opencv_bench,
    serial_bench,
    v4l2_bench,
)
from tests.contract.picamera2_bench import picamera2, wired_picamera2
from tests.contract.suite import Bench, rig_of, sequence_for

PROJECTOR = Size(96, 72)

PLATE = """
name = "plate"

[[object]]
name = "plate"
shape = "plane"
size_mm = [400.0, 400.0]
rotation_deg = [6.0, -10.0, 0.0]
albedo = 0.8
"""


def _eye(name: str, x_mm: float, **options: object) -> dict[str, object]:
    return {
        "name": name,
        "size_px": [160, 120],
        "focal_px": [800.0, 800.0],
        "position_mm": [x_mm, 0.0, -500.0],
        "target_mm": [0.0, 0.0, 0.0],
        "saturation_s": 0.03,
        "blur_px": 0.5,
        **options,
    }


def eyes(**options: object) -> list[dict[str, object]]:
    """Two cameras, one of 8 bit in colour and one of 12 bit in grey."""
    return [_eye("left", -60.0, colour=[0.7, 1.0, 0.6], **options), _eye("right", 180.0, bit_depth=12, **options)]


def beamer(**options: object) -> dict[str, object]:
    return {
        "size_px": [PROJECTOR.width_px, PROJECTOR.height_px],
        "focal_px": [440.0, 440.0],
        "position_mm": [90.0, 0.0, -500.0],
        "target_mm": [0.0, 0.0, 0.0],
        "blur_px": 0.4,
        "latency_s": 0.005,
        **options,
    }


def simulated(folder: Path, *, realtime: bool = False, **head: object) -> Bench:
    (folder / "plate.toml").write_text(PLATE)
    options: dict[str, object] = {
        "scene": "plate.toml",
        "realtime": realtime,
        "ambient": 0.02,
        "projector": beamer(),
        "camera": eyes(),
        **head,
    }
    return Bench(partial(device.open_head, options, folder), sequence_for(PROJECTOR))


def replayed(folder: Path, **options: object) -> Bench:
    """A recording, made here on the rendered rig, with the times and exposures of its frames."""
    bench = simulated(folder)
    with bench.head() as head:
        shots = tuple(capture(rig_of(head), bench.sequence, colour=head.cameras))
        formats = {name: camera.info.format for name, camera in head.cameras.items()}
        recorded = Capture(PROJECTOR, bench.sequence.patterns, formats, shots)
        write_bundle(folder / "recording", recorded, head.calibration)
    return Bench(partial(replay.open_head, {"bundle": "recording", **options}, folder), bench.sequence)


BENCHES: dict[str, Callable[[Path], Bench]] = {
    "simulated": simulated,
    "simulated in real time": partial(simulated, realtime=True),
    "replay": replayed,
    "replay in real time, 50 times as fast": partial(replayed, speed=50),
    "v4l2 (fake kernel)": v4l2_bench.bench,
    "opencv (stream)": opencv_bench.served_bench,
    "opencv (file)": partial(opencv_bench.served_bench, through="file"),
    "genicam (GigE Vision on loopback)": genicam_bench.bench,
    "gentl (a producer of our own)": gentl_bench.bench,
    "depthai (host-only)": depthai_bench.bench,
    "picamera2 (a stand-in for the library)": picamera2,
    "picamera2 by wire": wired_picamera2,
    "dlpc347x": dlpc347x_bench.bench,
    "dlpc350": dlpc350_bench.bench,
    "dlpc900": dlpc900_bench.bench,
    "serial projector": serial_bench.bench,
}
