"""The files of a finished scan that can be fetched, by name. One list for the service and the command line.

Loads nothing: a command asks it before anything is shot.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Mapping

MEDIA_TYPES: Mapping[str, str] = {
    "mesh.ply": "application/octet-stream",
    "mesh.glb": "model/gltf-binary",
    "mesh.stl": "model/stl",
    "mesh.obj": "model/obj",
    "mesh.3mf": "model/3mf",
    "view.glb": "model/gltf-binary",
    "coarse.glb": "model/gltf-binary",
    "points.ply": "application/octet-stream",
    "report.json": "application/json",
    "preview.png": "image/png",
}
"""Those that every scan that succeeded has."""

BUNDLE_ZIP = "bundle.zip"
"""The recorded frames, of a scan that failed, too."""

CALIBRATION_USED = "calibration.json"
"""The calibration that the mesh was made with: that in the bundle."""


def rejected_picture(camera: str) -> str:
    """The picture of a camera's refused pixels, for people.

    >>> rejected_picture("left")
    'rejected-left.png'
    """
    return f"rejected-{camera}.png"


def causes_picture(camera: str) -> str:
    """The same for programs: grey, a camera pixel each, whose value is the place of its cause in the report's `causes`.

    >>> causes_picture("left")
    'causes-left.png'
    """
    return f"causes-{camera}.png"


CLOUDS: Mapping[str, str] = {
    "points-{camera}.npz": "application/octet-stream",
    "points-{camera}.pcd": "application/octet-stream",
    "depth-{camera}.tiff": "image/tiff",
    "points-{camera}.e57": "model/e57",
}
"""The surface in the grid of a camera, made when asked for by `slrig.scan.cloud_files`: names and media types."""

BAG = "scan.mcap"
"""The scan as a ROS 2 bag, made when asked for by `slrig.scan.cloud_files`, too: all cameras in one."""

ON_DEMAND: Mapping[str, str] = {**CLOUDS, BAG: "application/octet-stream"}
"""What the worker makes: names and media types."""

PREFIXES = ("rejected-", "causes-", *sorted({form.partition("{")[0] for form in CLOUDS}))
"""With which the name of a camera's file begins."""


def camera_files(camera: str) -> tuple[str, ...]:
    """The names of a camera's files.

    >>> camera_files("left")[:3]
    ('rejected-left.png', 'causes-left.png', 'points-left.npz')
    """
    return rejected_picture(camera), causes_picture(camera), *(form.format(camera=camera) for form in CLOUDS)


_EXTRAS = {".e57": ("pye57", "e57"), ".mcap": ("rosbags", "ros")}
"""Endings of files that take a library that slrig does not bring, and the extra that does."""


def extra_of(ending: str) -> str | None:
    """What to install before files of this ending can be made; None where nothing is missing, or needed."""
    library, _ = _EXTRAS.get(ending, (None, ""))
    return None if library is None or importlib.util.find_spec(library) is not None else installed_by(ending)


def installed_by(ending: str) -> str | None:
    """What to install where files of this ending are made; None where nothing is needed.

    >>> installed_by(".e57"), installed_by(".npz")
    ("pip install 'slrig[e57]'", None)
    """
    return f"pip install 'slrig[{_EXTRAS[ending][1]}]'" if ending in _EXTRAS else None


def on_demand(name: str, cameras: Iterable[str]) -> tuple[str, str | None] | None:
    """Which of `ON_DEMAND` a name means, and of which camera; None where it means none.

    >>> on_demand("points-left.npz", ["left", "right"]), on_demand("scan.mcap", ["left"])
    (('points-{camera}.npz', 'left'), ('scan.mcap', None))
    """
    if name == BAG:
        return BAG, None
    known = ((form, camera) for camera in cameras for form in CLOUDS)
    return next((each for each in known if each[0].format(camera=each[1]) == name), None)


def offered(cameras: Iterable[str]) -> tuple[str, ...]:
    """The names of a scan's files. cameras : of the rig.

    >>> offered(["left"])[-4:]
    ('points-left.e57', 'scan.mcap', 'calibration.json', 'bundle.zip')
    """
    of_cameras = (name for camera in cameras for name in camera_files(camera))
    return *MEDIA_TYPES, *of_cameras, BAG, CALIBRATION_USED, BUNDLE_ZIP
