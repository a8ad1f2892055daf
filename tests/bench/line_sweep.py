"""The sweep that the lines of the named sequences were chosen by: period, number of shifts and width of the lines, over
scenes whose light is worse in one way each.

`python -m tests.bench.line_sweep` prints the table of `slrig/scan/README.md`; `--only gamma` one scene, `--seeds 3`
means of as many draws of the noise, `--named` the named sequences alone.
"""

from __future__ import annotations

import argparse
import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory

import structlog

from simulated_rig.scene import Scene, read_scene
from slrig.errors import NothingToReconstructError
from slrig.model import Gray, LineShift, Pattern, SequenceName, Size
from slrig.patterns.sequence import scan_patterns
from slrig.scan.plan import PatternPlan, pattern_sequence
from tests.golden.lit_scenes import SCENES, Figures, Light, LitScene

POSTS = Scene.model_validate(
    {
        "name": "posts",
        "object": [
            {"name": "wall", "shape": "plane", "position_mm": [0.0, 0.0, 30.0], "size_mm": [150.0, 120.0]},
            *(
                {
                    "name": f"post {at}", "shape": "turned", "position_mm": [20.0 * at, 0.0, 0.0],
                    "profile_mm": [[radius, -40.0], [radius, 0.0], [radius, 40.0]], "step_mm": 0.2,
                }
                for at, radius in ((-1, 1.5), (0, 0.75), (1, 3.0))
            ),
        ],
    }
)  # fmt: skip
"""Posts of 1.5, 3 and 6 mm before a wall."""


@dataclass(frozen=True, slots=True)
class Lines:
    """Lines of one period: how many shifts divide it, and how wide a line is, px."""

    period_px: int
    shifts: int
    width_px: int

    def __str__(self) -> str:
        return f"{self.period_px}/{self.shifts} w{self.width_px}"

    def patterns(self, size: Size, *, inverses: bool = False) -> tuple[Pattern, ...]:
        """White, black, the code, and these lines."""
        step = self.period_px // self.shifts
        every = scan_patterns(
            size, line_shift=True, period_px=self.period_px, line_width_px=self.width_px, gray_cell_px=None,
            gray_offset_px=0, rows=False,
        )  # fmt: skip
        return tuple(
            each for each in every
            if (inverses or not (isinstance(each, Gray) and each.inverted))
            and not (isinstance(each, LineShift) and each.shift % step)
        )  # fmt: skip


CHOICES = (
    *(Lines(period, period, width) for period in (4, 6, 8, 10, 12, 16) for width in {1, period // 4, period // 2}),
    Lines(6, 3, 3), Lines(12, 3, 6), Lines(12, 6, 6), Lines(16, 8, 8),
)  # fmt: skip


def scenes() -> dict[str, LitScene]:
    """By name; each is rendered when a frame of it is first asked for."""
    stairs = read_scene(SCENES / "stairs.toml")
    return {
        "plain": LitScene(Light(), share=0.5),
        "scaler": LitScene(Light(signal_blur_px=0.7, gamma=2.2), share=0.5),
        "gamma 2.6, scaler": LitScene(Light(signal_blur_px=0.5, gamma=2.6), share=0.5),
        "projector out of focus": LitScene(Light(projector_blur_px=1.6), share=0.5),
        "camera out of focus": LitScene(Light(camera_blur_px=1.6), share=0.5),
        "a fifth of the light, a lit room": LitScene(Light(brightness=0.2, ambient=0.15), share=0.5),
        "gloss": LitScene(Light(lobe=0.3, lobe_exponent=80.0), share=0.5),
        "translucent": LitScene(Light(scattered=0.6), share=0.5),
        "texture 7:1": LitScene(Light(texture_ratio=7.0), share=0.5),
        "JPEG 80": LitScene(Light(jpeg_quality=80), share=0.5),
        "concave": LitScene(Light(returned=0.25), share=0.5),
        "steps": LitScene(Light(), share=0.75, scene=stairs),
        "thin posts": LitScene(Light(), share=0.75, scene=POSTS),
    }


@dataclass(frozen=True, slots=True)
class Named:
    """A named sequence, or one that differs from it."""

    name: str
    plan: PatternPlan

    def __str__(self) -> str:
        return self.name

    def patterns(self, size: Size, *, inverses: bool = False) -> tuple[Pattern, ...]:
        """What it plays. inverses : none can be added to what it says itself."""
        assert not inverses
        return pattern_sequence(self.plan, size).patterns


NAMED = (
    *(Named(name, PatternPlan(sequence=name)) for name in SequenceName),
    Named("lines of 1 px, inverses", PatternPlan(sequence=SequenceName.ROBUST, line_width_px=1)),
)


def figures(scene: LitScene, lines: Lines | Named, seeds: int, *, inverses: bool = False) -> list[Figures]:
    """Of as many draws of the noise; fewer where nothing could be reconstructed."""
    found = []
    for seed in range(seeds):
        with TemporaryDirectory() as folder:
            try:
                patterns = lines.patterns(scene.projector, inverses=inverses)
                found.append(scene.scan(Path(folder), patterns, seed))
            except NothingToReconstructError:
                continue
    return found


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--only")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--inverses", action="store_true")
    parser.add_argument("--named", action="store_true")
    asked = parser.parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    for name, scene in scenes().items():
        if asked.only not in (None, name):
            continue
        sys.stdout.write(f"\n{name}\n| lines | rms, µm | covered | error/σ |\n|---|--:|--:|--:|\n")
        for lines in NAMED if asked.named else CHOICES:
            found = figures(scene, lines, asked.seeds, inverses=asked.inverses)
            if not found:
                sys.stdout.write(f"| {lines} | nothing | | |\n")
                continue
            rms_um = 1000 * fmean(each.rms_mm for each in found)
            covered = fmean(each.complete_03 for each in found)
            ratio = fmean(each.error_over_sigma for each in found)
            sys.stdout.write(f"| {lines} | {rms_um:.2f} | {covered:.4f} | {ratio:.2f} |\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
