"""The sweep that the shipped presets were chosen by: four kinds of object on a rendered rig, each way to expose, each
set of patterns; then the presets themselves, and what the exposure assistant proposes.

`python -m tests.bench.preset_sweep` prints the table of `slrig/scan/README.md`; `--only shiny` one object.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import structlog

from slrig.api.schemas import ScanRequest, scan_plan
from slrig.bundle.options import PresetDocument, ScanDefaults
from slrig.config import read_rig
from slrig.devices import Rig
from slrig.discovery import open_rig
from slrig.errors import NothingToReconstructError, ScanEvidenceError
from slrig.model import SequenceName
from slrig.scan.acquisition import capture_frames
from slrig.scan.exposure import Looking, Proposal, proposal
from slrig.scan.plan import SHIPPED, PatternPlan, ScanPlan, pattern_sequence
from tests.golden.shipped_rigs import PAINT, SMALL, rig_file
from tests.golden.test_bundles import reconstructed

OBJECTS = {
    "matt": """albedo = 0.85
texture = { kind = "noise", contrast = 0.25, scale_mm = 6.0 }
""",
    "dark": """albedo = 0.05
texture = { kind = "noise", contrast = 0.6, scale_mm = 6.0 }
""",
    "shiny": """albedo = 0.35
texture = { kind = "noise", contrast = 0.25, scale_mm = 6.0 }
specular = { strength = 4.0, exponent = 40.0 }
""",
    # Its darkest and brightest places are some thousand times apart.
    "mixed": """albedo = 0.3
texture = { kind = "noise", contrast = 0.995, scale_mm = 14.0 }
specular = { strength = 8.0, exponent = 60.0 }
""",
}
FACTORS = (
    (1 / 4,), (1 / 2,), (1,), (2,), (4,), (8,), (1 / 4, 1), (1 / 2, 2), (1, 4), (1 / 4, 2), (1 / 8, 1), (1 / 2, 4),
    (1, 8), (2, 8), (1 / 4, 1, 4), (1 / 8, 1 / 2, 2), (1 / 16, 1 / 2, 4), (1 / 16, 1 / 4, 1, 4),
)  # fmt: skip
USUAL = {"matt": (1,), "dark": (1, 8), "shiny": (1 / 4, 2), "mixed": (1 / 16, 1 / 2, 4)}
PATTERNS = {
    "fast": PatternPlan(sequence=SequenceName.FAST),
    "robust": PatternPlan(sequence=SequenceName.ROBUST),
    "lines of 1 px": PatternPlan(line_width_px=1),
    "period 16": PatternPlan(line_shift_period_px=16),
    "Gray code alone": PatternPlan(line_shift=False),
    "columns and rows": PatternPlan(rows=True),
}


QUICK = ("fast", "Gray code alone")


@dataclass(frozen=True, slots=True)
class Row:
    """What one scan cost and gave. seconds : of capture, by the rig's clock; complete : within 0.1 mm of the truth."""

    name: str
    seconds: float
    frames: int
    complete: float
    rms_um: float

    def __str__(self) -> str:
        if not self.frames:
            return f"| {self.name} | | | nothing | |"
        return f"| {self.name} | {self.seconds:.2f} | {self.frames} | {self.complete:.1%} | {self.rms_um:.1f} |"


def object_rig(folder: Path, kind: str) -> Path:
    """The rig file of a relief of one of `OBJECTS`, before a camera of 240 x 192 pixels."""
    return rig_file(folder, "relief", scene={PAINT: OBJECTS[kind]}, head=SMALL)


def scanned(rig: Rig, plan: ScanPlan, name: str) -> Row:
    """Scan once; no frames where no scan came of it."""
    with TemporaryDirectory() as folder:
        bundle, began_ns = Path(folder, "bundle"), rig.clock.now_ns()
        try:
            capture_frames(rig, plan, bundle).finish()
            seconds = (rig.clock.now_ns() - began_ns) / 1e9
            report: Mapping[str, Any] = reconstructed(bundle, Path(folder, "result"))
        except (ScanEvidenceError, NothingToReconstructError):
            return Row(name, 0.0, 0, 0.0, 0.0)
    truth = report["truth"]
    return Row(name, seconds, report["frames"]["shots"], truth["complete_0.1mm"], 1000 * truth["rms_mm"])


def swept(rig: Rig, factors: Iterable[tuple[float, ...]] = FACTORS) -> Iterator[Row]:
    """Ways to expose, with the usual patterns."""
    for each in factors:
        yield scanned(rig, ScanPlan(exposure_factors=each), _words(each))


def swept_patterns(rig: Rig, kind: str) -> Iterator[Row]:
    """Sets of patterns, exposed as suits the object, and as short as may be."""
    for factors in (USUAL[kind], (1 / 2,), (1 / 4,)):
        for name, patterns in PATTERNS.items():
            if factors == USUAL[kind] or name in QUICK:
                yield scanned(rig, ScanPlan(patterns, exposure_factors=factors), f"{_words(factors)}, {name}")


def _words(factors: tuple[float, ...]) -> str:
    return " + ".join(f"{factor:g}" for factor in factors)


def by_preset(rig: Rig, name: str) -> Row:
    """A scan by a shipped preset."""
    plan = scan_plan(ScanRequest(preset=name), ScanDefaults(), PresetDocument(scan=SHIPPED[name]))
    return scanned(rig, plan, f"preset {name}")


def proposed(rig: Rig, budget_s: float | None = None) -> Proposal:
    """What the assistant proposes for a scan by the usual patterns."""
    looking = Looking(rig)
    looking.look()
    frames = len(pattern_sequence(PatternPlan(), rig.projector.info.size, rig.calibration, rig.cameras))
    overhead_s = median(looking.overheads_s)
    return proposal(
        looking.seen(), looking.candidates_s(), frames=frames, overhead_s=overhead_s, budget_s=budget_s
    )  # fmt: skip


def by_assistant(rig: Rig, budget_s: float | None = None) -> tuple[Row, Proposal]:
    """A scan by what the assistant proposes; its looks count as capture."""
    began_ns = rig.clock.now_ns()
    found = proposed(rig, budget_s)
    looked_s = (rig.clock.now_ns() - began_ns) / 1e9
    times_s = tuple(each.exposure_s for each in found.exposures)
    plan = ScanPlan(exposure_s=times_s[0]) if len(times_s) == 1 else ScanPlan(exposures_s=times_s)
    within = "" if budget_s is None else f" within {budget_s:g} s"
    row = scanned(rig, plan, f"assistant{within}: {', '.join(f'{1000 * each:.3g}' for each in times_s)} ms")
    return replace(row, name=f"{row.name}, looks {looked_s:.1f} s"), found


def best_within(rows: list[Row], seconds: float) -> float:
    """The completeness of the best scan of a sweep that took no longer."""
    return max((row.complete for row in rows if row.seconds <= seconds), default=0.0)


def main() -> None:
    """Print the table."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    asked = argparse.ArgumentParser(description=main.__doc__)
    asked.add_argument("--only", choices=OBJECTS)
    only = asked.parse_args().only
    for kind in [only] if only else OBJECTS:
        sys.stdout.write(f"\n{kind}\n\n| scan | s | frames | complete | rms, µm |\n|---|---|---|---|---|\n")
        with TemporaryDirectory() as folder, open_rig(read_rig(object_rig(Path(folder), kind))) as rig:
            rows = []
            for row in chain(swept(rig), swept_patterns(rig, kind)):
                rows.append(row)
                sys.stdout.write(f"{row}\n")
                sys.stdout.flush()
            shown = [by_preset(rig, name) for name in SHIPPED]
            for budget_s in (None, 2.0, 1.2):
                row, found = by_assistant(rig, budget_s)
                shown.append(replace(row, name=f"{row.name}, says {found.completeness:.1%} in {found.seconds:.2f} s"))
            for row in shown:
                best = best_within(rows, row.seconds + 1e-6)
                sys.stdout.write(f"{row} best of the sweep in that time {best:.1%}\n")
                sys.stdout.flush()


if __name__ == "__main__":
    main()
