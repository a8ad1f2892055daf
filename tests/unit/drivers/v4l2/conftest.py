"""A fake video device below the driver."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.contract.stage import Stage
from tests.contract.v4l2_bench import Faked, FakeDevice, staged, why_not


@pytest.fixture
def plugged(tmp_path: Path) -> Iterator[Callable[..., FakeDevice]]:
    """Plug a fake camera in: `plugged(Faked(…), stage)`. Skips where umockdev is not installed."""
    if why_not():
        pytest.skip(why_not())
    with ExitStack() as leaving:

        def plug(faked: Faked | None = None, stage: Stage | None = None) -> FakeDevice:
            return leaving.enter_context(FakeDevice(tmp_path, stage or staged(), faked or Faked()))

        yield plug
