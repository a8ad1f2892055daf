"""Calibrations as other programs and libraries write them: the numbers come out right, or it is said how to go on."""

from __future__ import annotations

import json
import pickle
import random
import struct
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.io
import yaml

from slrig.bundle import check_calibration, read_calibration
from slrig.errors import CalibrationError
from slrig.importers import import_calibration
from slrig.importers.coded_images import CodedImages
from slrig.importers.lenses import MAX_FIT_PX, as_lens
from slrig.model import Axis, Calibration, CameraFormat, FloatArray, Gray, Pattern, Pinhole, Size, to_gray
from slrig.model.lens import distort
from tests.core import parametrize_core
from tests.strangers import harmed
from tests.unit.calibrate_command import refused, run

CAMERA, PROJECTOR = Size(160, 128), Size(128, 96)
K1: FloatArray = np.array([[172.0, 0, 80.5], [0, 172.5, 62.5], [0, 0, 1]])
K2: FloatArray = np.array([[181.0, 0, 64.0], [0, 181.5, 87.5], [0, 0, 1]])
D1: FloatArray = np.array([[-0.08, 0.11, 0.001, -0.002, 0.03]])
D2: FloatArray = np.array([[0.02, -0.03, 0.0005, 0.0001, 0.01]])
TURN: FloatArray = np.array([0.05, 0.38, -0.03])
R: FloatArray = np.asarray(cv2.Rodrigues(TURN)[0], dtype=np.float64)
T: FloatArray = np.array([[-236.0], [12.0], [55.0]])
SIX = (K1, D1, K2, D2, R, T)
POSE: FloatArray = np.vstack([np.hstack([R, T]), [[0, 0, 0, 1]]])
CAPTURE: dict[str, Any] = {"cameras": {"cam0": CAMERA}, "projector": PROJECTOR}

Write = Callable[[Path, Mapping[str, Any]], Path]


def plain(value: Any) -> Any:
    """The same with lists instead of arrays."""
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list):
        return [plain(each) for each in value]
    return value.tolist() if isinstance(value, np.ndarray) else value


def file_storage(path: Path, data: Mapping[str, Any]) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    # What programs write beside it.
    storage.write("empty", np.zeros((0, 0)))
    storage.write("image_files", ["a b.png", "c.png"])

    def put(entries: Mapping[str, Any]) -> None:
        for name, value in entries.items():
            if isinstance(value, Mapping):
                storage.startWriteStruct(name, cv2.FileNode_MAP)
                put(value)
                storage.endWriteStruct()
            else:
                storage.write(name, value)

    put(data)
    storage.release()
    return path


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def npz(path: Path, data: Mapping[str, Any]) -> Path:
    np.savez(path, **data)
    return path


def mat(path: Path, data: Mapping[str, Any]) -> Path:
    scipy.io.savemat(path, dict(data), do_compression=True)
    return path


def folder_of(save: Callable[[Path, Any], object], suffix: str) -> Write:
    def write(path: Path, data: Mapping[str, Any]) -> Path:
        path.mkdir()
        for name, value in data.items():
            save(path / f"{name}{suffix}", value)
        return path

    return write


WRITERS: dict[str, tuple[str, Write]] = {
    "OpenCV's YAML": ("rig.yml", file_storage),
    "OpenCV's XML": ("rig.xml", file_storage),
    "OpenCV's JSON": ("rig.json", file_storage),
    "NumPy's savez": ("rig.npz", npz),
    "MATLAB's save": ("rig.mat", mat),
    "json": ("rig.json", lambda path, data: written(path, json.dumps(plain(data)))),
    "PyYAML": ("rig.yaml", lambda path, data: written(path, yaml.safe_dump(plain(data)))),
    "np.save": ("rig", folder_of(np.save, ".npy")),
    "np.savetxt": ("rig", folder_of(np.savetxt, ".txt")),
    "a MATLAB script": ("rig.m", lambda path, data: written(path, "".join(
        f"{name} = [{'; '.join(', '.join(map(str, row)) for row in value.tolist())}];\n" for name, value in data.items()
    ))),
    "rows below names": ("rig.slcalib", lambda path, data: written(path, "#V1.0 SLStudio calibration\n" + "".join(
        "\n".join([name, *(" ".join(map(str, row)) for row in value.tolist()), "\n"]) for name, value in data.items()
    ))),
}  # fmt: skip
NAMES = [
    ("K1", "D1", "K2", "D2", "R", "T"),
    ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2", "R", "T"),
    ("cam_K", "cam_kc", "pro_K", "pro_kc", "R", "T"),
    ("cam_int", "cam_dist", "proj_int", "proj_dist", "rotation", "translation"),
    ("mtx_c", "dist_c", "mtx_p", "dist_p", "R_p", "T_p"),
    ("mtxL", "distL", "mtxR", "distR", "R", "T"),
    ("camera_matrix", "camera_distortion", "projector_matrix", "projector_distortion", "R_cam2proj", "t_cam2proj"),
    ("A1", "k1", "A2", "k2", "rot", "trans"),
    ("Kc", "kc", "Kp", "kp", "Rp", "Tp"),
    ("cameraMatrix", "distCoeffs", "projectorMatrix", "projectorDistCoeffs", "R_proj", "tvec"),
]


def read(path: Path, **options: Any) -> Calibration:
    return import_calibration(path, **options).calibration


def require_numbers(found: Calibration) -> None:
    """The six arrays, in any frame of the world."""
    camera, projector = next(iter(found.cameras.values())), found.projector
    assert projector is not None
    assert (camera.size, projector.size) == (CAMERA, PROJECTOR)
    rotation = projector.rotation @ camera.rotation.T
    between = projector.translation_mm - rotation @ camera.translation_mm
    numbers = (camera.matrix, camera.distortion, projector.matrix, projector.distortion, rotation, between)
    for each, wanted in zip(numbers, SIX, strict=True):
        np.testing.assert_allclose(each.ravel(), wanted.ravel(), atol=1e-9)


@pytest.mark.parametrize("names", NAMES, ids=lambda names: names[0])
@parametrize_core("writer", WRITERS, core=[0, 1])
def test_the_same_arrays_under_any_names_from_any_library_are_read(
    tmp_path: Path, writer: str, names: tuple[str, ...]
) -> None:
    name, write = WRITERS[writer]
    require_numbers(read(write(tmp_path / name, dict(zip(names, SIX, strict=True))), **CAPTURE))


def matlab_camera(matrix: FloatArray, terms: FloatArray, size: Size) -> dict[str, Any]:
    """A camera of MATLAB's stereoParameters: pixels count from 1, rows are multiplied from the left."""
    shifted = matrix + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    return {
        "RadialDistortion": terms[0, [0, 1, 4]],
        "TangentialDistortion": terms[0, 2:4],
        "ImageSize": np.array([size.height_px, size.width_px]),
        "WorldPoints": np.zeros((54, 2)),
        "WorldUnits": "millimeters",
        "IntrinsicMatrix": shifted.T,
        "K": shifted,
        "RotationVectors": np.zeros((12, 3)),
    }


CAMERA_MAP = {"intrinsic": K1, "distortion": D1}
PROJECTOR_MAP = {"intrinsic": K2, "distortion": D2}
SCALARS = {
    device: dict(zip(("fx", "fy", "cx", "cy"), (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), strict=True))
    | dict(zip(("k1", "k2", "p1", "p2", "k3"), d[0], strict=True))
    | {"width": s.width_px, "height": s.height_px}
    for device, k, d, s in (("camera", K1, D1, CAMERA), ("projector", K2, D2, PROJECTOR))
}
FORMS: dict[str, tuple[str, Mapping[str, Any]]] = {
    "maps of devices": ("json", {"camera": CAMERA_MAP, "projector": {**PROJECTOR_MAP, "R": R, "T": T}}),
    "a list of cameras": ("json", {"cameras": [CAMERA_MAP], "projector": PROJECTOR_MAP, "R": R, "t": T}),
    "flat rows, zeros as the camera's pose": ("json", {
        "cam": {"R": [0] * 9, "T": [0] * 3, "intrinsic": K1.ravel(), "distortion": D1.ravel(),
                "resolution": [128, 160]},
        "proj": {"R": R.ravel(), "T": T.ravel(), "intrinsic": K2.ravel(), "distortion": D2.ravel(),
                 "resolution": [96, 128]},
    }),
    "single numbers": ("json", {**SCALARS, "rotation": R, "translation_mm": T}),
    "OpenCV's sample of one camera, twice": ("xml", {
        **{name: {"image_width": s.width_px, "image_height": s.height_px, "camera_matrix": k,
                  "distortion_coefficients": d, "board_width": 9, "avg_reprojection_error": 0.2}
           for name, k, d, s in (("camera", K1, D1, CAMERA), ("projector", K2, D2, PROJECTOR))},
        "R": R, "T": T,
    }),
    "a rotation vector": ("yaml", {"camera": CAMERA_MAP, "projector": {**PROJECTOR_MAP, "rvec": TURN, "tvec": T}}),
    "results of rectification beside it": ("npz", {
        **dict(zip(("K1", "D1", "K2", "D2", "R", "T"), SIX, strict=True)), "R1": R.T, "R2": R, "E": R @ R,
        "Q": np.diag([1, 2, 3, 4]), "P1": np.hstack([K1, T]), "newcameramtx1": K1 - np.diag([9, 9, 0]),
        "roi1": np.arange(4), "rms": np.float64(0.3), "rvecs": np.zeros((7, 3)),
    }),
    "the calibration toolbox for MATLAB": ("mat", {
        "om": TURN[:, None], "R": R, "T": T, "kc_left": D1.T, "kc_right": D2.T, "nx": 160.0, "ny": 128.0,
        "fc_left": K1[[0, 1], [0, 1]], "cc_left": K1[:2, 2], "KK_left": K1, "KK_left_error": np.eye(3),
        "fc_right": K2[[0, 1], [0, 1]], "cc_right": K2[:2, 2], "KK_right": K2, "om_error": TURN,
        "T_error": T, "alpha_c_left": 0.0,
    }),
    "MATLAB's stereoParameters": ("mat", {"stereoParams": {
        "CameraParameters1": matlab_camera(K1, D1, CAMERA), "CameraParameters2": matlab_camera(K2, D2, PROJECTOR),
        "RotationOfCamera2": R.T, "TranslationOfCamera2": T.T, "Version": {"Major": 1},
    }}),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_forms_of_programs_are_read(tmp_path: Path, form: str) -> None:
    kind, data = FORMS[form]
    writers = {"xml": "OpenCV's XML", "yaml": "PyYAML", "npz": "NumPy's savez", "mat": "MATLAB's save", "json": "json"}
    require_numbers(read(WRITERS[writers[kind]][1](tmp_path / f"rig.{kind}", data), **CAPTURE))


def test_two_files_of_opencv_and_a_file_for_each_device_are_read_as_a_folder(tmp_path: Path) -> None:
    for folder, files in (
        ("opencv", {"intrinsics": dict(zip(("M1", "D1", "M2", "D2"), SIX, strict=False)),
                    "extrinsics": {"R": R, "T": T, "R1": R, "R2": R, "Q": np.eye(4)}}),
        ("devices", {"camera000": {**CAMERA_MAP, "R": np.zeros((3, 3)), "T": np.zeros(3)},
                     "projector000_camera000": {**PROJECTOR_MAP, "R": R, "T": T}}),
    ):  # fmt: skip
        (tmp_path / folder).mkdir()
        for name, data in files.items():
            file_storage(tmp_path / folder / f"{name}.yml", data)
        require_numbers(read(tmp_path / folder, **CAPTURE))


def test_sizes_and_the_unit_are_those_of_the_file(tmp_path: Path) -> None:
    path = written(tmp_path / "rig.json", json.dumps(plain({**SCALARS, "R": R, "T": T / 10, "units": "cm"})))
    require_numbers(read(path))
    notes = import_calibration(path).notes
    assert "fx, camera.fy" in notes[0]
    assert notes[-1] == "lengths in cm, as the file says"


def test_slstudio_states_the_sizes_of_both(tmp_path: Path) -> None:
    six = dict(zip(("Kc", "kc", "Kp", "kp", "Rp", "Tp"), SIX, strict=True))
    for n, names in enumerate((("frameWidth", "frameHeight", "screenResX", "screenResY"),
                               ("frame_width", "frame_height", "screen_res_x", "screen_res_y"))):  # fmt: skip
        path = file_storage(tmp_path / f"{n}.xml", six | dict(zip(names, (160, 128, 128, 96), strict=True)))
        require_numbers(read(path))
        found = read(path, cameras={"cam0": Size(80, 64)}, projector=PROJECTOR)
        with pytest.raises(CalibrationError, match="for other devices"):
            check_calibration(found, PROJECTOR, {"cam0": Size(80, 64)}, "here")


def test_sections_of_a_text_are_devices(tmp_path: Path) -> None:
    lines = [
        f"[{device}]\n" + "".join(f"{name} = {value}\n" for name, value in numbers.items())
        for device, numbers in SCALARS.items()
    ]
    pose = f"[stereo]\nR = {' '.join(map(str, R.ravel()))}\nT = {' '.join(map(str, T.ravel()))}\n"
    require_numbers(read(written(tmp_path / "rig.ini", "".join(lines) + pose)))


def test_an_array_of_both_and_one_distortion_without_a_device(tmp_path: Path) -> None:
    stacked = {"K": np.stack([K1, K2]), "D": np.stack([D1, D2]), "R": R, "T": T}
    require_numbers(read(npz(tmp_path / "stacked.npz", stacked), **CAPTURE))
    loose = dict(zip(NAMES[-1], SIX, strict=True))
    with pytest.raises(CalibrationError, match="expected the distortion of each device, found distCoeffs alone"):
        read(npz(tmp_path / "one.npz", {k: v for k, v in loose.items() if k != "projectorDistCoeffs"}), **CAPTURE)


def test_rounded_rotations_are_read_as_the_nearest_one(tmp_path: Path) -> None:
    names = dict(zip(("K1", "D1", "K2", "D2", "R", "T"), (*SIX[:4], R.round(3), T), strict=True))
    found = read(npz(tmp_path / "rig.npz", names), **CAPTURE).projector
    assert found is not None
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found.rotation, R, atol=1e-3)


# ---- What names leave open: the capture decides, or it is asked


def pattern_images(lit: FloatArray, axes: Sequence[Axis]) -> list[tuple[Any, Pattern]]:
    """Images of the codes of these axes, with noise, by the projector pixel (column, row) that lights each pixel."""
    chance = np.random.default_rng(1)
    inside = ((lit >= -0.5) & (lit < np.array([PROJECTOR.width_px, PROJECTOR.height_px]) - 0.5)).all(axis=-1)
    images: list[tuple[Any, Pattern]] = []
    for axis in axes:
        place = np.rint(lit[..., 0 if axis is Axis.COLUMN else 1]).astype(int)
        word = np.asarray(to_gray(np.clip(place, 0, PROJECTOR.along(axis) - 1)))
        for bit in range(7):
            on = (word >> (6 - bit)) & 1
            for inverted in (False, True):
                light = 20 + 160 * (on ^ inverted) * inside + chance.normal(0, 2, on.shape)
                images.append((light.clip(0, 255).astype(np.uint8), Gray(axis, bit, 7, inverted=inverted)))
    return images


def camera_rays() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Columns and rows of the camera's pixels, and its rays (n, 3) at depth 1."""
    v, u = np.mgrid[0 : CAMERA.height_px, 0 : CAMERA.width_px].astype(np.float64)
    rays = cv2.undistortPoints(np.stack([u, v], axis=-1).reshape(-1, 1, 2), K1, D1).reshape(-1, 2)
    return u, v, np.column_stack([rays, np.ones(len(rays))])


def codes(*axes: Axis, turn: FloatArray = TURN, shift: FloatArray = T) -> CodedImages[Any]:
    """The capture of a bent surface; nothing of it is slrig's geometry."""
    u, v, rays = camera_rays()
    points = rays * (600 + 60 * np.sin(u / 25) + 40 * np.cos(v / 17)).reshape(-1, 1)
    lit = cv2.projectPoints(points, turn, shift, K2, D2)[0].reshape(*u.shape, 2)
    form = CameraFormat(CAMERA, 8)
    return CodedImages({"cam0": pattern_images(lit, axes)}, {"cam0": form}, PROJECTOR, lambda image, _: image)


BACK: FloatArray = -R.T @ T
OPEN: dict[str, Mapping[str, Any]] = {
    "pose": {"K_cam": K1, "D_cam": D1, "K_proj": K2, "D_proj": D2, "extrinsic": POSE},
    "inverse pose": {"K_cam": K1, "D_cam": D1, "K_proj": K2, "D_proj": D2, "extrinsic": np.linalg.inv(POSE)},
    "rotate, translate": {"camera": CAMERA_MAP, "projector": PROJECTOR_MAP, "rotate": R.T, "translate": BACK},
    "poses of both": {
        "camera": {**CAMERA_MAP, "pose": np.linalg.inv(POSE)},
        "projector": {**PROJECTOR_MAP, "pose": np.eye(4) + 0},
    },
    "transposed": {"camera": {"K": K1.T, "D": D1}, "projector": {"K": K2.T, "D": D2}, "R": R.T, "T": T},
    "the other order": {"K1": K2, "D1": D2, "K2": K1, "D2": D1, "R": R.T, "T": BACK},
    "the usual order, inverse": {"K1": K1, "D1": D1, "K2": K2, "D2": D2, "R": R.T, "T": BACK},
}


@parametrize_core("case", OPEN, core=[0, 3])
def test_columns_and_rows_decide_what_names_leave_open(tmp_path: Path, case: str) -> None:
    path = written(tmp_path / "rig.json", json.dumps(plain(OPEN[case])))
    found = import_calibration(path, **CAPTURE, capture=codes(*Axis))
    require_numbers(found.calibration)
    assert "decided by the capture: columns and rows" in found.notes[-1]


def test_columns_alone_decide_where_points_are_otherwise_behind_the_devices(tmp_path: Path) -> None:
    """Devices side by side, with parallel axes."""
    shift = np.array([-60.0, 0, 0])
    pose = np.eye(4)
    pose[:3, 3] = shift
    for written_pose in (pose, np.linalg.inv(pose)):
        data = {"camera": CAMERA_MAP, "projector": PROJECTOR_MAP, "extrinsic": written_pose}
        path = written(tmp_path / "rig.json", json.dumps(plain(data)))
        found = import_calibration(path, **CAPTURE, capture=codes(Axis.COLUMN, turn=np.zeros(3), shift=shift))
        assert found.calibration.projector is not None
        np.testing.assert_allclose(found.calibration.projector.translation_mm, shift, atol=1e-9)
        assert found.notes[-1].endswith("decided by the capture: otherwise points are behind the devices")


def test_the_codes_of_two_cameras_decide_the_pose_between_them(tmp_path: Path) -> None:
    """Both see a plane in the first one's axes, n x = 600 mm; the projector stands anywhere."""
    normal = np.array([0.2, -0.1, 1.0])
    _, _, rays = camera_rays()
    behind = R @ normal, 600 + float(R @ normal @ T.ravel())
    surfaces = {
        "left": rays * (600 / (rays @ normal))[:, None],
        "right": (rays * (behind[1] / (rays @ behind[0]))[:, None] - T.ravel()) @ R,
    }
    images = {}
    for name, points in surfaces.items():
        lit = cv2.projectPoints(points, np.zeros(3), np.array([20.0, -120, 0]), K2, D2)[0]
        images[name] = pattern_images(lit.reshape(*CAMERA.shape, 2), list(Axis))
    sizes = dict.fromkeys(images, CAMERA)
    form = CameraFormat(CAMERA, 8)
    capture = CodedImages[Any](images, dict.fromkeys(images, form), PROJECTOR, lambda image, _: image)
    for pose in (POSE, np.linalg.inv(POSE)):
        data = {"left": {"K": K1, "D": D1}, "right": {"K": K1, "D": D1}, "extrinsics": pose}
        path = written(tmp_path / "rig.json", json.dumps(plain(data)))
        found = read(path, cameras=sizes, projector=PROJECTOR, capture=capture)
        assert found.projector is None
        np.testing.assert_allclose(found.cameras["right"].rotation, R, atol=1e-9)
        np.testing.assert_allclose(found.cameras["right"].translation_mm, T.ravel(), atol=1e-9)


@pytest.mark.parametrize("case", list(OPEN)[:3])
def test_the_direction_is_asked_where_no_capture_decides_it_and_the_answer_is_taken(tmp_path: Path, case: str) -> None:
    path = written(tmp_path / "rig.json", json.dumps(plain(OPEN[case])))
    for capture in (None, codes(Axis.COLUMN)):
        with pytest.raises(CalibrationError, match=r"'pose=(.*)' if x_projector = R x_camera .*'pose=\1,inverse'"):
            read(path, **CAPTURE, capture=capture)
    pose = "pose=rotate,translate" if "," in case else "pose=extrinsic"
    require_numbers(read(path, **CAPTURE, keys=[pose if case == "pose" else f"{pose},inverse"]))


def test_keys_say_what_is_what(tmp_path: Path) -> None:
    data = {"a": K1, "b": D1, "c": K2, "d": D2, "other": K1 + np.diag([3.0, 3, 0]), "rig": {"e": R, "f": T}}
    path = mat(tmp_path / "rig.mat", data)
    with pytest.raises(CalibrationError, match="expected one matrix of each device, here the first, found a, c, other"):
        read(path, **CAPTURE)
    require_numbers(read(path, **CAPTURE, keys=["camera=a,b projector=c,d pose=e,f"]))
    # In words of their own, with the sizes that the file lacks, by the group of the pose.
    require_numbers(read(path, keys=["camera=a,b,160x128", "projector=c,d,128x96", "pose=rig"]))
    for keys, words in (
        (["camera=a,b projector=x pose=e,f"], "expected the name 'x' of --keys, found a, b, c, d, other, rig.e, rig.f"),
        (["camera=a,c projector=d pose=e,f"], "expected one matrix of 'camera' in --keys, found 2"),
        (["camera:a"], "expected words as in --keys 'camera=K1,D1,1280x1024"),
        (["camera=a,b projector=c,d pose=e"], "as pose of --keys, found 0 poses in e"),
    ):
        with pytest.raises(CalibrationError) as caught:
            read(path, **CAPTURE, keys=keys)
        assert words in str(caught.value)


def test_keys_may_name_groups(tmp_path: Path) -> None:
    parts = FORMS["MATLAB's stereoParameters"][1]["stereoParams"]
    path = mat(tmp_path / "rig.mat", {"stereoParams": parts})
    with pytest.raises(CalibrationError, match="names that say which device is the projector"):
        read(path)
    words = ["camera=CameraParameters1,160x128 projector=CameraParameters2,128x96"]
    require_numbers(read(path, keys=words))
    two = read(path, keys=["left=CameraParameters1,160x128 right=CameraParameters2,128x96"])
    assert two.projector is None
    np.testing.assert_allclose(two.cameras["right"].rotation, R)


def pickled(path: Path) -> Path:
    np.save(path, {"K1": K1}, allow_pickle=True)  # type: ignore[arg-type]
    return path


def with_object(path: Path) -> Path:
    """A file of MATLAB that holds an object: an array of the class 17, with its name, system and class as texts."""

    def element(kind: int, content: bytes) -> bytes:
        return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)

    texts = b"".join(element(1, text) for text in (b"stereoParams", b"MCOS", b"stereoParameters"))
    data = element(14, element(6, struct.pack("<II", 17, 0)) + texts)
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + data)
    return path


def bomb(path: Path) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("K1.npy", bytes(2**26 + 1))
    return path


def without(*names: str) -> Write:
    def write(path: Path, _: Mapping[str, Any]) -> Path:
        all_names = dict(zip(("cam_A", "cam_d", "proj_A", "proj_d", "R", "T"), SIX, strict=True))
        return npz(path, {name: value for name, value in all_names.items() if name not in names})

    return write


REFUSED: dict[str, tuple[str, Callable[[Path], Path], Sequence[str]]] = {
    "v7.3": ("rig.mat", lambda p: written(p, "MATLAB 7.3 MAT-file, Platform: GLNXA64"), ["save('rig.mat', '-v7')"]),
    "HDF5": ("rig.h5", lambda p: (p.write_bytes(b"\x89HDF\r\n\x1a\n"), p)[1], ["found HDF5", "NumPy's savez"]),
    "pickle": ("rig.pkl", lambda p: (p.write_bytes(pickle.dumps({"K1": 1}, 4)), p)[1], ["can run code", "np.savez("]),
    "a dict in np.save": ("rig.npy", pickled, ["can run code; save plain arrays: np.savez("]),
    "a MATLAB object": ("rig.mat", with_object, ["s = toStruct(stereoParams); save('rig.mat', 's', '-v7')"]),
    "a bomb": ("rig.npz", bomb, ["at most 33554432 bytes are read"]),
    "one device": (
        "rig.npz", lambda p: without("proj_A", "proj_d")(p, {}), ["matrices of two devices", "cam_A (3 x 3)"]
    ),
    "no pose": ("rig.npz", lambda p: without("R")(p, {}), ["expected the pose between", "T (3 x 1)", "--keys '"]),
    "words": ("rig.txt", lambda p: written(p, "focal length 12 mm\n"), ["two devices", "found no arrays"]),
    "cut JSON": ("rig.json", lambda p: written(p, '{"K1": [[1,'), ["expected JSON, found", "save it again"]),
    "another lens": (
        "rig.json",
        lambda p: written(p, json.dumps(plain({"camera": {**CAMERA_MAP, "model": "double sphere"},
                                               "projector": {**PROJECTOR_MAP, "R": R, "T": T}}))),
        ["expected a pinhole lens, found 'double sphere'"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_not_read_is_refused_with_what_to_do(tmp_path: Path, case: str) -> None:
    name, write, words = REFUSED[case]
    with pytest.raises(CalibrationError) as caught:
        read(write(tmp_path / name), **CAPTURE)
    message = str(caught.value)
    assert all(word in message for word in (str(tmp_path / name), "; ", *words)), message


def test_sizes_that_no_one_states_are_asked(tmp_path: Path) -> None:
    path = without()(tmp_path / "rig.npz", {})
    with pytest.raises(CalibrationError, match=r"sizes of its images, found none of cam_A, cam_d; import a capture"):
        read(path)
    require_numbers(read(path, keys=["camera=160x128 projector=128x96"]))


def test_files_without_a_distortion_are_of_lenses_without_and_it_is_said(tmp_path: Path) -> None:
    found = import_calibration(without("proj_d")(tmp_path / "rig.npz", {}), **CAPTURE)
    assert found.calibration.projector is not None
    assert not found.calibration.projector.distortion.any()
    assert found.notes[1] == "proj_A: the projector, 128 x 96, without distortion, which the file lacks"


# ---- Lenses of other models


def equidistant(terms: Sequence[float]) -> Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    def image(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        radius = np.hypot(x, y)
        angle = np.arctan(radius)
        scale = angle * (1 + sum(k * angle ** (2 * n + 2) for n, k in enumerate(terms))) / radius
        return x * scale, y * scale

    return image


def rational(terms: Sequence[float]) -> Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    k1, k2, p1, p2, k3, k4, k5, k6 = terms

    def image(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        r2 = x * x + y * y
        radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        return (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )

    return image


MATRIX: FloatArray = np.array([[1400.0, 0, 655], [0, 1402, 500], [0, 0, 1]])
LENSES = [
    ([-0.02, 0.01, -0.005, 0.001], equidistant),
    ([-0.08, 0.12, 1e-4, -2e-4, 0.05, 0.01, 0.02, 0.1], rational),
    ([4.7, 3.2, 1e-4, 0, 0.17, 5.1, 4.8, 0.9], rational),
]


@pytest.mark.parametrize(("terms", "model"), LENSES)
def test_other_lenses_are_fitted_with_the_error_that_remains(terms: list[float], model: Any) -> None:
    lens = as_lens(MATRIX, np.array(terms), Size(1280, 1024), "here", equidistant=model is equidistant)
    x, y = np.meshgrid(np.linspace(-0.42, 0.42, 30), np.linspace(-0.33, 0.33, 30))
    wanted = [MATRIX[i, i] * each + MATRIX[i, 2] for i, each in enumerate(model(terms)(x, y))]
    found = [lens.matrix[i, i] * each + lens.matrix[i, 2] for i, each in enumerate(distort(lens.distortion, x, y)[:2])]
    error = np.hypot(found[0] - wanted[0], found[1] - wanted[1])
    inside = (wanted[0] >= 0) & (wanted[0] <= 1279) & (wanted[1] >= 0) & (wanted[1] <= 1023)
    assert inside.mean() > 0.5
    assert error[inside].max() <= lens.worst_px * 1.05
    assert 0 < lens.rms_px < MAX_FIT_PX
    assert f"leaves {lens.rms_px:.2g} px" in lens.note


def test_a_lens_that_cannot_be_fitted_is_refused_with_the_error() -> None:
    with pytest.raises(CalibrationError, match=r"fisheye\): the best fit is \d.* px off .*at most 0.2 px.*five terms"):
        as_lens(MATRIX * [[0.55], [0.55], [1]], np.zeros(4), Size(1280, 1024), "here", equidistant=True)


INFO = """image_width: {size.width_px}
image_height: {size.height_px}
camera_name: {name}
camera_matrix: {{rows: 3, cols: 3, data: {k}}}
distortion_model: {model}
distortion_coefficients: {{rows: 1, cols: 5, data: {d}}}
rectification_matrix: {{rows: 3, cols: 3, data: {r}}}
projection_matrix: {{rows: 3, cols: 4, data: {p}}}
"""


def camera_info(path: Path, size: Size, k: FloatArray, d: FloatArray, r: FloatArray, p: FloatArray, model: str) -> None:
    k, d, r, p = (each.ravel().tolist() for each in (k, d, r, p))  # type: ignore[assignment]
    path.write_text(INFO.format(size=size, name=path.stem, model=model, k=k, d=d, r=r, p=p))


def test_a_stereo_pair_of_ros_is_read_without_transforms_and_with_its_writers_wrong_header(tmp_path: Path) -> None:
    """camera_calibration states 5 columns for the 8 terms of a rational lens."""
    eight = np.hstack([D1, [[0.001, 0.002, 0.001]]])
    r1, r2, p1, p2, *_ = cv2.stereoRectify(K1, D1, K2, D2, (160, 128), R, T / 1000)
    camera_info(tmp_path / "left.yaml", CAMERA, K1, eight, r1, p1, "rational_polynomial")
    camera_info(tmp_path / "projector.yaml", PROJECTOR, K2, D2, r2, p2, "plumb_bob")
    found = import_calibration(tmp_path)
    assert found.calibration.projector is not None
    np.testing.assert_allclose(found.calibration.projector.rotation, R, atol=1e-9)
    np.testing.assert_allclose(found.calibration.projector.translation_mm, T.ravel(), atol=1e-6)
    np.testing.assert_allclose(found.calibration.cameras["left"].matrix, K1, atol=0.05)
    assert "left: its lens was fitted with k1, k2, p1, p2 and k3" in found.notes[0]


def test_an_equidistant_lens_of_kalibr_is_fitted(tmp_path: Path) -> None:
    cameras: dict[str, Any] = {
        name: {
            "camera_model": "pinhole", "distortion_model": "equidistant", "distortion_coeffs": [-0.02, 0.01, 0.0, 0.0],
            "intrinsics": [float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])],
            "resolution": [size.width_px, size.height_px], "rostopic": topic,
        }
        for name, k, size, topic in (("cam0", K1, CAMERA, "/left/image"), ("cam1", K2, PROJECTOR, "/projector/image"))
    }  # fmt: skip
    cameras["cam1"]["T_cn_cnm1"] = np.vstack([np.hstack([R, T / 1000]), [[0, 0, 0, 1]]]).tolist()
    path = written(tmp_path / "camchain.yaml", yaml.safe_dump(cameras))
    found = import_calibration(path)
    assert [note.split(":")[0] for note in found.notes] == ["left", "projector"]
    left = found.calibration.cameras["left"]
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.3, 0.3, 9))
    wanted = equidistant([-0.02, 0.01, 0, 0])(x, y + 1e-9)[0] * K1[0, 0] + K1[0, 2]
    found_px = distort(left.distortion, x, y)[0] * left.matrix[0, 0] + left.matrix[0, 2]
    np.testing.assert_allclose(found_px, wanted, atol=0.1)


def test_the_commands_take_the_words(tmp_path: Path) -> None:
    path = without()(tmp_path / "rig.npz", {})
    assert "expected a calibration with the sizes of its images" in refused(run("export", path, tmp_path / "rig.json"))
    shown = run("export", path, tmp_path / "rig.json", "--keys", "camera=160x128 projector=128x96")
    assert shown.exit_code == 0
    assert "read      R, T: x_projector = R x_cam0 + T" in shown.output
    require_numbers(read_calibration(tmp_path / "rig.json"))


@pytest.mark.parametrize("writer", ["NumPy's savez", "MATLAB's save", "json", "OpenCV's YAML"])
@pytest.mark.filterwarnings("ignore")
def test_a_harmed_file_is_read_or_refused(tmp_path: Path, writer: str) -> None:
    chance = random.Random(7)
    name, write = WRITERS[writer]
    good = write(tmp_path / name, dict(zip(NAMES[0], SIX, strict=True))).read_bytes()
    outcomes = {"read": 0, "refused": 0}
    for _ in range(60):
        (tmp_path / name).write_bytes(harmed(good, [good], chance))
        try:
            assert isinstance(read(tmp_path / name, **CAPTURE).projector, Pinhole | None)
            outcomes["read"] += 1
        except CalibrationError:
            outcomes["refused"] += 1
    assert outcomes["refused"] > 5
