"""Figures of a mesh that have one right value: a note for each that is off."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_MAX_SHARE = 0.001
_FAULTS = {
    "nonmanifold_edges": "edges of more than two triangles",
    "misoriented_edges": "edges between a front and a back",
    "duplicate_faces": "triangles that are there twice",
}


def fault_notes(figures: Mapping[str, Any]) -> list[str]:
    """A note if a mesh has faults of its topology. figures : `slrig.meshing.mesh_figures`."""
    faults = [f"{figures[name]:,} {words}" for name, words in _FAULTS.items() if figures[name] > 0]
    return [f"the mesh has {' and '.join(faults)}: an error of the program, please report it"] if faults else []


def layer_notes(layered: Mapping[str, float]) -> list[str]:
    """A note for each camera, by its name, that sees the mesh twice on more than a thousandth of its image of it."""
    return [
        f"camera '{name}' sees two layers of the mesh, one behind the other, on {share:.1%} of it: one of the two is "
        "no surface. Look for mirror images, and for wrong codes beside depth edges"
        for name, share in layered.items()
        if share > _MAX_SHARE
    ]


def truth_notes(truth: Mapping[str, Any]) -> list[str]:
    """Notes on a mesh whose true surface is known. truth : of a report, numbers that are not finite as NaN or None."""
    beyond, facing = truth.get("gross_fraction"), truth.get("facing_camera_area")
    notes = []
    if beyond is not None and beyond > _MAX_SHARE:
        notes.append(f"{beyond:.1%} of the area is more than 1 mm from the known truth; the rms is of the rest")
    if facing is not None and facing < 1 - _MAX_SHARE:
        notes.append(f"{1 - facing:.1%} of the area shows every camera its back: it is inside out, or no surface")
    return notes
