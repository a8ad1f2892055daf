"""How the cost of a scan grows: four times the pixels, four times the stripes. `pytest tests/bench/test_growth.py -s`.

Pixels: the rig of the demonstration, and the same with a camera of twice the width and height, all else equal.
Stripes: the same frames, with two of the eight line shifts and with all. The exponent is log₄ of the ratio of times: 1
where the cost grows with what there is to do.
"""

from __future__ import annotations

import math
import os
import statistics
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from slrig.bundle import Bundle, read_bundle, write_bundle
from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.model import Capture, LineShift, Pattern
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import ReconstructionPlan, ScanPlan
from slrig.scan.reconstruct import reconstruct_bundle
from tests.bench.peers.ours import FILE_STAGES

RIG = Path(__file__).parents[2] / "config" / "rigs" / "demo.toml"
WARM_RUNS = 5
KEPT_SHIFTS = (0, 4)
GROWTH = 4
STEEPEST = 1.25
"""The whole may grow a little faster than the work: caches."""

SHORTEST_S = 0.005


@dataclass(frozen=True)
class Measured:
    """One reconstruction, warm: median seconds per stage, and what it found."""

    stages_s: dict[str, float]
    vertices: int

    @property
    def total_s(self) -> float:
        """Seconds of all stages."""
        return sum(self.stages_s.values())


def rig_file(folder: Path, *, camera_scale: int) -> Path:
    """Write the demonstration's rig with `camera_scale` times the pixels each way; its path."""
    text = RIG.read_text(encoding="utf-8")
    head, _, camera = text.partition("[[head.camera]]")
    options = tomllib.loads(camera)
    options["size_px"] = [camera_scale * length for length in options["size_px"]]
    options["focal_px"] = [camera_scale * length for length in options["focal_px"]]
    # Pixel centres are at integers: the image's corner lies at -1/2.
    options["principal_px"] = [camera_scale * (x + 0.5) - 0.5 for x in options["principal_px"]]
    scene = (RIG.parent / tomllib.loads(text)["head"]["scene"]).resolve()
    lines = [f"{key} = {_toml(value)}" for key, value in options.items()]
    path = folder / f"rig-{camera_scale}.toml"
    path.write_text(
        "\n".join([head.replace('"../scenes/demo.toml"', _toml(str(scene))), "[[head.camera]]", *lines, ""]),
        encoding="utf-8",
    )
    return path


def _toml(value: Any) -> str:
    # Lists of numbers and plain text are written in TOML as in Python, but for the quotes.
    return f'"{value}"' if isinstance(value, str) else str(value)


def recorded(folder: Path, *, camera_scale: int) -> Bundle:
    """Render a scan and read it back."""
    with open_rig(read_rig(rig_file(folder, camera_scale=camera_scale))) as rig:
        capture_frames(
            rig, ScanPlan(), folder / f"rendered-{camera_scale}", progress=lambda *_: None, cancelled=lambda: False
        ).finish()
    return read_bundle(folder / f"rendered-{camera_scale}")


def kept(bundle: Bundle, folder: Path, keep: Callable[[Pattern], bool]) -> Path:
    """Write the frames of the patterns to keep as a bundle of their own, without truth beside them; its folder."""
    capture = bundle.capture
    shots = tuple(shot for shot in capture.shots if keep(capture.patterns[shot.pattern]))
    write_bundle(folder, Capture(capture.projector, capture.patterns, capture.cameras, shots), bundle.calibration)
    return folder


def measured(bundles: list[Path], output: Path) -> list[Measured]:
    """Reconstruct each bundle in turn, several times over, so that a busy minute falls on all of them alike."""
    reports: list[list[Any]] = [
        [
            reconstruct_bundle(
                bundle, output, plan=ReconstructionPlan(), progress=lambda *_: None, cancelled=lambda: False
            )
            for bundle in bundles
        ]
        for _ in range(1 + WARM_RUNS)
    ]
    found = []
    for of_one in zip(*reports[1:], strict=True):
        stages = [report["stages_s"] for report in of_one]
        figures = of_one[-1]["mesh"]["figures"]
        medians = {
            name: statistics.median(run[name] for run in stages) for name in stages[0] if name not in FILE_STAGES
        }
        found.append(Measured(medians, vertices=figures["vertices"]))
    return found


def exponent(small: float, large: float) -> float:
    """log₄ of a ratio of times: how steeply the cost grows when the work grows fourfold."""
    return math.log(large / small) / math.log(GROWTH)


def table(title: str, small: Measured, large: Measured) -> str:
    """Seconds per stage before and after, in Markdown, which a terminal shows as well."""
    lines = [f"{title}", "", "| stage | s | ×4 s | exponent |", "|---|---:|---:|---:|"]
    for stage, large_s in large.stages_s.items():
        small_s = small.stages_s[stage]
        steep = f"{exponent(small_s, large_s):.2f}" if min(small_s, large_s) >= SHORTEST_S else "too short"
        lines.append(f"| {stage} | {small_s:.3f} | {large_s:.3f} | {steep} |")
    steep = f"{exponent(small.total_s, large.total_s):.2f}"
    lines.append(f"| all | {small.total_s:.3f} | {large.total_s:.3f} | {steep} |")
    lines.append(
        f"| number of vertices | {small.vertices} | {large.vertices} | {exponent(small.vertices, large.vertices):.2f} |"
    )
    return "\n".join([*lines, ""])


def shown(text: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Print a table, and keep it where SLRIG_BENCH_OUTPUT says."""
    with capsys.disabled():
        print("\n\n" + text)  # noqa: T201
    folder = os.environ.get("SLRIG_BENCH_OUTPUT")
    if folder:
        Path(folder).mkdir(parents=True, exist_ok=True)
        (Path(folder) / f"{name}.md").write_text(text, encoding="utf-8")


def test_cost_grows_with_pixels_and_stripes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fine, coarse = recorded(tmp_path, camera_scale=2), recorded(tmp_path, camera_scale=1)
    few, whole, pixels = measured(
        [
            kept(coarse, tmp_path / "few", lambda p: not isinstance(p, LineShift) or p.shift in KEPT_SHIFTS),
            kept(coarse, tmp_path / "whole", lambda _: True),
            kept(fine, tmp_path / "pixels", lambda _: True),
        ],
        tmp_path / "out",
    )
    shown(table("Four times the pixels, the same patterns", whole, pixels), "growth-pixels", capsys)
    shown(table("Four times the stripes, the same pixels", few, whole), "growth-stripes", capsys)
    # Rows double, and with them the points of each stripe; stripes quadruple.
    assert 1.6 < pixels.vertices / whole.vertices < 2.4
    assert 3.2 < whole.vertices / few.vertices < 4.8
    assert exponent(whole.total_s, pixels.total_s) < STEEPEST
    assert exponent(few.total_s, whole.total_s) < STEEPEST
