"""The colours of a mesh against what the rendered scene is painted with.

`pytest tests/golden/test_albedo.py -s -m ""` prints the figures, and those of brightness in the white frame.
"""

from __future__ import annotations

import json
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from simulated_rig.options import HeadOptions
from simulated_rig.scene import build_surface, read_scene
from simulated_rig.transport import build_caster, trace_rays
from slrig.bundle import read_bundle, read_calibration, write_calibration
from slrig.capture.verifier import check_capture
from slrig.cli.commands import app
from slrig.errors import CalibrationError
from slrig.model import AlbedoMark, Black, Capture, FloatArray, LightMap, Primary, SequenceName, White
from slrig.scan.artefacts import decode_mesh_ply
from slrig.scan.plan import PatternPlan, ScanPlan
from slrig.scan.reconstruct import with_light_map
from tests.golden.shipped_rigs import GRAINY, SMALL, replaced, rig_file
from tests.golden.test_bracketing import captured
from tests.golden.test_bundles import reconstructed
from tests.unit.reconstruction.builders import opencv_pixels

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Painted:
    """A scan's vertices. found, truth : (V,), albedo, with one scale between them; brightness : of the white frame.

    mark : (V,) uint8; report : of the scan.
    """

    found: FloatArray
    truth: FloatArray
    brightness: FloatArray
    mark: NDArray[np.uint8]
    report: Mapping[str, Any]

    @property
    def sound(self) -> NDArray[np.bool_]:
        """(V,): vertices without a mark whose truth is known."""
        return np.asarray((self.mark == AlbedoMark.NONE) & (self.truth > 0))

    def told(self, name: str, values: FloatArray) -> tuple[float, float]:
        """Relative rms after one scale, and the correlation with the truth; printed, too."""
        values, truth = values[self.sound], self.truth[self.sound]
        scale = (values * truth).sum() / (values**2).sum()
        rms = float(np.sqrt(((scale * values / truth - 1) ** 2).mean()))
        correlation = float(np.corrcoef(values, truth)[0, 1])
        sys.stdout.write(f"\n{name:24} {len(truth):7} vertices, rms {rms:6.1%}, correlation {correlation:.3f}")
        return rms, correlation

    def off(self, where: NDArray[np.bool_]) -> FloatArray:
        """Found over true albedo, the median of the sound ones as 1."""
        usual = np.median(self.found[self.sound] / self.truth[self.sound])
        return np.asarray(self.found[where] / self.truth[where] / usual)


def painted(rig: Path, work: Path, plan: ScanPlan | None = None) -> Painted:
    """Scan, and ask the renderer what each vertex is painted with: along the ray of a camera that meets it."""
    (grey,) = channels(rig, work, plan)
    return grey


def channels(rig: Path, work: Path, plan: ScanPlan | None = None, *, mapped: LightMap | None = None) -> list[Painted]:
    """`painted` in each channel that a camera of the rig has: one, or red, green and blue."""
    bundle = captured(rig, plan or ScanPlan(), work / "bundle")
    if mapped is not None:
        known = read_calibration(bundle / "calibration.json")
        write_calibration(bundle / "calibration.json", replace(known, light=mapped))
    report = reconstructed(bundle, work / "out")
    mesh = decode_mesh_ply((work / "out" / "mesh.ply").read_bytes())
    table = tomllib.loads(rig.read_text())["head"]
    options = HeadOptions.model_validate({key: value for key, value in table.items() if key != "driver"})
    surface = build_surface(read_scene(rig.parent / options.scene), rig.parent)
    rays, lamp = build_caster(surface.vertices_mm, surface.faces), options.projector.pinhole()
    truth, brightness = np.zeros((len(mesh.vertices_mm), 3)), np.zeros(len(mesh.vertices_mm))
    vertices = mesh.vertices_mm.astype(np.float64)
    for eye in options.camera:
        pixels = opencv_pixels(eye.pinhole(), vertices)
        columns, rows = pixels.T.copy()
        met = trace_rays(columns, rows, eye.pinhole(), lamp, surface, rays, working_distance_mm=600.0)
        mine = (truth == 0).all(axis=1) & (np.linalg.norm(met.points_mm - vertices, axis=1) < 0.3)
        truth[mine] = met.albedo[mine, None] * met.hue[mine, ::-1]
        nearest = np.rint(np.clip(pixels[mine], 0, np.array(eye.size_px) - 1)).astype(int)
        brightness[mine] = white_frame(bundle, eye.name)[nearest[:, 1], nearest[:, 0]]
    share = mesh.colour / 255
    count = report["albedo"]["channels"]
    assert count == 3 or (mesh.colour == mesh.colour[:, :1]).all()
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    assert (truth > 0).mean() > 0.99
    return [Painted(light[:, each], truth[:, each], brightness, mesh.mark, report) for each in range(count)]


def white_frame(bundle: Path, camera: str) -> FloatArray:
    capture = read_bundle(bundle).capture
    white = capture.patterns.index(White())
    return next(shot.image for shot in capture.shots if shot.camera == camera and shot.pattern == white).astype(float)


MOTTLED = {GRAINY: 'texture = { kind = "noise", contrast = 0.99, scale_mm = 9.0 }'}
TINTED = {
    GRAINY: "colour = [0.25, 0.6, 0.95]\n"
    'texture = { kind = "noise", contrast = 0.25, scale_mm = 6.0, colour = [0.9, 0.5, 0.3] }'
}


@pytest.mark.parametrize(
    ("rig", "scene", "head", "most", "least"),
    [
        ("relief", {}, SMALL, 0.03, 0.85),
        ("demo", {}, {}, 0.03, 0.85),
        ("relief", MOTTLED, {**SMALL, "ambient = 0.01": "ambient = 0.15"}, 0.05, 0.98),
        ("relief", MOTTLED, {**SMALL, "saturation_s = 0.02": "saturation_s = 0.02\nresponse = 0.45"}, 0.05, 0.98),
    ],
    ids=["relief", "demo", "dark paint in a lit room", "values made for a display"],
)
def test_colours_are_what_the_scene_is_painted_with(
    rig: str, scene: Mapping[str, str], head: Mapping[str, str], most: float, least: float, tmp_path: Path
) -> None:
    seen = painted(rig_file(tmp_path, rig, scene=scene, head=head), tmp_path)
    rms, correlation = seen.told(rig, seen.found)
    assert rms <= most
    assert correlation >= least
    shading = seen.told("  its brightness", seen.brightness)
    assert shading[0] > 3 * rms
    if not scene:
        assert shading[1] < 0.5
        assert seen.sound.mean() > 0.985
        assert seen.report["albedo"]["brighter_than_white"] < 0.01


def test_two_cameras_of_different_gain_give_one_picture(tmp_path: Path) -> None:
    path = rig_file(tmp_path, "two_cameras", scene={}, head={})
    first, second = path.read_text().split('name = "right"')
    path.write_text(first + 'name = "right"' + second.replace("saturation_s = 0.02", "saturation_s = 0.05"))
    seen = painted(path, tmp_path)
    rms, correlation = seen.told("two gains", seen.found)
    assert rms <= 0.05
    assert correlation >= 0.85
    gains = seen.report["albedo"]["camera_gains"]
    assert gains["right"]["gain"][0] == pytest.approx(2.5, rel=0.01)
    assert gains["right"]["points"] > 1000
    # Where the projector's image ends, blur has taken light: these vertices are marked, and no dark rim is left.
    border = (seen.mark == AlbedoMark.BORDER) & (seen.truth > 0)
    assert border.sum() > 500
    assert np.median(seen.off(border)) < 0.97
    assert np.percentile(seen.off(seen.sound), 1) > 0.93


def test_saturated_paint_is_marked_and_a_bracket_needs_no_mark(tmp_path: Path) -> None:
    rig = rig_file(tmp_path, "relief", scene=MOTTLED, head=SMALL)
    # Narrow lines are seen where white is clipped; wide ones are not, and leave such places out.
    narrow = PatternPlan(sequence=SequenceName.ROBUST, line_width_px=1)
    long = painted(rig, tmp_path / "long", ScanPlan(patterns=narrow, exposure_s=0.05))
    assert long.told("overexposed", long.found)[0] <= 0.05
    saturated = (long.mark == AlbedoMark.SATURATED) & (long.truth > 0)
    assert 0.05 < saturated.mean() < 0.8
    assert np.median(long.off(saturated)) < 0.95
    assert long.report["albedo"]["marked_vertices"]["saturated"] == (long.mark == AlbedoMark.SATURATED).sum()
    bracket = painted(rig, tmp_path / "bracket", ScanPlan(exposures_s=(0.01, 0.05)))
    rms, correlation = bracket.told("bracket", bracket.found)
    assert rms <= 0.04
    assert correlation >= 0.98
    assert not (bracket.mark == AlbedoMark.SATURATED).any()


def require_colours(seen: list[Painted]) -> list[float]:
    """See that each of three channels is as it is painted; their relative rms."""
    told = [each.told(name, each.found) for name, each in zip(("red", "green", "blue"), seen, strict=True)]
    assert max(rms for rms, _ in told) <= 0.05
    assert min(correlation for _, correlation in told) >= 0.85
    return [rms for rms, _ in told]


def test_a_camera_that_has_colour_gives_each_channel_as_it_is_painted(tmp_path: Path) -> None:
    sees = {'name = "left"': 'name = "left"\ncolour = [0.7, 1.0, 0.8]'}
    seen = channels(rig_file(tmp_path, "relief", scene=TINTED, head={**SMALL, **sees}), tmp_path)
    require_colours(seen)
    # Between channels there is one scale: how strongly the camera sees each, and no more.
    red, blue = (np.median(each.found[each.sound] / each.truth[each.sound]) for each in (seen[0], seen[2]))
    assert red / blue == pytest.approx(0.8 / 0.7, rel=0.02)


def old_frames_are_told(capture: Capture) -> None:
    """A frame in coloured light that shows the pattern before, or lends its picture to the one after."""
    shown = {shot.pattern: shot.image for shot in capture.shots}
    for index in (i for i, pattern in enumerate(capture.patterns) if isinstance(pattern, Primary)):
        for old, at in ((index - 1, index), (index, index + 1)):
            shots = (replace(shot, image=shown[old]) if shot.pattern == at else shot for shot in capture.shots)
            faults = check_capture(replace(capture, shots=tuple(shots))).faults
            assert any(f"pattern {at} " in fault for fault in faults), (old, at)
        for end in (White(), Black()):
            image = shown[capture.patterns.index(end)]
            shots = (replace(shot, image=image) if shot.pattern == index else shot for shot in capture.shots)
            assert check_capture(replace(capture, shots=tuple(shots))).verified == len(capture.patterns) - 1


@pytest.mark.parametrize("exposures_s", [None, (0.01, 0.03)])
def test_lights_of_the_projector_give_a_mono_camera_colour(
    exposures_s: tuple[float, ...] | None, tmp_path: Path
) -> None:
    plan = ScanPlan(coloured_light=True, exposures_s=exposures_s)
    seen = channels(rig_file(tmp_path, "relief", scene=TINTED, head=SMALL), tmp_path, plan)
    require_colours(seen)
    assert seen[0].report["evidence"]["contradictions"] == []
    count = len(read_bundle(tmp_path / "bundle").capture.patterns)
    assert seen[0].report["evidence"]["patterns_verified"] == f"{count}/{count}"
    if exposures_s is None:
        old_frames_are_told(read_bundle(tmp_path / "bundle").capture)
    # Without these frames, the same surface to the last bit.
    description = tmp_path / "bundle" / "bundle.json"
    told = json.loads(description.read_text())
    kinds = [pattern["kind"] for pattern in told["patterns"]]
    told["frames"] = [frame for frame in told["frames"] if kinds[frame["pattern"]] != "primary"]
    description.write_text(json.dumps(told))
    report = reconstructed(tmp_path / "bundle", tmp_path / "grey")
    assert report["albedo"]["channels"] == 1
    with_light, without = (decode_mesh_ply((tmp_path / each / "mesh.ply").read_bytes()) for each in ("out", "grey"))
    for name in ("vertices_mm", "faces", "normals", "sigma_mm"):
        assert getattr(with_light, name).tobytes() == getattr(without, name).tobytes(), name


FALLS_OFF = {"gamma = 1.8": "gamma = 1.8\nfall_off = [4.0, 0.9]\nlights = [0.25, 0.5, 0.35]"}
BOARD = """name = "board"

[[object]]
name = "board"
shape = "plane"
size_mm = [220.0, 180.0]
rotation_deg = [4.0, -6.0, 0.0]
albedo = 0.85
"""


def board(folder: Path, text: str, plan: ScanPlan) -> Path:
    """The bundle of a scan of a board by a projector whose light falls off."""
    folder.mkdir()
    rig = rig_file(folder, "relief", scene={}, head={**SMALL, **FALLS_OFF})
    (folder / "scene.toml").write_text(text)
    return captured(rig, plan, folder / "bundle")


def test_a_white_board_takes_the_projectors_fall_off_out_and_tells_what_is_white(tmp_path: Path) -> None:
    plan = ScanPlan(coloured_light=True)
    output = tmp_path / "lit.json"
    shot = board(tmp_path / "board", BOARD, plan)
    told = CliRunner().invoke(app, ["calibrate", "light", str(shot), "--output", str(output)])
    assert told.exit_code == 0, told.output
    light = read_calibration(output).light
    assert light is not None
    (tmp_path / "scan").mkdir()
    rig = rig_file(tmp_path / "scan", "relief", scene=TINTED, head={**SMALL, **FALLS_OFF})
    plain = channels(rig, tmp_path / "plain", plan)
    seen = channels(rig, tmp_path / "mapped", plan, mapped=light)
    for before, rms in zip(plain, require_colours(seen), strict=True):
        assert before.told("  without", before.found)[0] > 2 * rms
    # The board is white: one scale for all channels.
    scales = [np.median(each.found[each.sound] / each.truth[each.sound]) for each in seen]
    assert max(scales) / min(scales) < 1.02
    assert seen[0].report["albedo"]["projector_light"] == "as measured on a white board"
    assert plain[0].report["albedo"]["projector_light"].startswith("taken as even")
    (tmp_path / "unpainted").mkdir()
    rig = rig_file(tmp_path / "unpainted", "relief", scene={}, head={**SMALL, **FALLS_OFF})
    (grey,) = channels(rig, tmp_path / "grey", mapped=light)
    assert grey.told("grey, with the map", grey.found)[0] <= 0.05


@pytest.mark.parametrize(
    ("changes", "exposure_s", "words"),
    [
        (
            {"albedo = 0.85": 'albedo = 0.85\ntexture = { kind = "noise", contrast = 0.6, scale_mm = 9.0 }'},
            None,
            "smooth",
        ),
        ({"[220.0, 180.0]": "[40.0, 30.0]"}, None, "shows no board"),
        ({}, 0.024, "is saturated"),
        ({'shape = "plane"': 'shape = "sphere"', "size_mm = [220.0, 180.0]": "radius_mm = 60.0"}, None, "flat board"),
    ],
)
def test_what_is_no_even_white_board_is_refused_in_words(
    changes: Mapping[str, str], exposure_s: float | None, words: str, tmp_path: Path
) -> None:
    bundle = board(tmp_path / "board", replaced(BOARD, changes), ScanPlan(exposure_s=exposure_s))
    with pytest.raises(CalibrationError, match=words):
        with_light_map(bundle, lambda *_: None)
