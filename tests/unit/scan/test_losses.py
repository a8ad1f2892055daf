"""Which stage of a scan lost its pixels, and what is said of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slrig.errors import NothingToReconstructError
from slrig.model import Axis, FloatArray, Gray, NoiseModel, Refusal, Size
from slrig.reconstruction.pipeline import CameraCurves
from slrig.scan.losses import (
    LossStage,
    code_extent_notes,
    coverage_notes,
    geometry_fault,
    geometry_notes,
    losing_stage,
    remedy,
    require_code_on_projector,
    require_coverage,
    require_surface,
    stage_shares,
)
from slrig.scan.report import layout_notes
from slrig.scan.stream import CameraResult
from tests.unit.reconstruction.builders import BALL, CAMERA, PROJECTOR, ensemble_of, lit_rows, opencv_pixels
from tests.unit.scan.test_triangulated import triangulate
from tests.unit.test_plausibility import rig

HERE = Path("here")
PIXELS = 10_000
GRAY = Gray(Axis.COLUMN, 0, 10)


def camera_with(
    *, points: int = 5000, decoded: int = 6000, white: float = 100.0, beyond: int = 0, furthest: int = -1,
    curves: tuple[list[float], list[int]] | None = None, **refused: int,
) -> CameraResult:  # fmt: skip
    """A camera of 100 x 100 pixels, of which so many are refused for each cause."""
    refusal = np.zeros(PIXELS, dtype=np.uint8)
    causes = np.repeat([Refusal[name.upper()] for name in refused], list(refused.values()))
    refusal[: len(causes)] = causes
    positions, counts = curves or ([0.0], [points])
    ensemble = ensemble_of([np.zeros((count, 2)) for count in counts], positions)
    found = CameraCurves(
        ensemble=ensemble, refusal=refusal.reshape(100, 100), noise=NoiseModel(1.0, 0.0), scale_px=1.0,
        decoded_pixels=decoded, stripe_points=points, stripe_count=len(positions), refined=True,
        disagreement_px=np.zeros(0), beyond_pixels=beyond, furthest_cell=furthest,
    )  # fmt: skip
    shape = (100, 100)
    image = np.full(shape, white, dtype=np.uint16)
    return CameraResult("left", CAMERA, found, image, np.ones(shape, np.float32), np.zeros(shape, np.bool_), 255.0)


@pytest.mark.parametrize(
    ("seen", "covered", "stage", "words"),
    [
        (camera_with(points=0, decoded=0, not_lit=10_000), None, LossStage.LIGHT, "lens cap"),
        (
            camera_with(points=0, decoded=0, not_lit=10_000, white=255),
            None,
            LossStage.LIGHT,
            "expose for a shorter time",
        ),
        (camera_with(points=0, decoded=0, not_lit=5000, ambiguous_bit=5000), None, LossStage.CODE, "differ too little"),
        (camera_with(points=0, decoded=0, not_lit=5000, saturated=4900), None, LossStage.CODE, "at the camera's limit"),
        (camera_with(points=0, not_lit=4000, stray_code=6000), None, LossStage.CODE, "changes from pixel to pixel"),
        (camera_with(not_lit=4000, behind_device=4900), None, LossStage.GEOMETRY, "4900 meet it behind a device"),
        (camera_with(not_lit=4000, no_intersection=4900), 0.01, LossStage.GEOMETRY, "does not fit these frames"),
        (camera_with(not_lit=4000), 0.01, LossStage.MESH, "the finest patterns may not resolve"),
        (camera_with(not_lit=4000, depth_edge=5500), 0.01, LossStage.MESH, "the code jumps nearly everywhere"),
    ],
)
def test_the_first_stage_that_lost_all_is_the_cause(
    seen: CameraResult, covered: float | None, stage: LossStage, words: str
) -> None:
    assert losing_stage(stage_shares([seen], covered=covered)) is stage
    assert words in remedy(stage, [seen])
    with pytest.raises(NothingToReconstructError, match=r"here: nothing\. camera 'left': white") as caught:
        require_surface(False, HERE, "nothing", [seen], stage=stage)
    assert words in str(caught.value)


def test_pixels_outside_the_region_are_nobodys_loss() -> None:
    small = camera_with(points=500, decoded=600, outside_region=9400, not_lit=0)
    assert stage_shares([small], covered=0.9) == {
        LossStage.LIGHT: 1.0, LossStage.CODE: 1.0, LossStage.GEOMETRY: 1.0, LossStage.MESH: 0.9
    }  # fmt: skip


def test_a_mesh_of_next_to_nothing_is_refused_and_a_thin_one_is_noted() -> None:
    seen = [camera_with(not_lit=4000, depth_edge=5500)]
    with pytest.raises(NothingToReconstructError, match=r"covers 1.0% of what camera 'left' decoded.*code jumps"):
        require_coverage(HERE, seen, 0.01)
    for covered in (0.3, None):
        require_coverage(HERE, seen, covered)
    assert "covers 30% of what camera 'left' decoded" in coverage_notes(seen, 0.3)[0]
    assert coverage_notes(seen, 0.7) == coverage_notes(seen, None) == []


def test_a_code_that_names_more_columns_than_there_are_is_refused_with_both_numbers() -> None:
    projector = Size(600, 400)
    with pytest.raises(NothingToReconstructError, match=r"names columns 0 to 639, the projector has 600 .*: 14.3%"):
        require_code_on_projector(HERE, [camera_with(beyond=1000, furthest=639)], GRAY, projector)
    few = [camera_with(beyond=100, furthest=700)]
    require_code_on_projector(HERE, few, GRAY, projector)
    before = [camera_with(beyond=1000, furthest=50)]
    with pytest.raises(NothingToReconstructError, match="names columns -142 to 599, the projector has 600"):
        require_code_on_projector(HERE, before, replace(GRAY, offset_px=192), projector)
    assert "names columns 0 to 700" in code_extent_notes(few, GRAY, projector)[0]
    assert code_extent_notes([camera_with()], GRAY, projector) == []


def curves(last: int, fade: int = 0, first: int = 1) -> tuple[list[float], list[int]]:
    """Code edges of all columns up to `last`, with fewer and fewer points towards the end, and the points of each."""
    position = np.arange(first, last + 1)
    points = np.full(len(position), 60) if not fade else np.minimum(60, 60 * (last + 1 - position) // fade)
    return (position - 0.5).tolist(), points.tolist()


@pytest.mark.parametrize(
    ("found", "noted"),
    [(curves(639), True), (curves(799), False), (curves(639, fade=12), False), (curves(639, first=100), False)],
    ids=["ends sharply", "reaches the border", "fades out", "begins inside"],
)
def test_a_code_that_ends_short_of_the_projector_is_noted(found: tuple[list[float], list[int]], noted: bool) -> None:
    notes = code_extent_notes([camera_with(curves=found)], GRAY, Size(800, 400))
    assert bool(notes) == noted
    assert not noted or "of the 800 that the projector is said to have" in notes[0]


def ball_seen() -> CameraResult:
    columns, rows = [140.0, 150.0, 160.0, 170.0], np.arange(80.0, 160.0, 1.5)
    pixels: list[FloatArray] = [opencv_pixels(CAMERA, lit_rows(column, rows, BALL)) for column in columns]
    seen = camera_with()
    refusal = np.zeros(CAMERA.size.shape, dtype=np.uint8)
    return replace(seen, curves=replace(seen.curves, ensemble=ensemble_of(pixels, columns), refusal=refusal))


def test_a_right_pose_has_a_place_for_every_point_and_the_usual_mistakes_are_named() -> None:
    seen = ball_seen()
    turn = PROJECTOR.rotation @ CAMERA.rotation.T
    shift = PROJECTOR.translation_mm - turn @ CAMERA.translation_mm
    right = triangulate([seen], PROJECTOR, Axis.COLUMN)
    assert geometry_fault(right.cameras, [seen], PROJECTOR, Axis.COLUMN) is None
    assert geometry_notes(right.cameras) == []
    wrong = replace(PROJECTOR, translation_mm=turn @ CAMERA.translation_mm - shift)
    found = triangulate([seen], wrong, Axis.COLUMN)
    words = geometry_fault(found.cameras, [seen], wrong, Axis.COLUMN)
    assert words is not None
    assert "have no place; nearly all have one with" in words
    assert "t negated" in words
    assert "does not fit these frames" in geometry_notes(found.cameras)[0]


def test_a_calibration_of_unknown_origin_that_makes_no_bench_is_asked_for_its_unit() -> None:
    assert layout_notes(rig()) == []
    (note,) = layout_notes(rig(1 / 25.4))
    assert "Inches? Then" in note
