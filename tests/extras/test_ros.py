"""Messages for ROS 2 as CDR and back, with the types of an old and of newer releases; the bag; and E57's fault."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slrig.extras.ros import device_of, encode_bag
from slrig.model import Calibration, Pinhole, Size
from slrig.ros_messages import Messages, pose
from slrig.scan.clouds import OrganisedCloud
from tests.ros_readers import colours, library, point_columns, seen_at
from tests.unit.scan.test_organised import BARREL, SIZE, camera

pytestmark = pytest.mark.slow

RELEASES = ["ROS2_HUMBLE", "ROS2_JAZZY", "LATEST"]
TURNED = camera(BARREL, (0.2, -2.9, 0.4))
SECONDS = 1_800_000_000.25


def types_of(release: str) -> Any:
    typesys = library("rosbags.typesys")
    return typesys.get_typestore(getattr(typesys.Stores, release))


def cloud() -> OrganisedCloud:
    random, shape = np.random.default_rng(2), SIZE.shape
    cause = (random.random(shape) < 0.4).astype(np.uint8)
    points, normals = (random.normal(300, 50, (*shape, 3)).astype(np.float32) for _ in range(2))
    sigma = random.uniform(0.01, 0.1, shape).astype(np.float32)
    for each in (points, normals, sigma):
        each[cause != 0] = np.nan
    colour = random.integers(0, 256, (*shape, 3), dtype=np.uint8)
    return OrganisedCloud("left", TURNED, points, normals, sigma, colour, np.zeros_like(cause), cause, ("none", "dark"))


@pytest.mark.parametrize("release", RELEASES)
def test_a_message_is_the_same_after_its_way_through_cdr(release: str) -> None:
    types = types_of(release)
    messages = Messages(class_of=types.types.__getitem__, sequence=np.ascontiguousarray, seconds=SECONDS)
    grey = np.arange(SIZE.width_px * SIZE.height_px, dtype=np.uint16).reshape(SIZE.shape)
    coloured = np.repeat((grey % 256).astype(np.uint8)[..., None], 3, axis=2)
    device = device_of(TURNED)
    made = [messages.points(cloud()), messages.camera_info("left", device), messages.transforms({"left": device})]
    made += [messages.image("left", grey), messages.image("left", coloured)]
    sent = [types.serialize_cdr(each, each.__msgtype__) for each in made]
    points, info, transforms, mono, bgr = (
        types.deserialize_cdr(data, each.__msgtype__) for data, each in zip(sent, made, strict=True)
    )
    # The bag is written with the types of one release, and read with those of another.
    oldest = types_of(RELEASES[0])
    assert [bytes(oldest.serialize_cdr(each, each.__msgtype__)) for each in made] == [bytes(each) for each in sent]
    assert [oldest.hash_rihs01(each.__msgtype__) for each in made] == [types.hash_rihs01(e.__msgtype__) for e in made]

    expected, columns = cloud(), point_columns(points)
    assert (points.header.frame_id, points.is_dense, points.is_bigendian) == ("world", False, False)
    assert (points.header.stamp.sec, points.header.stamp.nanosec) == (1_800_000_000, 250_000_000)
    for place, axis in enumerate("xyz"):
        np.testing.assert_allclose(columns[axis], expected.points_mm[..., place] / 1000, rtol=1e-6)
        np.testing.assert_array_equal(columns[f"normal_{axis}"], expected.normals[..., place])
    np.testing.assert_allclose(columns["sigma"], expected.sigma_mm / 1000, rtol=1e-6)
    np.testing.assert_array_equal(np.isnan(columns["z"]), expected.cause != 0)
    np.testing.assert_array_equal(colours(columns), expected.colour)

    assert (info.header.frame_id, info.width, info.height) == ("left_optical_frame", *SIZE.shape[::-1])
    np.testing.assert_array_equal(info.p.reshape(3, 4), np.hstack([TURNED.matrix, np.zeros((3, 1))]))
    np.testing.assert_array_equal(info.r.reshape(3, 3), np.eye(3))
    assert (mono.encoding, mono.step) == ("mono16", 2 * SIZE.width_px)
    assert (bgr.encoding, bgr.step) == ("bgr8", 3 * SIZE.width_px)
    np.testing.assert_array_equal(mono.data.view("<u2").reshape(SIZE.shape), grey)
    np.testing.assert_array_equal(bgr.data.reshape(coloured.shape), coloured)
    assert transforms.transforms[0].header.frame_id == "world"


@pytest.mark.parametrize("turn", [(0, 0, 0), (np.pi, 0, 0), (0, -np.pi, 0), (0.1, 0.2, np.pi - 1e-9), (0.3, -2.9, 0.4)])
def test_point_projects_where_transform_and_camera_info_say(turn: tuple[float, float, float]) -> None:
    rotation = np.asarray(cv2.Rodrigues(np.array(turn, dtype=np.float64))[0])
    matrix = np.array([[1900.0, 0, 482.8], [0, 1901.9, 379.4], [0, 0, 1]])
    device = Pinhole(Size(960, 768), matrix, np.array(BARREL), rotation, np.array([12.0, -40, 350]))
    random = np.random.default_rng(3)
    seen = np.column_stack([random.uniform(-60, 60, (50, 2)), random.uniform(300, 500, 50)])
    points_mm = (seen - device.translation_mm) @ device.rotation
    expected, _ = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), device.matrix, device.distortion)
    types = types_of("ROS2_HUMBLE")
    messages = Messages(class_of=types.types.__getitem__, sequence=np.ascontiguousarray)
    found = seen_at(
        messages.transforms({"left": device_of(device)}),
        messages.camera_info("left", device_of(device)),
        points_mm / 1000,
    )
    np.testing.assert_allclose(found, expected[:, 0], rtol=0, atol=1e-8)
    _, (*_, w) = pose(device.rotation, device.translation_mm)
    assert w >= 0
    # The same for the world in a robot's base.
    base = np.eye(4)
    base[:3, :3], base[:3, 3] = rotation, (1200.0, -300.0, 650.0)
    placed = messages.transforms({}, ("base_link", base)).transforms[0]
    assert (placed.header.frame_id, placed.child_frame_id) == ("base_link", "world")
    turned, shift = placed.transform.rotation, placed.transform.translation
    found_turn = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w]).as_matrix()
    np.testing.assert_allclose(found_turn, rotation, atol=1e-8)
    np.testing.assert_allclose([shift.x, shift.y, shift.z], [1.2, -0.3, 0.65], atol=1e-12)


@pytest.mark.parametrize(("seconds", "stamp_ns"), [(1.5, 1_500_000_000), (-1.0, 0), (2.0**31, 0)])
def test_a_time_that_ros_does_not_count_is_none(seconds: float, stamp_ns: int) -> None:
    assert Messages(class_of=dict, sequence=list, seconds=seconds).stamp_ns == stamp_ns  # type: ignore[arg-type]


def test_cameras_with_names_equal_to_ros_share_a_topic() -> None:
    library("rosbags.rosbag2")
    calibration = Calibration({"a-b": TURNED, "a_b": TURNED}, None)
    data = encode_bag(calibration, [], {}, None)
    assert data == encode_bag(calibration, [], {}, None)
    assert data.startswith(b"\x89MCAP0\r\n")
