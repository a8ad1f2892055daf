"""Models that `tests/golden/test_fusion.py` leaves out: `pytest tests/bench/test_fusion.py`, two minutes."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import trimesh

from tests.golden.test_fusion import require_one_model
from tests.unit.multiview.known_views import flange, plate_on_box, relief, star, vase


@pytest.mark.parametrize(
    ("made", "count"),
    [(relief, 8), (relief, 12), (vase, 8), (vase, 12), (flange, 8), (flange, 12), (star, 12), (plate_on_box, 12)],
)
def test_views_make_one_model(made: Callable[[], trimesh.Trimesh], count: int) -> None:
    require_one_model(made(), count)
