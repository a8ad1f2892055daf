"""The rendered world without its own projector and camera: lit by anyone's pixels, photographed by anyone's sensor."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from simulated_rig.light import light_table
from simulated_rig.options import HeadOptions
from simulated_rig.rendering import Stage, View
from simulated_rig.scene import read_scene
from simulated_rig.staging import Script
from slrig.bundle.faults import checked
from slrig.config import read_rig
from slrig.model import Calibration, CameraFormat, Pixels, Size

DARK: Pixels = np.zeros((1, 1), np.uint8)


def profile_of(colours: NDArray[np.uint8]) -> Pixels:
    """The one line that a picture, (H, W, 3), repeats: (1, W), (H, 1), or (1, 1) where all its pixels are alike.

    Raises
    ------
    ValueError
        The picture has a colour, or varies along both axes: no pattern, and nothing that the world can render.
    """
    grey = colours[..., 0]
    if (colours != grey[..., None]).any():
        raise ValueError("expected a grey picture on the output, found colours")
    along, down = bool((grey != grey[:, :1]).any()), bool((grey != grey[:1]).any())
    if along and down:
        message = "expected a picture that varies along one axis on the output, found one that varies along both"
        raise ValueError(message)
    return grey[: None if down else 1, : None if along else 1].copy()


class World:
    """The scene of a rendered rig's file, its projector's lens and lamp, and what its camera's sensor reads.

    Stands where `tests.contract.stage.Stage` does: below drivers. Light comes by `show` and `changed`, in
    CLOCK_MONOTONIC; `exposed` answers for any interval of the past, by a mixture where the light changed in it. Safe
    between threads. `seed` is of the sensor's noise.
    """

    def __init__(self, rig: Path, *, seed: int) -> None:
        head = read_rig(rig).head
        assert head is not None
        options = checked(HeadOptions, head.options, str(rig))
        (camera,) = options.camera
        scene = rig.parent / options.scene
        lens = options.projector.pinhole()
        self._script = Script(options, read_scene(scene), scene.parent)
        self._stage = Stage(
            self._script.surface(0),
            lens,
            working_distance_mm=options.projector.working_distance_mm or float(np.linalg.norm(lens.centre_mm)),
        )
        self._view = View(
            camera.pinhole(),
            self._stage,
            blur_px=camera.blur_px,
            ambient=options.ambient,
            samples_per_axis=options.samples_per_axis,
            jitter=options.jitter,
            seed=options.seed,
            workers=options.workers,
        )
        self._format = CameraFormat(camera.size, camera.bit_depth)
        self.projector: Size = options.projector.size
        self.calibration = Calibration({camera.name: camera.pinhole()}, lens)
        self._response = options.projector.response()
        self._sensor = camera.sensor()
        self._rng = np.random.default_rng((seed, 0x6C6F6F70))
        self._lock = threading.Lock()
        self._changes: list[tuple[int, Pixels]] = [(0, DARK)]
        self._images: dict[tuple[tuple[int, ...], bytes], NDArray[np.float32]] = {}
        # Tracing takes seconds: now, and not while a sensor waits.
        self._seen(DARK)

    @property
    def format(self) -> CameraFormat:
        return self._format

    def move(self, index: int) -> None:
        """Put what the script moves into a pose, as a person does: between photographs."""
        with self._lock:
            self._stage.change(surface=self._script.surface(index))
            self._images.clear()
        self._seen(DARK)

    @property
    def profiles(self) -> list[Pixels]:
        with self._lock:
            return [profile for _, profile in self._changes]

    def show(self, profile: Pixels | None) -> int:
        """Change the light now, to a pattern's profile or to the dark; return the instant, ns."""
        at_ns = time.monotonic_ns()
        self.changed(DARK if profile is None else profile, at_ns=at_ns)
        return at_ns

    def changed(self, profile: Pixels, *, at_ns: int) -> None:
        with self._lock:
            self._changes.append((max(at_ns, self._changes[-1][0]), profile))

    def exposed(self, t_start_ns: int, t_end_ns: int, *, gain: float = 1.0) -> Pixels:
        """(H, W): what the sensor reads after an exposure, with its noise."""
        with self._lock:
            changes = list(self._changes)
        span_ns = max(t_end_ns - t_start_ns, 1)
        mean = np.zeros(self._format.size.shape, np.float32)
        for index, (at_ns, profile) in enumerate(changes):
            until_ns = changes[index + 1][0] if index + 1 < len(changes) else t_end_ns
            share = (min(until_ns, t_end_ns) - max(at_ns, t_start_ns)) / span_ns
            if share > 0:
                mean += np.float32(share) * self._seen(profile)
        electrons = self._sensor.electrons(mean, span_ns / 1e9)
        with self._lock:
            return self._sensor.read_out(electrons, gain=gain, rng=self._rng)

    def _seen(self, profile: Pixels) -> NDArray[np.float32]:
        """(H, W): the mean light on the sensor while this is shown; light adds up, so mixtures are sums of these."""
        key = (profile.shape, profile.tobytes())
        with self._lock:
            if key not in self._images:
                self._images[key] = self._view.image([(1.0, light_table(profile, self.projector, self._response))])
            return self._images[key]
