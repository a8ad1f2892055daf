"""A fake kernel below the driver, on virtual time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from tests.contract.stage import Stage
from tests.contract.v4l2_bench import Faked, VirtualDevice, virtually

Plug = Callable[..., VirtualDevice]


@pytest.fixture
def plugged() -> Iterator[Plug]:
    """Plug a fake camera in: `plugged(Faked(…), stage)`; the one before is gone."""
    with ExitStack() as leaving:

        def plug(faked: Faked | None = None, stage: Stage | None = None) -> VirtualDevice:
            leaving.close()
            return leaving.enter_context(VirtualDevice(stage or virtually(), faked or Faked()))

        yield plug
