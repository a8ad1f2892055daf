"""One method in a process of its own: `python -m tests.bench.peers.worker METHOD BUNDLE POINTS OUTPUT`.

`run_apart` starts that process and brings back what it left in OUTPUT.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from slrig.model import Surface
from tests.bench.peers.catalogue import METHODS, Inputs
from tests.bench.peers.measuring import Cost, Phase, measured

_ROOT = Path(__file__).resolve().parents[3]
_MESH = "mesh.npz"
_COST = "cost.json"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a method gave. Without a mesh, `reason` says why there is none."""

    mesh: Surface | None
    cost: Cost | None
    reason: str = ""


def run_apart(method: str, bundle: Path, points_file: Path, output: Path, *, limit_s: float) -> Outcome:
    """Run one method in a new process, at most `limit_s` long; what it gave, or why it gave nothing."""
    output.mkdir(parents=True)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(_ROOT), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-m", "tests.bench.peers.worker", method, str(bundle), str(points_file), str(output)]
    try:
        ended = subprocess.run(  # noqa: S603
            command, cwd=_ROOT, env=environment, capture_output=True, text=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        return Outcome(None, None, f"not finished within {limit_s:g} s")
    if ended.returncode != 0:
        last = (ended.stderr.strip().splitlines() or ["it said nothing"])[-1]
        return Outcome(None, None, f"ended with {ended.returncode}: {last}")
    told = json.loads((output / _COST).read_text(encoding="utf-8"))
    cost = Cost(
        first_s=_by_phase(told["first_s"]),
        warm_s=_by_phase(told["warm_s"]),
        warm_runs=told["warm_runs"],
        peak_mb=_by_phase(told["peak_mb"]),
    )
    with np.load(output / _MESH) as arrays:
        return Outcome(Surface(arrays["vertices_mm"], arrays["faces"]), cost)


def _by_phase(values: dict[str, float]) -> dict[Phase, float]:
    return {Phase(name): value for name, value in values.items()}


def _main(method: str, bundle: str, points_file: str, output: str) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        chosen = METHODS[method]
        run = chosen.prepare(Inputs(Path(bundle), Path(points_file), Path(scratch)))
        mesh, cost = measured(run, compiles=chosen.compiles)
    folder = Path(output)
    np.savez(folder / _MESH, vertices_mm=mesh.vertices_mm, faces=mesh.faces)
    (folder / _COST).write_text(json.dumps(asdict(cost)), encoding="utf-8")


if __name__ == "__main__":
    _main(*sys.argv[1:])
