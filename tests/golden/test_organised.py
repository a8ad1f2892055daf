"""The surface of a rendered scan in the grids of its cameras, against mesh and truth, and read by other programs.

What reads the files here is not what wrote them: OpenCV and Pillow the depth, pypcd4 the PCD, the crate e57 (by its
Python package) the E57, lib3mf the 3MF, mcap and rosbags' reader the bag.
"""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import PIL.Image
import pytest
import trimesh

from slrig.bundle.calibration import read_calibration
from slrig.bundle.description import read_description
from slrig.bundle.reading import read_bundle
from slrig.model import FloatArray, Pinhole, Refusal, White
from slrig.scan.artefacts import decode_mesh_ply, write_converted
from slrig.scan.clouds import cloud_file
from slrig.scan.formats import requested_forms
from tests.golden.conftest import Scan
from tests.ros_readers import colours, library, point_columns, seen_at

pytestmark = pytest.mark.slow

BAG = "scan.mcap"
CAMERAS = ("left", "right")
SAMPLES = 20_000


class Clouds(NamedTuple):
    """A finished scan: its bundle, its folder with every cloud in it, its report, and the calibration's cameras."""

    bundle: Path
    folder: Path
    report: Any
    cameras: dict[str, Pinhole]

    def cloud(self, camera: str) -> dict[str, Any]:
        with np.load(self.folder / f"points-{camera}.npz") as data:
            return dict(data)


@pytest.fixture(scope="module")
def scan(scan_of: Callable[[str], Scan], tmp_path_factory: pytest.TempPathFactory) -> Clouds:
    made = scan_of("two_cameras")
    folder = tmp_path_factory.mktemp("organised") / "scan"
    shutil.copytree(made.folder, folder)
    calibration = made.bundle / "calibration.json"
    library("pye57")
    for camera in CAMERAS:
        for form in (each for each in requested_forms() if "{camera}" in each):
            data = cloud_file(folder, form, camera, calibration=calibration)
            (folder / form.format(camera=camera)).write_bytes(data)
    library("rosbags.rosbag2")
    (folder / BAG).write_bytes(cloud_file(folder, BAG, None, bundle=made.bundle))
    return Clouds(made.bundle, folder, made.report, dict(read_calibration(calibration).cameras))


def sampled(cloud: dict[str, Any]) -> FloatArray:
    """(n, 3) float64: points spread over the picture."""
    points = cloud["points_mm"][cloud["cause"] == 0].astype(np.float64)
    return np.asarray(points[:: max(1, len(points) // SAMPLES)])


def distances_mm(surface: trimesh.Trimesh, points: FloatArray) -> FloatArray:
    return np.asarray(trimesh.proximity.closest_point(surface, points)[1])


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_point_is_there_where_there_is_no_cause_against_it(scan: Clouds, camera: str) -> None:
    cloud, device = scan.cloud(camera), scan.cameras[camera]
    assert cloud["points_mm"].shape == (*device.size.shape, 3)
    for name in ("points_mm", "normals"):
        assert (np.isfinite(cloud[name]).all(axis=2) == (cloud["cause"] == 0)).all(), name
        assert (np.isnan(cloud[name]).all(axis=2) == (cloud["cause"] != 0)).all(), name
    assert (np.isfinite(cloud["sigma_mm"]) == (cloud["cause"] == 0)).all()
    refused = np.asarray(cv2.imread(str(scan.folder / f"causes-{camera}.png"), cv2.IMREAD_UNCHANGED))
    assert cloud["causes"].tolist() == [each["name"] for each in scan.report["causes"]]
    np.testing.assert_array_equal(cloud["cause"][refused != 0], refused[refused != 0])
    # Only at borders of the mesh, whose edges the lens bends, do the two differ.
    assert (cloud["cause"][refused == 0] == 0).mean() > 0.999
    # The mesh covers what was measured but for its borders.
    assert (cloud["cause"] == 0).sum() > 0.97 * np.isin(refused, (Refusal.NONE, Refusal.NO_SURFACE)).sum()


@pytest.mark.parametrize("camera", CAMERAS)
def test_points_lie_on_the_mesh_and_on_the_rays_of_their_pixels(scan: Clouds, camera: str) -> None:
    cloud, device = scan.cloud(camera), scan.cameras[camera]
    assert np.abs(device.distortion).max() > 0
    mesh = trimesh.load(scan.folder / "mesh.ply", process=False)
    # From y up, z towards the rig, to the axes of the calibration.
    mesh.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))
    assert distances_mm(mesh, sampled(cloud)).max() < 1e-3
    rows, columns = np.nonzero(cloud["cause"] == 0)
    points = cloud["points_mm"][rows, columns].astype(np.float64)
    turn, _ = cv2.Rodrigues(device.rotation)
    pixels, _ = cv2.projectPoints(points, turn, device.translation_mm, device.matrix, device.distortion)
    assert np.abs(pixels[:, 0] - np.stack((columns, rows), axis=1)).max() < 1e-3
    # What is nearest to the camera is met: nothing of the mesh lies before a point, along its ray.
    some = slice(None, None, max(1, len(points) // SAMPLES))
    rays = points[some] - device.centre_mm
    starts = np.broadcast_to(device.centre_mm, rays.shape)
    hits, ray, _ = mesh.ray.intersects_location(starts, rays, multiple_hits=False)
    before_mm = np.linalg.norm(rays[ray], axis=1) - np.linalg.norm(hits - device.centre_mm, axis=1)
    assert before_mm.max() < 0.01
    # Normals look at the camera that they were seen by, and deviations are of the mesh.
    normals = cloud["normals"][rows, columns]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert ((normals * (points - device.centre_mm)).sum(axis=1) < 0).mean() > 0.999
    raw = mesh.metadata["_ply_raw"]["vertex"]["data"]
    assert raw["sigma_mm"].min() <= cloud["sigma_mm"][rows, columns].min()
    assert cloud["sigma_mm"][rows, columns].max() <= raw["sigma_mm"].max()


@pytest.mark.parametrize("camera", CAMERAS)
def test_depth_is_read_in_mm_by_opencv_and_pillow(scan: Clouds, camera: str) -> None:
    path, cloud, device = scan.folder / f"depth-{camera}.tiff", scan.cloud(camera), scan.cameras[camera]
    values = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
    with PIL.Image.open(path) as picture:
        np.testing.assert_array_equal(np.asarray(picture), values)
        told = json.loads(picture.tag_v2[270])  # type: ignore[attr-defined] # of TIFF pictures
    assert values.dtype == np.uint16
    assert (told["unit"], told["none"], told["camera"]) == ("mm", 0, camera)
    known = cloud["cause"] == 0
    np.testing.assert_array_equal(values != told["none"], known)
    depth_mm = told["offset"] + told["scale"] * values[known].astype(np.float64)
    expected = cloud["points_mm"][known].astype(np.float64) @ device.rotation[2] + device.translation_mm[2]
    assert np.abs(depth_mm - expected).max() <= 0.501 * told["scale"]
    assert (values[known].min(), values.max()) == (1, 65535)
    np.testing.assert_array_equal(told["matrix"], device.matrix)
    # As OpenCV gives depth back its place.
    rows, columns = np.nonzero(known)
    pixels = np.stack((columns, rows), axis=1).astype(np.float64)[:, None]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    rays = cv2.undistortPoints(pixels, np.array(told["matrix"]), np.array(told["distortion"]), criteria=criteria)[:, 0]
    placed = (np.column_stack((rays, np.ones(len(rays)))) * depth_mm[:, None] - device.translation_mm) @ device.rotation
    assert np.abs(placed - cloud["points_mm"][known]).max() < 2 * told["scale"] + 1e-3


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_pcd_is_read_with_places_normals_and_colours(scan: Clouds, camera: str) -> None:
    pypcd4 = library("pypcd4")
    cloud, device = scan.cloud(camera), scan.cameras[camera]
    found = pypcd4.PointCloud.from_path(scan.folder / f"points-{camera}.pcd")
    high, wide = device.size.shape
    assert (found.metadata.width, found.metadata.height, found.metadata.points) == (wide, high, wide * high)
    read = {name: column.reshape(high, wide) for name, column in zip(found.fields, found.numpy().T, strict=True)}
    for name, part in (("", "points_mm"), ("normal_", "normals")):
        for axis, letter in enumerate("xyz"):
            np.testing.assert_array_equal(read[name + letter], cloud[part][..., axis])
    np.testing.assert_array_equal(read["sigma"], cloud["sigma_mm"])
    packed = np.ascontiguousarray(found.pc_data["rgb"]).view(np.uint32).reshape(high, wide)
    colours = np.stack([packed >> shift & 255 for shift in (16, 8, 0)], axis=2)
    np.testing.assert_array_equal(colours, cloud["colour"])
    place, (w, *axis) = found.metadata.viewpoint[:3], found.metadata.viewpoint[3:]
    np.testing.assert_allclose(place, device.centre_mm, rtol=1e-6, atol=1e-6)
    turn = trimesh.transformations.quaternion_matrix([w, *axis])[:3, :3]
    np.testing.assert_allclose(turn, device.rotation.T, atol=1e-6)


@pytest.mark.parametrize("camera", CAMERAS)
def test_an_e57_is_read_in_metres_with_colours(scan: Clouds, camera: str) -> None:
    reader, path, cloud = library("e57"), str(scan.folder / f"points-{camera}.e57"), scan.cloud(camera)
    found, known = reader.read_points(path), cloud["cause"] == 0
    np.testing.assert_allclose(found.points, cloud["points_mm"][known] / 1000, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(np.rint(found.color * 255), cloud["colour"][known])
    text = reader.raw_xml(path)
    assert "<rowIndex" in text
    assert "<columnIndex" in text


def test_a_bag_is_read_in_metres_with_devices_and_white_images(scan: Clouds) -> None:
    told: dict[str, Any] = {}
    stamps: set[int] = set()
    with library("rosbags.highlevel").AnyReader([scan.folder / BAG]) as reader:
        for connection, stamp_ns, data in reader.messages():
            message = told[connection.topic] = reader.deserialize(data, connection.msgtype)
            header = message.transforms[0].header if connection.topic == "/tf_static" else message.header
            stamps |= {stamp_ns, header.stamp.sec * 10**9 + header.stamp.nanosec}
            (offered,) = connection.ext.offered_qos_profiles
            assert (offered.durability.name, offered.reliability.name) == ("TRANSIENT_LOCAL", "RELIABLE")
    # Another reader finds the same bytes, by the format's own index, and what rosbag2 looks for.
    mcap = library("mcap.reader").make_reader(io.BytesIO((scan.folder / BAG).read_bytes()), validate_crcs=True)
    assert (mcap.get_header().profile, [each.name for each in mcap.iter_metadata()]) == ("ros2", ["rosbag2"])
    read = {channel.topic: (schema, channel, message) for schema, channel, message in mcap.iter_messages()}
    assert set(read) == set(told)
    assert {(schema.encoding, channel.message_encoding) for schema, channel, _ in read.values()} == {("ros2msg", "cdr")}

    captured_at = read_description(scan.bundle).captured_at
    assert captured_at is not None
    stamps |= {message.log_time for _, _, message in read.values()}
    assert stamps == {int(captured_at.timestamp()) * 10**9}

    transforms = told.pop("/tf_static")
    assert {(each.header.frame_id, each.child_frame_id) for each in transforms.transforms} == {
        ("world", f"{name}_optical_frame") for name in (*CAMERAS, "projector")
    }
    assert set(told) == {"/slrig/projector/camera_info"} | {
        f"/slrig/{name}/{what}" for name in CAMERAS for what in ("points", "camera_info", "image_raw")
    }
    capture = read_bundle(scan.bundle).capture
    # White is shown more than once.
    white = {shot.camera: shot for shot in reversed(capture.shots) if capture.patterns[shot.pattern] == White()}
    for camera in CAMERAS:
        cloud, message = scan.cloud(camera), told[f"/slrig/{camera}/points"]
        columns, known = point_columns(message), cloud["cause"] == 0
        for part, names, scale in (
            ("points_mm", ("x", "y", "z"), 1000),
            ("normals", ("normal_x", "normal_y", "normal_z"), 1),
            ("sigma_mm", ("sigma",), 1000),
        ):
            found = np.stack([columns[name] for name in names], axis=2).reshape(cloud[part].shape)
            np.testing.assert_allclose(found, cloud[part] / np.float32(scale), rtol=2e-7, atol=0)
        for name in set(columns) - {"rgb"}:
            np.testing.assert_array_equal(np.isfinite(columns[name]), known)
        np.testing.assert_array_equal(colours(columns), cloud["colour"])
        # A point in metres is seen at its pixel, by transform and camera info alone.
        points_m = np.stack([columns[axis] for axis in "xyz"], axis=2)[known].astype(np.float64)
        rows, places = np.nonzero(known)
        seen = seen_at(transforms, told[f"/slrig/{camera}/camera_info"], points_m)
        assert np.abs(seen - np.stack((places, rows), axis=1)).max() < 1e-3
        image = told[f"/slrig/{camera}/image_raw"]
        assert image.header.frame_id == f"{camera}_optical_frame"
        np.testing.assert_array_equal(image.data.reshape(image.height, image.width, -1)[..., 0], white[camera].image)


def test_a_3mf_is_read_in_mm_with_colours(scan: Clouds) -> None:
    write_converted(scan.folder, "mesh.3mf")
    mesh = decode_mesh_ply((scan.folder / "mesh.ply").read_bytes())
    made = library("lib3mf")
    model = made.get_wrapper().CreateModel()
    reader = model.QueryReader("3mf")
    reader.SetStrictModeActive(True)
    reader.ReadFromFile(str(scan.folder / "mesh.3mf"))
    assert reader.GetWarningCount() == 0
    assert model.GetUnit() == made.Lib3MF.ModelUnit.MilliMeter
    objects = model.GetMeshObjects()
    assert objects.Count() == 1
    assert objects.MoveNext()
    found = objects.GetCurrentMeshObject()
    np.testing.assert_allclose(
        [list(vertex.Coordinates) for vertex in found.GetVertices()], mesh.vertices_mm * [1, -1, -1], rtol=0, atol=3e-5
    )
    np.testing.assert_array_equal([list(triangle.Indices) for triangle in found.GetTriangleIndices()], mesh.faces)
    triangles = found.GetAllTriangleProperties()
    group = model.GetColorGroupByID(triangles[0].ResourceID)
    shades = {name: group.GetColor(name) for name in group.GetAllPropertyIDs()}
    colours = [[shades[name] for name in triangle.PropertyIDs] for triangle in triangles[::50]]
    expected = mesh.colour[mesh.faces[::50]].tolist()
    assert [[[each.Red, each.Green, each.Blue] for each in triangle] for triangle in colours] == expected
