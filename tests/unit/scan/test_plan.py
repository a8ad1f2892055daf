"""What a plan refuses, whoever makes it."""

from __future__ import annotations

import json
import math

import pytest

from slrig.errors import ConfigError
from slrig.model import Axis, FlipRule
from slrig.scan.plan import ReconstructionPlan, ScanPlan
from slrig.scan.records import plan_from_json, plan_json


@pytest.mark.parametrize("ratio", [1.0, 0.0, -3.0, math.nan, math.inf])
def test_depth_edge_ratio_is_above_one_and_finite(ratio: float) -> None:
    with pytest.raises(ConfigError, match=f"depth_edge_ratio: expected a finite number above 1, found {ratio:g};"):
        ReconstructionPlan(depth_edge_ratio=ratio)


def test_code_gap_is_at_least_one() -> None:
    with pytest.raises(ConfigError, match="max_code_gap: expected 1 or more, found 0;"):
        ReconstructionPlan(max_code_gap=0)


def test_flip_rule_is_taken_by_its_value_and_another_is_refused() -> None:
    assert ReconstructionPlan(flip_rule="delaunay").flip_rule is FlipRule.DELAUNAY  # type: ignore[arg-type]
    assert ReconstructionPlan().flip_rule is FlipRule.CONSTRAINED
    with pytest.raises(ConfigError, match="flip_rule: expected constrained or delaunay, found 'dyer';"):
        ReconstructionPlan(flip_rule="dyer")  # type: ignore[arg-type]


def test_a_plan_of_earlier_days_has_the_usual_mesh_and_a_stored_one_comes_back() -> None:
    plan = ScanPlan(reconstruction=ReconstructionPlan(flip_rule=FlipRule.DELAUNAY, smooth_boundary=False))
    document = json.loads(json.dumps(plan_json(plan)))
    assert plan_from_json(document) == plan
    del document["reconstruction"]["flip_rule"], document["reconstruction"]["smooth_boundary"]
    assert plan_from_json(document) == ScanPlan()


@pytest.mark.parametrize("exposure_s", [0.0, -0.1, math.nan, math.inf])
def test_exposure_is_positive_and_finite(exposure_s: float) -> None:
    with pytest.raises(ConfigError, match=f"exposure_s: expected a finite time above 0 s, found {exposure_s:g} s"):
        ScanPlan(exposure_s=exposure_s)


def test_an_axis_is_a_column_or_a_row() -> None:
    assert ReconstructionPlan(axis="row").axis is Axis.ROW  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="axis: expected column or row, found 'diagonal'"):
        ReconstructionPlan(axis="diagonal")  # type: ignore[arg-type]


def test_least_plan_is_accepted() -> None:
    assert ReconstructionPlan(depth_edge_ratio=1.001, max_code_gap=1).max_code_gap == 1
    assert ScanPlan(exposure_s=1e-6).exposure_s == 1e-6


@pytest.mark.parametrize("turn_deg", [math.nan, math.inf, -math.inf, 3600.1, -1e300])
def test_an_angle_of_the_stage_is_finite_and_not_huge(turn_deg: float) -> None:
    with pytest.raises(ConfigError, match=r"turn_deg .*: expected an angle from -3600° to 3600°, found "):
        ScanPlan(turn_deg=turn_deg)


def test_the_angle_of_the_stage_and_who_turned_are_kept_and_a_hand_says_where() -> None:
    plan = ScanPlan(turn_deg=-45.0, turned_by="hand")
    assert plan_from_json(json.loads(json.dumps(plan_json(plan)))) == plan
    with pytest.raises(ConfigError, match=r"turn_deg .*found none; say it"):
        ScanPlan(turned_by="hand")
