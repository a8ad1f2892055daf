"""Exported calibrations are read back to the same numbers, what is lost is named, and templates can be filled."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slrig.bundle import write_calibration
from slrig.errors import CalibrationError
from slrig.importers import import_calibration, lost_in_format, write_any_calibration
from slrig.importers.calibrations import CalibrationFormat
from slrig.model import Calibration, LightMap, Pinhole, Size, SolveRecord
from tests.unit.calibrate_command import refused, run

FILES: list[tuple[CalibrationFormat, str]] = [
    ("slrig", "rig.json"), ("opencv", "rig.yml"), ("opencv", "rig.xml"), ("ros", "rig"), ("kalibr", "rig.yaml")
]  # fmt: skip


def device(number: int, *, has_k3: bool = True) -> Pinhole:
    """A device about 600 mm before the origin, which it looks at; no two numbers are alike."""
    chance = np.random.default_rng(number)
    rotation = Rotation.from_euler("yxz", [0.3 * number - 0.4, *chance.uniform(-0.1, 0.1, 2)]).as_matrix()
    matrix = np.array([[1500 / 0.9 + number, 0, 1280 / 2.1], [0, 1500 / 0.91, 1024 / 2.1], [0, 0, 1]])
    distortion = chance.uniform(-0.01, 0.01, 5) * [1, 1, 0.1, 0.1, has_k3]
    return Pinhole(Size(1280, 1024), matrix, distortion, rotation, np.array([0.1, -0.2, 600.3 + number / 7]))


def calibration(*, has_projector: bool, has_k3: bool = True) -> Calibration:
    """Of cameras that are not in the order of the alphabet, with everything that a calibration can hold."""
    cameras = {name: device(number, has_k3=has_k3) for number, name in enumerate(("right", "left", "top-2"))}
    found = Calibration(cameras, device(3, has_k3=has_k3) if has_projector else None)
    covariance = np.diag(np.arange(1.0, 15 * (3 + has_projector) + 1)) * 1e-9 / 3
    volume_mm = np.array([[-90, -80, 500], [90, 80, 700 / 3]])
    solved = SolveRecord("3f2a", "2026-11-03T10:20:30+01:00", covariance, volume_mm, 0.02 / 3)
    light = LightMap(np.random.default_rng(1).random((1, 5, 5)), np.array([[0, 0], [1279.0, 1023]]))
    return replace(found, solved=solved, light=light if has_projector else None)


def devices(calibration: Calibration) -> dict[str, Pinhole]:
    projector = {} if calibration.projector is None else {"projector": calibration.projector}
    return {**calibration.cameras, **projector}


@pytest.mark.parametrize("has_projector", [True, False])
@pytest.mark.parametrize(("form", "name"), FILES)
def test_what_is_exported_is_read_back(tmp_path: Path, form: CalibrationFormat, name: str, has_projector: bool) -> None:
    wanted = calibration(has_projector=has_projector, has_k3=form != "kalibr")
    path = tmp_path / name
    write_any_calibration(path, wanted, form)
    found = import_calibration(path).calibration
    lost = " ".join(lost_in_format(wanted, path, form))
    assert ("error of the solve" in lost) == (found.solved is None)
    assert ("light" in lost) == (found.light is None and has_projector)
    assert list(devices(found)) == list(devices(wanted))
    world = wanted.cameras["right"]
    for each, other in zip(devices(wanted).values(), devices(found).values(), strict=True):
        assert other.size == each.size
        assert np.array_equal(other.matrix, each.matrix)
        assert np.array_equal(other.distortion, each.distortion)
        rotation, translation_mm = each.rotation, each.translation_mm
        if "the world" in lost:
            rotation = rotation @ world.rotation.T
            translation_mm = translation_mm - rotation @ world.translation_mm
        np.testing.assert_allclose(other.rotation, rotation, rtol=0, atol=1e-14)
        np.testing.assert_allclose(other.translation_mm, translation_mm, rtol=0, atol=1e-11)
    if found.solved is not None and wanted.solved is not None:
        assert np.array_equal(found.solved.covariance, wanted.solved.covariance)
        assert np.array_equal(found.solved.volume_mm, wanted.solved.volume_mm)
        assert found.solved.expected_error_mm == wanted.solved.expected_error_mm
    if found.light is not None and wanted.light is not None:
        assert np.array_equal(found.light.coefficients, wanted.light.coefficients)


def test_the_command_says_what_a_file_does_not_hold(tmp_path: Path) -> None:
    write_calibration(tmp_path / "rig.json", calibration(has_projector=True))
    said = run("export", tmp_path / "rig.json", tmp_path / "ros", "--to", "ros").stdout
    assert "left out  the projector's light" in said
    assert "left out  identity, date and error of the solve" in said
    assert "left out" not in run("export", tmp_path / "rig.json", tmp_path / "again.json").stdout


def fill(path: Path, wanted: Calibration) -> None:
    """Replace what a template leaves open by the numbers of a calibration, from its beginning to its end."""
    text = path.read_text()
    if path.suffix == ".json":
        data = json.loads(text)
        for entry, each in zip((*data["cameras"].values(), data["projector"]), devices(wanted).values(), strict=True):
            size = [each.size.width_px, each.size.height_px]
            missing = [key for key, value in entry.items() if isinstance(value, str)]
            entry |= {key: size if key == "size_px" else getattr(each, key).tolist() for key in missing}
        path.write_text(json.dumps(data))
        return
    numbers: list[float] = []
    for number, each in enumerate(devices(wanted).values()):
        numbers += [each.size.width_px, each.size.height_px, *each.matrix[[0, 0, 1, 1], [0, 2, 1, 2]].tolist()]
        numbers += each.distortion.tolist()
        numbers += [*each.rotation.ravel().tolist(), *each.translation_mm.tolist()] if number else []
    head, *parts = re.split(r"(?<!each )\.Nan", text)
    path.write_text(head + "".join(f"{value!r}{part}" for value, part in zip(numbers, parts, strict=True)))


@pytest.mark.parametrize("name", ["rig.json", "rig.yml"])
def test_a_template_is_filled_and_read(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    assert run("export", "--template", path, "--camera", "eye").exit_code == 0
    with pytest.raises(CalibrationError, match="eye"):
        import_calibration(path)
    eye = replace(device(0), rotation=np.eye(3), translation_mm=np.zeros(3))
    there = replace(device(1), translation_mm=np.array([-200.0, 3, 40]))
    fill(path, Calibration({"eye": eye}, there))
    found = import_calibration(path).calibration
    assert found.projector is not None
    assert np.array_equal(found.cameras["eye"].matrix, eye.matrix)
    assert np.array_equal(found.projector.rotation, there.rotation)
    assert np.array_equal(found.projector.translation_mm, there.translation_mm)
    if name.endswith("yml"):
        stored = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        assert np.array_equal(stored.getNode("projector").getNode("camera_matrix").mat(), there.matrix)


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("image_width", "extent of 'projector'"),
        ("camera_matrix", "projector.matrix"),
        ("distortion_coefficients", "projector.distortion"),
        ("rotation", "projector.rotation"),
        ("translation_mm", "projector.translation_mm"),
    ],
)
def test_a_value_that_was_not_filled_in_is_named(tmp_path: Path, key: str, said: str) -> None:
    path = tmp_path / "rig.yml"
    run("export", "--template", path)
    fill(path, Calibration({"cam0": device(0)}, device(1)))
    head, block = path.read_text().split("\nprojector:")
    before, after = block.split(f"   {key}:")
    after = re.sub(r"^ \d+" if key == "image_width" else r"(?<=data: \[ )[^, ]+", " .Nan", after, count=1)
    path.write_text(f"{head}\nprojector:{before}   {key}:{after}")
    with pytest.raises(CalibrationError, match=said):
        import_calibration(path)


def test_a_template_stands_alone(tmp_path: Path) -> None:
    both = run("export", "--template", tmp_path / "a.json", "3f2a", tmp_path / "b.json")
    for result in (both, run("export", "3f2a")):
        assert "or --template FILE alone" in refused(result)
    assert "ends in .json or .yml" in refused(run("export", "--template", tmp_path / "a.txt"))
