"""The files of a finished scan that can be fetched, by name. One list for the service and the command line.

Loads nothing: a command asks it before anything is shot.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

MEDIA_TYPES: Mapping[str, str] = {
    "mesh.ply": "application/octet-stream",
    "mesh.glb": "model/gltf-binary",
    "mesh.stl": "model/stl",
    "mesh.obj": "model/obj",
    "view.glb": "model/gltf-binary",
    "coarse.glb": "model/gltf-binary",
    "points.ply": "application/octet-stream",
    "report.json": "application/json",
    "preview.png": "image/png",
}
"""Those that every scan that succeeded has."""

BUNDLE_ZIP = "bundle.zip"
"""The recorded frames, of a scan that failed, too."""


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


CAMERA_PICTURES = (rejected_picture, causes_picture)


def offered(cameras: Iterable[str]) -> tuple[str, ...]:
    """The names of a scan's files. cameras : of the rig.

    >>> offered(["left"])[-3:]
    ('rejected-left.png', 'causes-left.png', 'bundle.zip')
    """
    return *MEDIA_TYPES, *(named(camera) for camera in cameras for named in CAMERA_PICTURES), BUNDLE_ZIP
