"""Calibrations of ROS, Kalibr and OpenCV's samples: what they say in metres and quaternions, and what is refused."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from slrig.bundle import read_calibration, write_calibration
from slrig.errors import BundleError, CalibrationError, PatternError, SlrigError
from slrig.importers.calibrations import import_calibration, write_any_calibration
from slrig.importers.captures import (
    ImageAssignment,
    ImageNaming,
    assign_images,
    drop_constant_bits,
    import_capture,
    parse_size,
)
from slrig.importers.documents import MAX_YAML_BYTES, read_yaml
from slrig.importers.images import SourceImage
from slrig.importers.orders import (
    ProjectorCode,
    compile_name_template,
    pattern_from_name,
    pattern_words,
    scan3d_sequence,
    slstudio_micro_sequence,
    slstudio_sequence,
)
from slrig.model import Axis, Black, Calibration, Gray, LineShift, Pattern, Pinhole, Sine, Size, White
from tests.samples import sample_calibration
from tests.strangers import harmed
from tests.unit.calibrate_command import refused, run

CAMCHAIN = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.2, 1e-05, 0.0, 2.5e-4]
  distortion_model: radtan
  intrinsics: [458.6, 457.2, 367.2, 248.3]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [0.0, -1.0, 0.0, -0.11]
  - [1.0, 0.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.003]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [0, 0, 0, 0]
  distortion_model: radtan
  intrinsics: [400, 400, 512, 384]
  resolution: [1024, 768]
  rostopic: /projector/image_raw
"""
INFO = """image_width: 640
image_height: 480
camera_name: head_camera
camera_matrix: {rows: 3, cols: 3, data: [600.0, 0, 320.0, 0, 601.0, 240.0, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0.001, 0.002, 0.03]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [600.0, 0, 320.0, 0, 0, 601.0, 240.0, 0, 0, 0, 1, 0]}
"""
# The bar stands 1 m before the table and is turned by a quarter about z; the camera is 0.2 m along the bar's x.
TRANSFORMS = """transforms:
- header: {frame_id: table}
  child_frame_id: bar
  transform:
    translation: {x: 0, y: 0, z: -1.0}
    rotation: {x: 0, y: 0, z: 0.7071067811865476, w: 0.7071067811865476}
- header: {frame_id: bar}
  child_frame_id: left_optical_frame
  transform:
    translation: {x: 0.2, y: 0, z: 0}
    rotation: {x: 0, y: 0, z: 0, w: 1}
"""


def written(path: Path, text: str) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


def ros(folder: Path, **changed: str) -> Path:
    for name, text in {"left": INFO, "transforms": TRANSFORMS, **changed}.items():
        written(folder / f"{name}.yaml", text)
    return folder


def read_any_calibration(path: Path, **options: Any) -> Calibration:
    return import_calibration(path, **options).calibration


def devices(calibration: Calibration) -> dict[str, Pinhole]:
    assert calibration.projector is not None
    return {**calibration.cameras, "projector": calibration.projector}


def test_a_camchain_is_read_as_kalibr_means_it(tmp_path: Path) -> None:
    found = read_any_calibration(written(tmp_path / "camchain.yaml", CAMCHAIN))
    assert list(found.cameras) == ["cam0"]
    assert found.projector is not None
    assert found.cameras["cam0"].size == Size(752, 480)
    assert found.cameras["cam0"].distortion.tolist() == [-0.2, 1e-05, 0.0, 2.5e-4, 0.0]
    assert found.cameras["cam0"].matrix.tolist() == [[458.6, 0, 367.2], [0, 457.2, 248.3], [0, 0, 1]]
    # A point 1 m before cam0, 100 mm to its right.
    seen = found.projector.rotation @ [100.0, 0.0, 1000.0] + found.projector.translation_mm
    assert np.allclose(seen, [-110.0, 120.0, 1003.0])


def test_camera_infos_are_read_with_their_transforms(tmp_path: Path) -> None:
    left = read_any_calibration(ros(tmp_path / "ros")).cameras["left"]
    assert left.size == Size(640, 480)
    assert left.distortion.tolist() == [0.1, -0.2, 0.001, 0.002, 0.03]
    # The bar's x is the table's y: the camera is at (0, 0.2, -1) m, and what is at (0, 0.2, 0) is 1 m before it.
    assert np.allclose(left.centre_mm, [0, 200, -1000])
    assert np.allclose(left.rotation @ [0, 200, 0] + left.translation_mm, [0, 0, 1000], atol=1e-9)
    assert np.allclose(left.rotation @ [0, 210, 0] + left.translation_mm, [10, 0, 1000], atol=1e-9)


def test_opencvs_stereo_sample_is_of_two_cameras_or_of_a_camera_and_the_projector(tmp_path: Path) -> None:
    path = tmp_path / "stereo.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    turn = cv2.Rodrigues(np.array([0.0, 0.1, 0.0]))[0]
    values = (
        np.diag([50.0, 51, 1]),
        np.zeros((1, 5)),
        np.diag([60.0, 61, 1]),
        np.zeros((1, 8)),
        turn,
        np.full((3, 1), 90.0),
    )
    for name, value in zip(("M1", "D1", "M2", "D2", "R", "T"), values, strict=True):
        storage.write(name, value)
    storage.release()
    sizes = {"left": Size(40, 30), "right": Size(44, 33)}
    both = read_any_calibration(path, cameras=sizes, projector=Size(32, 24))
    assert {name: each.size for name, each in both.cameras.items()} == sizes
    assert both.projector is None
    one = read_any_calibration(path, cameras={"left": Size(40, 30)}, projector=Size(32, 24))
    assert one.projector is not None
    assert one.projector.matrix[0, 0] == 60
    assert np.allclose(one.projector.rotation, turn)
    with pytest.raises(CalibrationError, match="sizes of its images, found none of M1, D1, in a file of OpenCV"):
        read_any_calibration(path)


OPENCV_KEYS = ("cam_int", "cam_dist", "proj_int", "proj_dist", "rotation", "translation")
SCAN3D_KEYS = ("cam_K", "cam_kc", "proj_K", "proj_kc", "R", "T")
SIZES = {"cam0": Size(640, 512)}


def program_file(path: Path, keys: tuple[str, ...] = OPENCV_KEYS, **changes: Any) -> Path:
    """A file of another program: a bench of 240 mm whose projector of 640 x 400 is turned towards the camera."""
    turn = cv2.Rodrigues(np.array([0.0, 0.38, 0.0]))[0]
    values: dict[str, Any] = {
        "camera": [[1375.0, 0, 322], [0, 1376, 251], [0, 0, 1]],
        "camera_lens": [[-0.08, 0.11, 0, 0, 0]],
        "projector": [[1450.0, 0, 322], [0, 1451, 195], [0, 0, 1]],
        "projector_lens": [[0.02, -0.03, 0, 0, 0]],
        "rotation": turn,
        "translation": [[-236.0], [12.0], [55.0]],
    }
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in zip(keys, (values | changes).values(), strict=True):
        storage.write(key, np.array(value, dtype=np.float64))
    storage.release()
    return path


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (1e-3, r"are 0.243 mm apart .*Metres\? Then .* 243 mm apart .*--unit m\)"),
        (0.1, r"are 24.3 mm apart .*Centimetres\? .*--unit cm\)"),
        (1 / 25.4, r"are 9.55 mm apart .*Inches\? .*--unit inch\)"),
        (1e3, r"are 2.43e\+05 mm apart .*State the unit"),
    ],
)
def test_a_file_without_unit_is_asked_for_it_where_it_makes_no_bench(tmp_path: Path, scale: float, words: str) -> None:
    path = program_file(tmp_path / "rig.yml", translation=np.array([[-236.0], [12.0], [55.0]]) * scale)
    with pytest.raises(CalibrationError, match=words):
        read_any_calibration(path, cameras=SIZES, projector=Size(640, 400))


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1.0), ("cm", 0.1), ("m", 1e-3), ("inch", 1 / 25.4)])
def test_translations_are_read_in_the_unit_that_was_stated(tmp_path: Path, unit: Any, scale: float) -> None:
    path = program_file(tmp_path / "rig.yml", translation=np.array([[-236.0], [12.0], [55.0]]) * scale)
    read = read_any_calibration(path, cameras=SIZES, projector=Size(640, 400), unit=unit)
    assert read.projector is not None
    assert np.allclose(read.projector.translation_mm, (-236, 12, 55))


def test_a_stated_unit_replaces_that_of_the_format(tmp_path: Path) -> None:
    in_mm = CAMCHAIN.replace("-0.11]", "-110.0]").replace("0.02]", "20.0]").replace("0.003]", "3.0]")
    with pytest.raises(CalibrationError, match="expected devices 2 to 15000 mm apart"):
        read_any_calibration(written(tmp_path / "camchain.yaml", in_mm))
    read = read_any_calibration(written(tmp_path / "camchain.yaml", in_mm), unit="mm")
    assert read.projector is not None
    assert np.allclose(read.projector.translation_mm, (-110, 20, 3))


@pytest.mark.parametrize("scale", [2.0, 0.5])
def test_a_matrix_of_images_of_another_size_is_refused(tmp_path: Path, scale: float) -> None:
    matrix = [[1375.0 * scale, 0, 322 * scale], [0, 1376 * scale, 251 * scale], [0, 0, 1]]
    path = program_file(tmp_path / "rig.yml", camera=matrix)
    with pytest.raises(CalibrationError, match=f"the middle of images about {scale:g} times as large"):
        read_any_calibration(path, cameras=SIZES, projector=Size(640, 400))


def test_a_projector_of_scan3d_capture_is_in_pixels_unless_the_capture_is_its_own(tmp_path: Path) -> None:
    """Its own captures of 640 x 400 have 9 bits of columns, in cells of 2 px, centred in the code."""
    cells = [[725.0, 0, 160.75], [0, 1451, 195], [0, 0, 1]]
    own = {each.axis: each for each in scan3d_sequence(ProjectorCode(Size(640, 400)), 38) if isinstance(each, Gray)}
    opencv = {axis: Gray(axis, 0, bits) for axis, bits in ((Axis.COLUMN, 10), (Axis.ROW, 9))}
    for bits, changes in ((own, {"projector": cells}), (opencv, {})):
        path = program_file(tmp_path / "rig.yml", SCAN3D_KEYS, **changes)
        read = read_any_calibration(path, cameras=SIZES, projector=Size(640, 400), bits=bits)
        assert read.projector is not None
        assert read.projector.matrix.tolist() == [[1450.0, 0, 322], [0, 1451, 195], [0, 0, 1]]


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("model: radtan", "model: fov", "found pinhole-fov"),
        ("camera_model: pinhole", "camera_model: omni", "expected pinhole-radtan"),
        ("[458.6, 457.2, 367.2, 248.3]", "[458.6, 457.2, 367.2]", "with 3 and 4"),
        ("cam1:", "cam2:", "expected Kalibr's cam0, cam1"),
        ("  rostopic: /cam0/image_raw\n", "  shutter: rolling\n", "cam0 is wrong:\n  shutter: unknown key"),
        ("[0.0, -1.0, 0.0, -0.11]", "[0.0, -2.0, 0.0, -0.11]", "cam1.rotation"),
        ("cam1:\n  T_cn_cnm1:", "cam1:\n  T_cam_imu:", "expected one for each except cam0"),
        ("rostopic: /cam0/image_raw", "camera_model: pinhole", "expected each key once"),
        ("intrinsics: [458.6, 457.2", "intrinsics: [.nan, 457.2", "finite number"),
    ],
)
def test_a_camchain_that_is_wrong_is_refused(tmp_path: Path, before: str, after: str, words: str) -> None:
    assert before in CAMCHAIN
    path = written(tmp_path / "chain.yaml", CAMCHAIN.replace(before, after, 1))
    with pytest.raises(CalibrationError) as caught:
        read_any_calibration(path)
    assert words in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"left": INFO.replace("plumb_bob", "omni")}, "expected the distortion plumb_bob"),
        ({"left": INFO.replace("plumb_bob", "equidistant")}, "expected 4 terms of an equidistant lens, found 5"),
        ({"left": INFO.replace("rows: 3, cols: 3, data: [600.0, 0,", "rows: 3, cols: 3, data: [0,")}, "expected 9"),
        ({"left": INFO.replace("image_width: 640", "image_width: 640.5")}, "image_width"),
        ({"right": INFO}, "expected a transform to the frame right or right_optical_frame"),
        ({"transforms": TRANSFORMS.replace("table", "left_optical_frame")}, "found a cycle"),
        ({"transforms": TRANSFORMS.replace("{frame_id: bar}", "{frame_id: wall}")}, "table, wall"),
        ({"transforms": TRANSFORMS.replace("w: 1}", "w: 2}")}, "quaternion of length 1"),
        ({"transforms": TRANSFORMS.replace("child_frame_id: bar", "child_frame_id: left_optical_frame")}, "found two"),
    ],
)
def test_a_folder_of_ros_that_is_wrong_is_refused(tmp_path: Path, changed: dict[str, str], words: str) -> None:
    with pytest.raises(CalibrationError) as caught:
        read_any_calibration(ros(tmp_path / "ros", **changed))
    assert words in str(caught.value)


def test_expanding_yaml_is_rejected_before_it_is_built(tmp_path: Path) -> None:
    bomb = "a0: &a0 [1, 1]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 40))
    for text, words in (
        (bomb, "without anchors"),
        ("[" * 10_000, "nested at most 12 deep"),
        ("a: !!python/object/apply:os.getcwd []", "python/object"),
        ("a: [1", "at line 1"),
        ("a: '" + "x" * MAX_YAML_BYTES + "'", f"at most {MAX_YAML_BYTES} bytes"),
    ):
        with pytest.raises(CalibrationError, match=words):
            read_yaml(written(tmp_path / "rig.yaml", text))


def test_a_harmed_file_is_read_or_refused(tmp_path: Path) -> None:
    chance = random.Random(3)
    good = [each.encode() for each in (CAMCHAIN, INFO, TRANSFORMS)]
    outcomes = {"read": 0, "refused": 0}
    for _ in range(60):
        folder = ros(tmp_path / "ros")
        number = chance.randrange(3)
        data = harmed(good[number], good, chance)
        path = tmp_path / "chain.yaml" if number == 0 else folder / ("left.yaml", "transforms.yaml")[number - 1]
        path.write_bytes(data)
        try:
            read_any_calibration(path if number == 0 else folder)
            outcomes["read"] += 1
        except CalibrationError:
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 2


def test_a_lens_that_kalibr_lacks_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"without k3 and skew.* left, right, projector"):
        write_any_calibration(tmp_path / "chain.yaml", sample_calibration(), "kalibr")
    assert list(tmp_path.iterdir()) == []


def test_the_command_converts_files(tmp_path: Path) -> None:
    write_calibration(tmp_path / "rig.json", sample_calibration())
    assert run("export", tmp_path / "rig.json", tmp_path / "rig", "--to", "ros").exit_code == 0
    assert yaml.safe_load((tmp_path / "rig" / "left.yaml").read_text())["distortion_model"] == "plumb_bob"
    assert run("export", tmp_path / "rig", tmp_path / "back.json").exit_code == 0
    assert np.allclose(
        read_calibration(tmp_path / "back.json").cameras["right"].rotation,
        sample_calibration().cameras["right"].rotation,
    )
    assert "found '.yaml'; rename it, or give --to" in refused(run("export", tmp_path / "rig", tmp_path / "chain.yaml"))
    assert "create the folder first" in refused(run("export", tmp_path / "rig", tmp_path / "no" / "x", "--to", "ros"))
    assert sorted(each.name for each in tmp_path.iterdir()) == ["back.json", "rig", "rig.json"]
    assert "expected a new folder" in refused(run("export", tmp_path / "rig.json", tmp_path / "rig", "--to", "ros"))


# ---- Which pattern an image shows by words and by names: what is known, and what is refused


CODE = ProjectorCode(Size(1824, 1140), cell_px=2)


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ("white", White()),
        ("Black", Black()),
        ("column 3", Gray(Axis.COLUMN, 3, 10, 2)),
        ("y 0 inverse", Gray(Axis.ROW, 0, 10, 2, inverted=True)),
        ("rows  9 plain", Gray(Axis.ROW, 9, 10, 2)),
        ("column line 2 of 8", LineShift(Axis.COLUMN, 2, 8)),
        ("row line 0 of 12 width 3", LineShift(Axis.ROW, 0, 12, 3)),
        ("row 2 of 9 cell 4 offset 112 inverted", Gray(Axis.ROW, 2, 9, 4, 112, inverted=True)),
        ("column sine 1 of 4 period 18.5", Sine(Axis.COLUMN, 18.5, 1, 4)),
    ],
)
def test_pattern_texts_are_parsed_and_written(words: str, wanted: Pattern) -> None:
    assert CODE.parse_pattern(words) == wanted
    assert CODE.parse_pattern(pattern_words(wanted)) == wanted


def test_sinusoids_are_described_by_period_and_steps() -> None:
    wanted = [Sine(Axis.COLUMN, 16.5, shift, 4) for shift in range(4)]
    assert CODE.parse_sequence("columns-sine:16.5/4") == wanted
    assert CODE.parse_sequence("columns-sine:16.5/-4") == [wanted[k] for k in (0, 3, 2, 1)]


def test_bits_that_a_projector_never_changes_are_left_out() -> None:
    image = SourceImage(Path("row-10.png"), "row-10.png", "row-10")
    eleven = [(image, Gray(Axis.ROW, bit, 11)) for bit in range(11)]
    assignment = ImageAssignment({"cam0": [*eleven, (image, Gray(Axis.COLUMN, 0, 11))]})

    drop_constant_bits(assignment, Size(1280, 800))

    kept = [pattern for _, pattern in assignment.cameras["cam0"]]
    assert kept == [*(Gray(Axis.ROW, bit, 10) for bit in range(10)), Gray(Axis.COLUMN, 0, 11)]
    assert assignment.notes == ["row-10.png: left out, bit 0 of 11 is the same on all 800 rows"]


def test_slstudios_phase_shifts_are_known() -> None:
    fine, cue = CODE.size.width_px / 16, float(CODE.size.width_px)
    assert slstudio_sequence(CODE, 6) == [Sine(Axis.COLUMN, each, k, 3) for each in (fine, cue) for k in range(3)]
    micro = slstudio_micro_sequence(CODE, 12)
    assert [(each.shift, each.steps) for each in micro if isinstance(each, Sine)][:5] == [
        (0, 3), (2, 3), (1, 3), (1, 2), (0, 2),
    ]  # fmt: skip
    with pytest.raises(BundleError, match="12 images of SLStudio's micro"):
        slstudio_micro_sequence(CODE, 11)


@pytest.mark.parametrize(
    ("words", "error", "said"),
    [
        ("column", BundleError, "expected `white`"),
        ("diagonal 3", BundleError, "'diagonal 3'"),
        ("column 3 upside", BundleError, "expected `white`"),
        ("xor02 column 3", BundleError, "XOR-02 and others"),
        ("sine 0", BundleError, "phase shifts are described by"),
        ("column 10", PatternError, "bit 10 of 10"),
        ("column line 9 of 8", PatternError, "found shift 9"),
    ],
)
def test_other_pattern_texts_are_rejected(words: str, error: type[SlrigError], said: str) -> None:
    with pytest.raises(error, match=said):
        CODE.parse_pattern(words)


@pytest.mark.parametrize(
    ("template", "name", "wanted"),
    [
        ("{axis}_{bit:02}_{inverted}.png", "column_03_inverted.png", Gray(Axis.COLUMN, 3, 10, 2, inverted=True)),
        ("{axis}_{bit:02}_{inverted}.png", "row_03_normal.png", Gray(Axis.ROW, 3, 10, 2)),
        ("{bit}{inverted}.png", "7i.png", Gray(Axis.COLUMN, 7, 10, 2, inverted=True)),
        ("{bit}{inverted}.png", "7.png", Gray(Axis.COLUMN, 7, 10, 2)),
        ("{camera}/{axis}{power}.bmp", "left/Y0.bmp", Gray(Axis.ROW, 9, 10, 2)),
    ],
)
def test_a_name_contains_its_bit(template: str, name: str, wanted: Pattern) -> None:
    named = compile_name_template(template).fullmatch(name)
    assert named is not None
    assert pattern_from_name(CODE, named) == wanted


@pytest.mark.parametrize(
    ("template", "name", "said"),
    [
        ("{bits}.png", "", "expected each of the fields"),
        ("{bit}_{bit}.png", "", "once"),
        ("{axis}.png", "column.png", "a field {bit} or {power}"),
        ("{axis}_{bit}.png", "diagonal_1.png", "'diagonal'"),
        ("{bit}_{inverted}.png", "1_upside.png", "'upside'"),
        ("{bit}.png", "10.png", "expected bits 0 to 9"),
        ("{power}.png", "10.png", "found -1"),
    ],
)
def test_a_name_without_a_bit_is_rejected(template: str, name: str, said: str) -> None:
    def read() -> Pattern:
        named = compile_name_template(template).fullmatch(name)
        assert named is not None
        return pattern_from_name(CODE, named)

    with pytest.raises(SlrigError) as caught:
        read()
    assert said in str(caught.value)


def test_first_bits_are_a_code_of_wider_cells() -> None:
    assert slstudio_sequence(ProjectorCode(Size(1824, 1140)), 12)[2:] == [
        Gray(Axis.COLUMN, bit, 10, 2) for bit in range(10)
    ]
    assert slstudio_sequence(ProjectorCode(Size(1824, 1140)), 8)[2:] == [Gray(Axis.ROW, bit, 6, 32) for bit in range(6)]
    # 1280 columns are centred in 2048, in cells of 2; 800 rows in 1024.
    shown = scan3d_sequence(ProjectorCode(Size(1280, 800)), 42)
    assert shown[2:4] == [Gray(Axis.COLUMN, 0, 10, 2, 384), Gray(Axis.COLUMN, 0, 10, 2, 384, inverted=True)]
    assert shown[-1] == Gray(Axis.ROW, 9, 10, 1, 112, inverted=True)
    for images in (2, 41, 46):
        with pytest.raises(BundleError, match=f"found {images}"):
            scan3d_sequence(ProjectorCode(Size(1280, 800)), images)


@pytest.mark.parametrize("words", ["", "1024", "0x768", "1024x", "-3x4", "1024x768x3", "123456x1"])
def test_an_extent_is_two_numbers(words: str) -> None:
    assert parse_size("1024X768") == Size(1024, 768)
    with pytest.raises(BundleError, match="expected columns x rows"):
        parse_size(words)


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("name,pattern\na.png,white", "expected the columns file, pattern and camera, found name, pattern"),
        ("file,pattern\na.png", "expected 2 cells in line 2"),
        ("file,pattern\na.png,white,left", "expected 2 cells in line 2"),
        ("file,pattern\na.png,grey", "line 2: expected `white`"),
        ("file,pattern\n", "expected a line for each image"),
        ("file,pattern\na.png,column 0\nb.png,column 2", "found none of bit 1"),
        ("file,pattern\na.png,column 0\nb.png,column 0", "expected one image for each bit, found two"),
        ("file,pattern\na.png,white", "No such file"),
    ],
)
def test_a_list_that_is_wrong_is_refused(tmp_path: Path, lines: str, said: str) -> None:
    (tmp_path / "list.csv").write_text(lines)

    def read() -> None:
        images = assign_images(tmp_path, CODE, ImageNaming(listed=tmp_path / "list.csv"))
        import_capture(tmp_path, tmp_path / "bundle", CODE, images)

    with pytest.raises(BundleError) as caught:
        read()
    assert said in str(caught.value)
