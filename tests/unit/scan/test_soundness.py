"""Notes on figures with one right value."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from slrig.model import Axis
from slrig.scan.artefacts import fault_notes, layer_notes, truth_notes
from slrig.scan.reconstruct import layered_share
from tests.unit.reconstruction.builders import CAMERA, PROJECTOR
from tests.unit.scan.test_mirror_images import triangles_between
from tests.unit.scan.test_triangulated import MANY, curves_in, seen, triangulate

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


@pytest.mark.parametrize(("behind_mm", "least_mm", "doubled"), [(10.0, 2.0, True), (1.0, 2.0, False)])
def test_layers_that_one_camera_sees_are_a_note(*, behind_mm: float, least_mm: float, doubled: bool) -> None:
    found = triangulate([seen("left", CAMERA, curves_in(CAMERA, MANY))], PROJECTOR, Axis.COLUMN)
    (camera,), curves = found.cameras, found.merged.curves
    # The ball's points twice, the second time further away.
    faces = triangles_between(0, 1)
    both = replace(
        curves,
        points_mm=np.concatenate([curves.points_mm, curves.points_mm + behind_mm * CAMERA.rotation[2]]),
        pixels_px=np.concatenate([curves.pixels_px, curves.pixels_px]),
    )
    faces = np.concatenate([faces, faces + np.int32(len(curves.points_mm))])
    mine = np.ones(len(both.points_mm), dtype=np.bool_)
    share = layered_share(camera, both, mine, faces, least_mm)
    assert share == doubled
    assert [note[:45] for note in layer_notes({"left": share, "right": 0.0005})] == [
        "camera 'left' sees two layers of the mesh, on"
    ] * doubled
    mine[len(curves.points_mm) :] = False
    assert layered_share(camera, both, mine, faces, least_mm) == 0
