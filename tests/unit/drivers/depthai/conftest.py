"""A pair of cameras on the bench, closed after each test."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest

from slrig.model import CameraFormat, Size
from tests.contract.depthai_bench import OakHead, oak_head
from tests.contract.stage import Stage
from tests.unit.capture.fake_rig import Scene

FORMAT = CameraFormat(Size(64, 48), 8)


def small_stage(**stage: Any) -> Stage:
    scene = Scene(camera=FORMAT.size, projector=Size(64, 48), first_column_px=4.0, columns_per_px=0.8, noise_dn=0.3)
    return Stage(scene, **stage)


@pytest.fixture
def head() -> Iterator[Callable[..., OakHead]]:
    """Opens a mono pair at 100 frames per second; `options` are the driver's, the rest is `FakeOak`'s."""
    opened: list[OakHead] = []

    def open_head(*, fps: float = 100.0, options: Mapping[str, object] | None = None, **oak: Any) -> OakHead:
        opened.append(oak_head(small_stage(), fps=fps, options=options, **oak))
        return opened[-1]

    yield open_head
    for each in opened:
        each.close()
        assert each.oak.closed == each.oak.opened, "the device was let go"
