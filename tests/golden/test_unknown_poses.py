"""Objects from eight sides each, whose poses nobody knows: the answer of known starts, or none, in words.

Each object takes 15 to 20 s.
"""

from __future__ import annotations

import numpy as np
import pytest

from slrig.errors import RegistrationRefusedError
from slrig.model import FloatArray
from slrig.multiview.registration import register_views
from slrig.multiview.unknown_poses import find_start_poses
from tests.known_objects import OBJECTS, SYMMETRIC, seen_around, seen_from
from tests.turned_views import displacement_mm
from tests.unit.multiview.known_views import View, around

HELD = ("figure", "flange", "bossed box")
ALIKE_MM = 0.002
"""Where registration comes to rest from two starts: less than it knows the poses by."""


def true_poses(views: list[View]) -> list[FloatArray]:
    """In the frame of the first."""
    return [np.linalg.inv(views[0].pose) @ view.pose for view in views]


def require_the_known_answer(views: list[View]) -> None:
    meshes, true = [view.mesh for view in views], true_poses(views)
    found = register_views(meshes, find_start_poses(meshes)).poses
    known = register_views(meshes, true).poses
    apart = [displacement_mm(*each) for each in zip(meshes, found, known, strict=True)]
    off = [displacement_mm(*each) for each in zip(meshes, found, true, strict=True)]
    print(f"{max(apart) * 1e3:.2f} µm from that of known starts, {max(off) * 1e3:.1f} µm from the truth")  # noqa: T201
    assert max(apart) < ALIKE_MM
    assert max(off) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("name", HELD)
def test_views_come_to_where_known_starts_take_them(name: str) -> None:
    require_the_known_answer(seen_around(OBJECTS[name]()))


@pytest.mark.slow
def test_a_vase_is_refused_in_words() -> None:
    views = seen_around(OBJECTS[SYMMETRIC]())
    with pytest.raises(RegistrationRefusedError, match=r"one place that agrees .* is symmetric or repeats itself"):
        find_start_poses([view.mesh for view in views], names=[f"turn{number}" for number in range(len(views))])


@pytest.mark.slow
def test_views_from_all_around_come_together_too() -> None:
    require_the_known_answer(seen_from(OBJECTS["bumpy ball"](), around(10), seed=3))
