"""Accuracy against completeness as thresholds move: `pytest tests/bench/test_knee.py -s`.

One threshold moves at a time, the others keep their defaults. Needs the extra `bench` and the sample bundles. The table
goes to standard output, the plot to tests/bench/figures/knee.svg.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.reconstruction.decoding import DecodingLimits
from slrig.reconstruction.edges import EdgeLimits
from slrig.reconstruction.refinement import refined
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import ReconstructionPlan, ScanPlan
from slrig.scan.reconstruct import reconstruct_bundle
from tests.bench.plots import FIGURES, Curve, Panel, require_matplotlib, write_figure

RIGS = Path(__file__).parents[2] / "config" / "rigs"
LEAST_COMPLETE = 0.96
# rms_mm and p99_mm that the sample bundles have to keep to; the demonstration has no goal of its own.
GOALS_MM: Mapping[str, tuple[float, float]] = {"vase": (0.022, 0.07), "terrace": (0.016, 0.06), "gauge": (0.025, 0.09)}


@dataclass(frozen=True)
class Threshold:
    """A threshold and the values it takes. owner : the function whose parameter it is; None for the plan's own."""

    name: str
    unit: str
    values: Sequence[float]
    owner: Callable[..., Any] | None

    @property
    def default(self) -> float:
        """The value that scans use."""
        found = inspect.signature(self.owner or ReconstructionPlan).parameters[self.name].default
        return float(found)

    def moved(self, monkeypatch: pytest.MonkeyPatch, value: float) -> ReconstructionPlan:
        """Make `value` the default of the parameter, wherever it is called from; the plan to reconstruct by."""
        if self.owner is None:
            changed: dict[str, Any] = {self.name: value}
            return replace(ReconstructionPlan(), **changed)
        function: Any = self.owner.__init__ if inspect.isclass(self.owner) else self.owner
        if self.name in (function.__kwdefaults__ or {}):
            monkeypatch.setitem(function.__kwdefaults__, self.name, value)
            return ReconstructionPlan()
        optional = [
            parameter.name
            for parameter in inspect.signature(function).parameters.values()
            if parameter.default is not inspect.Parameter.empty and parameter.kind is not parameter.KEYWORD_ONLY
        ]
        moved = dict(zip(optional, function.__defaults__, strict=True)) | {self.name: value}
        assert len(moved) == len(optional), f"{self.name} is no parameter of {self.owner.__name__}"
        monkeypatch.setattr(function, "__defaults__", tuple(moved.values()))
        return ReconstructionPlan()


THRESHOLDS = (
    Threshold("shadow_px", "px", (1.0, 1.5, 2.0, 2.3, 3.0), EdgeLimits),
    Threshold("depth_px", "px", (0.7, 1.0, 1.5, 2.0), EdgeLimits),
    Threshold("lit_sigma", "σ", (4.0, 6.0, 9.0, 15.0), DecodingLimits),
    Threshold("coarsest_px", "px", (0.1, 0.25, 0.5, 1.0), refined),
    Threshold("depth_edge_ratio", "", (3.0, 4.5, 6.0, 9.0, 14.0), None),
)


@dataclass(frozen=True, slots=True)
class Point:
    """What one scene gave at one setting."""

    rms_mm: float
    p99_mm: float
    complete: float


@pytest.fixture(scope="module")
def bundles(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The sample bundles, and the demonstration's scene, captured."""
    require_matplotlib()
    demo = tmp_path_factory.mktemp("demo") / "bundle"
    with open_rig(read_rig(RIGS / "demo.toml")) as rig:
        capture_frames(rig, ScanPlan(), demo, progress=lambda *_: None, cancelled=lambda: False).finish()
    return {name: shared / "bundles" / name for name in GOALS_MM} | {"demo": demo}


def measured(bundle: Path, output: Path, plan: ReconstructionPlan) -> Point:
    report: Any = reconstruct_bundle(bundle, output, plan=plan, progress=lambda *_: None, cancelled=lambda: False)
    truth = report["truth"]
    return Point(truth["rms_mm"], truth["p99_mm"], truth["complete_0.3mm"])


def row(name: str, value: float, default: float, points: Mapping[str, Point]) -> str:
    told = "  ".join(f"{p.rms_mm:.4f} {p.p99_mm:.4f} {p.complete:.4f}" for p in points.values())
    return f"{name:17} {value:5.2f}{'*' if value == default else ' '} {told}\n"


def panel(scene: str, told: Mapping[tuple[str, float], Point]) -> Panel:
    curves = []
    for threshold in THRESHOLDS:
        points = [told[threshold.name, value] for value in threshold.values]
        curves.append(
            Curve(
                label=threshold.name,
                x=[100 * point.complete for point in points],
                y=[1000 * point.rms_mm for point in points],
                texts=[f"{value:g}" if value in _outermost(threshold) else "" for value in threshold.values],
                ring=list(threshold.values).index(threshold.default),
            )
        )
    return Panel(
        title=scene,
        x_label="visible surface covered to 0.3 mm, %",
        y_label="rms, µm",
        curves=curves,
        limit_y=1000 * GOALS_MM[scene][0] if scene in GOALS_MM else None,
        limit_x=100 * LEAST_COMPLETE if scene in GOALS_MM else None,
    )


def _outermost(threshold: Threshold) -> set[float]:
    """The two values at the ends of the curve, without the default, which has the ring."""
    return {threshold.values[0], threshold.values[-1]} - {threshold.default}


def test_the_defaults_lie_at_the_knee(bundles: Mapping[str, Path], tmp_path: Path) -> None:
    defaults: dict[str, Point] = {
        scene: measured(bundle, tmp_path / "out", ReconstructionPlan()) for scene, bundle in bundles.items()
    }
    told: dict[str, dict[tuple[str, float], Point]] = {scene: {} for scene in bundles}
    heading = "  ".join(f"{scene + ' rms':>11} p99    c0.3" for scene in bundles)
    sys.stdout.write(f"\n{'threshold':23} {heading}\n")
    better = []
    for threshold in THRESHOLDS:
        assert threshold.default in threshold.values
        for value in threshold.values:
            points = defaults
            if value != threshold.default:
                with pytest.MonkeyPatch.context() as patch:
                    plan = threshold.moved(patch, value)
                    points = {scene: measured(bundle, tmp_path / "out", plan) for scene, bundle in bundles.items()}
            for scene, point in points.items():
                told[scene][threshold.name, value] = point
            sys.stdout.write(row(threshold.name, value, threshold.default, points))
            sys.stdout.flush()
            if all(_better(points[scene], defaults[scene]) for scene in bundles):
                better.append((threshold.name, value))
        seen = {told[scene][threshold.name, value] for scene in bundles for value in threshold.values}
        assert len(seen) > len(bundles), f"{threshold.name} changed nothing: it does not reach the reconstruction"
    write_figure(
        FIGURES / "knee.svg",
        [panel(scene, told[scene]) for scene in bundles],
        title="Accuracy against completeness as one threshold moves",
        columns=2,
        note="ring: the defaults; dashed: the goals; numbers: the outermost values",
    )
    for scene, (rms_mm, p99_mm) in GOALS_MM.items():
        point = defaults[scene]
        assert point.rms_mm <= rms_mm, scene
        assert point.p99_mm <= p99_mm, scene
        assert point.complete >= LEAST_COMPLETE, scene
    assert not better, f"better than the defaults on every scene: {better}"


def _better(point: Point, default: Point) -> bool:
    """More accurate by a twentieth at no loss of surface, or more surface by a thousandth at no loss of accuracy."""
    finer = point.rms_mm < 0.95 * default.rms_mm and point.complete >= default.complete
    wider = point.complete > default.complete + 0.001 and point.rms_mm <= default.rms_mm
    return finer or wider
