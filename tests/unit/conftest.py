"""What the tests of jobs, of the rig and of scans share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.unit.scan.bench import Bench


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    # Not above: the process that hands out tests loads this file first, and needs no service.
    from tests.unit.scan.bench import Bench

    bench = Bench(tmp_path)
    bench.manager.start()
    yield bench
    bench.close()
