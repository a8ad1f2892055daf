"""What benches of projectors share: the head that they open, a sequence, and a table with a wired camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from slrig.devices import Camera, Clock, Projector, SystemClock
from slrig.model import Calibration, PatternSequence, Size, Truth
from slrig.patterns.sequence import encode, scan_patterns
from tests.contract.stage import Stage
from tests.contract.wired_camera import WiredCamera
from tests.unit.capture.fake_rig import Scene


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
