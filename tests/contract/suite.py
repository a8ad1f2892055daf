"""The contract of cameras and projectors as tests: a bench per driver, what benches share, and the checks on it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from slrig.conformance import ConformanceRun
from slrig.conformance.bench import default_settings
from slrig.devices import Camera, Clock, HasClock, Projector, Rig, ScannerHead, SystemClock
from slrig.model import Calibration, PatternSequence, Size, Truth
from slrig.patterns.sequence import encode, scan_patterns
from tests.contract.stage import Stage
from tests.contract.wired_camera import WiredCamera
from tests.unit.capture.fake_rig import Scene, patterns_for

COLOUR = "frames_come_in_colour_where_it_is_declared"
"""The check that a mono camera has nothing to show for."""


@dataclass(frozen=True)
class Bench:
    """A driver under test. `open_head` opens the instrument afresh; `sequence` begins with white, then black; `end`
    lets go of what stands below the driver.
    """

    open_head: Callable[[], ScannerHead]
    sequence: PatternSequence
    end: Callable[[], object] = lambda: None

    @contextmanager
    def head(self) -> Iterator[ScannerHead]:
        head = self.open_head()
        try:
            yield head
        finally:
            close(head)

    def open_rig(self) -> Rig:
        return rig_of(self.open_head())

    def examination(self) -> ConformanceRun:
        return ConformanceRun(self.open_rig, self.sequence)


def sequence_for(projector: Size) -> PatternSequence:
    """White, black, Gray code of columns with inverses, shifted lines, and white and black again."""
    return encode(patterns_for(projector), projector)


def close(head: ScannerHead) -> None:
    head.projector.close()
    for camera in head.cameras.values():
        camera.close()


def rig_of(head: ScannerHead) -> Rig:
    settings = {name: default_settings(camera) for name, camera in head.cameras.items()}
    clock = head.clock if isinstance(head, HasClock) else SystemClock()
    return Rig("bench", head.cameras, head.projector, settings, head.calibration, head, clock=clock)


@dataclass(frozen=True)
class BenchHead:
    """Implements `slrig.devices.Head`: cameras and a projector, and nothing that is known of what is before them."""

    cameras: Mapping[str, Camera]
    projector: Projector
    clock: Clock = field(default_factory=SystemClock, kw_only=True)

    @property
    def calibration(self) -> Calibration | None:
        """See `Head`. None: nothing is measured here."""
        return None

    def truth(self) -> Truth | None:
        return None


def whole_scan(size: Size, *, period_px: int = 16, line_width_px: int = 2, rows: bool = False) -> PatternSequence:
    """White, black, Gray code with inverses, shifted lines, and white and black again."""
    patterns = scan_patterns(
        size,
        line_shift=True,
        period_px=period_px,
        line_width_px=line_width_px,
        gray_cell_px=None,
        gray_offset_px=0,
        rows=rows,
    )
    return encode(patterns, size)


class WiredTable:
    """A stage that an engine lights, and a camera that it triggers by wire; used by one head at a time.

    The camera sees most of the mirrors' columns, and of their rows a band.
    """

    def __init__(
        self,
        mirrors: Size,
        *,
        columns_per_px: float,
        rows_per_px: float = 10.0,
        white: float = 0.5,
        usual_s: float = 1 / 60,
        exposures_s: tuple[float, float] = (1e-4, 0.5),
    ) -> None:
        self.stage = Stage(
            Scene(
                camera=Size(640, 100),
                projector=mirrors,
                columns_per_px=columns_per_px,
                rows_per_px=rows_per_px,
                blur_px=0.8,
                noise_dn=0.5,
                white=white,
            )
        )
        self._usual_s, self._exposures_s = usual_s, exposures_s
        self._camera: WiredCamera | None = None

    def head(self, projector: Projector) -> BenchHead:
        self._camera = WiredCamera(
            "left", self.stage, usual_s=self._usual_s, exposures_s=self._exposures_s, gains=(1.0, 8.0)
        )
        return BenchHead({"left": self._camera}, projector)

    def pulse(self, t_ns: int) -> None:
        if self._camera is not None:
            self._camera.pulse(t_ns)
