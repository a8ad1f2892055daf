"""ROS's side of what slrig writes for it: rosbags' types, and what a message says, in numpy."""

from __future__ import annotations

import importlib
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slrig.model import FloatArray
from tests.npm import lacking


def library(name: str) -> Any:
    """A reader that is not ours."""
    try:
        return importlib.import_module(name)
    except ImportError:
        lacking(f"needs {name}: pip install 'slrig[e57,ros,readers]'")


def point_columns(message: Any) -> dict[str, NDArray[np.float32]]:
    """(H, W) of each field of a PointCloud2, read by the offsets that it states."""
    assert {field.datatype for field in message.fields} == {7}
    named = np.dtype(
        {
            "names": [field.name for field in message.fields],
            "formats": ["<f4"] * len(message.fields),
            "offsets": [field.offset for field in message.fields],
            "itemsize": message.point_step,
        }
    )
    assert message.row_step == message.width * message.point_step
    table = np.frombuffer(bytes(message.data), dtype=named).reshape(message.height, message.width)
    return {name: table[name] for name in named.names or ()}


def colours(columns: dict[str, NDArray[np.float32]]) -> NDArray[np.uint8]:
    """(H, W, 3): red, green and blue."""
    packed = np.ascontiguousarray(columns["rgb"]).view(np.uint32)
    return np.stack([packed >> shift & 255 for shift in (16, 8, 0)], axis=2).astype(np.uint8)


def seen_at(transforms: Any, info: Any, points_m: FloatArray) -> FloatArray:
    """(n, 2): the pixels at which (n, 3) points of the world are seen, by a TFMessage and a CameraInfo, as tf2 and
    image_geometry take them: a transform is the child's pose in its parent.
    """
    (pose,) = (each for each in transforms.transforms if each.child_frame_id == info.header.frame_id)
    place = [getattr(pose.transform.translation, axis) for axis in "xyz"]
    turn = Rotation.from_quat([getattr(pose.transform.rotation, axis) for axis in "xyzw"])
    seen = turn.inv().apply(points_m - place)
    assert info.distortion_model == "plumb_bob"
    k, d = np.array(info.k).reshape(3, 3), np.array(info.d)
    pixels, _ = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), k, d)
    return np.asarray(pixels[:, 0])
