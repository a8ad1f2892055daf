"""What a scan plays, which of it is used, what is said of light that tells little, and what a plan refuses."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from slrig.bundle import ScanDefaults
from slrig.errors import ConfigError, PatternError, UnsupportedByDeviceError
from slrig.model import (
    MIN_BASELINE_FRACTION,
    Axis,
    Black,
    Calibration,
    CameraFormat,
    FlipRule,
    FloatArray,
    Gray,
    LineShift,
    MeshAxes,
    Pinhole,
    SequenceName,
    Sine,
    Size,
    White,
    baseline_fraction,
    depth_sensitive_cameras,
    triangulated_axis,
)
from slrig.rig.session import RigFacts
from slrig.scan.job import plan_from_json, plan_json
from slrig.scan.plan import (
    FAIR_SHARE,
    PatternPlan,
    ReconstructionPlan,
    ScanPlan,
    check_plan,
    chosen_axis,
    left_out_notes,
    pattern_sequence,
    played_axes,
    weakness,
)
from tests.unit.scan.fakes import TameCamera, TameProjector

BOTH = tuple(Axis)


def standing(x_mm: float, y_mm: float) -> Pinhole:
    matrix = np.array([[900.0, 0, 320], [0, 900.0, 240], [0, 0, 1.0]])
    return Pinhole(Size(640, 480), matrix, np.zeros(5), np.eye(3), -np.array([x_mm, y_mm, 0.0]))


def rig(*places_mm: tuple[float, float], projector: bool) -> Calibration:
    """Cameras a, b, … at these places, and a projector at the middle."""
    cameras = {name: standing(*place) for name, place in zip("abc", places_mm, strict=False)}
    return Calibration(cameras, standing(0.0, 0.0) if projector else None)


BESIDE = rig((100.0, 0.0), projector=True)
ABOVE = rig((0.0, 100.0), projector=True)
PAIR = rig((-60.0, 0.0), (60.0, 0.0), projector=False)
VERTICAL_PAIR = rig((0.0, -60.0), (0.0, 60.0), projector=False)


@pytest.mark.parametrize(
    ("calibration", "axis"),
    [(BESIDE, Axis.COLUMN), (ABOVE, Axis.ROW), (PAIR, Axis.COLUMN), (VERTICAL_PAIR, Axis.ROW), (None, Axis.COLUMN)],
)
def test_by_itself_a_scan_plays_the_axis_that_tells_depth(calibration: Calibration | None, axis: Axis) -> None:
    assert played_axes(None, calibration, "ab") == (axis,)
    assert played_axes(True, calibration, "ab") == BOTH


def test_the_cameras_of_the_rig_count_and_not_all_of_the_calibration() -> None:
    three = rig((0.0, 0.0), (50.0, 0.0), (0.0, 90.0), projector=False)
    assert played_axes(None, three, "abc") == (Axis.ROW,)
    assert played_axes(None, three, "ab") == (Axis.COLUMN,)
    assert played_axes(None, three, "xy") == (Axis.COLUMN,)


def test_an_axis_that_was_asked_for_is_played_and_used() -> None:
    assert played_axes(None, PAIR, "ab", axis=Axis.ROW) == (Axis.ROW,)
    assert played_axes(None, None, "ab", axis=Axis.ROW) == (Axis.ROW,)
    assert played_axes(True, PAIR, "ab", axis=Axis.ROW) == BOTH
    assert played_axes(False, BESIDE, "a", axis=Axis.COLUMN) == (Axis.COLUMN,)
    with pytest.raises(PatternError, match="leave one of them out"):
        played_axes(False, PAIR, "ab", axis=Axis.ROW)
    with pytest.raises(PatternError, match=r"rows alone.* beside the projector"):
        played_axes(None, BESIDE, "a", axis=Axis.ROW)


def test_columns_that_were_asked_for_are_played_unless_they_tell_nothing() -> None:
    slanting = rig((math.sin(math.radians(13)), math.cos(math.radians(13))), projector=True)
    assert played_axes(False, slanting, "a") == (Axis.COLUMN,)
    # Without a projector nobody knows yet how the stripes will lie.
    assert played_axes(False, VERTICAL_PAIR, "ab") == (Axis.COLUMN,)
    with pytest.raises(PatternError, match=r"columns alone.* above or below the projector.*--rows"):
        played_axes(False, ABOVE, "a")


def test_of_both_axes_the_better_one_is_used_and_of_one_that() -> None:
    for calibration, better in ((ABOVE, Axis.ROW), (VERTICAL_PAIR, Axis.ROW), (BESIDE, Axis.COLUMN)):
        devices = list(calibration.cameras.values())
        assert chosen_axis(BOTH, devices, calibration.projector) is better
        assert chosen_axis((better,), devices, calibration.projector) is better
    assert chosen_axis((Axis.COLUMN,), list(VERTICAL_PAIR.cameras.values()), None) is Axis.COLUMN
    with pytest.raises(PatternError, match=r"rows alone.* beside the projector"):
        chosen_axis((Axis.ROW,), list(BESIDE.cameras.values()), BESIDE.projector)


def test_a_weak_crossing_is_told_in_degrees_with_its_price_and_its_cure() -> None:
    assert weakness(Axis.COLUMN, BOTH, FAIR_SHARE) is None
    told = weakness(Axis.COLUMN, (Axis.COLUMN,), 0.25)
    assert told is not None
    assert "at 14° only" in told
    assert "4.0 times" in told
    assert "Scan with both axes: rows (--rows)" in told
    assert "45°" in (weakness(Axis.ROW, BOTH, MIN_BASELINE_FRACTION) or "")
    requested = weakness(Axis.ROW, BOTH, 0.1, on_request=True) or ""
    assert "The columns were played, too" in requested
    assert "leave out axis (--axis)" in requested
    assert "more than 100 times" in (weakness(Axis.ROW, BOTH, 0.0) or "")


def test_a_camera_that_the_axis_tells_no_depth_is_named_as_left_out() -> None:
    cameras = {"beside": standing(100.0, 0.0), "above": standing(0.0, 100.0)}
    (note,) = left_out_notes(Axis.COLUMN, cameras, standing(0.0, 0.0))
    assert note.startswith("camera 'above' is left out: its baseline to the projector lies along the columns")
    assert left_out_notes(Axis.COLUMN, cameras, None) == []


@pytest.mark.parametrize(
    ("rows", "calibration", "axes"),
    [(None, ABOVE, {Axis.ROW}), (None, BESIDE, {Axis.COLUMN}), (None, None, {Axis.COLUMN}), (True, ABOVE, set(Axis))],
)
def test_a_sequence_holds_the_patterns_of_these_axes_and_no_others(
    rows: bool | None, calibration: Calibration | None, axes: set[Axis]
) -> None:
    sequence = pattern_sequence(PatternPlan(rows=rows), Size(64, 48), calibration, "a")
    coded = [pattern for pattern in sequence.patterns if isinstance(pattern, Gray | LineShift)]
    assert {pattern.axis for pattern in coded} == axes
    assert {pattern.axis for pattern in coded if isinstance(pattern, LineShift)} == axes
    assert len(coded) == len(sequence) - 3


@pytest.mark.parametrize(
    ("plan", "inverses"),
    [
        (PatternPlan(), False),
        (PatternPlan(sequence=SequenceName.FAST), False),
        (PatternPlan(sequence=SequenceName.ROBUST), True),
        (PatternPlan(inverses=True), True),
        # What proves no bit: no lines, lines that are narrow, and half of an odd period, which is none.
        (PatternPlan(line_shift=False), True),
        (PatternPlan(line_width_px=1), True),
        (PatternPlan(line_shift_period_px=9), True),
        (PatternPlan(line_shift_period_px=12), False),
        (PatternPlan(line_width_px=1, inverses=False), False),
    ],
)
def test_bits_come_with_inverses_where_lines_do_not_prove_them(plan: PatternPlan, inverses: bool) -> None:
    bits = [each for each in pattern_sequence(plan, Size(64, 48)).patterns if isinstance(each, Gray)]
    assert any(each.inverted for each in bits) == inverses


@pytest.mark.parametrize(("period_px", "frames"), [(None, 3), (7, 7), (8, 4), (9, 3), (10, 5)])
def test_a_period_of_its_own_has_the_fewest_frames_of_lines_that_divide_it(period_px: int | None, frames: int) -> None:
    plan = PatternPlan(sequence=SequenceName.FAST, line_shift_period_px=period_px)
    assert sum(isinstance(each, LineShift) for each in pattern_sequence(plan, Size(64, 48)).patterns) == frames


def test_sinusoids_are_played_in_their_period_and_steps_on_the_axes_of_lines() -> None:
    plan = PatternPlan(sequence=SequenceName.PHASE, sine_period_px=10, sine_steps=5, rows=True)
    patterns = pattern_sequence(plan, Size(64, 48)).patterns
    sines = [each for each in patterns if isinstance(each, Sine)]
    assert patterns[:2] == (White(), Black())
    assert len(sines) == len(patterns) - 2 == 2 * 3 * 5
    assert {each.axis for each in sines[:15]} == {Axis.COLUMN}
    assert {each.axis for each in sines[15:]} == {Axis.ROW}
    assert (sines[0].period_px, sines[0].steps) == (10, 5)


def test_a_projector_of_black_and_white_refuses_sinusoids_before_anything_moves() -> None:
    facts = RigFacts({"cam0": TameCamera().info}, replace(TameProjector().info, shades=False), None)
    plan = ScanPlan(PatternPlan(sequence=SequenceName.PHASE))
    with pytest.raises(UnsupportedByDeviceError, match=r"black and white alone.* standard or fast.* kms"):
        check_plan(plan, facts)
    assert check_plan(ScanPlan(), facts)
    assert check_plan(plan, replace(facts, projector=TameProjector().info))


@pytest.mark.parametrize(("bit_depth", "colour", "sample_bytes"), [(8, False, 1), (12, False, 2), (8, True, 1)])
def test_frames_take_as_many_bytes_as_they_have_samples(bit_depth: int, colour: bool, sample_bytes: int) -> None:
    size = Size(640, 480)
    camera = replace(TameCamera().info, format=CameraFormat(size, bit_depth), colour=colour)
    facts = RigFacts({"cam0": camera}, TameProjector().info, None)
    frames = len(pattern_sequence(PatternPlan(), facts.projector.size))
    # White, black and the closing white are kept in colour, too.
    images = frames + (3 * 3 if colour else 0)
    assert check_plan(ScanPlan(), facts) == images * 640 * 480 * sample_bytes
    assert check_plan(ScanPlan(exposures_s=(0.01, 0.02)), facts) == 2 * images * 640 * 480 * sample_bytes


# What a plan refuses


@pytest.mark.parametrize(
    ("plan", "key", "values", "words"),
    [
        (ReconstructionPlan, "depth_edge_ratio", (1.0, 0.0, math.nan, math.inf), "a finite number above 1, found "),
        (ReconstructionPlan, "max_code_gap", (0,), "1 or more, found 0;"),
        (ReconstructionPlan, "drop_finest_bits", (-1,), "0 or more, found -1;"),
        (ReconstructionPlan, "flip_rule", ("dyer",), "constrained or delaunay, found 'dyer';"),
        (ReconstructionPlan, "axis", ("diagonal",), "column or row, found 'diagonal'"),
        (ScanPlan, "exposure_s", (0.0, -0.1, math.nan, math.inf), "a finite time above 0 s, found "),
        (ScanPlan, "turn_deg", (math.nan, math.inf, 3600.1, -1e300), "an angle from -3600° to 3600°, found "),
    ],
)
def test_value_that_cannot_be_is_refused(
    plan: Callable[..., object], key: str, values: tuple[object, ...], words: str
) -> None:
    for value in values:
        with pytest.raises(ConfigError, match=f"{key}.*: expected {words}"):
            plan(**{key: value})


def test_axes_of_a_robot_need_its_place_and_come_back_with_it() -> None:
    place = ((1.0, 0.0, 0.0, 5.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    plan = ScanPlan(reconstruction=ReconstructionPlan(mesh_axes=MeshAxes.ROBOT, rig_in_base=place))
    assert plan_from_json(json.loads(json.dumps(plan_json(plan)))) == plan
    with pytest.raises(ConfigError, match="robot needs to know where the rig is"):
        ReconstructionPlan(mesh_axes=MeshAxes.ROBOT)
    # It would be that of every scan, and a rig in hand is elsewhere in each.
    with pytest.raises(ValueError, match="asked for scan by scan"):
        ScanDefaults(mesh_axes=MeshAxes.ROBOT)


def test_least_plan_is_accepted_and_names_are_taken_by_their_values() -> None:
    plan = ReconstructionPlan(depth_edge_ratio=1.001, max_code_gap=1, flip_rule="delaunay", axis="row")  # type: ignore[arg-type]
    assert (plan.flip_rule, plan.axis) == (FlipRule.DELAUNAY, Axis.ROW)
    assert ReconstructionPlan().flip_rule is FlipRule.CONSTRAINED
    assert ScanPlan(exposure_s=1e-6).exposure_s == 1e-6


def test_a_plan_of_earlier_days_has_the_usual_mesh_and_a_stored_one_comes_back() -> None:
    plan = ScanPlan(reconstruction=ReconstructionPlan(flip_rule=FlipRule.DELAUNAY, smooth_boundary=False))
    document = json.loads(json.dumps(plan_json(plan)))
    assert plan_from_json(document) == plan
    del document["reconstruction"]["flip_rule"], document["reconstruction"]["smooth_boundary"]
    assert plan_from_json(document) == ScanPlan()


def test_the_angle_of_the_stage_and_who_turned_are_kept_and_a_hand_says_where() -> None:
    plan = ScanPlan(turn_deg=-45.0, turned_by="hand")
    assert plan_from_json(json.loads(json.dumps(plan_json(plan)))) == plan
    with pytest.raises(ConfigError, match=r"turn_deg .*found none; say it"):
        ScanPlan(turned_by="hand")


# ---- The axis of light that tells depth, against how far a point's image moves when its depth changes


MIDDLE_MM = np.array([0.0, 0.0, 600.0])


def looking_from(
    x_mm: float, y_mm: float, *, roll_deg: float = 0.0, focal_px: tuple[float, float] = (900.0, 900.0)
) -> Pinhole:
    """A device that looks along z from (x, y, 0), turned about its view."""
    turn, _ = cv2.Rodrigues(np.array([0.0, 0.0, math.radians(roll_deg)]))
    matrix = np.array([[focal_px[0], 0, 320], [0, focal_px[1], 240], [0, 0, 1.0]])
    return Pinhole(Size(640, 480), matrix, np.zeros(5), turn, -turn @ np.array([x_mm, y_mm, 0.0]))


def moved_px(seen_by: Pinhole, other: Pinhole) -> FloatArray:
    """(2,): by how much the image of a point moves in a device when the point moves along the other device's ray."""

    def pixel(point_mm: FloatArray) -> FloatArray:
        x, y, z = seen_by.rotation @ point_mm + seen_by.translation_mm
        return np.array([x / z, y / z])

    return np.abs(pixel(MIDDLE_MM + 1e-3 * (MIDDLE_MM - other.centre_mm)) - pixel(MIDDLE_MM))


@pytest.mark.parametrize(("projector_known", "roll_deg"), [(True, 0.0), (True, 30.0), (False, 90.0), (False, 200.0)])
@pytest.mark.parametrize(("x_mm", "y_mm"), [(120.0, 0.0), (-110.0, 40.0), (10.0, 130.0), (0.0, -90.0), (-70.0, -75.0)])
def test_the_axis_is_the_one_along_which_depth_shows(
    x_mm: float, y_mm: float, roll_deg: float, *, projector_known: bool
) -> None:
    one, two = looking_from(0.0, 0.0, roll_deg=roll_deg), looking_from(x_mm, y_mm)
    cameras, projector = ([two], one) if projector_known else ([one, two], None)
    across, down = moved_px(one, two)
    assert triangulated_axis(cameras, projector) is (Axis.COLUMN if across > down else Axis.ROW)
    for axis, moved in ((Axis.COLUMN, across), (Axis.ROW, down)):
        assert baseline_fraction(axis, cameras, projector) == pytest.approx(moved / math.hypot(across, down), abs=1e-9)


def test_finer_rows_do_not_make_a_sheet_of_them_steeper() -> None:
    diamond = looking_from(0.0, 0.0, focal_px=(900.0, 1800.0))
    assert triangulated_axis([looking_from(100.0, 60.0)], diamond) is Axis.COLUMN
    assert baseline_fraction(Axis.ROW, [looking_from(100.0, 60.0)], diamond) == pytest.approx(60 / math.hypot(100, 60))


def test_with_a_projector_all_cameras_decide_by_what_they_resolve() -> None:
    projector = looking_from(0.0, 0.0)
    assert triangulated_axis([looking_from(0.0, 50.0), looking_from(300.0, 0.0)], projector) is Axis.COLUMN
    # Seven times the resolution outweighs six times the baseline.
    sharp = looking_from(0.0, 50.0, focal_px=(6300.0, 6300.0))
    assert triangulated_axis([sharp, looking_from(300.0, 0.0)], projector) is Axis.ROW
    two = [looking_from(0.0, 60.0), looking_from(80.0, 0.0)]
    assert baseline_fraction(Axis.ROW, two, projector) == pytest.approx(0.6)


def test_axis_gives_depth_to_cameras_with_a_baseline_across_it() -> None:
    cameras, projector = (
        [looking_from(10.0, 90.0), looking_from(80.0, 80.0), looking_from(120.0, 0.0)],
        looking_from(0.0, 0.0),
    )
    assert depth_sensitive_cameras(Axis.COLUMN, cameras, projector) == [False, True, True]
    assert depth_sensitive_cameras(Axis.ROW, cameras, projector) == [True, True, False]
    assert depth_sensitive_cameras(Axis.ROW, cameras[2:], projector) == [True]


def test_of_several_cameras_the_longest_baseline_of_the_first_decides() -> None:
    cameras = [looking_from(0.0, 0.0), looking_from(80.0, 0.0), looking_from(0.0, 120.0)]
    assert triangulated_axis(cameras, None) is Axis.ROW
    assert triangulated_axis(cameras[:2], None) is Axis.COLUMN
    assert baseline_fraction(Axis.ROW, cameras, None) == 1.0
    # Without a baseline columns are as good as rows.
    assert triangulated_axis(cameras[:1], None) is triangulated_axis(cameras[:1] * 2, None) is Axis.COLUMN


@pytest.mark.parametrize("sequence", [SequenceName.STANDARD, SequenceName.PHASE])
def test_cross_lines_are_one_frame_of_the_axis_that_is_not_played(sequence: SequenceName) -> None:
    def patterns(*, rows: bool, cross_lines: bool) -> tuple[object, ...]:
        return pattern_sequence(PatternPlan(sequence, rows=rows, cross_lines=cross_lines), Size(640, 400)).patterns

    without, crossed = (patterns(rows=False, cross_lines=each) for each in (False, True))
    (added,) = set(crossed) - set(without)
    assert isinstance(added, LineShift)
    assert added.axis is Axis.ROW
    assert added.is_half_lit
    assert len(crossed) == len(without) + 1
    assert patterns(rows=True, cross_lines=True) == patterns(rows=True, cross_lines=False)
