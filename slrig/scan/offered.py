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
    """The picture of a camera's refused pixels.

    >>> rejected_picture("left")
    'rejected-left.png'
    """
    return f"rejected-{camera}.png"


def not_offered(names: Iterable[str], cameras: Iterable[str] | None) -> tuple[str, ...]:
    """The names that no scan has, in the order given. cameras : of the rig; None takes any.

    >>> not_offered(["mesh.ply", "mesh.e57", "rejected-left.png"], ["right"])
    ('mesh.e57', 'rejected-left.png')
    """
    pictures = None if cameras is None else {rejected_picture(camera) for camera in cameras}
    before, after = rejected_picture("\0").split("\0")

    def is_picture(name: str) -> bool:
        return name.startswith(before) and name.endswith(after) if pictures is None else name in pictures

    return tuple(name for name in names if name not in MEDIA_TYPES and name != BUNDLE_ZIP and not is_picture(name))
