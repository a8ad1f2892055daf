"""Random wrong calibrations and sequences on rendered scenes: none may give a surface that is off and does not say so.

`python -m tests.bench.wrong_calibrations --wrong 200 --right 40 --seed 1` prints a line a case and the counts;
`--only CASE` runs one, `--keep FOLDER` keeps its bundle and its report.

A case is a scene (relief, balls, steps, or a ball before a wall; its texture, gloss, gamma, noise, exposure and lenses
are drawn), recorded by columns and rows, one fifth of them by columns alone, and one or two mistakes. Their sizes are
drawn log-uniformly, from below the noise to gross. Truth is the triangles that the renderer traces. A vertex's error is
its distance from them. A surface is off if 68 % of errors exceed 3 σ or 5 % exceed 6 σ, and silent if it is off without
refusal or note. Of one axis, whose calibration nothing tests, the report has to say just that.

The length of the baseline is no mistake here: it scales the surface and leaves all rays crossing.
"""

from __future__ import annotations

import argparse
import logging
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import structlog
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from simulated_rig.light import Response
from simulated_rig.optics import look_at
from simulated_rig.rendering import CameraView, SceneState, SensorModel
from simulated_rig.scene import Scene, SceneSurface, build_surface
from slrig.bundle import write_bundle
from slrig.errors import SlrigError
from slrig.model import (
    Axis,
    Calibration,
    CameraFormat,
    Capture,
    FloatArray,
    Gray,
    LineShift,
    Pinhole,
    Pixels,
    Shot,
    Size,
)
from slrig.patterns.sequence import profile
from slrig.scan.artefacts import decode_mesh_ply
from slrig.scan.plan import PatternPlan, pattern_sequence
from tests.golden.test_bundles import reconstructed
from tests.light_bound import ExposedView

EYE, LAMP = Size(320, 256), Size(384, 256)
SCENES = 12  # of which a campaign's mistakes are made
SIGMAS = 3.0
UNTESTED = "this scan cannot test it"
HIDDEN = r"errors of it below ([0-9.e+-]+) mm would not show"
SURFACE_POINTS = 400_000


@dataclass(frozen=True)
class Recorded:
    """A rendered scene: right frames, right calibration, and points (n, 3) on its surface with their normals."""

    capture: Capture
    calibration: Calibration
    points_mm: FloatArray
    normals: FloatArray
    described: str

    def error_mm(self, points_mm: FloatArray) -> FloatArray:
        """(n,) distance of each point from the surface: from the plane of the nearest triangle's sample."""
        away, nearest = cKDTree(self.points_mm).query(points_mm)
        flat = np.abs(np.einsum("ij,ij->i", points_mm - self.points_mm[nearest], self.normals[nearest]))
        # Beside a sample, the plane counts; far from every sample, the distance itself.
        return np.asarray(np.where(away < 1.0, flat, away))


def _scene(rng: np.random.Generator) -> Scene:
    kind = rng.choice(["relief", "bar", "steps", "ball"])
    paint = {
        "albedo": float(rng.uniform(0.3, 0.9)),
        "texture": {
            "kind": str(rng.choice(["uniform", "noise", "checker"], p=[0.3, 0.5, 0.2])),
            "contrast": float(rng.uniform(0.1, 0.7)), "scale_mm": float(rng.uniform(4, 15)),
        },
        "specular": {"strength": float(rng.choice([0.0, 0.3])), "exponent": 30.0},
        "rotation_deg": rng.uniform(-15, 15, 3).tolist(),
    }  # fmt: skip
    wall = paint | {"name": "wall", "shape": "plane", "size_mm": [220.0, 180.0], "position_mm": [0.0, 0.0, 45.0]}
    things: dict[str, list[dict[str, Any]]] = {
        "relief": [
            paint
            | {
                "shape": "relief", "size_mm": [130.0, 110.0], "step_mm": 0.4,
                "wave": [{"amplitude_mm": 1.0, "wavelength_mm": 25.0, "direction_deg": float(rng.uniform(0, 180))}],
                "bump": [
                    {"centre_mm": rng.uniform(-35, 35, 2).tolist(), "height_mm": float(rng.uniform(-15, 15)),
                     "sigma_mm": float(rng.uniform(9, 18))}
                    for _ in range(4)
                ],
            }
        ],
        "bar": [paint | {"shape": "ball_bar", "radius_mm": 18.0, "distance_mm": 70.0, "bar_radius_mm": 5.0}, wall],
        "steps": [paint | {"shape": "stairs", "steps": 4, "tread_mm": 24.0, "rise_mm": 6.0, "height_mm": 90.0}],
        "ball": [paint | {"shape": "sphere", "radius_mm": float(rng.uniform(25, 40))}, wall],
    }  # fmt: skip
    return Scene.model_validate({"name": str(kind), "object": [{"name": "thing"} | each for each in things[kind]]})


def _device(rng: np.random.Generator, size: Size, focal_px: float, centre_mm: FloatArray, k1: float) -> Pinhole:
    rotation, translation = look_at(centre_mm, rng.uniform(-5, 5, 3), np.array([rng.uniform(-0.05, 0.05), 1.0, 0.0]))
    focal_px *= float(rng.uniform(0.95, 1.1))
    centre = (np.array([size.width_px, size.height_px]) - 1) / 2 + rng.uniform(-6, 6, 2)
    matrix = np.array([[focal_px, 0, centre[0]], [0, focal_px * rng.uniform(0.998, 1.002), centre[1]], [0, 0, 1]])
    return Pinhole(size, matrix, np.array([k1, -k1, *rng.uniform(-5e-4, 5e-4, 2), 0.0]), rotation, translation)


def recorded(seed: int) -> Recorded:
    """Render a scene by all patterns of both axes."""
    rng = np.random.default_rng((seed, 43))
    scene = _scene(rng)
    surface = build_surface(scene, Path())
    eye = _device(rng, EYE, 1270.0, np.array([rng.uniform(-160, -60), rng.uniform(-20, 20), -560.0]),
                  float(rng.uniform(-0.15, 0.05)))  # fmt: skip
    lamp = _device(rng, LAMP, 1650.0, np.array([rng.uniform(60, 140), rng.uniform(-20, 20), -590.0]),
                   float(rng.uniform(-0.04, 0.04)))  # fmt: skip
    stage = SceneState(surface, lamp, working_distance_mm=float(np.linalg.norm(lamp.centre_mm)))
    view = CameraView(
        eye, stage, blur_px=float(rng.uniform(0.4, 0.9)), ambient=float(rng.uniform(0, 0.05)), jitter=False, seed=seed,
        samples_per_axis=2, workers=1,
    )  # fmt: skip
    well, gamma = float(np.exp(rng.uniform(np.log(4e3), np.log(25e3)))), float(rng.uniform(1.0, 2.4))
    response = float(rng.choice([1.0, 1.0, 0.45]))
    sensor = SensorModel(8, well, float(rng.uniform(4, 12)), 0.02, float(rng.uniform(0, 4)), response)
    light = Response(gamma, 0.002, float(rng.uniform(0.4, 0.8)), float(rng.choice([0.0, 0.4])))
    full = ExposedView(view, LAMP, light, sensor, sensor.saturation_s)
    level = float(rng.choice([0.5, 0.85, 1.25]))
    exposure_s = float(sensor.saturation_s * level * well / np.percentile(full.ends[0], 99.5))
    exposed = replace(full, exposure_s=exposure_s)
    plan = PatternPlan(rows=True, line_shift=bool(rng.random() < 0.8))
    patterns = pattern_sequence(plan, LAMP).patterns
    shots = tuple(
        Shot(index, "eye", exposed.frame(profile(pattern, LAMP), rng)) for index, pattern in enumerate(patterns)
    )
    points, normals = _sampled(surface)
    return Recorded(
        Capture(LAMP, patterns, {"eye": CameraFormat(EYE, 8)}, shots), Calibration({"eye": eye}, lamp), points, normals,
        f"{scene.name:6} white {level:.2f} response {response} {'lines' if plan.line_shift else 'gray'}",
    )  # fmt: skip


def _sampled(surface: SceneSurface) -> tuple[FloatArray, FloatArray]:
    mesh = trimesh.Trimesh(surface.vertices_mm, surface.faces, process=False)
    points, faces = trimesh.sample.sample_surface(mesh, SURFACE_POINTS, seed=1)
    return np.asarray(points, np.float64), np.asarray(mesh.face_normals[faces], np.float64)


Change = Callable[[np.random.Generator, float, Capture, Calibration], tuple[Capture, Calibration]]
"""From right frames and calibration to wrong ones. The number is the size, 0 to 1: from below the noise to gross."""


def _log(size: float, least: float, most: float) -> float:
    return float(least * (most / least) ** size)


def _way(rng: np.random.Generator, count: int) -> FloatArray:
    way = rng.standard_normal(count)
    return np.asarray(way / np.linalg.norm(way))


def _of_calibration(
    changed: Callable[[np.random.Generator, float, Pinhole, Pinhole], tuple[Pinhole, Pinhole]],
) -> Change:
    def change(
        rng: np.random.Generator, size: float, capture: Capture, right: Calibration
    ) -> tuple[Capture, Calibration]:
        assert right.projector is not None
        eye, lamp = changed(rng, size, right.cameras["eye"], right.projector)
        return capture, Calibration({"eye": eye}, lamp)

    return change


def _turned(rng: np.random.Generator, size: float, eye: Pinhole, lamp: Pinhole) -> tuple[Pinhole, Pinhole]:
    turn = Rotation.from_rotvec(np.radians(_log(size, 0.001, 10)) * _way(rng, 3)).as_matrix() @ lamp.rotation
    return eye, replace(lamp, rotation=turn, translation_mm=-turn @ lamp.centre_mm)


def _shifted(rng: np.random.Generator, size: float, eye: Pinhole, lamp: Pinhole) -> tuple[Pinhole, Pinhole]:
    # Across the baseline: along it, the surface scales.
    baseline = lamp.centre_mm - eye.centre_mm
    way = np.cross(baseline / np.linalg.norm(baseline), _way(rng, 3))
    return eye, replace(lamp, translation_mm=lamp.translation_mm - lamp.rotation @ way * _log(size, 0.01, 60))


def _convention(rng: np.random.Generator, _size: float, eye: Pinhole, lamp: Pinhole) -> tuple[Pinhole, Pinhole]:
    rotation = lamp.rotation @ eye.rotation.T
    shift = lamp.translation_mm - rotation @ eye.translation_mm
    poses = [
        (rotation.T, -rotation.T @ shift),
        (rotation.T, shift),
        (rotation, -shift),
        (rotation, -rotation.T @ shift),
    ]
    turn, moved = poses[rng.integers(len(poses))]
    return eye, replace(lamp, rotation=turn @ eye.rotation, translation_mm=turn @ eye.translation_mm + moved)


def _exchanged(rng: np.random.Generator, _size: float, eye: Pinhole, lamp: Pinhole) -> tuple[Pinhole, Pinhole]:
    lenses = [replace(a, matrix=b.matrix, distortion=b.distortion) for a, b in ((eye, lamp), (lamp, eye))]
    return (lenses[0], lenses[1]) if rng.random() < 0.5 else _convention(rng, 0, lenses[0], lenses[1])


def _lens(least: float, most: float, change: Callable[[np.random.Generator, float, Pinhole], Pinhole]) -> Change:
    def changed(rng: np.random.Generator, size: float, eye: Pinhole, lamp: Pinhole) -> tuple[Pinhole, Pinhole]:
        by = _log(size, least, most) * rng.choice([-1, 1])
        return (change(rng, by, eye), lamp) if rng.random() < 0.5 else (eye, change(rng, by, lamp))

    return _of_calibration(changed)


def _focal(_rng: np.random.Generator, by: float, device: Pinhole) -> Pinhole:
    matrix = device.matrix.copy()
    matrix[:2, :2] *= np.exp(by)
    return replace(device, matrix=matrix)


def _centre(rng: np.random.Generator, by: float, device: Pinhole) -> Pinhole:
    matrix = device.matrix.copy()
    matrix[:2, 2] += by * _way(rng, 2)
    return replace(device, matrix=matrix)


def _radial(_rng: np.random.Generator, by: float, device: Pinhole) -> Pinhole:
    return replace(device, distortion=device.distortion + np.array([by, 0, 0, 0, 0]))


def _resolution(_rng: np.random.Generator, by: float, device: Pinhole) -> Pinhole:
    """The matrix of a picture of another size: p' = s (p + ½) - ½."""
    matrix = device.matrix.copy()
    matrix[:2, 2] += 0.5
    matrix[:2] *= np.exp(by)
    matrix[:2, 2] -= 0.5
    return replace(device, matrix=matrix)


def _of_pictures(changed: Callable[[np.random.Generator, float], Callable[[Pixels], Pixels]]) -> Change:
    def change(
        rng: np.random.Generator, size: float, capture: Capture, right: Calibration
    ) -> tuple[Capture, Calibration]:
        moved = changed(rng, size)
        shots = tuple(replace(shot, image=np.ascontiguousarray(moved(shot.image))) for shot in capture.shots)
        return replace(capture, shots=shots), right

    return change


def _mirrored(rng: np.random.Generator, _size: float) -> Callable[[Pixels], Pixels]:
    way: Any = [(slice(None), slice(None, None, -1)), (slice(None, None, -1),), (slice(None, None, -1),) * 2][
        rng.integers(3)
    ]
    return lambda image: image[way]


def _warped(matrix: FloatArray) -> Callable[[Pixels], Pixels]:
    return lambda image: np.asarray(
        cv2.warpAffine(image, matrix, image.shape[::-1], flags=cv2.INTER_CUBIC, borderValue=0), image.dtype
    )


def _zoomed(rng: np.random.Generator, size: float) -> Callable[[Pixels], Pixels]:
    scale = np.exp(_log(size, 1e-4, 0.5) * rng.choice([-1, 1]))
    middle = np.array([EYE.width_px - 1, EYE.height_px - 1]) / 2
    return _warped(np.column_stack([scale * np.eye(2), (1 - scale) * middle]))


def _cropped(rng: np.random.Generator, size: float) -> Callable[[Pixels], Pixels]:
    return _warped(np.column_stack([np.eye(2), _log(size, 0.02, 60) * _way(rng, 2)]))


def _rolled(rng: np.random.Generator, size: float) -> Callable[[Pixels], Pixels]:
    turn = np.radians(_log(size, 0.005, 10) * rng.choice([-1, 1]))
    middle = np.array([EYE.width_px - 1, EYE.height_px - 1]) / 2
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return _warped(np.column_stack([matrix, middle - matrix @ middle]))


def _offset(rng: np.random.Generator, size: float, capture: Capture, right: Calibration) -> tuple[Capture, Calibration]:
    """The code of one axis or of both starts elsewhere than is said; of lines, too, or not."""
    by, axes, lines = round(_log(size, 1, 60)), list(Axis)[: rng.integers(1, 3)], rng.random() < 0.5

    def moved(pattern: Any) -> Any:
        if isinstance(pattern, Gray) and pattern.axis in axes:
            return replace(pattern, offset_px=pattern.offset_px + by)
        if lines and isinstance(pattern, LineShift) and pattern.axis in axes:
            return replace(pattern, shift=(pattern.shift - by) % pattern.period_px)
        return pattern

    return replace(capture, patterns=tuple(moved(each) for each in capture.patterns)), right


def _reordered(order: Callable[[np.random.Generator, tuple[Any, ...]], list[int]]) -> Change:
    """Frames of other patterns than is said. order : of each pattern, the one whose frame it gets."""

    def change(
        rng: np.random.Generator, _size: float, capture: Capture, right: Calibration
    ) -> tuple[Capture, Calibration]:
        images = {shot.pattern: shot.image for shot in capture.shots}
        source = order(rng, capture.patterns)
        shots = tuple(replace(shot, image=images[source[shot.pattern]]) for shot in capture.shots)
        return replace(capture, shots=shots), right

    return change


def _one_off(rng: np.random.Generator, patterns: tuple[Any, ...]) -> list[int]:
    count, by, first = len(patterns), int(rng.choice([-1, 1])), int(rng.integers(len(patterns) - 2))
    return [min(max(k + by * (k >= first), 0), count - 1) for k in range(count)]


def _two_exchanged(rng: np.random.Generator, patterns: tuple[Any, ...]) -> list[int]:
    order = list(range(len(patterns)))
    i, j = rng.choice(len(order), 2, replace=False)
    order[i], order[j] = j, i
    return order


def _bits_exchanged(rng: np.random.Generator, patterns: tuple[Any, ...]) -> list[int]:
    """Two bits of one axis with their inverses, or one bit with its inverse."""
    order = list(range(len(patterns)))
    bits: dict[tuple[Axis, int], dict[bool, int]] = {}
    for k, each in enumerate(patterns):
        if isinstance(each, Gray):
            bits.setdefault((each.axis, each.bit), {})[each.inverted] = k
    axis = list(Axis)[rng.integers(2)]
    frames = [each for (which, _), each in bits.items() if which is axis]
    a, b = (frames[k] for k in rng.choice(len(frames), 2, replace=False))
    if rng.random() < 0.3 and len(a) == 2:
        order[a[False]], order[a[True]] = a[True], a[False]
        return order
    for way in a.keys() & b.keys():
        order[a[way]], order[b[way]] = b[way], a[way]
    return order


def _axes_exchanged(
    _rng: np.random.Generator, _size: float, capture: Capture, right: Calibration
) -> tuple[Capture, Calibration]:
    """Columns called rows, by who took the projector for upright."""
    return replace(capture, patterns=tuple(
        replace(each, axis=each.axis.other) if isinstance(each, Gray | LineShift) else each
        for each in capture.patterns
    )), right  # fmt: skip


KINDS: dict[str, Change] = {
    "projector turned": _of_calibration(_turned),
    "projector shifted": _of_calibration(_shifted),
    "pose of another convention": _of_calibration(_convention),
    "devices exchanged": _of_calibration(_exchanged),
    "focal length": _lens(1e-4, 0.5, _focal),
    "principal point": _lens(0.02, 80, _centre),
    "radial distortion": _lens(3e-4, 0.5, _radial),
    "matrix of another resolution": _lens(1e-3, 0.7, _resolution),
    "picture mirrored": _of_pictures(_mirrored),
    "picture zoomed": _of_pictures(_zoomed),
    "picture cropped": _of_pictures(_cropped),
    "picture turned": _of_pictures(_rolled),
    "code with an offset": _offset,
    "one frame off": _reordered(_one_off),
    "two frames exchanged": _reordered(_two_exchanged),
    "bits exchanged": _reordered(_bits_exchanged),
    "axes exchanged": _axes_exchanged,
}


@dataclass(frozen=True)
class Outcome:
    """What came of a case. over_sigma : (2,) errors over σ that 68 % and 95 % of the vertices have at most, NaN without
    a surface. said : refusal, notes, or the words for one axis, empty if nothing was said.
    """

    name: str
    over_sigma: tuple[float, float]
    p68_mm: float
    said: str
    holds: str = ""

    @property
    def is_off(self) -> bool:
        return self.over_sigma[0] > SIGMAS or self.over_sigma[1] > 2 * SIGMAS

    @property
    def is_silent(self) -> bool:
        return self.is_off and not self.said

    def __str__(self) -> str:
        if np.isnan(self.p68_mm):
            return f"{self.name}: {self.said}"
        ratios = " ".join(f"{each:.2f}" for each in self.over_sigma)
        verdict = "SILENT" if self.is_silent else "said" if self.is_off else "holds"
        return f"{self.name}: {verdict}: {ratios} σ, {self.p68_mm:.4f} mm. {self.said or self.holds}"


def outcome(name: str, scene: Recorded, capture: Capture, calibration: Calibration, folder: Path) -> Outcome:
    """Reconstruct, and hold the surface against the truth."""
    none = (np.nan, np.nan)
    try:
        write_bundle(folder / "bundle", capture, calibration)
        report = reconstructed(folder / "bundle", folder / "mesh")
    except SlrigError as error:
        return Outcome(name, none, np.nan, f"refused, {type(error).__name__}: {error}")
    mesh = decode_mesh_ply((folder / "mesh" / "mesh.ply").read_bytes())
    apart = scene.error_mm(np.asarray(mesh.vertices_mm, np.float64))
    ratio = np.nan_to_num(apart / mesh.sigma_mm, nan=np.inf)
    evidence = report.get("evidence") or {}
    spoken = [each for each in report["notes"] if any(word in each for word in WARNINGS)]
    if evidence.get("contradictions"):
        spoken.append(f"{len(evidence['contradictions'])} contradictions of the frames")
    p68, p95 = (float(each) for each in np.percentile(ratio, [68.3, 95]))
    typical = float(np.percentile(apart, 68.3))
    holds = report["mesh"]["sigma_holds"]
    if UNTESTED in holds and not any(getattr(each, "axis", Axis.COLUMN) is Axis.ROW for each in capture.patterns):
        spoken.append(UNTESTED)
    # What the other axis would not show is stated in millimetres, if it is as much as this.
    if (hidden := re.search(HIDDEN, holds)) and float(hidden[1]) >= typical:
        spoken.append(hidden[0])
    return Outcome(name, (p68, p95), typical, "; ".join(spoken), holds)


WARNINGS = ("contradict", "covers only", "mirror images", "face ", "layers", "beyond", "disagree", "beside each other")


def _by_columns(capture: Capture) -> Capture:
    kept = {k: each for k, each in enumerate(capture.patterns) if getattr(each, "axis", Axis.COLUMN) is Axis.COLUMN}
    place = {k: index for index, k in enumerate(kept)}
    shots = tuple(replace(shot, pattern=place[shot.pattern]) for shot in capture.shots if shot.pattern in kept)
    return replace(capture, patterns=tuple(kept.values()), shots=shots)


_recorded = cache(recorded)


def wrong_case(seed: int, number: int, folder: Path) -> Outcome:
    """One wrong case of a campaign."""
    rng = np.random.default_rng((seed, number, 7))
    scene = _recorded(1000 * seed + number % SCENES)
    names = list(KINDS)
    # Each kind as often as any other, and a second one in a fourth of the cases.
    chosen = [names[number % len(names)]]
    chosen += [names[k] for k in rng.choice(len(names), 1) if rng.random() < 0.25 and names[k] != chosen[0]]
    sizes = rng.random(len(chosen))
    capture, calibration = scene.capture, scene.calibration
    one_axis = rng.random() < 0.2 and "axes exchanged" not in chosen
    name = f"{number} {scene.described}{' one axis' if one_axis else ''}: " + " + ".join(
        f"{kind} {size:.2f}" for kind, size in zip(chosen, sizes, strict=True)
    )
    try:
        for kind, size in zip(chosen, sizes, strict=True):
            capture, calibration = KINDS[kind](rng, float(size), capture, calibration)
    except SlrigError as error:
        return Outcome(name, (np.nan, np.nan), np.nan, f"refused, {type(error).__name__}: {error}")
    return outcome(name, scene, _by_columns(capture) if one_axis else capture, calibration, folder)


def right_case(seed: int, number: int, folder: Path) -> Outcome:
    """One right case of a campaign: a scene of its own."""
    scene = recorded(1000 * seed + 500 + number)
    return outcome(f"right {number} {scene.described}", scene, scene.capture, scene.calibration, folder)


def campaign(seed: int, wrong: range, right: range, keep: Path | None = None) -> Iterator[tuple[bool, Outcome]]:
    """Right cases (True), then wrong ones (False)."""
    for is_right, number in [(True, k) for k in right] + [(False, k) for k in wrong]:
        with TemporaryDirectory() as folder:
            where = Path(folder) if keep is None else keep / f"{'right' if is_right else 'wrong'}-{number}"
            where.mkdir(parents=True, exist_ok=True)
            yield is_right, (right_case if is_right else wrong_case)(seed, number, where)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--wrong", type=int, default=200)
    parser.add_argument("--right", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int)
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    only = range(0) if options.only is None else range(options.only, options.only + 1)
    wrong, right = (only, range(0)) if only else (range(options.wrong), range(options.right))
    counts: Counter[str] = Counter()
    for is_right, found in campaign(options.seed, wrong, right, options.keep):
        print(found, flush=True)  # noqa: T201
        refused = bool(np.isnan(found.p68_mm))
        if is_right:
            counts["right"] += 1
            counts["right refused"] += refused
            counts["right called wrong"] += "contradict" in found.said
            counts["right off"] += found.is_off
        else:
            counts["wrong"] += 1
            counts["wrong refused"] += refused
            counts["wrong silent"] += found.is_silent
            counts["wrong off and said"] += found.is_off and not found.is_silent
            counts["wrong within the stated"] += not refused and not found.is_off
    print(dict(counts))  # noqa: T201
    return int(counts["wrong silent"] + counts["right refused"] > 0)


if __name__ == "__main__":
    sys.exit(main())
