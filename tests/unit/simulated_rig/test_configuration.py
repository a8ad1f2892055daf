"""Rig and scene files: those we ship open, and every fault of a wrong one is named at once."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from simulated_rig.device import open_head, open_simulated_head
from slrig.errors import ConfigError
from slrig.examples import EXAMPLES
from tests.unit.simulated_rig.building import FACING_PLATE, coarser, head_options, small_head

RIGS = sorted((EXAMPLES / "rigs").glob("*.toml"))
RENDERED = [path for path in RIGS if tomllib.loads(path.read_text()).get("head", {}).get("driver") == "simulated"]


# Every golden scan opens the demonstration, whose mesh is large.
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(each, marks=[pytest.mark.slow] * (each.stem != "sphere"), id=each.stem)
        for each in RENDERED
        if each.stem != "demo"
    ],
)
def test_every_rendered_rig_we_ship_sees_a_lit_surface(path: Path) -> None:
    table = tomllib.loads(path.read_text())["head"]
    table.pop("driver")
    # The board of the small rig has to fit into its images.
    head = open_simulated_head(coarser(table, 2 if path.stem.endswith("small") else 8), path.parent)
    assert (head.calibration is None) is ("calibration" in path.stem)
    truth = head.truth()
    assert list(truth.cameras) == list(head.exact_calibration.cameras) == list(head.cameras)
    for name, seen in truth.cameras.items():
        assert seen.depth_mm.shape == head.exact_calibration.cameras[name].size.shape
        assert len(seen.visible_points_mm) > 0.05 * seen.depth_mm.size
        assert np.nanmin(seen.depth_mm) > 300


def test_all_faults_of_the_options_come_in_one_message(tmp_path: Path) -> None:
    options = head_options(
        camera={"focal_px": [-1.0, 400.0], "colour": "red", "exposure_s": "long"},
        projector={"gamma": float("nan")},
        faults={"drop_frames": [-3]},
        sede=4,
    )
    (tmp_path / "scene.toml").write_text(FACING_PLATE)
    with pytest.raises(ConfigError) as caught:
        open_head(options, tmp_path)
    message = str(caught.value)
    for place in (
        "camera[0].focal_px[0]",
        "camera[0].colour",
        "camera[0].exposure_s",
        "projector.gamma",
        "faults.drop_frames[0]",
        "sede",
    ):
        assert place in message
    assert len(message.splitlines()) == 7
    assert "sede: unknown key; did you mean 'seed'?" in message


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"camera": {"position_mm": None}}, "position_mm and target_mm"),
        ({"camera": {"target_mm": [-60.0, 0.0, -500.0]}}, "must differ"),
        ({"camera": {"exposure_s": 20.0}}, "exposure_min_s"),
        ({"camera": {"stamp_error_s": 0.1}}, "trigger_latency_s"),
        ({"camera": {"pedestal_dn": 255.0}}, "full scale"),
        ({"faults": {"cameras": ["nose"]}}, "nose"),
        ({"cameras": [head_options()["camera"][0], head_options()["camera"][0]]}, "must be unique"),
        ({"samples_per_axis": 0}, "samples_per_axis"),
        ({"seed": 1.5}, "seed"),
        (
            {
                "projector": {
                    "position_mm": None,
                    "target_mm": None,
                    "rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]],
                    "translation_mm": [0.0, 0.0, 500.0],
                }
            },
            "rotation",
        ),
    ],
)
def test_options_that_contradict_themselves_are_refused(tmp_path: Path, options: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        small_head(tmp_path, **options)  # type: ignore[arg-type]


def test_a_pose_may_be_given_as_a_calibration_has_it(tmp_path: Path) -> None:
    pose = {
        "position_mm": None,
        "target_mm": None,
        "rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        "translation_mm": [3.0, 4.0, 500.0],
    }
    head = small_head(tmp_path, camera=pose)
    np.testing.assert_allclose(head.exact_calibration.cameras["eye"].centre_mm, [-3, -4, -500])
    np.testing.assert_allclose(head.truth().cameras["eye"].depth_mm, 500, atol=1e-9)


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        ("", "object"),
        ("object = []", "at least one"),
        ('[[object]]\nshape = "cube"\n', "shape"),
        ('[[object]]\nshape = "sphere"\nradius_mm = -1.0\npaint = 3\n', r"(?s)radius_mm.*paint: unknown key"),
        ('[[object]]\nshape = "mesh"\nfile = "absent.stl"\n', "absent.stl"),
        ('[[object]]\nshape = "mesh"\nfile = "broken.stl"\n', "broken.stl"),
        ('[[object]]\nshape = "mesh"\nfile = "strange.xyzzy"\n', "strange.xyzzy"),
        (
            '[[object]]\nshape = "ball_bar"\nradius_mm = 9.0\ndistance_mm = 10.0\nbar_radius_mm = 1.0\n',
            "must not touch",
        ),
        ('[[object]]\nshape = "relief"\nsize_mm = [5000.0, 5000.0]\nstep_mm = 0.1\n', "larger step_mm"),
        ('[[object]]\nshape = "turned"\nprofile_mm = [[9.0, 0.0], [9.0, 5.0], [9.0, 4.0]]\n', "rising heights"),
        ('[[object]]\nshape = "turned"\nprofile_mm = [[9.0, 0.0], [9.0, 5.0]]\n', "at least 3 points"),
        ("[[object]\n", "expected TOML, found a fault"),
    ],
)
def test_a_faulty_scene_is_refused_with_its_cause(tmp_path: Path, scene: str, words: str) -> None:
    (tmp_path / "broken.stl").write_bytes(b"solid nothing")
    (tmp_path / "strange.xyzzy").write_text("?")
    with pytest.raises(ConfigError, match=words):
        small_head(tmp_path, scene)


def test_missing_files_are_named(tmp_path: Path) -> None:
    scene = "".join(f'[[object]]\nshape = "mesh"\nfile = "{name}.stl"\n' for name in ("one", "two"))
    with pytest.raises(ConfigError) as caught:
        small_head(tmp_path, scene)
    assert "one.stl" in str(caught.value)
    assert "two.stl" in str(caught.value)
    with pytest.raises(ConfigError, match=r"absent\.toml"):
        open_head(head_options() | {"scene": "absent.toml"}, tmp_path)
