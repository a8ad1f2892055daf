"""ROS 2 messages of a scan: their contents, for the message classes of any library.

The bag is made with rosbags' classes, and the node's messages with ROS's own; both take fields by name. Lengths are
metres (REP 103). A device's frame is called NAME_optical_frame, and its axes are those of ROS's optical frames, which
are slrig's own: x right, y down, z ahead.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

WORLD = "world"
"""The frame of the mesh and its points: the axes of the calibration."""

PROJECTOR = "projector"
FRAME = "_optical_frame"
MM_PER_M = 1000.0

POINT_FIELDS = ("x", "y", "z", "normal_x", "normal_y", "normal_z", "rgb", "sigma")
"""Numbers of a point, float32; PCL and RViz read those of its known names."""

LIVE_FIELDS = ("x", "y", "z", "sigma", "intensity")
"""The same of a live depth image, in messages and in files."""

TF_STATIC = "/tf_static"
_FLOAT32 = 7  # sensor_msgs/msg/PointField
_MOST_SECONDS = 2**31 - 1  # builtin_interfaces/msg/Time counts in an int32
_NS = 1_000_000_000

Floats = NDArray[np.float64]


class Device(NamedTuple):
    """A camera or projector, as `slrig.model.Pinhole`. rotation : (3, 3), world to device; translation_mm : (3,)."""

    width_px: int
    height_px: int
    matrix: Floats
    distortion: Floats
    rotation: Floats
    translation_mm: Floats


class Points(Protocol):
    """Points in the grid of a camera, (H, W), as `slrig.scan.clouds.OrganisedCloud` and `slrig.client.Cloud`."""

    @property
    def points_mm(self) -> NDArray[np.float32]: ...  # noqa: D102
    @property
    def normals(self) -> NDArray[np.float32]: ...  # noqa: D102
    @property
    def sigma_mm(self) -> NDArray[np.float32]: ...  # noqa: D102
    @property
    def colour(self) -> NDArray[np.uint8]: ...  # noqa: D102


def topic(name: str, what: str, *, under: str = "/slrig") -> str:
    """Topic of a device's messages. ROS's names hold no hyphens, and do not begin with a digit.

    >>> topic("left-2", "points"), topic("2nd", "points", under="~")
    ('/slrig/left_2/points', '~/_2nd/points')
    """
    return f"{under}/{re.sub('^(?=[0-9])', '_', name.replace('-', '_'))}/{what}"


def point_table(cloud: Points, *, units_per_mm: float = 1.0) -> NDArray[np.float32]:
    """(H, W, 8) float32, little-endian: `POINT_FIELDS` of each pixel, NaN where it has no point.

    rgb is as PCL packs it: the bits of a number are 0, red, green, blue, a byte each. units_per_mm : of x, y, z and
    sigma.
    """
    table = np.zeros((*cloud.sigma_mm.shape, len(POINT_FIELDS)), dtype="<f4")
    scale = np.float32(units_per_mm)
    table[..., :3], table[..., 3:6], table[..., 7] = cloud.points_mm * scale, cloud.normals, cloud.sigma_mm * scale
    red, green, blue = np.moveaxis(cloud.colour.astype("<u4"), 2, 0)
    table[..., 6] = (red << 16 | green << 8 | blue).view("<f4")
    return table


def lens(matrix: Floats, distortion: Floats) -> dict[str, Any]:
    """The fields of a CameraInfo of a device's optics. It is not rectified: r is the identity, and p is k."""
    straight = np.hstack([matrix, np.zeros((3, 1))])
    return {"distortion_model": "plumb_bob", "d": distortion, "k": matrix, "r": np.eye(3), "p": straight}


def pose(rotation: Floats, translation_mm: Floats) -> tuple[list[float], list[float]]:
    """Pose of a device in the world: its centre, m, and the turn from its axes to the world's, (x, y, z, w).

    The quaternion is the direction of 4 q qᵀ (Bar-Itzhack 2000), which the turn's matrix gives.
    """
    r = rotation.T
    outer = np.array(
        [
            [1 + r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], 1 - r[0, 0] + r[1, 1] - r[2, 2], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 - r[0, 0] - r[1, 1] + r[2, 2], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1 + r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    turn = np.linalg.eigh(outer)[1][:, -1]
    centre_m = -r @ translation_mm / MM_PER_M
    return centre_m.tolist(), (turn if turn[3] >= 0 else -turn).tolist()


@dataclass(frozen=True, slots=True)
class Messages:
    """Makes the messages of one scan.

    class_of : the class of a type, as "sensor_msgs/msg/Image". sequence : (n,) numbers as its fields of any length
    take them. seconds : when the scan was captured, since 1970; 0 where that is not known, or beyond what ROS counts.
    world : what the frame of the points is called.
    """

    class_of: Callable[[str], Callable[..., Any]]
    sequence: Callable[[NDArray[Any]], Any]
    seconds: float = 0.0
    world: str = WORLD

    @property
    def stamp_ns(self) -> int:
        """When the scan was captured."""
        return round(self.seconds * 1e6) * 1000 if 0 <= self.seconds <= _MOST_SECONDS else 0

    def points(self, cloud: Points) -> Any:
        """sensor_msgs/msg/PointCloud2: in the world, m, organised as the camera's image."""
        return self._cloud(point_table(cloud, units_per_mm=1 / MM_PER_M), POINT_FIELDS, self.world)

    def live_points(self, name: str, points_mm: NDArray[Any], sigma_mm: NDArray[Any], grey: NDArray[Any]) -> Any:
        """sensor_msgs/msg/PointCloud2: a live depth image of a camera, in its own frame, m, organised. points_mm : (h,
        w, 3); sigma_mm, grey : (h, w).
        """
        parts = points_mm / MM_PER_M, sigma_mm[..., None] / MM_PER_M, grey[..., None]
        table = np.concatenate(parts, axis=2).astype("<f4")
        return self._cloud(table, LIVE_FIELDS, name + FRAME)

    def _cloud(self, table: NDArray[np.float32], names: Sequence[str], frame: str) -> Any:
        high, wide, count = table.shape
        fields = [
            self.class_of("sensor_msgs/msg/PointField")(name=name, offset=4 * place, datatype=_FLOAT32, count=1)
            for place, name in enumerate(names)
        ]
        return self.class_of("sensor_msgs/msg/PointCloud2")(
            header=self._header(frame),
            height=high,
            width=wide,
            fields=fields,
            is_bigendian=False,
            point_step=4 * count,
            row_step=4 * count * wide,
            data=self.sequence(table.reshape(-1).view(np.uint8)),
            is_dense=False,
        )

    def camera_info(self, name: str, device: Device) -> Any:
        """sensor_msgs/msg/CameraInfo: plumb_bob with k1, k2, p1, p2, k3, which is the lens that slrig has."""
        numbers = lens(device.matrix, device.distortion)
        everything = self.class_of("sensor_msgs/msg/RegionOfInterest")(
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self.class_of("sensor_msgs/msg/CameraInfo")(
            header=self._header(name + FRAME),
            height=device.height_px,
            width=device.width_px,
            distortion_model=numbers["distortion_model"],
            d=self.sequence(numbers["d"]),
            **{each: np.ascontiguousarray(numbers[each], dtype=np.float64).reshape(-1) for each in "krp"},
            binning_x=0,
            binning_y=0,
            roi=everything,
        )

    def image(self, name: str, pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> Any:
        """sensor_msgs/msg/Image. pixels : (H, W) grey, or (H, W, 3) blue, green and red; values as the camera's."""
        high, wide = pixels.shape[:2]
        bits = 8 * pixels.dtype.itemsize
        data = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<")).reshape(-1).view(np.uint8)
        return self.class_of("sensor_msgs/msg/Image")(
            header=self._header(name + FRAME),
            height=high,
            width=wide,
            encoding=f"{'mono' if pixels.ndim == 2 else 'bgr'}{bits}",
            is_bigendian=0,
            step=len(data) // high,
            data=self.sequence(data),
        )

    def transforms(self, devices: Mapping[str, Device], robot: tuple[str, Floats] | None = None) -> Any:
        """tf2_msgs/msg/TFMessage for /tf_static: the pose of each device in the world. robot : a frame of a robot, and
        the pose of the world in it, (4, 4), mm.
        """
        made = [
            self._transform(self.world, name + FRAME, device.rotation, device.translation_mm)
            for name, device in devices.items()
        ]
        if robot is not None:
            frame, world_pose = robot
            back = world_pose[:3, :3].T
            made.append(self._transform(frame, self.world, back, -back @ world_pose[:3, 3]))
        return self.class_of("tf2_msgs/msg/TFMessage")(transforms=made)

    def _transform(self, parent: str, child: str, rotation: Floats, translation_mm: Floats) -> Any:
        place, turn = pose(rotation, translation_mm)
        vector = self.class_of("geometry_msgs/msg/Vector3")(**dict(zip("xyz", place, strict=True)))
        quaternion = self.class_of("geometry_msgs/msg/Quaternion")(**dict(zip("xyzw", turn, strict=True)))
        moved = self.class_of("geometry_msgs/msg/Transform")(translation=vector, rotation=quaternion)
        return self.class_of("geometry_msgs/msg/TransformStamped")(
            header=self._header(parent), child_frame_id=child, transform=moved
        )

    def _header(self, frame: str) -> Any:
        seconds, nanoseconds = divmod(self.stamp_ns, _NS)
        stamp = self.class_of("builtin_interfaces/msg/Time")(sec=seconds, nanosec=nanoseconds)
        return self.class_of("std_msgs/msg/Header")(stamp=stamp, frame_id=frame)
