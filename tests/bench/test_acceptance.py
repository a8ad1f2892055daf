"""The acceptance test on a rendered rig, whatever the noise: `pytest -m slow tests/bench/test_acceptance.py -s`.

The demonstration's rig at its usual size; SLRIG_SEEDS seeds (30), each the whole test of 23 positions, about a minute
and a half of processor time. SLRIG_RIG names another rig file. A line per seed, the figures at the end; all of them go
into acceptance.json of the folder SLRIG_BENCH_OUT.
"""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slrig.calibration.artefacts import Decision, fitted_sphere
from slrig.config import HeadTable, read_rig
from slrig.discovery import open_rig
from slrig.model import FloatArray
from slrig.sessions.acceptance.plan import AcceptancePlan, Artefact, Quantity, Step, exact_artefacts
from slrig.sessions.acceptance.positions import acceptance_plan, rig_volume_mm
from slrig.sessions.acceptance.running import AcceptanceResult, run_acceptance
from slrig.sessions.acceptance.scene import scripted_config

RIG = Path(os.environ.get("SLRIG_RIG") or Path(__file__).parents[2] / "config" / "rigs" / "demo.toml")
SEEDS = int(os.environ.get("SLRIG_SEEDS") or 30)
GOAL_FORM_SIGMAS = 6.5
GOAL_SHARE = 1 / 20_000


def true_form_mm(step: Step, plan: AcceptancePlan, points: FloatArray) -> float:
    """Range of the distances from the sphere that was rendered, at most three in a thousand left out."""
    off = np.linalg.norm(points - step.centre_mm, axis=1) - plan.artefacts.diameter.value_mm / 2
    kept = np.sort(np.abs(off - off.mean()))[: len(off) - int(0.003 * len(off))]
    return float(np.ptp(off[np.abs(off - off.mean()) <= kept[-1]]))


def true_centres(step: Step, plan: AcceptancePlan) -> FloatArray:
    """(2, 3): where the bar's balls are."""
    half = plan.artefacts.distance.value_mm / 2
    return np.stack([step.centre_mm + side * half * step.axis for side in (-1, 1)])


def row(result: AcceptanceResult, folder: Path) -> dict[str, list[float]]:
    """Of one seed, by quantity: ratios and errors of all positions, and what truth says of the same points."""
    plan = result.plan
    steps = {step.name: step for step in plan.steps}
    told: dict[str, list[float]] = {name: [] for name in ("pf_sigmas", "pf_true", "ps", "sd", "centre", "f_sigmas")}
    for each in result.readings:
        step = steps[each.step]
        kept = np.load(folder / "points" / f"{each.step}-{each.take + 1}.npz")
        points = kept["points_mm"].astype(np.float64)
        if step.artefact is Artefact.SPHERE:
            told["pf_sigmas"].append(each.errors_mm[Quantity.FORM] / each.noise_mm)
            told["pf_true"].append(true_form_mm(step, plan, points[kept["used"]]) / each.errors_mm[Quantity.FORM])
            told["ps"].append(each.errors_mm[Quantity.SIZE])
        elif step.artefact is Artefact.BAR:
            told["sd"].append(each.errors_mm[Quantity.SPACING])
            centres = [fitted_sphere(points[kept["used"] & (kept["artefact"] == ball)]).centre_mm for ball in (1, 2)]
            true = true_centres(step, plan)
            told["centre"] += [float(np.linalg.norm(true - centre, axis=1).min()) for centre in centres]
        else:
            told["f_sigmas"].append(each.errors_mm[Quantity.FLATNESS] / each.noise_mm)
    return told


@pytest.mark.slow
def test_acceptance_over_seeds(tmp_path: Path) -> None:
    config = read_rig(RIG)
    assert config.head is not None
    with open_rig(config) as rig:
        calibration = rig.calibration
    assert calibration is not None
    volume = rig_volume_mm(calibration)
    plan = acceptance_plan(calibration, volume, exact_artefacts(volume), rendered=True, repeats=1)
    rows = []
    for seed in range(1, SEEDS + 1):
        head = HeadTable.model_validate({**config.head.model_dump(), "seed": seed})
        folder = tmp_path / str(seed)
        with open_rig(scripted_config(replace(config, head=head), plan, folder / "scene")) as rig:
            result = run_acceptance(rig, plan, folder / "out", progress=lambda *_: None, cancelled=lambda: False)
        rows.append(row(result, folder / "out"))
        told = ", ".join(f"{v.quantity} {1000 * v.error_mm:+.1f} µm {v.decision}" for v in result.verdicts)
        print(  # noqa: T201
            f"seed {seed}: {told}; PF/σ at most {max(rows[-1]['pf_sigmas']):.2f}", flush=True
        )
        assert result.decision is not Decision.FAILS
    every = {name: np.array([each[name] for each in rows]) for name in rows[0]}
    limit_mm = plan.diagonal_mm * GOAL_SHARE
    agreement = (float(every["pf_true"].min()), float(every["pf_true"].max()))
    worst_sigmas, worst_mm = float(every["pf_sigmas"].max()), float(np.abs(every["sd"]).max())
    summary = {
        "rig": RIG.stem,
        "seeds": SEEDS,
        "diagonal_mm": plan.diagonal_mm,
        "spacing_goal_um": 1000 * limit_mm,
        "spacing_worst_um": 1000 * worst_mm,
        "spacing_bias_worst_um": 1000 * float(np.abs(every["sd"].mean(axis=0)).max()),
        "spacing_scatter_um": 1000 * float(every["sd"].std(axis=0, ddof=1).mean()) if SEEDS > 1 else None,
        "form_sigmas_worst": worst_sigmas,
        "form_sigmas_median": float(np.median(every["pf_sigmas"])),
        "form_against_true_sphere": agreement,
        "size_worst_um": 1000 * float(np.abs(every["ps"]).max()),
        "flatness_sigmas_worst": float(every["f_sigmas"].max()),
        "centre_worst_um": 1000 * float(every["centre"].max()),
    }
    print(json.dumps(summary, indent=2))  # noqa: T201
    target = os.environ.get("SLRIG_BENCH_OUT")
    if target:
        figures = {"summary": summary, "rows": rows}
        (Path(target) / "acceptance.json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    assert worst_sigmas <= GOAL_FORM_SIGMAS
    assert worst_mm <= limit_mm
    # The sphere that was rendered says what the fitted one says.
    assert 0.85 <= agreement[0] <= agreement[1] <= 1.25
