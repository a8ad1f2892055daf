"""A cloud in a camera's grid in the formats that other programs read. The same cloud gives the same bytes."""

from __future__ import annotations

import io
import json

import numpy as np
import tifffile
from scipy.spatial.transform import Rotation

from slrig.model import FloatArray
from slrig.reconstruction import optical_depths_mm
from slrig.ros_messages import POINT_FIELDS, point_table
from slrig.scan.organised import OrganisedCloud

_MOST = 65535


def encode_npz(cloud: OrganisedCloud) -> bytes:
    """The arrays of a cloud as numpy's own archive, not packed: `numpy.load` reads it, and needs no pickle.

    Keys: points_mm, normals, sigma_mm, colour, mark, cause as in `OrganisedCloud`; causes (n,) str; camera and unit,
    () str.
    """
    out = io.BytesIO()
    np.savez(
        out,
        points_mm=cloud.points_mm,
        normals=cloud.normals,
        sigma_mm=cloud.sigma_mm,
        colour=cloud.colour,
        mark=cloud.mark,
        cause=cloud.cause,
        causes=np.array(cloud.causes),
        camera=np.array(cloud.camera),
        unit=np.array("mm"),
    )
    return out.getvalue()


def encode_depth_tiff(cloud: OrganisedCloud) -> bytes:
    """Depth along the camera's optical axis as a grey TIFF of 16 bits: offset + scale * value in mm, 0 for none.

    The nearest point is 1 and the farthest 65535, so that nothing is cut off; a step is a 65534th of what lies between.
    Scale, offset and unit are in the tag ImageDescription, as JSON, with the camera's matrix and lens: the picture is
    the camera's own, with the lens's distortion.
    """
    known = cloud.cause == 0
    z_mm = depths_mm(cloud)[known]
    offset, scale = 0.0, 1.0
    if len(z_mm):
        nearest = float(z_mm.min())
        scale = (float(z_mm.max()) - nearest) / (_MOST - 1) or 1.0
        offset = nearest - scale
    values = np.zeros(cloud.cause.shape, dtype=np.uint16)
    values[known] = np.clip(np.rint((z_mm - offset) / scale), 1, _MOST)
    told = {
        "depth": "offset + scale * value, along the optical axis",
        "unit": "mm",
        "scale": scale,
        "offset": offset,
        "none": 0,
        "camera": cloud.camera,
        "matrix": cloud.device.matrix.tolist(),
        "distortion": cloud.device.distortion.tolist(),
    }
    out = io.BytesIO()
    tifffile.imwrite(out, values, photometric="minisblack", description=json.dumps(told), metadata=None, software=False)
    return out.getvalue()


def depths_mm(cloud: OrganisedCloud) -> FloatArray:
    """(H, W) float64: depth of each point along the camera's optical axis, NaN for none."""
    points = cloud.points_mm.reshape(-1, 3).astype(np.float64)
    return optical_depths_mm(cloud.device, points).reshape(cloud.cause.shape)


def encode_pcd(cloud: OrganisedCloud) -> bytes:
    """PCD 0.7, binary, organised: x y z and sigma in mm, the normal, and rgb as PCL packs it; NaN where there is none.

    Points are in the world. VIEWPOINT is the camera there: its centre, mm, and the rotation from its axes to the
    world's as a quaternion, w x y z.
    """
    high, wide = cloud.cause.shape
    x, y, z, w = Rotation.from_matrix(cloud.device.rotation.T).as_quat(canonical=True)
    count = len(POINT_FIELDS)
    header = [
        "# .PCD v0.7 - slrig, millimetres",
        "VERSION 0.7",
        f"FIELDS {' '.join(POINT_FIELDS)}",
        f"SIZE {' '.join(['4'] * count)}",
        f"TYPE {' '.join(['F'] * count)}",
        f"COUNT {' '.join(['1'] * count)}",
        f"WIDTH {wide}",
        f"HEIGHT {high}",
        f"VIEWPOINT {' '.join(f'{float(each):.9g}' for each in (*cloud.device.centre_mm, w, x, y, z))}",
        f"POINTS {high * wide}",
        "DATA binary",
    ]
    return "\n".join(header).encode("ascii") + b"\n" + point_table(cloud).tobytes()
