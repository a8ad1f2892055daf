"""The acceptance test on a rendered rig, whatever the noise: `pytest -m slow tests/bench/test_acceptance.py -s`.

The demonstration's rig at its usual size; SLRIG_SEEDS seeds (30), each the whole test of 23 positions, about a minute
and a half of processor time. SLRIG_RIG names another rig file. A line per seed, the figures at the end.
"""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slrig.accept.plan import AcceptancePlan, Artefact, Quantity, Step, exact_artefacts
from slrig.accept.positions import acceptance_plan, rig_volume_mm
from slrig.accept.running import run_acceptance
from slrig.accept.scene import scripted_config
from slrig.accept.verdicts import AcceptanceResult
from slrig.calibration.artefacts import REJECTED_SHARE, Decision, fitted_sphere
from slrig.config import HeadTable, read_rig
from slrig.discovery import open_rig
from slrig.model import FloatArray

RIG = Path(os.environ.get("SLRIG_RIG") or Path(__file__).parents[2] / "config" / "rigs" / "demo.toml")
SEEDS = int(os.environ.get("SLRIG_SEEDS") or 30)
GOAL_SHARE = 1 / 20_000
DRAWS = 400
LISTS = ("pf_sigmas", "pf_true", "pf_noise", "pf_noise_high", "spread", "points", "ps", "sd", "centre", "f_sigmas")


def noise_form_sigmas(sigma_mm: FloatArray, seed: int) -> tuple[float, float]:
    """Median of PF / σ that Gaussian noise alone gives points of these deviations, (n,), and what one in a hundred
    exceeds. σ is their root mean square, as in a reading.
    """
    noise = np.random.default_rng(seed).normal(0, sigma_mm, (DRAWS, len(sigma_mm)))
    noise -= noise.mean(axis=1, keepdims=True)
    inner = len(sigma_mm) - int(REJECTED_SHARE * len(sigma_mm))
    widest = np.partition(np.abs(noise), inner - 1, axis=1)[:, inner - 1 : inner]
    kept = np.where(np.abs(noise) <= widest, noise, 0.0)
    ranges = np.ptp(kept, axis=1) / np.sqrt(np.mean(sigma_mm**2))
    return float(np.median(ranges)), float(np.quantile(ranges, 0.99))


def true_form_mm(step: Step, plan: AcceptancePlan, points: FloatArray) -> float:
    """Range of the distances from the sphere that was rendered, at most three in a thousand left out."""
    off = np.linalg.norm(points - step.centre_mm, axis=1) - plan.artefacts.diameter.value_mm / 2
    kept = np.sort(np.abs(off - off.mean()))[: len(off) - int(0.003 * len(off))]
    return float(np.ptp(off[np.abs(off - off.mean()) <= kept[-1]]))


def true_centres(step: Step, plan: AcceptancePlan) -> FloatArray:
    """(2, 3): where the bar's balls are."""
    half = plan.artefacts.distance.value_mm / 2
    return np.stack([step.centre_mm + side * half * step.axis for side in (-1, 1)])


def row(result: AcceptanceResult, folder: Path, seed: int) -> dict[str, Any]:
    """Of one seed, by quantity: ratios and errors of all positions, and what truth says of the same points."""
    plan = result.plan
    steps = {step.name: step for step in plan.steps}
    told: dict[str, list[float]] = {name: [] for name in LISTS}
    for each in result.readings:
        step = steps[each.step]
        kept = np.load(folder / "points" / f"{each.step}-{each.take + 1}.npz")
        points = kept["points_mm"].astype(np.float64)
        if step.artefact is Artefact.SPHERE:
            told["pf_sigmas"].append(each.errors_mm[Quantity.FORM] / each.noise_mm)
            told["pf_true"].append(
                true_form_mm(step, plan, points[kept["artefact"] == 1]) / each.errors_mm[Quantity.FORM]
            )
            usual, high = noise_form_sigmas(kept["sigma_mm"][kept["artefact"] == 1].astype(np.float64), seed)
            told["pf_noise"].append(usual)
            told["pf_noise_high"].append(high)
            told["spread"].append(each.sigma_mm / each.noise_mm)
            told["points"].append(each.used)
            told["ps"].append(each.errors_mm[Quantity.SIZE])
        elif step.artefact is Artefact.BAR:
            told["sd"].append(each.errors_mm[Quantity.SPACING])
            centres = [fitted_sphere(points[kept["artefact"] == ball]).centre_mm for ball in (1, 2)]
            true = true_centres(step, plan)
            told["centre"] += [float(np.linalg.norm(true - centre, axis=1).min()) for centre in centres]
        else:
            told["f_sigmas"].append(each.errors_mm[Quantity.FLATNESS] / each.noise_mm)
    decisions = {str(each.quantity): str(each.decision) for each in result.verdicts}
    return {"seed": seed, "decision": str(result.decision), "decisions": decisions, **told}


def summary_of(rows: list[dict[str, Any]], plan: AcceptancePlan) -> dict[str, Any]:
    """The figures of the table over all seeds."""
    every = {name: np.array([each[name] for each in rows]) for name in LISTS}
    several = len(rows) > 1
    return {
        "rig": RIG.stem,
        "seeds": len(rows),
        "diagonal_mm": plan.diagonal_mm,
        "spacing_goal_um": 1000 * plan.diagonal_mm * GOAL_SHARE,
        "spacing_worst_um": 1000 * float(np.abs(every["sd"]).max()),
        "spacing_bias_worst_um": 1000 * float(np.abs(every["sd"].mean(axis=0)).max()),
        "spacing_scatter_um": 1000 * float(every["sd"].std(axis=0, ddof=1).mean()) if several else None,
        "spheres": int(every["pf_sigmas"].size),
        "sphere_points": (int(every["points"].min()), int(every["points"].max())),
        "form_sigmas_worst": float(every["pf_sigmas"].max()),
        "form_sigmas_median": float(np.median(every["pf_sigmas"])),
        "form_sigmas_by_position": [round(float(each), 3) for each in np.median(every["pf_sigmas"], axis=0)],
        "form_sigmas_of_equal_noise": noise_form_sigmas(np.ones(int(np.median(every["points"]))), 0),
        "form_sigmas_of_noise_alone": float(np.median(every["pf_noise"])),
        "form_sigmas_of_noise_one_in_a_hundred": float(np.median(every["pf_noise_high"])),
        "form_beyond_one_in_a_hundred_of_noise": float((every["pf_sigmas"] > every["pf_noise_high"]).mean()),
        "rms_over_stated_noise": (float(every["spread"].min()), float(every["spread"].max())),
        "form_against_true_sphere": (float(every["pf_true"].min()), float(every["pf_true"].max())),
        "size_worst_um": 1000 * float(np.abs(every["ps"]).max()),
        "flatness_sigmas_worst": float(every["f_sigmas"].max()),
        "centre_worst_um": 1000 * float(every["centre"].max()),
        "decisions": {
            quantity: {
                told: sum(each["decisions"][quantity] == told for each in rows)
                for told in sorted({each["decisions"][quantity] for each in rows})
            }
            for quantity in rows[0]["decisions"]
        },
    }


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
        rows.append(row(result, folder / "out", seed))
        shutil.rmtree(folder)
        told = ", ".join(f"{v.quantity} {1000 * v.error_mm:+.1f} µm {v.decision}" for v in result.verdicts)
        print(f"seed {seed}: {told}; PF/σ at most {max(rows[-1]['pf_sigmas']):.2f}", flush=True)  # noqa: T201
    summary = summary_of(rows, plan)
    print(json.dumps(summary, indent=2))  # noqa: T201
    assert not [each["seed"] for each in rows if each["decision"] == Decision.FAILS]
    assert summary["spacing_worst_um"] <= summary["spacing_goal_um"]
    # The sphere that was rendered says what the fitted one says.
    assert 0.85 <= summary["form_against_true_sphere"][0] <= summary["form_against_true_sphere"][1] <= 1.25
