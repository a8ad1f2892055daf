"""Notes on figures with one right value."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from slrig.model import Size
from slrig.scan.coverage import layered_share
from slrig.scan.soundness import fault_notes, layer_notes, truth_notes
from tests.unit.meshing.plain import grid_faces

SOUND = {"nonmanifold_edges": 0, "misoriented_edges": 0, "duplicate_faces": 0}


@pytest.mark.parametrize("fault", SOUND)
def test_a_fault_of_topology_is_a_note(fault: str) -> None:
    assert fault_notes(SOUND) == []
    (note,) = fault_notes({**SOUND, fault: 1234})
    assert "1,234" in note


@pytest.mark.parametrize(
    ("truth", "words"),
    [
        ({}, ()),
        ({"gross_fraction": 0.0005, "facing_camera_area": 0.9996}, ()),
        ({"gross_fraction": 0.519, "facing_camera_area": 1.0}, ("51.9% of the area is more than 1 mm from",)),
        ({"gross_fraction": 0.0, "facing_camera_area": 0.528}, ("47.2% of the area shows every camera its back",)),
        ({"gross_fraction": None, "facing_camera_area": None}, ()),
    ],
)
def test_what_is_off_the_truth_is_a_note(truth: dict[str, Any], words: tuple[str, ...]) -> None:
    found = truth_notes(truth)
    assert len(found) == len(words)
    assert all(note.startswith(each) for note, each in zip(found, words, strict=True))


def test_layers_that_one_camera_sees_are_a_note() -> None:
    size = Size(1000, 800)
    rows, columns = (index.ravel() for index in np.mgrid[:21, :31])
    first = np.column_stack((100.0 + 20 * columns, 100.0 + 20 * rows))
    # The second layer lies over a quarter of the first, and continues beside it.
    pixels, faces = np.concatenate([first, first + np.array([300.0, 200.0])]), grid_faces(21, 31)
    both = np.concatenate([faces, faces + len(first)])
    share = layered_share(pixels, both, np.ones(len(pixels), dtype=np.bool_), size)
    assert share == pytest.approx(0.25 / 1.75, abs=0.01)
    (note,) = layer_notes({"left": share, "right": 0.0005})
    assert note.startswith("camera 'left' sees two layers of the mesh")
    seen = np.arange(len(pixels)) < len(first)
    assert layered_share(pixels, both, seen, size) == 0
